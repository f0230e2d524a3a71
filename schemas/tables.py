"""Columns of the tables in a run folder: names end in their unit, pixels are base pixels unless the name says raw."""

DETECTION_COLUMNS: dict[str, str] = {
    "detection_id": "int64",  # frame * 2**20 + index in the frame: unique, and the same however the flight is cut
    "frame": "int32",  # index in frames.zarr
    "time_s": "float64",
    "x_px": "float64",
    "y_px": "float64",
    "orientation_rad": "float32",  # axial, [0, pi), from +x towards +y (down)
    "orientation_sd_rad": "float32",
    "area_px": "float32",
    "score": "float32",
}

TRACKLET_COLUMNS: dict[str, str] = {
    "tracklet_id": "int64",  # the detection_id of its middle detection: a detection is in the middle of at most one
    "track_id": "int64",  # the smallest detection_id of the vehicle's track; -1 until tracklets are chained
    "frame_0": "int32",
    "frame_1": "int32",
    "frame_2": "int32",
    "detection_id_0": "int64",
    "detection_id_1": "int64",
    "detection_id_2": "int64",
    "time_0_s": "float64",
    "time_1_s": "float64",
    "time_2_s": "float64",
    "x_0_px": "float64",
    "y_0_px": "float64",
    "x_1_px": "float64",
    "y_1_px": "float64",
    "x_2_px": "float64",
    "y_2_px": "float64",
    "vx_01_px_per_s": "float64",  # from the refined displacement where there is one
    "vy_01_px_per_s": "float64",
    "vx_12_px_per_s": "float64",
    "vy_12_px_per_s": "float64",
    "displacement_sd_01_px": "float32",
    "displacement_sd_12_px": "float32",
    "sad_01": "float32",  # appearance difference of the two detections, grey levels
    "sad_12": "float32",
    "confidence": "float32",  # [0, 1]
}

TRACK_COLUMNS: dict[str, str] = TRACKLET_COLUMNS | {"recovered": "bool"}
"""Tracklets with the track that they belong to.

``recovered``: of detections that only the track confirmed.
"""

DIMENSION_COLUMNS: dict[str, str] = {
    "track_id": "int64",
    "length_px": "float32",
    "length_sd_px": "float32",  # standard deviation
    "width_px": "float32",
    "width_sd_px": "float32",
    "strips": "int32",  # number of detections that they were measured on
}
"""Dimensions of vehicles, a row a track."""

TRACK_POSITION_COLUMNS: dict[str, str] = {
    "track_id": "int64",  # -1: none, of a doubtful detection
    "frame": "int32",
    "time_s": "float64",
    "x_px": "float64",
    "y_px": "float64",
    "detection_id": "int64",  # -1: interpolated
    "source": "int8",  # index in POSITION_SOURCES
}
"""Where each track's vehicle was in each registered frame, a row a track and frame."""
POSITION_SOURCES = ("tracklet", "candidate", "interpolated")
"""Source of a position: detection in a tracklet; detection, perhaps of a low score, confirmed by the track; or none."""

JOIN_COLUMNS: dict[str, str] = {
    "track_id": "int64",
    "before": "int64",  # ids of the tracks that were joined, as they were before
    "after": "int64",
    "end_time_s": "float64",
    "start_time_s": "float64",
    "probability": "float32",  # that both are one vehicle's
}
"""Joins of tracks over a gap, a row each."""

LABEL_COLUMNS: dict[str, str] = {
    "frame": "str",  # a picture's file name, or a video's 0-based frame index, as text
    "x_px": "float64",  # raw pixels
    "y_px": "float64",
    "orientation_rad": "float64",  # NaN where the label does not give it
    "length_px": "float64",  # NaN where the label does not give it
    "width_px": "float64",
    "abs_box_angle_rad": "float64",  # |angle| of the car's axis to the rows, from the sides of an upright box
}
