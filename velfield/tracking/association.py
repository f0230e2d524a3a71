"""Data association over three frames: which candidate triples of detections become tracklets.

The paper links frame to frame: each detection to the one of most similar appearance, where the two are each other's
best (cross-check). In a platoon that is not enough. Cars 25 px apart that drive 12 px a frame can also be linked each
to the one behind, at -13 px a frame: speed, axis, turn and acceleration are all consistent, and one neighbour of
similar appearance gives a wrong velocity. So the two links of a window are selected jointly. The cost of a triple is
the sum of an appearance term (all three pairs of crops) and a motion term (deviation from constant velocity, sideways
motion), each about half a chi square, i.e. a negative log-likelihood:

- a triple is accepted only as the cheapest of all triples through each of its three detections (mutual best);
- its confidence is its likelihood over the sum of the likelihoods of its competitors (all triples through any of its
  detections) and of a false alarm, so that a platoon of identical cars gives no tracklet rather than a wrong one.

Also here: the input of tracking by frame, the frames that a part of a flight needs, and the table of tracklets.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import ByteArray, FloatArray, IntArray, Mask
from schemas.tables import TRACKLET_COLUMNS
from velfield.detection.crops import patches_of_chips
from velfield.tracking.crop_alignment import UprightCrops, refine_links
from velfield.tracking.gates import DetectionStates, Limits


@dataclass(frozen=True)
class FrameTable:
    """Detections of one frame with their positions, axes, appearance and time."""

    frame: int
    time_s: float
    """Index in ``frames.zarr``, and its true time."""
    registered: bool
    """Whether it is used: registered, and not flagged."""
    residual_px: float
    """Registration residual, base px; widens the gates."""
    detection_id: IntArray
    x_px: FloatArray
    y_px: FloatArray
    orientation_rad: FloatArray
    orientation_sd_rad: FloatArray
    score: FloatArray
    """(n,) as in the detections' table. Orientations may be NaN."""
    crops: ByteArray | None = None
    """(n, 32, 32) uint8 upright crops in working px, centred on ``round(x_work), round(y_work)``; None: appearance is
    not used, and displacements are not refined."""
    x_work: FloatArray | None = None
    y_work: FloatArray | None = None
    """(n,) positions in working px of this frame's rectified image; with ``crops`` only."""
    working_scale: float = 1.0
    """Working px a base px."""
    registration_sd_px: float = 0.0
    """Standard error of the frame's transform, base px; part of a displacement's standard deviation."""

    def take(self, rows: IntArray) -> "FrameTable":
        """Some of the detections, in this order."""
        return self._with_arrays(lambda name: None if (array := getattr(self, name)) is None else array[rows])

    def with_weak(self, weak: "FrameTable") -> "FrameTable":
        """The detections, then the weak candidates of the same frame."""

        def join(name: str) -> NDArray[Any] | None:
            both = getattr(self, name), getattr(weak, name)
            return None if any(array is None for array in both) else np.concatenate(both)

        return self._with_arrays(join)

    def _with_arrays(self, make: Callable[[str], NDArray[Any] | None]) -> "FrameTable":
        arrays: dict[str, Any] = {name: make(name) for name in _ARRAYS}
        return replace(self, **arrays)

    def states(self, limits: Limits) -> DetectionStates:
        """Positions and axes of the detections, for the gates."""
        return DetectionStates(
            x_px=np.asarray(self.x_px, np.float64),
            y_px=np.asarray(self.y_px, np.float64),
            axis_rad=np.asarray(self.orientation_rad, np.float64),
            axis_sd_rad=np.asarray(self.orientation_sd_rad, np.float64),
            sd_px=limits.position_sd_px(self.residual_px),
            time_s=self.time_s,
        )

    def oriented_patches(self) -> ByteArray | None:
        """(n, 16, 8) uint8 patches in working px with the axis along the columns, cut out of the crops."""
        if self.crops is None or self.x_work is None or self.y_work is None:
            return None
        xy = np.column_stack([self.x_work, self.y_work])
        return patches_of_chips(self.crops, xy - np.rint(xy), np.asarray(self.orientation_rad, np.float64))

    def upright_crops(self) -> UprightCrops | None:
        """The upright crops with their centres in base px."""
        if self.crops is None or self.x_work is None or self.y_work is None:
            return None
        return UprightCrops(
            pixels=self.crops,
            centre_x_px=self.x_px + (np.rint(self.x_work) - self.x_work) / self.working_scale,
            centre_y_px=self.y_px + (np.rint(self.y_work) - self.y_work) / self.working_scale,
            axis_rad=np.asarray(self.orientation_rad, np.float64),
            scale=self.working_scale,
        )


_ARRAYS = (
    *("detection_id", "x_px", "y_px", "orientation_rad", "orientation_sd_rad", "score"),
    *("crops", "x_work", "y_work"),
)
"""Attributes of `FrameTable` with a row a detection."""


