"""A line across a road: who crosses it, which way, how fast; and who only stands on it."""

from itertools import pairwise

import numpy as np
import pytest

from velfield.analysis.crossings import line_crossings
from velfield.field.segments import SEGMENT_DTYPE, Segments


def paths(*ways: list[tuple[float, float]], interval_s: float = 0.2) -> Segments:
    """Passages along points, one an interval."""
    rows = []
    for passage, way in enumerate(ways):
        for k, ((x0, y0), (x1, y1)) in enumerate(pairwise(way)):
            velocity = ((x1 - x0) / interval_s, (y1 - y0) / interval_s)
            rows.append((passage, k * interval_s, interval_s, x0, y0, x1, y1, *velocity))
    names = ["track", "start_s", "duration_s", "x0_px", "y0_px", "x1_px", "y1_px", "vx_px_per_s", "vy_px_per_s"]
    segments = np.zeros(len(rows), SEGMENT_DTYPE)
    for name, values in zip(names, zip(*rows, strict=True), strict=True):
        segments[name] = values
    return segments


def straight(x: float, y: float, dx: float, dy: float, steps: int = 10) -> list[tuple[float, float]]:
    return [(x + k * dx, y + k * dy) for k in range(steps + 1)]


BOTTOM, TOP = (50.0, 100.0), (50.0, 0.0)  # a line across a road that goes along x


def test_each_crosses_once_its_own_way() -> None:
    found = line_crossings(paths(straight(3, 40, 12, 0), straight(97, 60, -6, 0)), BOTTOM, TOP, settle_px=8)
    assert found["direction"].tolist() == [1, -1]  # looking up from the bottom, the first goes from left to right
    assert found["passage"].tolist() == [0, 1]
    np.testing.assert_allclose(found["speed_px_per_s"], [60, 30])
    np.testing.assert_allclose(found["time_s"], [47 / 60, 47 / 30])
    np.testing.assert_allclose(found[["x_px", "y_px"]], [[50, 40], [50, 60]])


def test_a_line_turned_round_turns_the_directions() -> None:
    segments = paths(straight(3, 40, 12, 0))
    assert line_crossings(segments, TOP, BOTTOM, settle_px=8)["direction"].tolist() == [-1]


def test_who_passes_beside_the_line_does_not_cross_it() -> None:
    assert line_crossings(paths(straight(3, 140, 12, 0)), BOTTOM, TOP, settle_px=8).empty


def test_who_stands_on_the_line_and_jitters_does_not_cross_it() -> None:
    rng = np.random.default_rng(3)
    standing = [(50 + dx, 50 + dy) for dx, dy in rng.normal(0, 0.6, (60, 2))]
    assert len(line_crossings(paths(standing), BOTTOM, TOP, settle_px=8)) <= 1
    through = [*straight(3, 50, 12, 0, 3), *standing, *straight(56, 50, 12, 0, 3)]
    assert line_crossings(paths(through), BOTTOM, TOP, settle_px=8)["direction"].tolist() == [1]


def test_who_turns_back_beyond_the_line_crosses_it_both_ways() -> None:
    there = straight(3, 40, 12, 0)
    found = line_crossings(paths(there + straight(123, 60, -12, 0)), BOTTOM, TOP, settle_px=8)
    assert found["direction"].tolist() == [1, -1]


def test_a_point_on_the_line_is_crossed_once() -> None:
    assert len(line_crossings(paths(straight(0, 40, 10, 0)), BOTTOM, TOP, settle_px=8)) == 1


@pytest.mark.parametrize("segments", [np.empty(0, SEGMENT_DTYPE), paths(straight(3, 40, 0.01, 0))])
def test_nobody_crosses(segments: Segments) -> None:
    assert line_crossings(segments, BOTTOM, TOP, settle_px=8).empty


def test_a_line_of_no_length_is_crossed_by_nobody() -> None:
    assert line_crossings(paths(straight(3, 41, 12, 0)), (50, 40), (50, 40), settle_px=8).empty
