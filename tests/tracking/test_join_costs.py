"""Which gaps may be one vehicle's: hidden turns, long vehicles, and what stays briefly in one place."""

import numpy as np
import pytest

from schemas.arrays import FloatArray, IntArray
from tests.tracking_scenes import together
from velfield.tracking import join_costs
from velfield.tracking.join_costs import GapLimits, TrackEnds, find_candidates
from velfield.tracking.joins import EndContext, close_gaps

LIMITS = GapLimits(4.0, 60.0, 15.0)


def side(time_s: float, x: float, y: float, speed: float, heading_deg: float) -> TrackEnds:
    heading = np.radians(heading_deg)
    velocity = speed * np.array([[np.cos(heading), np.sin(heading)]])
    return TrackEnds(np.array([round(5 * time_s)]), np.array([time_s]), np.array([[x, y]], dtype=float), velocity)


def may_join(end: TrackEnds, start: TrackEnds, length_m: float = np.nan) -> bool:
    """Whether the end of one track and the start of another are a candidate."""
    never = side(-1000.0, 0.0, 0.0, 0.0, 0.0)
    pairs, _ = find_candidates(together(end, never), together(never, start), LIMITS, np.full(2, length_m))
    return [0, 1] in pairs.tolist()


def on_a_circle(turn_deg: float, radius: float) -> tuple[FloatArray, float]:
    """Where a vehicle that sets off along x is after so much of a circle, and how far it drove."""
    turn = np.radians(turn_deg)
    return radius * np.array([np.sin(turn), 1 - np.cos(turn)]), radius * turn


@pytest.mark.parametrize("turn_deg", [40, 90, 135, 170])
def test_a_vehicle_that_goes_round_a_circle_under_trees_is_followed(turn_deg: float) -> None:
    place, way = on_a_circle(turn_deg, 13.0)
    gap = way / 5.5
    end = side(1.0, 0, 0, 5.5, 0)
    assert may_join(end, side(1.0 + gap, *place, 5.5, turn_deg))
    assert not may_join(end, side(1.0 + gap, place[0], -place[1], 5.5, turn_deg))  # it would have turned the other way
    assert not may_join(end, side(1.0 + 0.4 * gap, *place, 5.5, turn_deg))  # too soon
    assert not may_join(end, side(1.0 + gap, *place, 5.5, turn_deg + 100))


@pytest.mark.parametrize(("before_m", "after_m"), [(12.0, 20.0), (20.0, 12.0), (15.0, 15.0)])
def test_a_vehicle_that_turns_somewhere_within_a_junction_is_followed(before_m: float, after_m: float) -> None:
    """Straight on, an arc of 8 m, straight on."""
    way = before_m + after_m - 16.0 + 8.0 * np.pi / 2
    start = side(1.0 + way / 5.0, before_m, after_m, 5.0, 90)
    assert may_join(side(1.0, 0, 0, 5.0, 0), start)
    assert not may_join(side(1.0, 0, 0, 5.0, 0), side(1.0 + way / 5.0, before_m, after_m, 5.0, -90))


def test_no_vehicle_takes_a_turn_that_would_throw_it_out() -> None:
    """On an arc of 6 m at 7 m/s it would feel 8 m/s^2."""
    place, way = on_a_circle(160, 6.0)
    assert not may_join(side(1.0, 0, 0, 7.0, 0), side(1.0 + way / 7.0, *place, 7.0, 160))
    assert may_join(side(1.0, 0, 0, 4.0, 0), side(1.0 + way / 4.0, *place, 4.0, 160))


def test_a_lorry_may_be_found_at_its_cab_and_then_at_its_load() -> None:
    end, start = side(1.0, 0, 0, 10.0, 0), side(1.2, -1.0, 0, 10.0, 0)
    assert may_join(end, start, 10.0)
    assert not may_join(end, start, 4.5)
    assert not may_join(end, start)
    assert not may_join(end, side(1.2, 2.0, 6.0, 10.0, 0), 10.0)  # in another lane