def window_frames(registered: Sequence[bool], times_s: Sequence[float], starts: range, max_interval_s: float) -> range:
    """Frames (positions) that the windows starting in ``starts`` read, so that parts of it can be processed alone.

    Parameters
    ----------
    registered, times_s
        For every frame of the flight, in time order: whether it is registered, and its time.
    starts
        Positions at which a window may start.
    max_interval_s
        Longest interval between two frames of a window.

    Examples
    --------
    >>> window_frames([True, True, False, True, True, True], [0.0, 0.2, 0.4, 0.6, 0.8, 1.0], range(0, 2), 0.45)
    range(0, 5)
    """
    stop = min(max(starts.stop, starts.start), len(times_s))
    if stop <= starts.start:
        return range(starts.start, starts.start)
    last, missing = stop, 2
    while last < len(times_s) and missing and times_s[last] - times_s[stop - 1] <= 2 * max_interval_s:
        missing -= bool(registered[last])
        last += 1
    return range(starts.start, last)


@dataclass(frozen=True)
class LinkedTriples:
    """Accepted triples of detections of one window."""

    start: int
    """Index, among the registered frames, of the window's first."""
    detections: IntArray
    """(m, 3) index of the detection in each frame."""
    differences: FloatArray
    """(m, 2) appearance difference of both links, grey levels; NaN where unknown."""
    confidence: FloatArray
    """(m,) in [0, 1]."""


def tracklet_table(
    tables: Sequence[FrameTable], windows: Sequence[LinkedTriples], limits: Limits, *, refine: bool
) -> tuple[pd.DataFrame, int]:
    """The tracklets of many windows, with columns `schemas.tables.TRACKLET_COLUMNS`; ``track_id`` is still -1.

    Parameters
    ----------
    tables
        The registered frames, in time order.
    windows
        Tracklets by window.
    limits
        For the standard deviation of displacements between detections.
    refine
        Whether displacements are measured by aligning the crops.

    Returns
    -------
    DataFrame, int
        The table, and the number of its links (two a tracklet) whose displacement is from the crops.
    """
    start = _concatenate([np.full(len(w.detections), w.start) for w in windows], np.int64)
    indices = _concatenate([w.detections.ravel() for w in windows], np.int64).reshape(-1, 3)
    differences = _concatenate([w.differences.ravel() for w in windows], np.float64).reshape(-1, 2)
    column = _detection_columns(tables, start, indices)
    displacement = _displacements(tables, start, indices, limits, refine=refine)
    for k, link in ((0, "01"), (1, "12")):
        interval = column[f"time_{k + 1}_s"] - column[f"time_{k}_s"]
        column[f"vx_{link}_px_per_s"] = displacement[:, k, 0] / interval
        column[f"vy_{link}_px_per_s"] = displacement[:, k, 1] / interval
        column[f"displacement_sd_{link}_px"] = displacement[:, k, 2]
        column[f"sad_{link}"] = differences[:, k]
    column["confidence"] = _concatenate([w.confidence for w in windows], np.float64)
    column["tracklet_id"] = column["detection_id_1"]
    column["track_id"] = np.full(start.size, -1, np.int64)
    frame = pd.DataFrame({name: column[name].astype(kind) for name, kind in TRACKLET_COLUMNS.items()})
    return frame, int(np.sum(displacement[:, :, 3]))


def _concatenate(parts: Sequence[NDArray[Any]], kind: type) -> NDArray[Any]:
    return np.concatenate(parts).astype(kind) if parts else np.zeros(0, kind)


def _detection_columns(tables: Sequence[FrameTable], start: IntArray, indices: IntArray) -> dict[str, NDArray[Any]]:
    """Frames, times, ids and positions of the detections of each tracklet."""
    frames = np.array([t.frame for t in tables], np.int64)
    times = np.array([t.time_s for t in tables], np.float64)
    bounds = np.cumsum([0] + [t.detection_id.size for t in tables])
    ids = _concatenate([t.detection_id for t in tables], np.int64)
    x = _concatenate([t.x_px for t in tables], np.float64)
    y = _concatenate([t.y_px for t in tables], np.float64)
    column: dict[str, NDArray[Any]] = {}
    for k in range(3):
        rows = bounds[start + k] + indices[:, k]
        column[f"frame_{k}"], column[f"time_{k}_s"] = frames[start + k], times[start + k]
        column[f"detection_id_{k}"], column[f"x_{k}_px"], column[f"y_{k}_px"] = ids[rows], x[rows], y[rows]
    return column


def _displacements(
    tables: Sequence[FrameTable], start: IntArray, indices: IntArray, limits: Limits, *, refine: bool
) -> FloatArray:
    """(n, 2, 4): displacement in x and y, its standard deviation, and whether it is from the crops, of both links of
    each tracklet."""
    size = max([1, *(table.detection_id.size for table in tables)])
    keys = np.concatenate([((start + k) * size + indices[:, k]) * size + indices[:, k + 1] for k in (0, 1)])
    links, where = np.unique(keys, return_inverse=True)  # a link that two tracklets share is aligned once
    window, first, second = links // size**2, links // size % size, links % size
    displacement = np.zeros((len(links), 4))
    # Of the two frames of a link: what is prepared of them is kept for the next.
    crops: dict[int, UprightCrops | None] = {}
    for i in map(int, np.unique(window)):
        rows = window == i
        crops = {k: crops[k] if k in crops else tables[k].upright_crops() if refine else None for k in (i, i + 1)}
        displacement[rows] = _frame_displacements(
            tables[i], tables[i + 1], crops[i], crops[i + 1], first[rows], second[rows], limits
        )
    return np.moveaxis(displacement[where].reshape(2, -1, 4), 0, 1)


