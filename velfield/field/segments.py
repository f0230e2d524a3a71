"""The segment table, of which the velocity histogram is built, and the tiles that its segments touch.

The velocity axes of the histogram, and the field's lengths in pixels (paper: velocity model).
"""

from dataclasses import dataclass
from math import ceil

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray, Mask
from schemas.flight import FieldConfig, assumed_gsd_m
from velfield.errors import InputError


def require_gsd_m(gsd_m: float | None) -> float:
    """The ground sample distance, for whoever asks for metres.

    Raises
    ------
    InputError
        It is not known.

    Examples
    --------
    >>> require_gsd_m(0.23)
    0.23
    """
    if gsd_m is None:
        raise InputError(
            "the run has no scale, so metres and km/h are unknown; run it again with "
            "--gsd-m, georeference it (`velfield georeference RUN`), or use px and px/s"
        )
    return gsd_m


@dataclass(frozen=True)
class VelocityBins:
    """Square bins of velocity, the same on both axes, one of them centred on zero velocity.

    The outermost bins also hold all higher speeds.

    Examples
    --------
    >>> bins = VelocityBins(width_px_per_s=10.0, reach=2, kernel_sigma_px_per_s=3.5)
    >>> bins.centres_px_per_s
    array([-20., -10.,   0.,  10.,  20.])
    """

    width_px_per_s: float
    """Width of a bin, px/s."""
    reach: int
    """Bins on either side of the central one; an axis has ``2 * reach + 1``."""
    kernel_sigma_px_per_s: float
    """Standard deviation of the Gaussian kernel that a segment adds, px/s."""
    gsd_m: float | None = None
    """Metres a base pixel; None where speeds are known in px/s only."""

    def __post_init__(self) -> None:
        if not (self.width_px_per_s > 0 and self.kernel_sigma_px_per_s > 0 and self.reach >= 1):
            raise ValueError(f"bins need a positive width and kernel and at least 3 bins, found {self}")

    @classmethod
    def from_config(cls, config: FieldConfig, gsd_m: float | None) -> "VelocityBins":
        """Bins of a configuration; without a ground sample distance its metres are converted by the paper's."""
        metres = assumed_gsd_m(gsd_m)
        return cls(
            width_px_per_s=config.bin_width_m_per_s / metres,
            reach=max(1, ceil(config.max_speed_m_per_s / config.bin_width_m_per_s - 1e-9)),
            kernel_sigma_px_per_s=config.kernel_sigma_m_per_s / metres,
            gsd_m=gsd_m,
        )

    @property
    def km_per_h_per_px_per_s(self) -> float:
        """A speed of 1 px/s, km/h.

        Raises
        ------
        InputError
            The ground sample distance is not known.
        """
        return 3.6 * require_gsd_m(self.gsd_m)

    @property
    def n(self) -> int:
        """Number of bins along an axis."""
        return 2 * self.reach + 1

    @property
    def centres_px_per_s(self) -> FloatArray:
        """(n,) centres of the bins, px/s, ascending."""
        return (np.arange(self.n, dtype=np.float64) - self.reach) * self.width_px_per_s

    @property
    def area_px2_per_s2(self) -> float:
        """Area of a bin, (px/s)^2: a density is a weight over it."""
        return self.width_px_per_s**2

    @property
    def kernel_sigma_bins(self) -> float:
        """Standard deviation of the kernel, bins."""
        return self.kernel_sigma_px_per_s / self.width_px_per_s

    @property
    def blur_bins2(self) -> float:
        """Variance that the kernel and the width of a bin add to a velocity component, bins^2."""
        return self.kernel_sigma_bins**2 + 1.0 / 12.0

    def to_bins(self, velocity_px_per_s: FloatArray) -> FloatArray:
        """Velocity components in units of bins, 0 being the centre of the first bin."""
        return velocity_px_per_s / self.width_px_per_s + self.reach

    def from_bins(self, position: FloatArray) -> FloatArray:
        """The inverse of `to_bins`: px/s."""
        return (position - self.reach) * self.width_px_per_s

    def grid_px_per_s(self, samples_per_bin: int) -> FloatArray:
        """(m, 2) velocities (vx, vy) on a square grid over all bins, px/s, ``samples_per_bin`` along a bin's width."""
        axis = self.from_bins(np.arange(samples_per_bin * (self.n - 1) + 1) / samples_per_bin)
        return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def band_radius_px(config: FieldConfig, gsd_m: float | None) -> float | None:
    """Half the width of a segment's band, px: a quarter of a lane; None for the paper's line of one pixel."""
    if config.path_width == "pixel":
        return None
    # Below 0.71 px a path could pass between the pixel centres and touch no pixel.
    return max(config.lane_width_m / 4 / assumed_gsd_m(gsd_m), 0.75)


