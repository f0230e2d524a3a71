"""The flight's configuration: one frozen model a stage, the paper's number beside each default.

"Paper" is Rosten, Loveland, Hickman, "Automatic creation of urban velocity fields from aerial video". A stage function
takes its own section and nothing else, so that a changed number redoes only the stages that read it.
"""

from collections.abc import Mapping
from math import pi
from typing import Annotated, Literal, Self

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from schemas.detector import CnnConfig, DetectionConfig
from schemas.model import Model

Every = PositiveInt | Literal["auto"]
Preset = Literal["best", "fast", "paper"]
Device = Literal["auto", "cpu", "cuda"]

STATIONARY_SPEED_M_PER_S = 1.15
"""Below this speed a vehicle is stationary and its direction of motion is undefined. Paper: 5 px/s."""


class FramesConfig(Model):
    """Which frames of the source are processed."""

    every: Every = "auto"
    """Take every n-th source frame; ``auto``: the frames nearest to ``target_interval_s`` apart."""
    target_interval_s: PositiveFloat = 0.2
    """Working interval that ``every = auto`` aims at, s. Paper: about 5 frames a second."""
    start_s: float | None = None
    """Skip frames before this time, s from the first frame."""
    stop_s: float | None = None
    """Skip frames at or after this time, s from the first frame."""
    fps: PositiveFloat | None = None
    """Frame rate of a folder of images without time stamps; ignored if the source has them."""
    max_pixels: PositiveInt = 400_000_000
    """A larger image is refused before memory is allocated."""

    @model_validator(mode="after")
    def _has_time(self) -> Self:
        if self.start_s is not None and self.stop_s is not None and self.stop_s <= self.start_s:
            raise ValueError(
                f"stop_s = {self.stop_s:g} (--stop-s) must be later than start_s = {self.start_s:g} (--start-s); both "
                "count from the first frame, in s"
            )
        return self


class LensConfig(Model):
    """Radial distortion from the plumb-line constraint (paper: camera calibration)."""

    calibrate: Literal["auto", "always", "never"] = "auto"
    """``auto``: calibrate, and keep the pinhole model where no distortion is significant."""
    refine: Literal["auto", "never"] = "auto"
    """``auto``: refine the lens by a multi-view estimate, from matched points of frames that see the same ground in
    different parts of the image, where it lowers the hold-out error. Paper: straight lines alone."""
    frames: PositiveInt = 12
    """Number of frames, spread over the flight, that give edge points and matches."""
    max_edge_points: PositiveInt = 40_000
    """Maximum number of edge points of all frames together."""
    angle_bins: PositiveInt = 720
    """Bins of the histogram of line angles, whose entropy is minimal for straight lines."""
    max_distortion: PositiveFloat = 0.6
    """Largest |a| of Harris' model r_d = r / sqrt(1 + a r^2) in the search grid; r in half-diagonals."""


class BaseConfig(Model):
    """Base image: inter-sensor registration to a given image, or built from the flight itself."""

    coarse_scale: PositiveFloat = Field(0.25, le=1)
    """Image scale of SIFT for the coarse homography. Paper: 1/4."""
    grid_spacing_px: PositiveInt = 50
    """Spacing of the points matched by normalised cross-correlation. Paper: 50."""
    patch_size_px: PositiveInt = 75
    """Side of the correlated patches. Paper: 75 x 75."""
    search_radius_px: PositiveInt = 40
    """Search radius around the coarse prediction."""
    drop_fraction: PositiveFloat = Field(0.05, lt=1)
    """Fraction of the worst points removed in a round of case deletion. Paper: 5 %."""
    max_mean_error_px: PositiveFloat = 2.0
    """Case deletion ends when the mean error is below this. Paper: 2 px, at which some outliers remain."""
    min_control_points: PositiveInt = 40
    """With fewer control points left, the given image does not show this area."""
    median_frames: PositiveInt = 40
    """At most so many frames, spread over the flight, whose median is the base image if none is given."""


