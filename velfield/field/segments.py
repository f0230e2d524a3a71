"""The segment table, the truth that the histogram is built from, and which tiles it touches."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.flight import FieldConfig
from velfield.errors import InputError

SEGMENT_DTYPE = np.dtype(
    [
        ("passage", "i8"),
        ("start_s", "f8"),
        ("duration_s", "f8"),
        ("x0_px", "f8"),
        ("y0_px", "f8"),
        ("x1_px", "f8"),
        ("y1_px", "f8"),
        ("vx_px_per_s", "f8"),
        ("vy_px_per_s", "f8"),
        ("detection_0", "i8"),
        ("detection_1", "i8"),
        ("sd_px_per_s", "f8"),
    ]
)
"""One vehicle from one frame to the next. Sorted by passage, then time: the order that `accumulate_tile` needs.

``sd_px_per_s``: standard deviation of either component of its velocity, by registration and displacement.
"""

_EQUALLY_SURE_PX = 0.15
"""Displacements with a standard deviation below this have about the same say in a mean."""

Segments = NDArray[np.void]
"""(n,) structured array of `SEGMENT_DTYPE`."""


def segment_table(tracklets: pd.DataFrame, config: FieldConfig) -> Segments:
    """The segments of a table of tracklets, two a tracklet, sorted by passage and time.

    A segment that two tracklets share (the second of one, the first of the next) stands once, and its velocity is the
    mean along its passage over ``config.velocity_span_s``; with a ``config.shared_segment_weight`` of 2, as in
    the paper, each stands as it is. A tracklet of no passage (-1) is its own.

    Raises
    ------
    InputError
        Where a place, a velocity or a time is not finite, or an interval is not positive.
    """
    halves = [_half(tracklets, first) for first in (0, 1)]
    segments = np.concatenate(halves)
    _check(segments)
    order = np.lexsort((segments["detection_1"], segments["detection_0"], segments["start_s"], segments["passage"]))
    segments = segments[order]
    if config.shared_segment_weight == 1:
        segments = _averaged(segments[_first_of_equals(segments)], config.velocity_span_s)
    return segments


def _averaged(segments: Segments, span_s: float) -> Segments:
    """Velocities averaged by time over the neighbours, unbroken, whose middles are within half a span.

    The error of a detection's place enters two neighbouring segments with opposite signs, so their mean loses most of
    it; within half a second or so a vehicle's acceleration is constant, and the mean is that of the middle. A segment
    whose crops did not align, and is a pixel or more off, has hardly a say beside those that did.
    """
    if not len(segments):
        return segments
    broken = segments["passage"][1:] != segments["passage"][:-1]
    broken |= segments["detection_0"][1:] != segments["detection_1"][:-1]
    run = np.concatenate([[0], np.cumsum(broken)])
    middle = segments["start_s"] + segments["duration_s"] / 2
    before, after = _neighbours(run, middle, span_s / 2), _neighbours(run[::-1], -middle[::-1], span_s / 2)[::-1]
    # As many on either side; at a run's end one neighbour on the side that is there: more would be another moment.
    reach = np.maximum(np.minimum(before, after), 1)
    before, after = np.minimum(before, reach), np.minimum(after, reach)
    out = segments.copy()
    sd_px = segments["sd_px_per_s"] * segments["duration_s"]
    trust = segments["duration_s"] / (sd_px**2 + _EQUALLY_SURE_PX**2)
    total = _windowed(trust, before, after)
    for name in ("vx_px_per_s", "vy_px_per_s"):
        out[name] = _windowed(segments[name] * trust, before, after) / total
    # Errors of two displacements are taken as independent. Those of places cancel in part, so that where the crops did
    # not align this is a little too large.
    out["sd_px_per_s"] = np.sqrt(_windowed((segments["sd_px_per_s"] * trust) ** 2, before, after)) / total
    return out


def _windowed(values: NDArray[np.float64], before: NDArray[np.int64], after: NDArray[np.int64]) -> NDArray[np.float64]:
    """Sum over the rows from ``before`` rows above to ``after`` rows below each.

    Window by window, not by running sums: these would depend, in the last bit, on which rows are given.
    """
    rows = np.arange(len(values))
    total = np.zeros(len(values))
    for step in range(-int(before.max(initial=0)), int(after.max(initial=0)) + 1):
        mine = rows[(step >= -before) & (step <= after)]
        total[mine] += values[mine + step]
    return total


def _neighbours(run: NDArray[np.int64], middle: NDArray[np.float64], reach_s: float) -> NDArray[np.int64]:
    """How many rows before each belong to its run and lie within ``reach_s`` of its time."""
    count = np.zeros(len(run), np.int64)
    for step in range(1, len(run)):
        near = (run[step:] == run[:-step]) & (np.abs(middle[step:] - middle[:-step]) <= reach_s + 1e-9)
        if not near.any():
            break
        count[step:] += near
    return count


def _half(tracklets: pd.DataFrame, first: int) -> Segments:
    """The segments between detections ``first`` and ``first + 1`` of every tracklet."""
    a, b = first, first + 1
    half = np.zeros(len(tracklets), SEGMENT_DTYPE)
    passage = tracklets["passage_id"].to_numpy()
    # Own passages are negative, so that none meets a chain's id.
    half["passage"] = np.where(passage >= 0, passage, -2 - tracklets["tracklet_id"].to_numpy())
    half["start_s"] = tracklets[f"time_{a}_s"]
    half["duration_s"] = tracklets[f"time_{b}_s"].to_numpy() - tracklets[f"time_{a}_s"].to_numpy()
    half["x0_px"], half["y0_px"] = tracklets[f"x_{a}_px"], tracklets[f"y_{a}_px"]
    half["x1_px"], half["y1_px"] = tracklets[f"x_{b}_px"], tracklets[f"y_{b}_px"]
    half["vx_px_per_s"] = tracklets[f"vx_{a}{b}_px_per_s"]
    half["vy_px_per_s"] = tracklets[f"vy_{a}{b}_px_per_s"]
    half["sd_px_per_s"] = tracklets[f"displacement_sd_{a}{b}_px"] / half["duration_s"]
    half["detection_0"], half["detection_1"] = tracklets[f"detection_id_{a}"], tracklets[f"detection_id_{b}"]
    return half


def _check(segments: Segments) -> None:
    numbers = [name for name in SEGMENT_DTYPE.names or () if SEGMENT_DTYPE[name].kind == "f"]
    finite = np.logical_and.reduce([np.isfinite(segments[name]) for name in numbers])
    bad = ~finite | ~(segments["duration_s"] > 0)
    if bad.any():
        row = segments[int(np.flatnonzero(bad)[0])]
        raise InputError(
            f"{int(bad.sum())} of {len(segments)} tracklet segments are not usable, the first from detection "
            f"{row['detection_0']} to {row['detection_1']} with interval {row['duration_s']} s: places, times and "
            "velocities must be finite and intervals positive; check the tracklets table"
        )


def _first_of_equals(segments: Segments) -> NDArray[np.bool_]:
    """Mask of rows that do not repeat the row before (sorted: the same passage and detections are neighbours)."""
    keep = np.ones(len(segments), bool)
    same = [segments[name][1:] == segments[name][:-1] for name in ("passage", "detection_0", "detection_1")]
    keep[1:] = ~np.logical_and.reduce(same)
    return keep


def segments_by_tile(
    segments: Segments, *, shape: tuple[int, int], tile_size: int, radius_px: float | None
) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Rows of the segments whose band may reach a tile, for every such tile (ty, tx) of a (height, width) grid.

    Rows keep the table's order. A tile that is listed may still turn out empty: bands are boxed here.
    """
    reach = 0.5 if radius_px is None else radius_px
    low_x, high_x = _tile_range(segments["x0_px"], segments["x1_px"], reach, shape[1], tile_size)
    low_y, high_y = _tile_range(segments["y0_px"], segments["y1_px"], reach, shape[0], tile_size)
    across, down = np.maximum(high_x - low_x + 1, 0), np.maximum(high_y - low_y + 1, 0)
    copies = across * down
    rows = np.repeat(np.arange(len(segments)), copies)
    nth = np.arange(len(rows)) - np.repeat(np.cumsum(copies) - copies, copies)
    ty = low_y[rows] + nth // np.maximum(across[rows], 1)
    tx = low_x[rows] + nth % np.maximum(across[rows], 1)
    if not len(rows):
        return {}
    columns = -(-shape[1] // tile_size)
    key = ty * columns + tx
    order = np.argsort(key, kind="stable")
    keys, starts = np.unique(key[order], return_index=True)
    parts = np.split(rows[order], starts[1:])
    return {(int(k) // columns, int(k) % columns): part for k, part in zip(keys, parts, strict=True)}


def _tile_range(
    a: NDArray[np.float64], b: NDArray[np.float64], reach: float, length: int, tile_size: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last tile of an axis that [min - reach, max + reach] meets; last < first where it misses the grid."""
    low = np.ceil(np.minimum(a, b) - reach).clip(0, length)
    high = np.floor(np.maximum(a, b) + reach).clip(-1, length - 1)
    missed = high < low
    first = low.astype(np.int64) // tile_size
    last = np.where(missed, first - 1, high.astype(np.int64) // tile_size)
    return first, last


def touched_tiles(
    segments: Segments, *, shape: tuple[int, int], tile_size: int, radius_px: float | None
) -> list[tuple[int, int]]:
    """The tiles (ty, tx) that `segments_by_tile` lists, in raster order."""
    return sorted(segments_by_tile(segments, shape=shape, tile_size=tile_size, radius_px=radius_px))
