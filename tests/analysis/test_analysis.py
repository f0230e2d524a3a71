"""Carriageways, stops, bottlenecks and U-turns of constructed fields."""

import math

import numpy as np

from velfield.analysis.bottlenecks import find_bottlenecks
from velfield.analysis.carriageways import find_carriageways
from velfield.analysis.stops import find_stops
from velfield.analysis.u_turns import find_u_turns
from velfield.field.segments import SEGMENT_DTYPE, Segments


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


def test_a_queue_is_a_stop_and_a_car_park_is_not() -> None:
    fraction, count = np.zeros((60, 100)), np.full((60, 100), 8)
    fraction[20:25, 40:60] = 0.5
    fraction[40:50, 10:30] = 1.0
    found = find_stops(fraction, count)
    labels, table = found.labels, found.table
    assert len(table) == 1
    assert labels[22, 50] == table.region[0]
    assert labels[45, 20] == 0


def test_a_slow_section_is_a_bottleneck_downstream_of_its_approach() -> None:
    speed = np.full((40, 200), np.nan)
    direction = np.full((40, 200), np.nan)
    speed[15:25], direction[15:25] = 60.0, 0.0
    speed[15:25, 100:160] = 20.0
    found = find_bottlenecks(speed, direction, np.full(speed.shape, 9), distance_px=40)
    labels, table = found.labels, found.table
    assert len(table) == 1
    assert abs(table.ratio[0] - 1 / 3) < 0.01
    assert labels[20, 110] == table.region[0]
    assert labels[20, 90] == 0
    assert labels[20, 170] == 0  # faster than upstream: not a bottleneck


def path(track: int, points: np.ndarray) -> Segments:
    """One track along points, five frames a second."""
    out = np.zeros(len(points) - 1, SEGMENT_DTYPE)
    out["track"], out["start_s"], out["duration_s"] = track, np.arange(len(out)) / 5, 0.2
    out["x0_px"], out["y0_px"], out["x1_px"], out["y1_px"] = *points[:-1].T, *points[1:].T
    out["vx_px_per_s"], out["vy_px_per_s"] = (np.diff(points, axis=0) * 5).T
    return out


def arc(radius: float, turn: float, n: int = 24) -> np.ndarray:
    """A straight, an arc about (100, 100), a straight."""
    angle = np.linspace(-np.pi / 2, -np.pi / 2 + turn, n)
    bend = 100 + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    start = bend[0] + np.column_stack([np.arange(-60, 0, 10), np.zeros(6)])
    along = np.array([-np.sin(angle[-1]), np.cos(angle[-1])])
    return np.concatenate([start, bend, bend[-1] + along * np.arange(10, 70, 10)[:, None]])


def test_a_u_turn_is_found_and_a_roundabout_a_right_turn_and_a_straight_are_not() -> None:
    segments = np.concatenate(
        [
            path(1, arc(20, np.pi)),
            path(2, arc(200, np.pi, n=60)),
            path(3, arc(20, np.pi / 2)),
            path(4, np.column_stack([np.arange(0, 100, 8.0), np.full(13, 50.0)])),
        ]
    )
    found = find_u_turns(segments, stationary_speed_px_per_s=4.0, max_path_px=120)
    assert found.track_id.tolist() == [1]
    assert np.hypot(found.x_px[0] - 120, found.y_px[0] - 100) < 12
    assert found.turn_rad[0] > math.radians(150)


def test_no_segments_give_no_u_turns() -> None:
    assert find_u_turns(np.zeros(0, SEGMENT_DTYPE), stationary_speed_px_per_s=4.0, max_path_px=100).empty
