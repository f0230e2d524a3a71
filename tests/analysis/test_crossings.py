"""Crossings of a line across a road: directions, times and speeds; stationary vehicles on it."""

from itertools import pairwise

import numpy as np
import pytest

from velfield.analysis.crossings import find_crossings
from velfield.field.segments import SEGMENT_DTYPE, Segments


def tracks(*paths: list[tuple[float, float]], interval_s: float = 0.2) -> Segments:
    """Tracks along points, one an interval."""
    rows = []
    for track, path in enumerate(paths):
        for k, ((x0, y0), (x1, y1)) in enumerate(pairwise(path)):
            velocity = ((x1 - x0) / interval_s, (y1 - y0) / interval_s)
            rows.append((track, k * interval_s, interval_s, x0, y0, x1, y1, *velocity))
    names = ["track", "start_s", "duration_s", "x0_px", "y0_px", "x1_px", "y1_px", "vx_px_per_s", "vy_px_per_s"]
    segments = np.zeros(len(rows), SEGMENT_DTYPE)
    for name, values in zip(names, zip(*rows, strict=True), strict=True):
        segments[name] = values
    return segments


def straight(x: float, y: float, dx: float, dy: float, steps: int = 10) -> list[tuple[float, float]]:
    return [(x + k * dx, y + k * dy) for k in range(steps + 1)]


BOTTOM, TOP = (50.0, 100.0), (50.0, 0.0)  # a line across a road that goes along x


def test_each_vehicle_crosses_once_in_its_direction() -> None:
    found = find_crossings(tracks(straight(3, 40, 12, 0), straight(97, 60, -6, 0)), BOTTOM, TOP, hysteresis_px=8)
    assert found["direction"].tolist() == [1, -1]  # looking up from the bottom, the first goes from left to right
    assert found["track_id"].tolist() == [0, 1]
    np.testing.assert_allclose(found["speed_px_per_s"], [60, 30])
    np.testing.assert_allclose(found["time_s"], [47 / 60, 47 / 30])
    np.testing.assert_allclose(found[["x_px", "y_px"]], [[50, 40], [50, 60]])


def test_reversing_the_line_reverses_the_directions() -> None:
    segments = tracks(straight(3, 40, 12, 0))
    assert find_crossings(segments, TOP, BOTTOM, hysteresis_px=8)["direction"].tolist() == [-1]


def test_a_vehicle_beside_the_line_does_not_cross_it() -> None:
    assert find_crossings(tracks(straight(3, 140, 12, 0)), BOTTOM, TOP, hysteresis_px=8).empty


def test_a_stationary_vehicle_on_the_line_that_jitters_does_not_cross_it() -> None:
    rng = np.random.default_rng(3)
    stationary = [(50 + dx, 50 + dy) for dx, dy in rng.normal(0, 0.6, (60, 2))]
    assert len(find_crossings(tracks(stationary), BOTTOM, TOP, hysteresis_px=8)) <= 1
    through = [*straight(3, 50, 12, 0, 3), *stationary, *straight(56, 50, 12, 0, 3)]
    assert find_crossings(tracks(through), BOTTOM, TOP, hysteresis_px=8)["direction"].tolist() == [1]


def test_a_u_turn_beyond_the_line_crosses_it_in_both_directions() -> None:
    there = straight(3, 40, 12, 0)
    found = find_crossings(tracks(there + straight(123, 60, -12, 0)), BOTTOM, TOP, hysteresis_px=8)
    assert found["direction"].tolist() == [1, -1]


def test_a_point_on_the_line_is_crossed_once() -> None:
    assert len(find_crossings(tracks(straight(0, 40, 10, 0)), BOTTOM, TOP, hysteresis_px=8)) == 1


@pytest.mark.parametrize("segments", [np.empty(0, SEGMENT_DTYPE), tracks(straight(3, 40, 0.01, 0))])
def test_tables_without_crossings(segments: Segments) -> None:
    assert find_crossings(segments, BOTTOM, TOP, hysteresis_px=8).empty


def test_a_line_of_no_length_has_no_crossings() -> None:
    assert find_crossings(tracks(straight(3, 41, 12, 0)), (50, 40), (50, 40), hysteresis_px=8).empty