class RegistrationConfig(Model):
    """Each frame to the base image and the previous registered frame jointly (paper: intra-sensor registration)."""

    model: Literal["row_spline", "polyprojective", "homography"] = "row_spline"
    """``row_spline``: second-order polyprojective transform and a spline in the row (rolling shutter), fitted jointly
    by robust least squares; ``polyprojective``: the paper's, by case deletion; ``homography``: eight parameters."""
    row_spline_knots: PositiveInt = Field(48, ge=4)
    """Knots of the row spline, which represents up to a third as many cycles a frame. Its stiffness is cross-validated
    for each frame, so that more knots than needed do no harm."""
    start: Literal["optical_flow", "keypoints"] = "optical_flow"
    """Start of a frame's fit: the frame before, by optical flow, with keypoints for the first of a chain and
    wherever that fails; or the keypoints of every frame."""
    max_keypoints: PositiveInt = 4000
    """Keypoints kept a frame, spread by cells."""
    keypoint_scale: PositiveFloat = Field(0.5, le=1)
    """Image scale of keypoint detection (an image beyond 5 megapixels is reduced to these first); matches are refined
    below the pixel at full size."""
    match_search_px: PositiveInt = 50
    """Side of the square around the predicted position in which a match is searched. Paper: 50 x 50."""
    drop_fraction: PositiveFloat = Field(0.05, lt=1)
    """Fraction of the worst control points removed in a round of case deletion. Paper: 5 %."""
    max_mean_error_px: PositiveFloat = 0.8
    """Case deletion ends when the mean error is below this. Paper: 2 px, at which 10 % wrong matches remain."""
    cell_size_px: PositiveInt = 120
    """Cell of the displacement mesh, whose stiffness is cross-validated. Paper: 200 x 200."""
    mesh: bool = True
    """Whether the residual displacement is modelled by a mesh."""
    min_control_points: PositiveInt = 40
    """With fewer inliers the frame is not registered."""
    max_residual_px: PositiveFloat = 3.0
    """With a larger hold-out RMS the frame is not registered."""
    chain_length_frames: PositiveInt = 64
    """Frames registered one to the next before the chain starts again from the base image."""


class TrackingConfig(Model):
    """Tracklets over three frames (paper: tracking). Limits are physical; jitter widens them by ``jitter_sigmas``."""

    max_speed_m_per_s: PositiveFloat = 34.5
    """Paper: 30 px a frame, that is 78 mph."""
    max_turn_rad: PositiveFloat = Field(0.5235987755982988, le=pi)
    """Paper: 30 degrees between the two segments."""
    max_axis_offset_rad: PositiveFloat = Field(0.5235987755982988, le=pi / 2)
    """Paper: motion within 30 degrees of the car's axis."""
    stationary_speed_m_per_s: PositiveFloat = STATIONARY_SPEED_M_PER_S
    """Below this speed a vehicle is stationary: its direction of motion is not tested. Paper: 5 px/s."""
    max_acceleration_m_per_s2: PositiveFloat = 23.0
    """Paper: 4 px/frame^2, that is 100 px/s^2 at 5 Hz."""
    jitter_sigmas: PositiveFloat = 3.0
    """Gates are widened by this many standard deviations of a detection's position."""
    jitter_px: PositiveFloat = 1.0
    """Standard deviation of a detection's position, without the registration error, base px."""
    max_interval_s: PositiveFloat = 0.45
    """Consecutive frames of a window are no farther apart than this."""
    linking: Literal["joint", "pairwise"] = "joint"
    """``joint``: the two links of a three-frame window are chosen together, by appearance and motion; ``pairwise``: the
    paper's, each link the mutual best by SAD, then the gates."""
    min_confidence: float = Field(0.8, ge=0, lt=1)
    """Tracklets of a lower posterior probability, against alternatives and false alarms, are dropped."""
    refine: bool = True
    """Refine the displacement of a link by aligning its patches below the pixel."""
    max_gap_s: float = Field(4.0, ge=0)
    """Longest gap in the track of a vehicle that drives on that gap closing bridges; 0: none."""
    max_stationary_gap_s: float = Field(60.0, ge=0)
    """The same for a vehicle that stands, or stops and sets off again, in the gap."""
    max_hidden_gap_s: float = Field(15.0, ge=0)
    """The same for a vehicle that creeps under trees, say, where its lane, order and looks determine which it is."""
    doubt: bool = True
    """Set aside what stands far from vehicles with a low score: roof gear, sheds. Read with the scores of the network
    alone, not with those of the paper's detector, an ONNX model, or given boxes."""

    @model_validator(mode="after")
    def _has_moving_vehicles(self) -> Self:
        if self.stationary_speed_m_per_s >= self.max_speed_m_per_s:
            raise ValueError(
                f"stationary_speed_m_per_s {self.stationary_speed_m_per_s:g} is not below max_speed_m_per_s "
                f"{self.max_speed_m_per_s:g}: no vehicle could move"
            )
        return self


