"""Gap closing: a track that was interrupted goes on as itself, and no other vehicle's does in its place."""

import tracemalloc
from collections.abc import Sequence

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import linear_sum_assignment

from velfield.tracking.join_costs import GapLimits
from velfield.tracking.joins import (
    END_COLUMNS,
    _assign,
    _assign_sparse,
    _assign_table,
    close_gaps,
    find_ends,
)

GSD_M = 0.25
INTERVAL_S = 0.2


def seen(start_s: float, frames: int, x_m: float, speed: float, acceleration: float = 0.0, lane_m: float = 0.0):
    """Tracklets of a vehicle along x, detected in so many frames: `END_COLUMNS`."""
    t = start_s + INTERVAL_S * np.arange(frames)
    x = x_m + speed * (t - start_s) + acceleration * (t - start_s) ** 2 / 2
    v = np.diff(x) / INTERVAL_S
    columns = {"time_0_s": t[:-2], "x_0_px": x[:-2] / GSD_M, "y_0_px": lane_m / GSD_M, "vx_01_px_per_s": v[:-1] / GSD_M}
    columns |= {"frame_0": np.round(t[:-2] / INTERVAL_S), "frame_2": np.round(t[2:] / INTERVAL_S)}
    columns |= {"time_2_s": t[2:], "x_2_px": x[2:] / GSD_M, "y_2_px": lane_m / GSD_M, "vx_12_px_per_s": v[1:] / GSD_M}
    return pd.DataFrame({**columns, "vy_01_px_per_s": 0.0, "vy_12_px_per_s": 0.0})[END_COLUMNS]


def reconnected(parts: Sequence[pd.DataFrame], gap_s: float = 2.0, stationary_gap_s: float = 0.0) -> list[int]:
    """The track of each part, each a track of its own before."""
    tracks = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    starts, ends = find_ends(pd.concat(parts, ignore_index=True), tracks, len(parts), GSD_M)
    after = close_gaps(np.arange(len(parts)), ends, starts, GapLimits(gap_s, stationary_gap_s)).tracks[tracks]
    assert all(len(set(after[tracks == k])) == 1 for k in range(len(parts)))
    return [int(after[tracks == k][0]) for k in range(len(parts))]


@pytest.mark.parametrize(("speed", "acceleration"), [(0.0, 0.0), (14.0, 0.0), (12.0, -3.0), (3.0, 2.5)])
def test_a_gap_of_a_second_is_closed(speed: float, acceleration: float) -> None:
    before = seen(0.0, 6, 0.0, speed, acceleration)
    gap_seconds = 1.0 + 1.2  # five intervals detected, six not
    x_after = speed * gap_seconds + acceleration * gap_seconds**2 / 2
    after = seen(gap_seconds, 5, x_after, speed + acceleration * gap_seconds, acceleration)
    assert reconnected([before, after]) == [0, 0]
    assert reconnected([before, after], gap_s=1.0) == [0, 1]
    assert reconnected([before, after], gap_s=0.0) == [0, 1]


def test_a_stationary_vehicle_is_reconnected_however_long_the_gap() -> None:
    stationary, again = seen(0.0, 6, 0.0, 0.1), seen(20.0, 6, 0.5, 0.0)
    assert reconnected([stationary, again], stationary_gap_s=30.0) == [0, 0]
    assert reconnected([stationary, again]) == [0, 1]
    assert reconnected([stationary, again], stationary_gap_s=10.0) == [0, 1]
    assert reconnected([stationary, seen(20.0, 6, 1.4, 0.0)], stationary_gap_s=30.0) == [0, 0]  # another end of it
    assert reconnected([stationary, seen(20.0, 6, 2.1, 0.0)], stationary_gap_s=30.0) == [0, 1]
    rolling = seen(20.0, 6, 0.5, 3.0)  # the next vehicle at its position, and one that passes through it
    assert reconnected([stationary, rolling], stationary_gap_s=30.0) == [0, 1]
    assert reconnected([seen(0.0, 6, -2.0, 3.0), again], stationary_gap_s=30.0) == [0, 1]


