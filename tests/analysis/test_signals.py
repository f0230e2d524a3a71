"""Signals of lanes in which some give way: stop lines, phases and greens."""

import numpy as np
import pytest

from tests.analysis.test_traffic_analysis import CYCLE_S, EAST, SOUTH, Track, crossroads, drive, gather
from velfield.analysis.signals.cycles import JunctionSignal
from velfield.analysis.signals.phases import START_DELAY_S, fit_phases
from velfield.analysis.traffic_analysis import TrafficAnalysis

STOP_M, GAP_M = 128.0, 138.0
"""Where the first vehicles from the west stand at red, and where those that turn left wait within the junction."""


def signal_of(tracks: list[Track]) -> JunctionSignal:
    (signal,) = (s for s in TrafficAnalysis(gather(tracks)).signals.values() if s.signalised)
    return signal


def giving_way() -> list[Track]:
    """Twelve cycles, as `crossroads`; in three of four the second from the west waits in the junction until 16 s of
    the cycle, and those behind it wait too."""
    out = []
    for cycle in range(12):
        begin = cycle * CYCLE_S
        for k in range(4):
            go = begin + START_DELAY_S + 1.8 * k
            waits = (GAP_M - 7.0 * (k - 1), begin + 14.2 + 1.8 * k) if cycle % 4 and k else None
            out.append(drive(EAST, begin - 24 + 3 * k, stop_at_m=STOP_M - 7 * k, go_s=go, waits=waits))
            out.append(drive(SOUTH, begin - 4 + 3 * k, stop_at_m=78.0 - 7 * k, go_s=go + 20))
    return out


def test_the_stop_line_is_not_where_vehicles_wait_for_a_gap() -> None:
    signal = signal_of(giving_way())
    assert len(signal.phases) == 2
    (west,) = (s for s in signal.streams if np.ptp(s.stream.approach.path_m[:, 1]) < 2.0)
    stop = west.stream.approach.path_m[round(west.stream.stop_line_m or 0)]
    assert stop[0] == pytest.approx(STOP_M + 2.4, abs=1.5)  # the front of a car
    early_s = (west.green_phase_s.value + CYCLE_S / 2) % CYCLE_S - CYCLE_S / 2
    assert early_s == pytest.approx(0.0, abs=1.0)


def test_where_the_first_is_not_seen_the_second_does_not_stand_at_the_line() -> None:
    whole, found = (signal_of([t for k, t in enumerate(crossroads()) if k % 18 or not missed]) for missed in (0, 1))
    lines = [{s.stream.approach.lane: s.stream.stop_line_m for s in signal.streams} for signal in (whole, found)]
    assert len(lines[0]) == len(lines[1]) == 2
    for (_, a), (_, b) in zip(*(sorted(one.items()) for one in lines), strict=True):
        assert a == pytest.approx(b, abs=1.5)


def test_who_stands_over_the_stop_line_behind_one_that_waits_has_crossed_it() -> None:
    """The third from the west stands with its front 3 m beyond the line until 17.8 s of the cycle; a queue's third
    crosses within 9 s."""
    tracks = giving_way()
    west = next(s.stream for s in signal_of(tracks).streams if np.ptp(s.stream.approach.path_m[:, 1]) < 2.0)
    third = np.flatnonzero(np.isin(west.cross_track, np.arange(len(tracks))[4::8]))
    assert len(third) == 12
    assert np.max(west.cross_time_s[third] % CYCLE_S) < 12.0


def test_a_cycle_of_starts_that_wait_for_the_junction_to_clear_holds_the_truth() -> None:
    """All lanes of a phase wait as long; the starts of four cycles then seem to recur after more or less than 80 s."""
    rng, held, green, half_s = np.random.default_rng(6), [], [], []
    for _ in range(150):
        starts = []
        for onset in (12.0, 52.0):
            late = onset + START_DELAY_S + 80.0 * np.arange(4) + rng.exponential(2.5, 4)
            starts += [late + rng.normal(0, 0.25, 4) for _ in range(4)]
        cycle, phases = fit_phases(starts, 80.1)
        held.append(cycle.low <= 80.0 <= cycle.high)
        half_s.append((cycle.high - cycle.low) / 2)
        green += [p.green_s.low < true < p.green_s.high for p, true in zip(phases, (12.0, 52.0), strict=True)]
    assert np.mean(held) > 0.86
    assert np.mean(green) > 0.86
    assert np.median(half_s) < 1.6
