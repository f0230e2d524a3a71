"""The table of tracklets: positions of the three detections, and the displacements between them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray
from schemas.tables import TRACKLET_COLUMNS
from velfield.tracking.crop_alignment import refine_links
from velfield.tracking.limits import Limits
from velfield.tracking.windows import FrameTable


@dataclass(frozen=True)
class LinkedTriples:
    """Accepted triples of detections of one window.

    Attributes
    ----------
    start
        Index, among the registered frames, of the window's first.
    detections
        (m, 3) index of the detection in each frame.
    differences
        (m, 2) mean absolute difference of the patches of both links, grey levels; NaN without patches.
    confidence
        (m,) in [0, 1].
    """

    start: int
    detections: IntArray
    differences: FloatArray
    confidence: FloatArray


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
    keys = np.concatenate([np.stack([start + k, indices[:, k], indices[:, k + 1]], axis=1) for k in (0, 1)])
    links, where = np.unique(keys, axis=0, return_inverse=True)  # a link that two tracklets share is aligned once
    displacement = np.zeros((len(links), 4))
    for i in np.unique(links[:, 0]):
        rows = links[:, 0] == i
        pair = (tables[int(i)], tables[int(i) + 1])
        displacement[rows] = _frame_displacements(*pair, links[rows, 1], links[rows, 2], limits, refine=refine)
    return np.moveaxis(displacement[where.ravel()].reshape(2, -1, 4), 0, 1)


def _frame_displacements(
    before: FrameTable, after: FrameTable, first: IntArray, second: IntArray, limits: Limits, *, refine: bool
) -> FloatArray:
    """(k, 4) of the links between two frames: from the crops where they align, otherwise from the detections'
    positions."""
    noise = float(np.hypot(limits.position_sd_px(before.residual_px), limits.position_sd_px(after.residual_px)))
    x = after.x_px[second] - before.x_px[first]
    y = after.y_px[second] - before.y_px[first]
    unrefined = np.stack([x, y, np.full(x.size, noise), np.zeros(x.size)], axis=1)
    crops = (before.upright_crops(), after.upright_crops())
    if not refine or crops[0] is None or crops[1] is None:
        return unrefined
    aligned = refine_links(crops[0], crops[1], first, second)
    # Crops that align far from the detections' displacement match something else: a road marking, a neighbour.
    near = np.hypot(aligned.x_px - x, aligned.y_px - y) <= limits.jitter_sigmas * noise
    sd = np.sqrt(aligned.sd_px**2 + before.registration_sd_px**2 + after.registration_sd_px**2)
    refined = np.stack([aligned.x_px, aligned.y_px, sd, np.ones(x.size)], axis=1)
    return np.where(near[:, None], refined, unrefined)
