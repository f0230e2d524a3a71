"""Connected regions of a map, and the table of them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components

from schemas.arrays import FloatArray, Mask

_EIGHT_NEIGHBOURS = np.ones((3, 3), np.int8)


@dataclass(frozen=True)
class Regions:
    """Connected regions of a map."""

    labels: NDArray[np.int32]
    """(h, w) int32 number of the region of each pixel, 0 outside all."""
    table: pd.DataFrame
    """One row a region: ``region`` (its number), ``x_px, y_px`` (its pixel nearest to its centroid), ``area_px``, and
    medians of layers over its pixels."""


def label_mask(mask: Mask, *, min_area_px: int) -> NDArray[np.int32]:
    """Connected components of a mask (8-connectivity), numbered from 1; smaller ones are dropped (0)."""
    labels, _ = ndimage.label(mask, structure=_EIGHT_NEIGHBOURS)
    return keep_large(np.asarray(labels, np.int32), min_area_px=min_area_px)


def keep_large(labels: NDArray[np.int32], *, min_area_px: int) -> NDArray[np.int32]:
    """Regions of at least ``min_area_px``, renumbered from 1 in the same order."""
    area = np.bincount(labels.ravel())
    large = area >= min_area_px
    large[0] = False
    number = np.zeros(len(area), np.int32)
    number[large] = np.arange(1, large.sum() + 1)
    return np.asarray(number[labels])


def region_table(labels: NDArray[np.int32], medians: Mapping[str, NDArray[np.floating]]) -> pd.DataFrame:
    """The table of `Regions`, with the medians of the layers in ``medians``; NaN where a layer is unknown."""
    rows = []
    for k, box in enumerate(ndimage.find_objects(labels), start=1):
        inside = labels[box] == k
        y, x = np.nonzero(inside)
        nearest = np.argmin((y - y.mean()) ** 2 + (x - x.mean()) ** 2)
        row: dict[str, float] = {
            "region": k,
            "x_px": int(x[nearest] + box[1].start),
            "y_px": int(y[nearest] + box[0].start),
            "area_px": len(x),
        }
        for name, values in medians.items():
            known = values[box][inside]
            known = known[np.isfinite(known)]
            row[name] = float(np.median(known)) if len(known) else np.nan
        rows.append(row)
    return pd.DataFrame(rows, columns=["region", "x_px", "y_px", "area_px", *medians])


def label_smooth(angle_rad: FloatArray, max_step_rad: float) -> NDArray[np.int32]:
    """Connected components (4-connectivity) of pixels whose angles differ by at most ``max_step_rad``; 0 where NaN."""
    number = np.arange(angle_rad.size).reshape(angle_rad.shape)
    pairs = []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        step = np.abs((angle_rad[here] - angle_rad[there] + np.pi) % (2 * np.pi) - np.pi)
        joined = step <= max_step_rad  # False for NaN
        pairs.append((number[here][joined], number[there][joined]))
    a, b = np.concatenate(pairs, axis=1)
    links = sparse.coo_array((np.ones(len(a), bool), (a, b)), (number.size, number.size))
    _, component = connected_components(links, directed=False)
    known = ~np.isnan(angle_rad)
    labels = np.zeros(angle_rad.shape, np.int32)
    labels[known] = pd.factorize(component[known.ravel()])[0] + 1  # numbered in raster order
    return labels