_MAX_BINS = 200
"""Velocity bins an axis: a pixel has their square."""


class FieldConfig(Model):
    """The velocity histogram at every pixel (paper: velocity model)."""

    bin_width_m_per_s: PositiveFloat = 2.0
    """Width of a velocity bin; modes are located below it."""
    kernel_sigma_m_per_s: PositiveFloat = 0.7
    """Gaussian kernel of a segment; maximises the hold-out likelihood of real tracks. The paper gives no width."""
    velocity_span_s: float = Field(0.6, ge=0)
    """A segment's velocity is averaged along its track over this time; 0, as in preset ``paper``: not averaged."""
    max_speed_m_per_s: PositiveFloat = 36.0
    """Largest velocity component that the histogram covers, in either direction."""
    lane_width_m: PositiveFloat = 3.5
    """Width of a lane, from which the width of a path follows."""
    path_width: Literal["lane", "pixel"] = "lane"
    """Width of the path that a segment is accumulated along. ``lane``: half of ``lane_width_m``; ``pixel``: one pixel,
    as in the paper."""
    shared_segment_weight: Literal[1, 2] = 1
    """Weight of a segment that two tracklets share. Paper: 2."""
    tile_size_px: PositiveInt = Field(64, ge=8, le=512)
    """Side of a stored tile, base px."""
    stationary_speed_m_per_s: PositiveFloat = STATIONARY_SPEED_M_PER_S
    """Below this speed a vehicle is stationary: no direction is drawn where the modal speed is below it."""
    time_weighted: bool = True
    """Keep a time-weighted histogram too (``velocity_histogram_time_weighted``): its speeds are space-mean, as a camera
    sees them at a random moment; those of the other are time-mean, as a detector in the road counts them."""
    time_intervals: str | None = None
    """Accumulate a field for each time interval too: a length (``15min``), or intervals (``0-300,300-900`` or
    ``07:00-09:00``)."""

    @model_validator(mode="after")
    def _has_bins(self) -> Self:
        bins = 2 * self.max_speed_m_per_s / self.bin_width_m_per_s
        if not 2 <= bins <= _MAX_BINS:
            raise ValueError(
                f"bin_width_m_per_s {self.bin_width_m_per_s:g} and max_speed_m_per_s {self.max_speed_m_per_s:g} make "
                f"{bins:.0f} bins an axis, expected 2 to {_MAX_BINS}"
            )
        return self


class WorkConfig(Model):
    """Division of the work into units, which is independent of the number of workers."""

    block_frames: PositiveInt = Field(8, le=4096)
    """Frames a Dask block; one-frame blocks cost 10 ms each."""
    unit_frames: Annotated[int, Field(ge=1, le=65536)] | Literal["auto"] = "auto"
    """Frames a unit: what is committed, retried or lost as a whole; ``auto``: all of
    16 frames, else an even number of units of at most 32 up to 256 frames, 64 up to 4096, then 256."""
    previews: bool = True
    """Make maps of a long flight while it is processed: of its first frames, then of all that are through."""
    retries: int = Field(2, ge=0, le=100)
    """Retries of a unit that failed."""
    device: Device = "auto"
    """Where the detector's network is run: ``cpu``; ``cuda``, an NVIDIA GPU; ``auto``: a GPU that onnxruntime can use,
    else the processor. Results differ in their last bits, and nothing is computed again for another device."""


