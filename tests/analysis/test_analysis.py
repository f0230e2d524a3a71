"""Carriageways and bottlenecks of constructed fields."""

import math

import numpy as np

from velfield.analysis.carriageways import find_carriageways


def test_opposite_lanes_that_touch_are_two_carriageways_and_a_bend_is_one() -> None:
    direction = np.full((120, 200), np.nan)
    direction[20:30, 20:180], direction[30:40, 20:180] = 0.0, math.pi
    y, x = np.mgrid[:120, :200]
    ring = (np.abs(np.hypot(x - 100, y - 80) - 25) < 5) & (y > 45)
    direction[ring] = np.arctan2(y - 80, x - 100)[ring] + np.pi / 2
    count = np.where(np.isnan(direction), 0, 5)
    speed = np.where(direction == 0, 40.0, 60.0)
    found = find_carriageways(direction, count, speeds_px_per_s={"p85": speed})
    labels, table = found.labels, found.table
    assert len(table) == 3
    assert labels[25, 100] != labels[35, 100]
    east = table[table.region == labels[25, 100]].iloc[0]
    assert abs(east.direction_rad) < 0.01
    assert east.speed_p85_px_per_s == 40
    assert east.straightness > 0.99
    assert table.straightness.min() < 0.1
    assert labels[table.y_px, table.x_px].tolist() == table.region.tolist()


def test_direction_that_wraps_at_pi_does_not_split_a_carriageway() -> None:
    direction = np.full((30, 100), np.nan)
    direction[10:20] = np.where(np.arange(100) % 2, math.pi - 0.02, -math.pi + 0.02)
    table = find_carriageways(direction, np.full(direction.shape, 4)).table
    assert len(table) == 1
    assert abs(abs(table.direction_rad[0]) - math.pi) < 0.01