def _frame_displacements(
    before: FrameTable,
    after: FrameTable,
    crops_before: UprightCrops | None,
    crops_after: UprightCrops | None,
    first: IntArray,
    second: IntArray,
    limits: Limits,
) -> FloatArray:
    """(k, 4) of the links between two frames: from the crops where there are and they align, otherwise from the
    detections' positions."""
    noise = float(np.hypot(limits.position_sd_px(before.residual_px), limits.position_sd_px(after.residual_px)))
    x = after.x_px[second] - before.x_px[first]
    y = after.y_px[second] - before.y_px[first]
    unrefined = np.stack([x, y, np.full(x.size, noise), np.zeros(x.size)], axis=1)
    if crops_before is None or crops_after is None:
        return unrefined
    aligned_x, aligned_y, aligned_sd = refine_links(crops_before, crops_after, first, second)
    # Crops that align far from the detections' displacement match something else: a road marking, a neighbour.
    near = np.hypot(aligned_x - x, aligned_y - y) <= limits.jitter_sigmas * noise
    sd = np.sqrt(aligned_sd**2 + before.registration_sd_px**2 + after.registration_sd_px**2)
    refined = np.stack([aligned_x, aligned_y, sd, np.ones(x.size)], axis=1)
    return np.where(near[:, None], refined, unrefined)


APPEARANCE_EXPONENT = 4.0
"""Likelihood of a pair falls as this power of (1 + difference / typical difference of a car to itself)."""
FALSE_ALARM_COST = 19.0
"""Cost at which a triple is as likely a false alarm as a car; a typical correct triple costs half of that."""
MAX_COST = FALSE_ALARM_COST + 5.0
"""Above this a triple cannot be accepted, and lowers no other's confidence by more than one per cent."""
MIN_TYPICAL_DIFFERENCE = 2.0
"""Appearance difference of camera noise alone, grey levels."""


def typical_difference(differences: FloatArray, first: IntArray) -> float:
    """Typical appearance difference of a car to itself: the median over detections of the smallest of their links'.

    ``differences``, ``first`` (m,): appearance difference of each candidate link (NaN: unknown), its earlier detection.
    """
    known = np.isfinite(differences)
    if not known.any():
        return MIN_TYPICAL_DIFFERENCE
    best = np.full(int(first.max()) + 1, np.inf)
    np.minimum.at(best, first[known], differences[known])
    return max(float(np.median(best[np.isfinite(best)])), MIN_TYPICAL_DIFFERENCE)


def appearance_cost(differences: FloatArray, typical: float) -> FloatArray:
    """Negative log-likelihood that pairs with these appearance differences are one car each; zero where unknown."""
    return np.where(np.isfinite(differences), APPEARANCE_EXPONENT * np.log1p(differences / typical), 0.0)


def best_triples(detections: IntArray, cost: FloatArray, counts: tuple[int, int, int]) -> tuple[Mask, FloatArray]:
    """Mask of the candidate triples of one window that are mutual best, and the confidence of each.

    Parameters
    ----------
    detections, cost
        (m, 3) index of the detection in each of the three frames, and (m,) negative log-likelihood of appearance and
        motion, up to a constant.
    counts
        Number of detections in each of the three frames.

    Returns
    -------
    (m,) bool, (m,) float64
        Mutual best: no other triple through any of its detections is as cheap. Confidence in [0, 1]: its likelihood
        over the sum of its own, its competitors' and a false alarm's.
    """
    likelihood = np.exp(-cost)
    best, competitors = np.ones(cost.size, np.bool_), np.zeros(cost.size)
    for column, count in zip(detections.T, counts, strict=True):
        best &= _is_least_alone(cost, column)
        total = np.bincount(column, likelihood, count)
        competitors += np.maximum(total[column] - likelihood, 0.0)
    return best, likelihood / (likelihood + competitors + np.exp(-FALSE_ALARM_COST))


def _is_least_alone(values: FloatArray, group: IntArray) -> Mask:
    """Whether each value is the least of its group (m,), and no other is equal to it."""
    least = np.full(int(group.max(initial=-1)) + 1, np.inf)
    np.minimum.at(least, group, values)
    is_least = values == least[group]
    return np.asarray(is_least & (np.bincount(group[is_least], minlength=least.size)[group] == 1))


def mutual_best_links(differences: FloatArray, first: IntArray, second: IntArray) -> Mask:
    """Cross-check (paper: tracking): links whose two detections are each most similar in appearance to the other;
    of two equal differences neither is.

    ``differences``, ``first``, ``second`` (m,): appearance difference of each candidate link, its earlier and its later
    detection.
    """
    return _is_least_alone(differences, first) & _is_least_alone(differences, second)
