"""Length and width of vehicles, measured on strips along their axes, and the classes of vehicles that follow from them.

A strip shows a vehicle whole, with its shadow, the road and its neighbours, at half the resolution
(`velfield.detection.detect.oriented_strips`). A track's strips are averaged: the road that it passes blurs, the vehicle
does not, and noise falls below the contrast of a black car and its shadow. A small network reads the mean of log length
and log width and their standard deviations off it; it was trained on drawn vehicles (`tools/train_dimensions.py`).
"""

from base64 import b64decode
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import pairwise
from math import prod

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray, Mask
from schemas.detector import DimensionsRecord

STRIP_SHAPE = (32, 10)
"""Along and across the axis; a pixel is two working px."""
_STRIPS = 16
"""Detections of a track that are averaged, spread over it."""
_END_STRIPS = 5
"""Detections at either end of a track that stand for its looks there."""
_MIN_CONTRAST = 8.0
"""Grey levels: below it a strip is not stretched further, as it shows little but noise."""


@dataclass(frozen=True)
class Dimensions:
    """Dimensions of vehicles, px of the strips' full resolution, and their standard deviations; (n,) each."""

    length: FloatArray
    length_sd: FloatArray
    width: FloatArray
    width_sd: FloatArray


def normalise(strips: FloatArray) -> FloatArray:
    """Strips (n, length, width) without brightness and contrast: zero is the road beside the vehicle."""
    if not len(strips):
        return strips
    road = np.median(strips[:, :, [0, 1, -2, -1]], axis=(1, 2))[:, None, None]
    spread = np.sqrt(((strips - road) ** 2).mean(axis=(1, 2)))[:, None, None]
    return np.asarray((strips - road) / np.maximum(spread, _MIN_CONTRAST))


def measure(strips: FloatArray) -> Dimensions:
    """Dimensions of the vehicles of mean strips (n, 32, 10), grey levels.

    Each strip is read in the four orientations that its symmetries give. Their disagreement is part of the standard
    deviation.
    """
    if not len(strips):
        return Dimensions(*np.empty((4, 0)))
    upright = normalise(strips)
    views = [upright[:, ::along, ::across] for along in (1, -1) for across in (1, -1)]
    outputs = np.stack([_forward(view.reshape(len(view), -1)) for view in views])
    mean, sd = outputs[..., :2], np.exp(np.clip(outputs[..., 2:], -5, 1))
    log_size = mean.mean(axis=0)
    log_sd = np.sqrt((sd**2).mean(axis=0) + mean.var(axis=0))
    size = np.exp(log_size)
    (length, width), (length_sd, width_sd) = size.T, (size * log_sd).T
    return Dimensions(length, length_sd, width, width_sd)


@cache
def _layers() -> list[tuple[FloatArray, FloatArray]]:
    text = files("velfield.tracking").joinpath("shipped_dimensions.json").read_text(encoding="utf-8")
    record = DimensionsRecord.model_validate_json(text)
    layers = []
    for k, shape in enumerate(pairwise(record.widths)):
        weights = np.frombuffer(b64decode(record.weights_f16[k]), "<f2", prod(shape)).astype(np.float64)
        layers.append(
            (weights.reshape(shape), np.frombuffer(b64decode(record.biases_f16[k]), "<f2").astype(np.float64))
        )
    return layers


def _forward(x: FloatArray) -> FloatArray:
    *hidden, (weights, biases) = _layers()
    for w, b in hidden:
        x = np.maximum(x @ w + b, 0)
    return np.asarray(x @ weights + biases)


def sample_tracks(tracklets: pd.DataFrame) -> tuple[IntArray, pd.DataFrame]:
    """Detections whose strips stand for each track: some spread over it, and the first and the last ones.

    Parameters
    ----------
    tracklets
        ``track_id``, ``detection_id_{k}``, ``vx_{link}_px_per_s``, ``vy_{link}_px_per_s``.

    Returns
    -------
    (tracks,) ids of the tracks; and a table ``detection_id, track`` (index of the track), ``heading_rad`` of the
    vehicle there, of one that hardly moves its mean over the track, and for what it was chosen: ``spread, start, end``.
    """
    parts = []
    for k, link in ((0, "01"), (1, "12"), (2, "12")):
        names = ["track_id", f"detection_id_{k}", f"vx_{link}_px_per_s", f"vy_{link}_px_per_s"]
        parts.append(tracklets[names].set_axis(["track_id", "detection_id", "vx", "vy"], axis=1))
    table = pd.concat(parts, ignore_index=True).drop_duplicates("detection_id")
    table = table.sort_values(["track_id", "detection_id"], ignore_index=True)  # ids ascend with time
    ids, track = np.unique(table["track_id"].to_numpy(), return_inverse=True)
    size = np.bincount(track, minlength=len(ids))[track]
    rank = np.arange(len(track)) - np.searchsorted(track, track)
    picks = np.minimum(size, _STRIPS)
    mean = table.groupby(track)[["vx", "vy"]].mean().to_numpy()[track]
    v = table[["vx", "vy"]].to_numpy()
    slow = np.hypot(*v.T) < 0.5 * np.hypot(*mean.T)
    v = np.where(slow[:, None], mean, v)
    found = pd.DataFrame(
        {
            "detection_id": table["detection_id"],
            "track": track,
            "heading_rad": np.arctan2(*v.T[::-1]),
            "spread": (rank * picks) // size != ((rank - 1) * picks) // size,
            "start": rank < _END_STRIPS,
            "end": rank >= size - _END_STRIPS,
        }
    )
    return ids, found[found[["spread", "start", "end"]].any(axis=1)].reset_index(drop=True)


def direction_of_axes(axis_rad: FloatArray, heading_rad: FloatArray) -> Mask:
    """(n,) whether each axis points backward along its vehicle's heading."""
    return np.asarray(np.cos(axis_rad - heading_rad) < 0)


def looks(strips: FloatArray) -> FloatArray:
    """Looks of vehicles, (n, 16, 6), from mean strips (n, 32, 10) along their headings: the part of a car."""
    along, across = (STRIP_SHAPE[0] - 16) // 2, (STRIP_SHAPE[1] - 6) // 2
    return normalise(strips)[:, along:-along, across:-across]


def looks_difference(before: FloatArray, after: FloatArray) -> FloatArray:
    """(k,) mean absolute difference of looks (k, 16, 6), either way round; NaN where one is unknown."""
    ways = [np.abs(before - one).mean(axis=(1, 2)) for one in (after, after[:, ::-1, ::-1])]
    return np.asarray(np.minimum(*ways))
