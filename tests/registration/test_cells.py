"""Cells filled in one kernel, compared with OpenCV's remap by a map of every pixel."""

import cv2
import numpy as np
import pytest

from velfield.registration.resampling.cells import CELL_PX
from velfield.registration.warp import extend_border, resample_cells


@pytest.mark.parametrize("step", [16, 8])
@pytest.mark.parametrize("shape", [(192, 256), (203, 249), (37, 21)])
def test_cells_are_those_of_remap(step: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(step)
    source = cv2.GaussianBlur(rng.integers(0, 256, (170, 230)).astype(np.uint8), (0, 0), 1.5)
    rows, columns = (-(-size // step) + 2 for size in shape)
    y, x = np.mgrid[:rows, :columns] * float(step) - 20.0
    coarse = np.stack([x + 0.05 * y + 2 * np.sin(y / 50), y - 0.04 * x], axis=2).astype(np.float32)
    coarse[:3, 0] = -1e5  # no inverse
    cells = rng.random((-(-shape[0] // CELL_PX), -(-shape[1] // CELL_PX))) < 0.7
    image, valid = np.full(shape, 7, np.uint8), np.zeros(shape, bool)
    resample_cells(extend_border(source), coarse, step, np.argwhere(cells), image, valid)
    dense = cv2.resize(coarse, None, fx=step, fy=step)[step : step + shape[0], step : step + shape[1]]
    expected = cv2.remap(source, dense, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    inside = ((dense >= -0.5) & (dense <= np.array(source.shape[::-1]) - 0.5)).all(axis=2)
    filled = np.kron(cells, np.ones((CELL_PX, CELL_PX), bool))[: shape[0], : shape[1]]
    off = image[filled].astype(int) - expected[filled]
    assert np.abs(off).max() <= 2  # OpenCV rounds positions to 1/32 px
    assert abs(off.mean()) < 0.05
    assert np.abs(off).mean() < 0.3
    assert (valid == inside)[filled].all()
    assert 0 < inside[filled].mean() < 1
    assert (image[~filled] == 7).all()
    assert not valid[~filled].any()