@pytest.mark.parametrize(
    ("speed_before", "speed_after", "displacement_m", "same"),
    [
        (0.2, 2.0, 1.2, True),  # sets off
        (4.0, 0.1, 4.5, True),  # comes to rest
        (4.0, 3.0, 6.0, True),  # both
        (4.0, 3.0, 15.0, False),  # it would have driven on
        (4.0, 3.0, 1.0, False),  # no vehicle brakes and accelerates so fast
        (4.0, 3.0, -6.0, False),
        (9.0, 9.0, 40.0, False),  # how far that takes is too uncertain
    ],
)
def test_a_vehicle_that_stops_in_the_gap_gets_as_far_as_its_speeds_say(
    speed_before: float, speed_after: float, displacement_m: float, same: bool
) -> None:
    before = seen(0.0, 6, 0.0, speed_before)
    after = seen(20.0, 6, 5 * INTERVAL_S * speed_before + displacement_m, speed_after)
    assert reconnected([before, after], stationary_gap_s=30.0) == ([0, 0] if same else [0, 1])
    assert reconnected([before, after], stationary_gap_s=10.0) == [0, 1]
    aside = seen(20.0, 6, 5 * INTERVAL_S * speed_before + displacement_m, speed_after, lane_m=3.0)
    assert reconnected([before, aside], stationary_gap_s=30.0) == [0, 1]


def test_a_queue_lost_as_a_whole_sets_off_in_its_order() -> None:
    """Six vehicles 6.5 m apart, at rest, are seen again at speeds of their own: the first has gone farthest."""
    x_m, speeds = -6.5 * np.arange(6), np.array([5.0, 4.5, 4.0, 3.0, 2.0, 1.2])
    before = [seen(0.0, 6, x, 0.0) for x in x_m]
    after = [seen(25.0, 4, x + v**2 / 4, v) for x, v in zip(x_m, speeds, strict=True)]
    assert reconnected([*before, *after], stationary_gap_s=60.0) == [*range(6), *range(6)]


@pytest.mark.parametrize("frames", [3, 8])
def test_a_velocity_that_the_positions_contradict_is_not_believed(frames: int) -> None:
    """The last crop of a vehicle that drives under a tree aligned with the tree."""
    again_s = INTERVAL_S * (frames - 1) + 1.6
    before, after = seen(0.0, frames, 0.0, 9.0), seen(again_s, 6, 9.0 * again_s, 9.0)
    assert reconnected([before, after]) == [0, 0]
    before.loc[before.index[-1], "vx_12_px_per_s"] = 0.2
    assert reconnected([before, after]) == [0, 0]
    stands = seen(again_s, 6, 9.0 * (again_s - 1.6) + 0.5, 0.0)  # another one, where it was seen last
    assert reconnected([before, stands], stationary_gap_s=30.0) == [0, 1]
    after.loc[after.index[0], "vx_01_px_per_s"] = -3.0
    assert reconnected([before, after]) == [0, 0]


def test_joins_are_chosen_together() -> None:
    """The nearest pair of all would leave two others apart that are a vehicle's as well."""
    ends = [seen(0.0, 6, 0.0, 10.0), seen(0.0, 6, 1.6, 10.0)]
    starts = [seen(2.0, 6, 20.0 + 1.2, 10.0), seen(2.0, 6, 20.0 + 2.7, 10.0)]
    assert reconnected([*ends, *starts]) == [0, 1, 0, 1]


def test_three_parts_are_one_track_in_any_order() -> None:
    first, second, third = (seen(k * 2.0, 6, 20.0 * k, 10.0) for k in range(3))
    assert reconnected([first, second, third]) == [0, 0, 0]
    assert reconnected([third, first, second]) == [0, 0, 0]


def test_the_next_vehicle_of_a_queue_is_another_track() -> None:
    stationary = seen(0.0, 6, 0.0, 0.0)
    assert reconnected([stationary, seen(1.8, 6, 6.0, 0.0)]) == [0, 1]
    assert reconnected([stationary, seen(1.8, 6, 0.0, 0.0, lane_m=3.2)]) == [0, 1]


