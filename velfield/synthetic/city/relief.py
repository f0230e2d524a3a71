"""The ground's height: long waves on a coarse grid, interpolated bilinearly; one definition for renderer and truth."""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray
from velfield.compiled import kernel

GRID_PX = 16.0
"""Spacing of the relief's grid, base px."""


@dataclass(frozen=True)
class Relief:
    """Height of the ground, base px: ``grid`` (ny, nx); ``frame`` = (x and y of the first node, spacing)."""

    grid: FloatArray
    frame: FloatArray


def make_relief(
    bounds: tuple[float, float, float, float], *, height_px: float, length_px: float, rng: np.random.Generator
) -> Relief:
    """Relief over ``bounds`` (x0, y0, x1, y1), base px: five waves whose sum stays within +-``height_px``."""
    x = np.arange(bounds[0], bounds[2] + 2 * GRID_PX, GRID_PX)
    y = np.arange(bounds[1], bounds[3] + 2 * GRID_PX, GRID_PX)
    angle = rng.uniform(0, np.pi, 5)
    number = 2 * np.pi / (length_px * rng.uniform(0.7, 1.6, 5))
    phase = rng.uniform(0, 2 * np.pi, 5)
    weight = rng.dirichlet(np.full(5, 3.0))
    grid = np.zeros((len(y), len(x)))
    for a, k, p, s in zip(angle, number, phase, weight, strict=True):
        grid += s * np.sin(k * (np.cos(a) * x[None, :] + np.sin(a) * y[:, None]) + p)
    return Relief(grid * height_px, np.array([bounds[0], bounds[1], GRID_PX]))


@kernel
def ground_height_at(x: float, y: float, grid: FloatArray, frame: FloatArray) -> float:
    """Height at one position, base px; outside the grid that of its border."""
    gx = min(max((x - frame[0]) / frame[2], 0.0), grid.shape[1] - 1.001)
    gy = min(max((y - frame[1]) / frame[2], 0.0), grid.shape[0] - 1.001)
    i, j = int(gy), int(gx)
    fy, fx = gy - i, gx - j
    top = grid[i, j] + fx * (grid[i, j + 1] - grid[i, j])
    bottom = grid[i + 1, j] + fx * (grid[i + 1, j + 1] - grid[i + 1, j])
    return float(top + fy * (bottom - top))


@kernel
def ground_height(x: FloatArray, y: FloatArray, grid: FloatArray, frame: FloatArray) -> FloatArray:
    """Heights (n,) at positions x, y (n,), base px."""
    out = np.empty(len(x))
    for i in range(len(x)):
        out[i] = ground_height_at(x[i], y[i], grid, frame)
    return out
