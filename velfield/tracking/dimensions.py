"""Dimensions of vehicles by the sizes of their detections, and their looks by strips along their axes.

The network gives the length and the width of each detection, with their standard deviations. A track has the mean over
its detections. A strip shows a vehicle whole, at half the resolution (`velfield.detection.crops.oriented_strips`). A
track's strips are averaged: the road that it passes blurs, the vehicle does not.
"""

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray, Mask

STRIP_SHAPE = (32, 10)
"""Along and across the axis; a pixel is two working px."""
_STRIPS = 16
"""Detections of a track that are averaged, spread over it."""
_COMMON_VARIANCE = 0.5
"""Fraction of a measurement's variance that all detections of a vehicle have in common, which more of them do not
lessen."""
_OUTLIER_SD = 1.5
"""Standard deviations from the track's median beyond which a measurement counts less (Huber's weight)."""
_END_STRIPS = 5
"""Detections at either end of a track that stand for its looks there."""
_MIN_CONTRAST = 8.0
"""Grey levels: below it a strip is not stretched further, as it shows little but noise."""


def normalise(strips: FloatArray) -> FloatArray:
    """Strips (n, length, width) without brightness and contrast: zero is the road beside the vehicle."""
    if not len(strips):
        return strips
    road = np.median(strips[:, :, [0, 1, -2, -1]], axis=(1, 2))[:, None, None]
    spread = np.sqrt(((strips - road) ** 2).mean(axis=(1, 2)))[:, None, None]
    return np.asarray((strips - road) / np.maximum(spread, _MIN_CONTRAST))


def mean_dimensions(sizes: FloatArray, track: IntArray, count: int) -> FloatArray:
    """Dimensions of tracks by the sizes of some of their detections.

    Parameters
    ----------
    sizes
        (n, 4) length and width, px, and the standard deviations of their logarithms; finite.
    track
        (n,) index of the track of each, below ``count``.

    Returns
    -------
    (count, 5) length and width, px, the standard deviations of their logarithms, and the number of detections; NaN
    where there are none.
    """
    logarithms, variance = np.log(sizes[:, :2]), sizes[:, 2:] ** 2
    number = np.bincount(track, minlength=count).astype(np.float64)
    median = pd.DataFrame(logarithms).groupby(track).median().reindex(range(count)).to_numpy(np.float64)
    off = np.abs(logarithms - median[track])
    weight = np.minimum(1.0, _OUTLIER_SD * np.sqrt(variance) / np.maximum(off, 1e-9)) / variance

    def total(values: FloatArray) -> FloatArray:
        return np.stack([np.bincount(track, values[:, k], count) for k in (0, 1)], axis=1)

    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total(weight * logarithms) / total(weight)
        usual = total(weight * variance) / total(weight)
        share = _COMMON_VARIANCE + (1 - _COMMON_VARIANCE) / number
        return np.column_stack([np.exp(mean), np.sqrt(usual * share[:, None]), number])


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