def stationary_speed_px_per_s(config: FieldConfig, gsd_m: float | None) -> float:
    """The speed below which a vehicle is stationary and has no direction, px/s."""
    return config.stationary_speed_m_per_s / assumed_gsd_m(gsd_m)


SEGMENT_DTYPE = np.dtype(
    [
        ("track", "i8"),
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
"""A segment: half a tracklet, one vehicle from one frame to the next. Sorted by track, then time, as
`accumulate_tile` needs it.

``sd_px_per_s``: standard deviation of either velocity component, from registration and displacement.
"""

_MIN_DISPLACEMENT_SD_PX = 0.15
"""Lower bound of a displacement's standard deviation as a weight: those below have about the same weight in a mean."""

Segments = NDArray[np.void]
"""(n,) structured array of `SEGMENT_DTYPE`."""

SEGMENT_COLUMNS = (
    *("track_id", "tracklet_id"),
    *(f"{name}_{k}{unit}" for k in range(3) for name, unit in (("time", "_s"), ("x", "_px"), ("y", "_px"))),
    *(f"detection_id_{k}" for k in range(3)),
    *(f"v{axis}_{link}_px_per_s" for link in ("01", "12") for axis in "xy"),
    *(f"displacement_sd_{link}_px" for link in ("01", "12")),
)
"""Columns of tracklets that `segment_table` reads."""


def segment_table(tracklets: pd.DataFrame, config: FieldConfig) -> Segments:
    """The segments of a table of tracklets, two a tracklet, sorted by track and time.

    A segment that two tracklets share (the second of one, the first of the next) is kept once, and its velocity is the
    moving average along its track over ``config.velocity_span_s``; with a ``config.shared_segment_weight`` of 2, as in
    the paper, both are kept without averaging. A tracklet of no track (-1) is a track of its own.

    Raises
    ------
    InputError
        A position, a velocity or a time is not finite, or an interval is not positive.
    """
    both: Segments = np.zeros(2 * len(tracklets), SEGMENT_DTYPE)  # filled in place: of a long flight each copy is much
    for first in (0, 1):
        _fill_with_half(np.split(both, 2)[first], tracklets, first)
    del tracklets
    _check(both)
    order = np.lexsort((both["detection_1"], both["detection_0"], both["start_s"], both["track"]))
    if config.shared_segment_weight != 1:
        return both[order]
    segments = both[order[_first_of_duplicates(both, order)]]
    del both, order
    _average_velocities(segments, config.velocity_span_s)
    return segments


def _average_velocities(segments: Segments, span_s: float) -> None:
    """Replace the velocities by their moving average over the consecutive segments whose midpoints are within half a
    span, weighted by duration over variance.

    The error of a detection's position enters two neighbouring segments with opposite signs, so that it mostly cancels
    in their mean; for half a second or so a vehicle's acceleration is about constant, and a symmetric mean is
    unbiased. Segments whose crops did not align, with errors of a pixel or more, have little weight.
    """
    if not len(segments):
        return
    broken = segments["track"][1:] != segments["track"][:-1]
    broken |= segments["detection_0"][1:] != segments["detection_1"][:-1]
    run = np.concatenate([[0], np.cumsum(broken)])
    middle = segments["start_s"] + segments["duration_s"] / 2
    before, after = _neighbours(run, middle, span_s / 2), _neighbours(run[::-1], -middle[::-1], span_s / 2)[::-1]
    # Symmetric; at a run's end one neighbour on the one side, as more would shift the mean in time.
    reach = np.maximum(np.minimum(before, after), 1)
    before, after = np.minimum(before, reach), np.minimum(after, reach)
    sd_px = segments["sd_px_per_s"] * segments["duration_s"]
    weight = segments["duration_s"] / (sd_px**2 + _MIN_DISPLACEMENT_SD_PX**2)
    total = _window_sum(weight, before, after)
    for name in ("vx_px_per_s", "vy_px_per_s"):
        segments[name] = _window_sum(segments[name] * weight, before, after) / total
    # Errors of displacements are assumed independent. Those of positions cancel in part, so that for segments whose
    # crops did not align this is slightly too large.
    segments["sd_px_per_s"] = np.sqrt(_window_sum((segments["sd_px_per_s"] * weight) ** 2, before, after)) / total


def _window_sum(values: FloatArray, before: IntArray, after: IntArray) -> FloatArray:
    """Sum over the rows from ``before`` rows above to ``after`` rows below each.

    Window by window, not by running sums, whose last bits would depend on the rows of other tracks.
    """
    rows = np.arange(len(values))
    total = np.zeros(len(values))
    for step in range(-int(before.max(initial=0)), int(after.max(initial=0)) + 1):
        inside = rows[(step >= -before) & (step <= after)]
        total[inside] += values[inside + step]
    return total


def _neighbours(run: IntArray, middle: FloatArray, reach_s: float) -> IntArray:
    """Number of rows before each that belong to its run and lie within ``reach_s`` of its time."""
    count = np.zeros(len(run), np.int64)
    for step in range(1, len(run)):
        near = (run[step:] == run[:-step]) & (np.abs(middle[step:] - middle[:-step]) <= reach_s + 1e-9)
        if not near.any():
            break
        count[step:] += near
    return count


def _fill_with_half(half: Segments, tracklets: pd.DataFrame, first: int) -> None:
    """Fill in the segments between detections ``first`` and ``first + 1`` of every tracklet."""
    a, b = first, first + 1
    track = tracklets["track_id"].to_numpy()
    # The ids of tracklets without a track are negative, so that none equals a track's.
    half["track"] = np.where(track >= 0, track, -2 - tracklets["tracklet_id"].to_numpy())
    half["start_s"] = tracklets[f"time_{a}_s"]
    half["duration_s"] = tracklets[f"time_{b}_s"].to_numpy() - tracklets[f"time_{a}_s"].to_numpy()
    half["x0_px"], half["y0_px"] = tracklets[f"x_{a}_px"], tracklets[f"y_{a}_px"]
    half["x1_px"], half["y1_px"] = tracklets[f"x_{b}_px"], tracklets[f"y_{b}_px"]
    half["vx_px_per_s"] = tracklets[f"vx_{a}{b}_px_per_s"]
    half["vy_px_per_s"] = tracklets[f"vy_{a}{b}_px_per_s"]
    half["sd_px_per_s"] = tracklets[f"displacement_sd_{a}{b}_px"] / half["duration_s"]
    half["detection_0"], half["detection_1"] = tracklets[f"detection_id_{a}"], tracklets[f"detection_id_{b}"]


def _check(segments: Segments) -> None:
    numbers = [name for name in SEGMENT_DTYPE.names or () if SEGMENT_DTYPE[name].kind == "f"]
    finite = np.logical_and.reduce([np.isfinite(segments[name]) for name in numbers])
    bad = ~finite | ~(segments["duration_s"] > 0)
    if bad.any():
        row = segments[int(np.flatnonzero(bad)[0])]
        raise InputError(
            f"{int(bad.sum())} of {len(segments)} tracklet segments are not usable, the first from detection "
            f"{row['detection_0']} to {row['detection_1']} with interval {row['duration_s']} s: positions, times and "
            "velocities must be finite and intervals positive; check the tracklets table"
        )


def _first_of_duplicates(segments: Segments, order: IntArray) -> Mask:
    """Mask of the rows, in an order, that do not repeat the row before; rows of equal track and detections are adjacent
    in it."""
    keep = np.ones(len(segments), bool)
    columns = (segments[name][order] for name in ("track", "detection_0", "detection_1"))
    keep[1:] = ~np.logical_and.reduce([column[1:] == column[:-1] for column in columns])
    return keep


def segments_by_tile(
    segments: Segments, *, shape: tuple[int, int], tile_size: int, radius_px: float | None
) -> dict[tuple[int, int], IntArray]:
    """Rows of the segments whose band's bounding box meets a tile, for every such tile (ty, tx) of a (height, width)
    grid.

    Rows keep the table's order. A listed tile may still be empty.
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


def _tile_range(a: FloatArray, b: FloatArray, reach: float, length: int, tile_size: int) -> tuple[IntArray, IntArray]:
    """First and last tile of an axis that [min - reach, max + reach] meets; last < first where it is off the grid."""
    low = np.ceil(np.minimum(a, b) - reach).clip(0, length)
    high = np.floor(np.maximum(a, b) + reach).clip(-1, length - 1)
    outside = high < low
    first = low.astype(np.int64) // tile_size
    last = np.where(outside, first - 1, high.astype(np.int64) // tile_size)
    return first, last


def tracks_in(table: pd.DataFrame, low_xy: tuple[float, float], high_xy: tuple[float, float]) -> IntArray:
    """Tracks of the tracklets (`TRACKLET_COLUMNS`) whose bounding box meets a rectangle."""
    inside = np.ones(len(table), bool)
    for axis, low, high in zip("xy", low_xy, high_xy, strict=True):
        positions = table[[f"{axis}_{k}_px" for k in range(3)]].to_numpy()
        inside &= (positions.max(axis=1, initial=-np.inf) >= low) & (positions.min(axis=1, initial=np.inf) <= high)
    return np.unique(table["track_id"].to_numpy(np.int64)[inside])