def test_opposite_traffic_is_another_track() -> None:
    assert reconnected([seen(0.0, 6, 0.0, 12.0), seen(1.6, 6, 19.2, -12.0)]) == [0, 1]


def test_vehicles_lost_at_the_same_time_are_not_exchanged() -> None:
    """Side by side and one behind the other, with equal gaps: each is reconnected to itself."""
    ways = [(0.0, 0.0, 13.0), (9.0, 0.0, 13.0), (0.0, 3.3, 15.0)]
    before = [seen(0.0, 6, x, speed, lane_m=lane) for x, lane, speed in ways]
    after = [seen(2.4, 6, x + 2.4 * speed, speed, lane_m=lane) for x, lane, speed in ways]
    assert reconnected([*before, *after]) == [0, 1, 2, 0, 1, 2]


def test_an_end_is_reconnected_once() -> None:
    """Two tracks start near one prediction: the nearer is reconnected, the other is new."""
    assert reconnected([seen(0.0, 6, 0.0, 10.0), seen(1.8, 6, 19.0, 10.0), seen(1.8, 6, 18.1, 10.0)]) == [0, 1, 0]


def test_no_tracklets() -> None:
    none = np.zeros(0, np.int64)
    starts, ends = find_ends(seen(0.0, 2, 0.0, 1.0), none, 0, None)
    assert close_gaps(none, ends, starts, GapLimits(2.0)).tracks.size == 0


@pytest.mark.parametrize(("tracks", "pairs"), [(3, 6), (150, 900), (500, 4000)])
def test_sparse_assignment_is_that_of_a_table(tracks: int, pairs: int) -> None:
    rng = np.random.default_rng(tracks)
    ends, starts = np.unique(rng.integers(0, tracks, (pairs, 2)), axis=0).T
    row, column = (np.unique(one, return_inverse=True)[1] for one in (ends, starts))
    gain = rng.uniform(0.01, 4, len(row))
    by_table, by_pairs = _assign_table(row, column, gain), _assign_sparse(row, column, gain)
    np.testing.assert_array_equal(by_pairs[0], by_table[0])
    np.testing.assert_allclose(by_pairs[1], by_table[1], atol=1e-12)


@pytest.mark.parametrize("tracks", [12, 150])
def test_a_margin_is_what_the_total_loses_without_the_pair(tracks: int) -> None:
    """Candidates are of a queue: the next two of it."""
    rng, reach = np.random.default_rng(tracks), 2
    row, column = (one.ravel() for one in np.mgrid[:tracks, -reach : reach + 1])
    row, column = row[keep := (row + column >= 0) & (row + column < tracks)], (row + column)[keep]
    gain = rng.uniform(0.01, 4, len(row))
    best, margins = _assign_table(row, column, gain)
    table = np.zeros((tracks, tracks))
    table[row, column] = gain
    whole, exact = table[linear_sum_assignment(-table)].sum(), []
    for i, j in best:
        without = table.copy()
        without[i, j] = 0
        exact.append(whole - without[linear_sum_assignment(-without)].sum())
    sure = margins >= 1.5  # of these a lower bound is enough
    assert 0 < sure.sum() < len(best)
    assert margins[~sure] == pytest.approx(np.array(exact)[~sure], abs=1e-9)
    assert (margins <= np.array(exact) + 1e-9).all()


def test_memory_grows_with_the_pairs_and_not_with_their_square() -> None:
    """A chain of 20,000 tracks that all hang together: a table of them would take 3.2 GB."""
    tracks = 20_000
    pairs = np.concatenate(
        [np.column_stack([np.arange(tracks - 1 - k), np.arange(tracks - 1 - k) + 1 + k]) for k in (0, 1)]
    )
    tracemalloc.start()
    joined, _ = _assign(pairs, np.repeat([3.0, 0.5], [tracks - 1, tracks - 2]))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(joined) == tracks - 1
    assert (joined[:, 1] == joined[:, 0] + 1).all()
    assert peak < 100e6
