"""Passages over gaps: who is lost from sight for a moment goes on, and nobody else goes on in his place."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import pytest

from velfield.tracking.gap_closing import END_COLUMNS, Gaps, join_chains

GSD_M = 0.25
INTERVAL_S = 0.2


def seen(start_s: float, frames: int, place_m: float, speed: float, acceleration: float = 0.0, lane_m: float = 0.0):  # type: ignore[no-untyped-def]
    """Tracklets of a vehicle along x, seen in so many frames: `END_COLUMNS`."""
    t = start_s + INTERVAL_S * np.arange(frames)
    x = place_m + speed * (t - start_s) + acceleration * (t - start_s) ** 2 / 2
    v = np.diff(x) / INTERVAL_S
    columns = {"time_0_s": t[:-2], "x_0_px": x[:-2] / GSD_M, "y_0_px": lane_m / GSD_M, "vx_01_px_per_s": v[:-1] / GSD_M}
    columns |= {"time_2_s": t[2:], "x_2_px": x[2:] / GSD_M, "y_2_px": lane_m / GSD_M, "vx_12_px_per_s": v[1:] / GSD_M}
    return pd.DataFrame({**columns, "vy_01_px_per_s": 0.0, "vy_12_px_per_s": 0.0})[END_COLUMNS]


def joined(parts: Sequence[pd.DataFrame], gap_s: float = 2.0, standing_gap_s: float = 0.0) -> list[int]:
    """The passage of each part, each a chain of its own."""
    chains = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    passages = join_chains(pd.concat(parts, ignore_index=True), chains, Gaps(gap_s, standing_gap_s), gsd_m=GSD_M)
    assert all(len(set(passages[chains == k])) == 1 for k in range(len(parts)))
    return [int(passages[chains == k][0]) for k in range(len(parts))]


@pytest.mark.parametrize(("speed", "acceleration"), [(0.0, 0.0), (14.0, 0.0), (12.0, -3.0), (3.0, 2.5)])
def test_lost_for_a_second_it_goes_on(speed: float, acceleration: float) -> None:
    before = seen(0.0, 6, 0.0, speed, acceleration)
    gone_s = 1.0 + 1.2  # five intervals seen, six not
    later_place = speed * gone_s + acceleration * gone_s**2 / 2
    after = seen(gone_s, 5, later_place, speed + acceleration * gone_s, acceleration)
    assert joined([before, after]) == [0, 0]
    assert joined([before, after], gap_s=1.0) == [0, 1]
    assert joined([before, after], gap_s=0.0) == [0, 1]


def test_what_stands_is_itself_however_long_it_is_lost() -> None:
    standing, again = seen(0.0, 6, 0.0, 0.1), seen(20.0, 6, 0.5, 0.0)
    assert joined([standing, again], standing_gap_s=30.0) == [0, 0]
    assert joined([standing, again]) == [0, 1]
    assert joined([standing, again], standing_gap_s=10.0) == [0, 1]
    assert joined([standing, seen(20.0, 6, 1.5, 0.0)], standing_gap_s=30.0) == [0, 1]
    rolling = seen(20.0, 6, 0.5, 3.0)  # the next in its place, and one that passes through it
    assert joined([standing, rolling], standing_gap_s=30.0) == [0, 1]
    assert joined([seen(0.0, 6, -2.0, 3.0), again], standing_gap_s=30.0) == [0, 1]


def test_three_parts_are_one_whatever_their_order() -> None:
    first, second, third = (seen(k * 2.0, 6, 20.0 * k, 10.0) for k in range(3))
    assert joined([first, second, third]) == [0, 0, 0]
    assert joined([third, first, second]) == [0, 0, 0]


def test_the_next_in_a_queue_is_another() -> None:
    standing = seen(0.0, 6, 0.0, 0.0)
    assert joined([standing, seen(1.8, 6, 6.0, 0.0)]) == [0, 1]
    assert joined([standing, seen(1.8, 6, 0.0, 0.0, lane_m=3.2)]) == [0, 1]


def test_what_comes_the_other_way_is_another() -> None:
    assert joined([seen(0.0, 6, 0.0, 12.0), seen(1.6, 6, 19.2, -12.0)]) == [0, 1]


def test_two_that_are_lost_at_once_keep_their_ways() -> None:
    """Side by side and one behind the other, all lost for as long: each goes on as itself."""
    ways = [(0.0, 0.0, 13.0), (9.0, 0.0, 13.0), (0.0, 3.3, 15.0)]
    before = [seen(0.0, 6, place, speed, lane_m=lane) for place, lane, speed in ways]
    after = [seen(2.4, 6, place + 2.4 * speed, speed, lane_m=lane) for place, lane, speed in ways]
    assert joined([*before, *after]) == [0, 1, 2, 0, 1, 2]


def test_an_end_goes_on_once() -> None:
    """Two start where one is foretold: the nearer is he, the other is new."""
    assert joined([seen(0.0, 6, 0.0, 10.0), seen(1.8, 6, 19.0, 10.0), seen(1.8, 6, 18.1, 10.0)]) == [0, 1, 0]


def test_no_tracklets() -> None:
    empty = seen(0.0, 2, 0.0, 1.0)
    assert join_chains(empty, np.zeros(0, np.int64), Gaps(2.0), gsd_m=None).size == 0
