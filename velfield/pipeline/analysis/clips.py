"""Strips of pictures of the unusual tracks: five moments around each, cut from the frames on the base image's grid."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.unusual import Unusual
from velfield.errors import StoreError
from velfield.registration.warp import warp_to_base

if TYPE_CHECKING:
    from velfield.registration.warp import RawToBase

MAX_CLIPS = 40
"""Unusual tracks that get a strip: each costs five frames to read."""
_MOMENTS_S = (-2.0, -1.0, 0.0, 1.0, 2.0)
_SIDE_M, _SIDE_PX = 50.0, 220
_EDGE_PX = 4


@dataclass(frozen=True)
class Frames:
    """Where pictures come from."""

    times_s: FloatArray
    """(frames,) times, s."""
    read: Callable[[int], GreyImage]
    """Returns a raw frame (h, w)."""
    transform: "Callable[[int], RawToBase | None]"
    """Returns a frame's map of raw to base pixels; None: it is not registered."""


def unusual_clips(analysis: TrafficAnalysis, frames: Frames) -> Iterator[tuple[int, bytes]]:
    """JPEG strips of the unusual tracks, by their number in ``analysis.unusual``; none where no frame is there."""
    for number, found in enumerate(analysis.unusual[:MAX_CLIPS]):
        strip = make_strip(analysis, frames, found)
        if strip is not None:
            done, data = cv2.imencode(".jpg", strip, [cv2.IMWRITE_JPEG_QUALITY, 80])
            if done:
                yield number, data.tobytes()


def make_strip(analysis: TrafficAnalysis, frames: Frames, found: Unusual) -> GreyImage | None:
    """Pictures side by side, two seconds before to two after, the vehicle in a ring; None where no frame is there."""
    tracks = analysis.trajectories
    rows = slice(int(tracks.first[found.track]), int(tracks.first[found.track + 1]))
    time, xy = tracks.time_s[rows], tracks.xy_m[rows] / tracks.gsd_m
    centre = [float(np.interp(found.time_s, time, xy[:, k])) for k in (0, 1)]
    side = _SIDE_M / tracks.gsd_m
    corner = [round(c - side / 2) for c in centre]
    window = (corner[0], corner[1], round(side), round(side))
    parts: list[GreyImage] = []
    for moment in _MOMENTS_S:
        frame = int(np.argmin(np.abs(frames.times_s - (found.time_s + moment))))
        part = _picture(frames, frame, window)
        if part is None:
            part = np.zeros((_SIDE_PX, _SIDE_PX), np.uint8)
        elif time[0] <= frames.times_s[frame] <= time[-1]:
            at = [
                (float(np.interp(frames.times_s[frame], time, xy[:, k])) - corner[k]) * _SIDE_PX / side for k in (0, 1)
            ]
            cv2.circle(part, (round(at[0]), round(at[1])), round(_SIDE_PX * 3.5 / _SIDE_M), 255, 1, cv2.LINE_AA)
        parts += [part, np.full((_SIDE_PX, _EDGE_PX), 255, np.uint8)]
    strip = np.concatenate(parts[:-1], axis=1)
    return strip if any(part.any() for part in parts[::2]) else None


def _picture(frames: Frames, frame: int, window: tuple[int, int, int, int]) -> GreyImage | None:
    transform = frames.transform(frame)
    if transform is None:
        return None
    try:
        raw = frames.read(frame)
    except StoreError:  # frames may have been removed to save space
        return None
    image, inside = warp_to_base(raw, transform, window=window, scale=_SIDE_PX / window[2])
    return cv2.resize(image, (_SIDE_PX, _SIDE_PX)) if inside.any() else None