def three_tracks(vanish: bool) -> tuple[TrackEnds, TrackEnds, EndContext]:
    """A car that drives in, something that stays for 0.4 s where it was lost, and a car that drives on from there."""
    ends = together(side(2.0, 0, 0, 4.6, 0), side(3.0, 1.5, 0.5, 0, 0), side(9.0, 50, 0, 9.0, 0))
    starts = together(side(0.0, -10, 0, 4.6, 0), side(2.6, 1.5, 0.5, 0, 0), side(3.4, 5.5, 0.2, 3.5, 0))
    unknown = np.full((3, 16, 6), np.nan)
    middle = np.array([False, vanish, False])
    end_vanishes, start_vanishes = middle | [True, False, False], middle | [False, False, True]
    return ends, starts, EndContext(end_vanishes, start_vanishes, unknown, unknown, np.full(3, np.nan))


def test_what_stays_briefly_amid_the_frames_takes_no_vehicles_place() -> None:
    ends, starts, context = three_tracks(vanish=True)
    joins = close_gaps(np.arange(3), ends, starts, LIMITS, context).joins
    assert joins[["before", "after"]].to_numpy().tolist() == [[0, 2]]


def test_two_of_them_in_one_place_are_one() -> None:
    ends = together(side(1.6, 0, 0, 0.1, 0), side(8.0, 0.3, 0, 0.1, 90))
    starts = together(side(1.0, 0, 0, 0.1, 0), side(7.4, 0.3, 0, 0.1, 90))
    unknown, all_of = np.full((2, 16, 6), np.nan), np.ones(2, bool)
    context = EndContext(all_of, all_of, unknown, unknown, np.full(2, np.nan))
    assert len(close_gaps(np.arange(2), ends, starts, LIMITS, context).joins) == 1


@pytest.mark.parametrize("seed", range(4))
def test_no_join_is_lost_where_only_near_starts_are_weighed(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Starts where each vehicle would be by its speed, at its greatest pace, or after a stop, and far from there."""
    rng = np.random.default_rng(seed)
    count = 700

    def ends_at(time_s: FloatArray, position_m: FloatArray, speed: FloatArray, heading: FloatArray) -> TrackEnds:
        velocity = speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
        return TrackEnds(np.round(5 * time_s).astype(np.int64), time_s, position_m, velocity)

    speed, heading = rng.choice([0.0, 1.0, 4.0, 9.0, 16.0, 35.0], count), rng.uniform(-np.pi, np.pi, count)
    end = ends_at(rng.uniform(0, 30, count), rng.uniform(0, 400, (count, 2)), speed, heading)
    gap_s, pace = rng.choice([0.3, 2.0, 4.0, 10.0, 15.0], count), speed + rng.choice([-2.0, 0.0, 2.4, 3.0], count)
    turned = heading + rng.normal(0, 0.5, count)
    way = (pace * gap_s + rng.choice([0.0, 2.0, 12.0, 18.0], count))[:, None]
    place = end.position_m + way * np.column_stack([np.cos(turned), np.sin(turned)]) + rng.normal(0, 2, (count, 2))
    start = ends_at(end.time_s + gap_s, place, np.abs(speed + rng.normal(0, 1, count)), turned)
    length_m = rng.choice([np.nan, 4.0, 18.0], count)
    monkeypatch.setattr("velfield.tracking.join_costs._PAIRS_AT_ONCE", 9000)
    for limits in (LIMITS, GapLimits(4.0, 60.0, 15.0, 1.15), GapLimits(2.0, 5.0, 8.0, 6.0)):
        pairs, cost = find_candidates(end, start, limits, length_m)
        expected_pairs, expected_cost = weigh_all_pairs(end, start, limits, length_m)
        assert len(expected_pairs) > 300
        np.testing.assert_array_equal(pairs, expected_pairs)
        np.testing.assert_array_equal(cost, expected_cost)


def weigh_all_pairs(
    ends: TrackEnds, starts: TrackEnds, limits: GapLimits, length_m: FloatArray
) -> tuple[IntArray, FloatArray]:
    """`find_candidates` by every model of every end and every start after it."""
    slack = 0.9 * np.maximum(np.nan_to_num(length_m) - 4.8, 0.0)
    end, start = np.nonzero(starts.time_s > ends.time_s[:, None])
    gaps = join_costs._Gaps(
        starts.time_s[start] - ends.time_s[end],
        starts.position_m[start] - ends.position_m[end],
        ends.velocity_m_per_s[end],
        starts.velocity_m_per_s[start],
        (slack[end] + slack[start]) / 2,
    )
    cost = np.min([model(gaps, limits) for model in join_costs._MODELS], axis=0)
    rank = np.lexsort((start, end, cost))
    rank = rank[np.isfinite(cost[rank])]
    return np.column_stack([end, start])[rank], cost[rank]
