"""Detections that only a track confirms: ends extended, gaps filled, and positions in between."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.arrays import FloatArray, IntArray
from tests.tracking_scenes import together
from velfield.tracking.join_costs import GapLimits, TrackEnds
from velfield.tracking.joins import EndContext
from velfield.tracking.recovery import (
    Candidates,
    Gap,
    extend_tracks,
    fill_gap,
    interpolate_gap,
    recover_tracks,
)

DT = 0.2
LIMITS = GapLimits(4.0, 60.0, 15.0)


def end(frame: int, x: float, speed: float, y: float = 0.0) -> TrackEnds:
    return TrackEnds(np.array([frame]), np.array([frame * DT]), np.array([[x, y]]), np.array([[speed, 0.0]]))


def candidates(frames: IntArray, xy: FloatArray, axis: float = 0.0) -> Candidates:
    order = np.argsort(frames, kind="stable")
    frames, xy = np.asarray(frames)[order], np.asarray(xy, np.float64)[order]
    return Candidates(frames * 1000 + np.arange(len(frames)), frames, frames * DT, xy, np.full(len(frames), axis))


def context(n: int, *, vanish: bool) -> EndContext:
    unknown = np.full((n, 16, 6), np.nan)
    return EndContext(np.full(n, vanish), np.full(n, vanish), unknown, unknown, np.full(n, np.nan))


@pytest.mark.parametrize("forward", [True, False])
def test_an_end_is_extended_by_what_moves_as_predicted_and_by_nothing_else(forward: bool) -> None:
    sign = 1 if forward else -1
    rng = np.random.default_rng(3)
    frames = 10 + sign * np.arange(1, 8)
    way = np.column_stack([sign * 2.0 * np.arange(1, 8), np.zeros(7)]) + rng.normal(0, 0.15, (7, 2))
    aside, standing = way + np.array([0.0, 3.0]), np.repeat([[sign * 3.0, 0.1]], 7, axis=0)
    seen = candidates(np.tile(frames, 3), np.concatenate([way, aside, standing]))
    free = np.ones(len(seen), bool)
    _, found, ends = extend_tracks(end(10, 0.0, 10.0), np.array([0]), seen, free, forward=forward)
    assert sorted(seen.frame[found]) == sorted(frames)
    assert np.abs(seen.position_m[found, 1]).max() < 1
    assert ends.frame.tolist() == [10 + 7 * sign]
    assert ends.velocity_m_per_s[0, 0] == pytest.approx(10, abs=0.8)
    assert free.sum() == 14
    across, _, _ = extend_tracks(
        end(10, 0.0, 10.0), np.array([0]), replace(seen, axis_rad=np.full(21, 1.2)), free | True, forward=forward
    )
    assert not len(across)  # a car that lies across the way


def test_an_end_is_not_extended_over_a_long_silence() -> None:
    seen = candidates(np.array([16]), np.array([[12.0, 0.0]]))
    _, found, _ = extend_tracks(end(10, 0.0, 10.0), np.array([0]), seen, np.ones(1, bool), forward=True)
    assert not len(found)


def test_one_candidate_is_of_one_track() -> None:
    seen = candidates(np.array([11]), np.array([[2.0, 0.4]]))
    both = together(end(10, 0.0, 10.0), end(10, 0.0, 10.0, y=1.0))
    tracks, _, _ = extend_tracks(both, np.array([0, 1]), seen, np.ones(1, bool), forward=True)
    assert tracks.tolist() == [0]


def test_a_gap_is_filled_on_the_way_and_goes_through_what_fills_it() -> None:
    gap = Gap(
        7, (2.0, 4.0), (np.array([0.0, 0.0]), np.array([16.0, 0.0])), (np.array([8.0, 0.0]), np.array([8.0, 0.0]))
    )
    assert gap.at(np.array([2.0, 3.0, 4.0]))[:, 0] == pytest.approx([0, 8, 16])
    seen = candidates(
        np.array([13, 13, 15, 17, 25]), np.array([[4.8, 0.3], [4.8, 1.2], [8.0, 4.0], [11.2, -0.4], [30, 0]])
    )
    free = np.ones(5, bool)
    rows = fill_gap(gap, seen, free)
    assert seen.frame[rows].tolist() == [13, 17]
    assert seen.position_m[rows[0], 1] == 0.3
    assert free.tolist() == [False, True, True, False, True]
    through = interpolate_gap(replace(gap, filled=rows), seen, np.array([2.6, 3.0, 3.4]))
    assert through == pytest.approx(np.array([[4.8, 0.3], [8.0, -0.05], [11.2, -0.4]]))


def test_a_vehicle_that_stops_in_a_gap_does_not_overshoot() -> None:
    gap = Gap(0, (0.0, 20.0), (np.zeros(2), np.array([6.0, 0.0])), (np.array([4.0, 0.0]), np.array([3.0, 0.0])))
    x = gap.at(np.linspace(0, 20, 41))[:, 0]
    assert (np.diff(x) >= -1e-9).all()
    assert x.min() >= 0
    assert x.max() <= 6 + 1e-9


def test_a_queue_that_creeps_under_trees_keeps_its_order_and_each_join_has_a_probability() -> None:
    """Five vehicles 8 m apart disappear one after the other and appear 30 m further on; alone no gap is closed."""
    speed, way = 3.0, 30.0
    times = np.arange(5) * 8.0 / speed
    late, after = np.array([0.4, -0.3, 0.2, 0.0, -0.4]), np.array([3.2, 2.8, 3.1, 3.0, 3.4])
    nowhere, never = end(10**6, 1e6, 0.0), end(-(10**6), -1e6, 0.0)
    ends = [end(round(t / DT), 0.0, speed) for t in times] + [nowhere] * 5
    again = np.rint((times + way / speed + late) / DT).astype(int)
    starts = [never] * 5 + [end(int(frame), way, v) for frame, v in zip(again, after, strict=True)]
    vanish = context(10, vanish=True)
    vanish.end_looks[:5] = np.random.default_rng(5).normal(0, 1, (5, 16, 6))
    vanish.start_looks[5:] = vanish.end_looks[:5] + np.random.default_rng(6).normal(0, 0.2, (5, 16, 6))
    nothing = candidates(np.empty(0, np.int64), np.empty((0, 2)))
    found = recover_tracks(np.arange(10), together(*ends), together(*starts), LIMITS, vanish, nothing)
    assert found.tracks.tolist() == [*range(5), *range(5)]
    assert found.joins["probability"].between(0.75, 1.0).all()
    assert [gap.track_id for gap in found.gaps] == found.joins["before"].tolist()
    alike = recover_tracks(np.arange(10), together(*ends), together(*starts), LIMITS, context(10, vanish=True), nothing)
    assert len(alike.joins) < 5  # which is which is not certain enough