class FlightConfig(Model):
    """The configuration of a run. ``gsd_m`` and ``preset`` concern several stages."""

    preset: Preset = "best"
    """The set of defaults that this configuration started from."""
    gsd_m: float | None = Field(None, ge=0.001, le=5)
    """Ground sample distance of the base image, m a pixel; None: from its CRS, the metadata or the vehicles."""
    position_unit: Literal["m", "ft", "cm", "mm", "px", "deg"] | None = None
    """Unit of the columns x and y of `velfield run --tracks`, where their names do not say it."""
    position_y_axis: Literal["up", "down"] | None = None
    """Where y points in the tracks of `velfield run --tracks`: up (north) or down, where the format does not say it."""
    frames: FramesConfig = FramesConfig()
    lens: LensConfig = LensConfig()
    base: BaseConfig = BaseConfig()
    registration: RegistrationConfig = RegistrationConfig()
    detection: DetectionConfig = CnnConfig()
    tracking: TrackingConfig = TrackingConfig()
    field: FieldConfig = FieldConfig()
    work: WorkConfig = WorkConfig()


PAPER_GSD_M = 0.23
"""The paper's ground sample distance, by which limits in metres become pixels where none is known."""


def assumed_gsd_m(gsd_m: float | None) -> float:
    """A ground sample distance, the paper's where none is known: for limits and pictures, never for a figure."""
    return gsd_m or PAPER_GSD_M


PRESETS: dict[Preset, dict[str, dict[str, object]]] = {
    "best": {},
    "fast": {
        "registration": {"max_keypoints": 1500, "keypoint_scale": 0.25},
        "detection": {"method": "cnn", "fine_tune_steps": 120},
    },
    "paper": {
        "lens": {"refine": "never"},
        "registration": {
            "model": "polyprojective",
            "start": "keypoints",
            "max_mean_error_px": 2.0,
            "keypoint_scale": 1.0,
            "cell_size_px": 200,
        },
        "detection": {"method": "paper"},
        "tracking": {"refine": False, "linking": "pairwise", "min_confidence": 0.0, "doubt": False},
        "field": {"path_width": "pixel", "shared_segment_weight": 2, "velocity_span_s": 0.0},
    },
}
"""Preset -> the values that differ from the defaults."""

_CALIBRATED: Mapping[str, tuple[object, ...]] = {"lens.calibrate": ("auto", "always")}
_CASE_DELETION: Mapping[str, tuple[object, ...]] = {"registration.model": ("polyprojective",)}
_MESH: tuple[object, ...] = ("row_spline", "polyprojective")
READ_WITH: Mapping[str, Mapping[str, tuple[object, ...]]] = {
    "frames.target_interval_s": {"frames.every": ("auto",)},
    "lens.refine": _CALIBRATED,
    "lens.frames": _CALIBRATED,
    "lens.max_edge_points": _CALIBRATED,
    "lens.angle_bins": _CALIBRATED,
    "lens.max_distortion": _CALIBRATED,
    "registration.start": {"registration.model": ("row_spline", "homography")},
    "registration.row_spline_knots": {"registration.model": ("row_spline",)},
    "registration.drop_fraction": _CASE_DELETION,
    "registration.max_mean_error_px": _CASE_DELETION,
    "registration.mesh": {"registration.model": _MESH},
    "registration.cell_size_px": {"registration.mesh": (True,), "registration.model": _MESH},
    "field.lane_width_m": {"field.path_width": ("lane",)},
    "field.velocity_span_s": {"field.shared_segment_weight": (1,)},
}
"""Key -> the keys that decide whether it is read, and their values with which it is."""
