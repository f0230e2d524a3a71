"""Carriageways: connected pixels of one direction of travel, with their direction and speeds."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from velfield.analysis.regions import Regions, keep_large, label_smooth, region_table

_MAX_STEP_RAD = math.radians(15)
"""Largest change of direction between neighbouring pixels."""


def find_carriageways(
    direction_rad: NDArray[np.floating],
    count: NDArray[np.integer],
    *,
    speeds_px_per_s: Mapping[str, NDArray[np.floating]] | None = None,
    min_count: int = 3,
    min_area_px: int = 200,
) -> Regions:
    """Connected pixels whose direction changes smoothly: a carriageway may bend, the opposite one is another.

    Parameters
    ----------
    direction_rad
        (h, w) modal direction; NaN where there is none.
    count
        (h, w) tracks.
    speeds_px_per_s
        (h, w) speed layers by name (``p50``, ``p85``), of which the table gives medians.
    min_count
        Fewest tracks of a pixel: a single track is no lane.
    min_area_px
        Smaller regions are dropped, px.

    Returns
    -------
    Regions
        The table's columns: medians ``tracks`` and ``speed_<name>_px_per_s``; ``direction_rad`` (circular mean) and
        ``straightness`` (resultant length of the directions: 1 all equal, 0 a full circle).
    """
    direction = np.where(count >= min_count, direction_rad, np.nan).astype(np.float64)
    labels = keep_large(label_smooth(direction, _MAX_STEP_RAD), min_area_px=min_area_px)
    layers: dict[str, NDArray[np.floating]] = {"tracks": np.asarray(count, np.float64)}
    for name, speed in (speeds_px_per_s or {}).items():
        layers[f"speed_{name}_px_per_s"] = speed
    table = region_table(labels, layers)
    size = len(table) + 1
    flat = labels.ravel()
    angle = np.nan_to_num(direction).ravel()
    cosine = np.bincount(flat, np.cos(angle), size)[1:]
    sine = np.bincount(flat, np.sin(angle), size)[1:]
    table["direction_rad"] = np.arctan2(sine, cosine)
    table["straightness"] = np.hypot(cosine, sine) / np.maximum(table["area_px"].to_numpy(), 1)
    return Regions(labels, table)
