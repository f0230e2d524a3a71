"""The tracklets' columns: where the three detections are, and how far the car went between them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray
from schemas.tables import TRACKLET_COLUMNS
from velfield.tracking.limits import Limits
from velfield.tracking.refine import refine_links
from velfield.tracking.windows import FrameTable


@dataclass(frozen=True)
class Found:
    """Tracklets of one window.

    Attributes
    ----------
    start
        Position, among the registered frames, of the window's first.
    detections
        (m, 3) index of the detection in each frame.
    differences
        (m, 2) mean absolute difference of the patches of both links; NaN without patches.
    confidence
        (m,) in [0, 1].
    """

    start: int
    detections: IntArray
    differences: FloatArray
    confidence: FloatArray


def tracklet_table(
    tables: Sequence[FrameTable], found: Sequence[Found], limits: Limits, *, refine: bool
) -> tuple[pd.DataFrame, int]:
    """Columns of `schemas.tables.TRACKLET_COLUMNS` of the tracklets of many windows, ``passage_id`` still -1.

    Parameters
    ----------
    tables
        The registered frames, in time order.
    found
        Tracklets by window.
    limits
        For the standard deviation of a displacement that the crops do not give.
    refine
        Whether displacements are taken from the crops.

    Returns
    -------
    DataFrame, int
        The table, and how many of its links (two a tracklet) have a displacement from the crops.
    """
    start = _joined([np.full(len(f.detections), f.start) for f in found], np.int64)
    picked = _joined([f.detections.ravel() for f in found], np.int64).reshape(-1, 3)
    differences = _joined([f.differences.ravel() for f in found], np.float64).reshape(-1, 2)
    column = _places(tables, start, picked)
    moved = _displacements(tables, start, picked, limits, refine=refine)
    for k, link in ((0, "01"), (1, "12")):
        interval = column[f"time_{k + 1}_s"] - column[f"time_{k}_s"]
        column[f"vx_{link}_px_per_s"] = moved[:, k, 0] / interval
        column[f"vy_{link}_px_per_s"] = moved[:, k, 1] / interval
        column[f"displacement_sd_{link}_px"] = moved[:, k, 2]
        column[f"sad_{link}"] = differences[:, k]
    column["confidence"] = _joined([f.confidence for f in found], np.float64)
    column["tracklet_id"] = column["detection_id_1"]
    column["passage_id"] = np.full(start.size, -1, np.int64)
    frame = pd.DataFrame({name: column[name].astype(kind) for name, kind in TRACKLET_COLUMNS.items()})
    return frame, int(np.sum(moved[:, :, 3]))


def _joined(parts: Sequence[NDArray[Any]], kind: type) -> NDArray[Any]:
    return np.concatenate(parts).astype(kind) if parts else np.zeros(0, kind)


def _places(tables: Sequence[FrameTable], start: IntArray, picked: IntArray) -> dict[str, NDArray[Any]]:
    """Frames, times, ids and places of the detections of each tracklet."""
    frames = np.array([t.frame for t in tables], np.int64)
    times = np.array([t.time_s for t in tables], np.float64)
    bounds = np.cumsum([0] + [t.detection_id.size for t in tables])
    ids = _joined([t.detection_id for t in tables], np.int64)
    x = _joined([t.x_px for t in tables], np.float64)
    y = _joined([t.y_px for t in tables], np.float64)
    column: dict[str, NDArray[Any]] = {}
    for k in range(3):
        rows = bounds[start + k] + picked[:, k]
        column[f"frame_{k}"], column[f"time_{k}_s"] = frames[start + k], times[start + k]
        column[f"detection_id_{k}"], column[f"x_{k}_px"], column[f"y_{k}_px"] = ids[rows], x[rows], y[rows]
    return column


def _displacements(
    tables: Sequence[FrameTable], start: IntArray, picked: IntArray, limits: Limits, *, refine: bool
) -> FloatArray:
    """(n, 2, 4): displacement in x and y, its standard deviation, and whether the crops gave it, of both links of
    each tracklet."""
    keys = np.concatenate([np.stack([start + k, picked[:, k], picked[:, k + 1]], axis=1) for k in (0, 1)])
    links, where = np.unique(keys, axis=0, return_inverse=True)  # a link that two tracklets share is aligned once
    moved = np.zeros((len(links), 4))
    for i in np.unique(links[:, 0]):
        rows = links[:, 0] == i
        pair = (tables[int(i)], tables[int(i) + 1])
        moved[rows] = _frame_displacements(*pair, links[rows, 1], links[rows, 2], limits, refine=refine)
    return np.moveaxis(moved[where.ravel()].reshape(2, -1, 4), 0, 1)


def _frame_displacements(
    before: FrameTable, after: FrameTable, first: IntArray, second: IntArray, limits: Limits, *, refine: bool
) -> FloatArray:
    """(k, 4) of the links between two frames: from the crops where they align, else from the detections' places."""
    noise = float(np.hypot(limits.place_sd_px(before.residual_px), limits.place_sd_px(after.residual_px)))
    x = after.x_px[second] - before.x_px[first]
    y = after.y_px[second] - before.y_px[first]
    plain = np.stack([x, y, np.full(x.size, noise), np.zeros(x.size)], axis=1)
    crops = (before.crops(), after.crops())
    if not refine or crops[0] is None or crops[1] is None:
        return plain
    aligned = refine_links(crops[0], crops[1], first, second)
    # Crops that align far from where the detector saw the car have locked on to something else: a road marking, its
    # neighbour.
    near = np.hypot(aligned.x_px - x, aligned.y_px - y) <= limits.jitter_sigmas * noise
    sd = np.sqrt(aligned.sd_px**2 + before.registration_sd_px**2 + after.registration_sd_px**2)
    refined = np.stack([aligned.x_px, aligned.y_px, sd, np.ones(x.size)], axis=1)
    return np.where(near[:, None], refined, plain)
