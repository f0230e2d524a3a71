"""The stabilised clip as H.264: each frame rectified onto the base image, under the field, tracks, vehicles and speeds.

Written frame by frame at the frames' true times: memory does not grow with the flight.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage, IntArray, Mask, RGBImage
from schemas.export import ExportOptions
from velfield.errors import InputError
from velfield.exports.pictures.figures import resized_map
from velfield.field.segments import Segments
from velfield.report.colours import ramp_colours
from velfield.report.figures import MapScale, colour_scale_max, round_up
from velfield.report.panel import Legend, legend_panel
from velfield.run.run import Run

FILE_NAME = "video.mp4"
Progress = Callable[[int, int], None]

_DEFAULT_WIDTH_PX = 1920
_MAX_SIDE_PX = 8192
"""Maximum side of an H.264 video that players read."""
_TICKS = 90_000
_DIMMED, _OUTSIDE, _FIELD = 0.75, 0.4, 0.4
"""Brightness of the frame, and of the base image where the frame does not reach; opacity of the field."""
_TRAIL_S, _SPEED_S = 3.0, 0.5
"""Length of the tracks drawn, and half the time over which the speed shown is."""
_LENGTH_M, _WIDTH_M, _UNKNOWN_LENGTH_PX = 4.5, 1.9, 20.0
_MIN_BOX_PX, _MIN_LABELLED_PX = 6.0, 8.0
_LABEL_SIZE = 0.4
_PARKED = np.array([154, 160, 168])
_SHIFT = 4
"""Binary digits of a pixel's fraction in OpenCV's drawing."""


def write(run: Run, path: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the video to a local file.

    Raises
    ------
    InputError
        It would be too large, or the run has no images: it was made from tracks or merged, or no frame is registered.
    """
    import av  # loaded by this format alone

    run.require_frames()
    if not run.has_frames:
        raise InputError(
            f"{run.layout.root} was made from tracks and has no images for a video; replay it by `velfield view`, or "
            "export another format, such as speed or poster"
        )
    scene = _Scene.of(run, options)
    frames = [k for k, status in enumerate(run.registration_status) if status == "ok"]
    if not frames:
        raise InputError(
            f"{run.layout.root}: found no registered frame, expected some for a video; the report says why none is"
        )
    times_s = run.times_s
    seconds = float(times_s[frames[-1]] - times_s[frames[0]])
    rate = Fraction((len(frames) - 1) / seconds if seconds > 0 else 5.0).limit_denominator(1000)
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": "21", "preset": "veryfast"})
        stream.height, stream.width = (side - side % 2 for side in scene.shape)
        stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, _TICKS)
        stream.codec_context.time_base = stream.time_base
        for done, (frame, image) in enumerate(_images(run, scene, frames), 1):
            picture = av.VideoFrame.from_ndarray(image[: stream.height, : stream.width], format="rgb24")
            picture.pts = round((times_s[frame] - times_s[frames[0]]) * _TICKS)
            picture.time_base = stream.time_base
            container.mux(stream.encode(picture))
            progress(done, len(frames))
        container.mux(stream.encode())


def _images(run: Run, scene: "_Scene", frames: list[int]) -> Iterator[tuple[int, RGBImage]]:
    for frame in frames:
        rectified = run.rectified_frame(frame, scale=scene.scale)
        if rectified is not None:
            yield frame, scene.draw(*rectified, float(run.times_s[frame]))


