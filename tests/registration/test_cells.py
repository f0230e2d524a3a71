"""Cells filled in one kernel, compared with OpenCV's remap by a map of every pixel."""

import cv2
import numpy as np
import pytest

from schemas.arrays import Float32Array, GreyImage, Mask
from velfield.registration.warp import CELL_PX, extend_border, resample_cells

_UNIT = np.float32(32)


def _reference(source: GreyImage, coarse: Float32Array, step: int, shape: tuple[int, int]) -> tuple[GreyImage, Mask]:
    """All of an image by remap, from a dense map in 1/32 px; both are interpolated along columns first."""
    at = (np.arange(max(shape)) + 0.5) / step + 0.5
    k, part = at.astype(np.int64), (at - at.astype(np.int64)).astype(np.float32)
    rows, columns = slice(0, shape[0]), slice(0, shape[1])
    above, below = coarse[k[rows]], coarse[k[rows] + 1]
    by_row = (above + part[rows, None, None] * (below - above) + np.float32(1024)) * _UNIT
    left, right = by_row[:, k[columns]], by_row[:, k[columns] + 1]
    fine = left + part[None, columns, None] * (right - left)
    height, width = source.shape
    first = (np.float32(1024) - np.float32(0.5)) * _UNIT
    end = first + np.array([width, height], np.float32) * _UNIT
    inside = ((fine >= first) & (fine <= end)).all(axis=2)
    rounded = np.clip(fine + np.float32(0.5), 0, (np.array([width, height]) + 2048) * 32).astype(np.int32)
    whole, fraction = (rounded >> 5) - 1024, rounded & 31
    maps = whole.astype(np.int16), (fraction[..., 1] * 32 + fraction[..., 0]).astype(np.uint16)
    image = cv2.remap(source, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(image, np.uint8), inside


@pytest.mark.parametrize("step", [16, 8])
@pytest.mark.parametrize("shape", [(192, 256), (203, 249)])
def test_cells_are_those_of_remap(step: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(step)
    source = rng.integers(0, 256, (170, 230)).astype(np.uint8)
    rows, columns = (-(-size // step) + 2 for size in shape)
    y, x = np.mgrid[:rows, :columns] * float(step) - 20.0
    coarse = np.stack([x + 0.05 * y + 2 * np.sin(y / 50), y - 0.04 * x], axis=2).astype(np.float32)
    coarse[:3, 0] = -1e5  # no inverse
    cells = rng.random((-(-shape[0] // CELL_PX), -(-shape[1] // CELL_PX))) < 0.7
    image, valid = np.full(shape, 7, np.uint8), np.zeros(shape, bool)
    resample_cells(extend_border(source), coarse, step, np.argwhere(cells), image, valid)
    expected, inside = _reference(source, coarse, step, shape)
    filled = np.kron(cells, np.ones((CELL_PX, CELL_PX), bool))[: shape[0], : shape[1]]
    difference = np.abs(image.astype(np.int64) - expected)[filled]
    assert difference.max() <= 1
    assert (difference > 0).mean() < 1e-3  # none where products and sums are fused
    assert (valid == inside)[filled].all()
    assert 0 < inside[filled].mean() < 1
    assert (image[~filled] == 7).all()
    assert not valid[~filled].any()