@dataclass(frozen=True)
class _Scene:
    """Parts that are the same in all images of the video, at its size."""

    scale: float
    """Video pixels a base pixel."""
    base: GreyImage
    """(h, w) base image."""
    field: RGBImage
    known: Mask
    """(h, w, 3) colours of the modal speed, and (h, w) where vehicles move."""
    panel: RGBImage
    """(h, legend, 3) legend."""
    top_px_per_s: float
    """Speed of the last colour."""
    legend_scale: MapScale
    """For speeds as text."""
    tracks: "_Tracks"

    @classmethod
    def of(cls, run: Run, options: ExportOptions) -> "_Scene":
        width = options.width_px or min(run.grid.width_px, _DEFAULT_WIDTH_PX)
        slow, speed = run.field.stationary_speed_px_per_s, run.field.modal_speed_px_per_s()
        shown = resized_map(run, np.where(speed >= slow, speed, np.nan), options.model_copy(update={"width_px": width}))
        if max(shown.grey.shape) > _MAX_SIDE_PX:
            raise InputError(
                f"--width {width}: found a video of {shown.grey.shape[1]} x {shown.grey.shape[0]} px, expected at most "
                f"{_MAX_SIDE_PX}; give less"
            )
        scale = MapScale(gsd_m=run.grid.gsd_m, unit=options.unit, north_rad=shown.scale.north_rad)
        top = round_up(colour_scale_max(scale.shown_speed(speed)) or 10.0)
        note = (
            "Boxes: vehicles, at their speed; grey: what stands throughout. Lanes, paler: the speed of most vehicles."
        )
        title = f"Speed, {scale.shown_unit}"
        legend = Legend(title, note, "speed", top, shown.scale.gsd_m, shown.scale.north_rad)
        panel = legend_panel(shown.grey.shape, legend)
        per_px_per_s = float(scale.shown_speed(np.ones(1))[0])
        return cls(
            scale=width / run.grid.width_px,
            base=shown.grey,
            field=ramp_colours(scale.shown_speed(shown.layer) / top),
            known=np.isfinite(shown.layer),
            panel=panel,
            top_px_per_s=top / per_px_per_s,
            legend_scale=scale,
            tracks=_Tracks.of(run, slow),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of an image."""
        return self.base.shape[0], self.base.shape[1] + self.panel.shape[1]

    def draw(self, grey: GreyImage, inside: Mask, time_s: float) -> RGBImage:
        """An image of the video, (h, w + legend, 3)."""
        dimmed = np.where(inside, grey * _DIMMED, self.base * _OUTSIDE).astype(np.uint8)
        image = np.ascontiguousarray(np.repeat(dimmed[..., None], 3, axis=2))
        tinted = cv2.addWeighted(image, 1 - _FIELD, self.field, _FIELD, 0)
        np.copyto(image, tinted, where=self.known[..., None])
        self._draw_trails(image, time_s)
        self._draw_vehicles(image, time_s)
        self._write(image, f"{int(time_s // 60)}:{time_s % 60:04.1f}", (12, image.shape[0] - 14), 0.9)
        return np.hstack([image, self.panel])

    def _draw_trails(self, image: RGBImage, time_s: float) -> None:
        rows = self.tracks.between(time_s - _TRAIL_S, time_s)
        rows = rows[~self.tracks.parked[rows]]
        ends = self._place(self.tracks.ends_px[rows].reshape(-1, 2)).reshape(-1, 2, 2)
        colours = ramp_colours(self.tracks.speed[rows] / self.top_px_per_s).tolist()
        for line, colour in zip(ends, colours, strict=True):
            cv2.line(image, line[0].tolist(), line[1].tolist(), colour, 1, cv2.LINE_AA, _SHIFT)

    def _draw_vehicles(self, image: RGBImage, time_s: float) -> None:
        rows = self.tracks.at(time_s)
        fraction = ((time_s - self.tracks.start_s[rows]) / self.tracks.duration_s[rows])[:, None]
        ends = self.tracks.ends_px[rows]
        centre = ends[:, 0] + fraction * (ends[:, 1] - ends[:, 0])
        gsd_m = self.legend_scale.gsd_m
        car = max(self.scale * (_UNKNOWN_LENGTH_PX if gsd_m is None else _LENGTH_M / gsd_m), _MIN_BOX_PX)
        length = car * self.tracks.cars_long[rows]
        boxes = _boxes(centre, self.tracks.axis_rad[rows], length / self.scale, car / self.scale * _WIDTH_M / _LENGTH_M)
        corners = self._place(boxes.reshape(-1, 2)).reshape(-1, 4, 2)
        parked, speed = self.tracks.parked[rows], self.tracks.speed[rows]
        colours = np.where(parked[:, None], _PARKED, ramp_colours(speed / self.top_px_per_s))
        for box, colour in zip(corners, colours.tolist(), strict=True):
            cv2.fillConvexPoly(image, box, colour, cv2.LINE_AA, _SHIFT)
            cv2.polylines(image, [box], True, (0, 0, 0), 1, cv2.LINE_AA, _SHIFT)
        if car < _MIN_LABELLED_PX:
            return
        shown = self.legend_scale.shown_speed(speed)
        heading = (ends[:, 1] - ends[:, 0]) / np.maximum(np.hypot(*(ends[:, 1] - ends[:, 0]).T), 1e-9)[:, None]
        places = self._place(centre) / 2**_SHIFT
        moving = np.flatnonzero(~parked & (shown >= 0.5))  # colour shows who waits: a queue would be full of zeros
        self._write_speeds(image, shown[moving], places[moving], heading[moving], length[moving])

    def _write_speeds(
        self, image: RGBImage, shown: FloatArray, places: FloatArray, heading: FloatArray, length: FloatArray
    ) -> None:
        """Speeds behind their vehicles, in their own lanes, beside them they would be the next one's; the fastest
        first, and none over another."""
        taken = np.zeros((0, 4))
        for k in np.argsort(-shown, kind="stable"):
            text = f"{shown[k]:.0f}"
            (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, _LABEL_SIZE, 1)
            reach = 0.5 * (length[k] + abs(heading[k, 0]) * width + abs(heading[k, 1]) * height) + 2
            x, y = places[k] - reach * heading[k]
            box = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
            if ((taken[:, :2] < box[2:] + 1) & (box[:2] - 1 < taken[:, 2:])).all(axis=1).any():
                continue
            taken = np.vstack([taken, box])
            self._write(image, text, (round(box[0]), round(box[3])), _LABEL_SIZE)

    def _place(self, xy_px: FloatArray) -> IntArray:
        """Base pixels as OpenCV's fixed-point pixels of the video."""
        fixed: IntArray = np.rint(((xy_px + 0.5) * self.scale - 0.5) * 2**_SHIFT).astype(np.int32)
        return fixed

    @staticmethod
    def _write(image: RGBImage, text: str, at: tuple[int, int], size: float) -> None:
        for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, thickness, cv2.LINE_AA)


def _boxes(centre: FloatArray, axis_rad: FloatArray, length_px: FloatArray, width_px: float) -> FloatArray:
    """(n, 4, 2) corners of vehicles."""
    axis = np.stack([np.cos(axis_rad), np.sin(axis_rad)], axis=1)
    along, across = axis * length_px[:, None] / 2, np.stack([-axis[:, 1], axis[:, 0]], axis=1) * width_px / 2
    return centre[:, None] + np.stack([along + across, along - across, -along - across, -along + across], axis=1)


@dataclass(frozen=True)
class _Tracks:
    """Segments of all tracks by the time of their start, (n,) each; ends (n, 2, 2); ``cars_long``: the length of the
    vehicle over a car's, 1 where it was not measured."""

    start_s: FloatArray
    duration_s: FloatArray
    ends_px: FloatArray
    speed: FloatArray
    axis_rad: FloatArray
    cars_long: FloatArray
    parked: Mask

    @classmethod
    def of(cls, run: Run, stationary_px_per_s: float) -> "_Tracks":
        segments, vehicles = run.segments(), run.vehicles().set_index("track_id")
        velocity = _smoothed_velocity(segments)
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        mine = vehicles.loc[segments["track"]]
        axis = np.nan_to_num(mine["orientation_rad"].to_numpy(np.float64))
        heading = np.arctan2(velocity[:, 1], velocity[:, 0])
        order = np.argsort(segments["start_s"], kind="stable")
        ends = np.stack([np.stack([segments[f"{c}{k}_px"] for c in "xy"], axis=1) for k in (0, 1)], axis=1)
        return cls(
            start_s=segments["start_s"][order],
            duration_s=segments["duration_s"][order],
            ends_px=ends[order],
            speed=speed[order],
            axis_rad=np.where(speed > stationary_px_per_s, heading, axis)[order],
            cars_long=np.nan_to_num(np.maximum(mine["length_m"], 2 * _WIDTH_M) / _LENGTH_M, nan=1.0)[order],
            parked=(mine["state"] == "parked").to_numpy()[order],
        )

    def between(self, first_s: float, last_s: float) -> IntArray:
        """Segments that begin in a stretch of time, before its end."""
        return np.arange(*np.searchsorted(self.start_s, [first_s, last_s]))

    def at(self, time_s: float) -> IntArray:
        """The segments that last at a time; of a vehicle at a frame between two of its segments, the earlier one."""
        longest = float(self.duration_s.max(initial=0.0))
        rows = self.between(time_s - longest - 1e-6, time_s - 1e-6)
        return rows[self.start_s[rows] + self.duration_s[rows] >= time_s - 1e-6]


def _smoothed_velocity(segments: Segments) -> FloatArray:
    """(n, 2) velocity of each segment's vehicle over a second around it, px/s."""
    smooth = np.empty((len(segments), 2))
    bounds = np.flatnonzero(np.diff(segments["track"], prepend=-1, append=-1))
    for first, last in pairwise(bounds):
        mine = segments[first:last]
        t = np.append(mine["start_s"], mine["start_s"][-1] + mine["duration_s"][-1])
        middle = mine["start_s"] + mine["duration_s"] / 2
        before, after = np.maximum(middle - _SPEED_S, t[0]), np.minimum(middle + _SPEED_S, t[-1])
        for k, axis in enumerate("xy"):
            place = np.append(mine[f"{axis}0_px"], mine[f"{axis}1_px"][-1])
            smooth[first:last, k] = (np.interp(after, t, place) - np.interp(before, t, place)) / (after - before)
    return smooth
