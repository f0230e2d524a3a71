"""Signals of lanes in which some give way: stop lines, phases and greens."""

import numpy as np
import pytest

from tests.analysis.test_traffic_analysis import CYCLE_S, EAST, SOUTH, Track, crossroads, drive, gather
from velfield.analysis.answers import find_answers
from velfield.analysis.signals.cycles import JunctionSignal
from velfield.analysis.signals.phases import START_DELAY_S, fit_phases
from velfield.analysis.traffic_analysis import TrafficAnalysis

STOP_M, GAP_M = 128.0, 138.0
"""Where the first vehicles from the west stand at red, and where those that turn left wait within the junction."""


def signal_of(tracks: list[Track]) -> JunctionSignal:
    (signal,) = (s for s in TrafficAnalysis(gather(tracks)).signals.values() if s.signalised)
    return signal


def giving_way(*, vehicles: int = 4, leave_s: float = 14.2, south_s: float = 20.0) -> list[Track]:
    """Twelve cycles, as `crossroads`; in three of four the second from the west waits in the junction, and those behind
    it wait too. To the south the first drive off after ``south_s``."""
    out = []
    for cycle in range(12):
        begin = cycle * CYCLE_S
        for k in range(vehicles):
            go = begin + START_DELAY_S + 1.8 * k
            waits = (GAP_M - 7.0 * (k - 1), begin + leave_s + 1.8 * k) if cycle % 4 and k else None
            out.append(drive(EAST, begin - 24 + 3 * k, stop_at_m=STOP_M - 7 * k, go_s=go, waits=waits))
            out.append(drive(SOUTH, begin - 4 + 3 * k, stop_at_m=78.0 - 7 * k, go_s=go + south_s))
    return out


def test_the_stop_line_is_not_where_vehicles_wait_for_a_gap() -> None:
    signal = signal_of(giving_way())
    assert len(signal.phases) == 2
    (west,) = (s for s in signal.streams if np.ptp(s.stream.approach.path_m[:, 1]) < 2.0)
    stop = west.stream.approach.path_m[round(west.stream.stop_line_m or 0)]
    assert stop[0] == pytest.approx(STOP_M + 2.4, abs=1.5)  # the front of a car
    early_s = (west.green_phase_s.value + CYCLE_S / 2) % CYCLE_S - CYCLE_S / 2
    assert early_s == pytest.approx(0.0, abs=1.0)


def test_who_stands_at_the_line_behind_one_that_is_not_seen_has_no_green_of_its_own() -> None:
    """In two cycles a vehicle stands there until 18 s of the cycle: one that waits in the junction is missed."""
    late = [drive(EAST, k * CYCLE_S + 2.0, stop_at_m=STOP_M + 0.5, go_s=k * CYCLE_S + 18.0) for k in (4, 8)]
    west = next(s for s in signal_of(giving_way() + late).streams if np.ptp(s.stream.approach.path_m[:, 1]) < 2.0)
    stop = west.stream.approach.path_m[round(west.stream.stop_line_m or 0)]
    assert stop[0] == pytest.approx(STOP_M + 2.4, abs=1.5)


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


def test_a_green_may_begin_before_the_junction_is_clear() -> None:
    """To the south green begins at 20 s. The first start after 23 s, behind the last that wait in the junction."""
    tracks = [track for k, track in enumerate(giving_way(vehicles=3, leave_s=17.0, south_s=23.0)) if k // 6 % 4]
    south = next(s for s in signal_of(tracks).streams if np.ptp(s.stream.approach.path_m[:, 0]) < 2.0)
    assert south.green_phase_s.low < 20.0 < 22.0 < south.green_phase_s.value


def two_lanes(inner_go_s: list[float]) -> list[Track]:
    """Twelve cycles: two lanes from the west, of which the first of the inner one drives off at given times of the
    cycles, one after the other; to the south green from 20 s on."""
    inner = EAST - np.array([0.0, 3.5])
    out = []
    for cycle in range(12):
        begin = cycle * CYCLE_S
        for k in range(3):
            go, inner_go = begin + START_DELAY_S + 1.8 * k, inner_go_s[cycle % len(inner_go_s)]
            out.append(drive(EAST, begin - 20 + 3 * k, stop_at_m=STOP_M - 7 * k, go_s=go))
            out.append(drive(inner, begin - 18.5 + 3 * k, stop_at_m=STOP_M - 7 * k, go_s=go + inner_go))
            out.append(drive(SOUTH, begin - 4 + 3 * k, stop_at_m=78.0 - 7 * k, go_s=go + 20))
    return out


@pytest.mark.parametrize(
    ("inner_go_s", "phases"),
    [([0.0, 10.0, 10.0], 2), ([3.0, 10.0, 10.0, 6.0], 2), ([10.0], 3)],
    ids=["first at green, or in a gap", "in gaps alone", "a green of its own"],
)
def test_a_lane_has_a_green_of_its_own_where_it_has_red_before(inner_go_s: list[float], phases: int) -> None:
    signal = signal_of(two_lanes(inner_go_s))
    assert len(signal.phases) == phases
    for stream in signal.streams:
        path = stream.stream.approach.path_m
        inner = path[0, 1] < 98.0
        true = 20.0 if np.ptp(path[:, 0]) < 2.0 else 10.0 if phases == 3 and inner else 0.0
        green = stream.green_phase_s
        off = (true - green.value + CYCLE_S / 2) % CYCLE_S - CYCLE_S / 2
        assert green.low - green.value < off < green.high - green.value


def test_a_lane_whose_green_is_not_known_is_named() -> None:
    """Two vehicles start on the inner lane, 10 s after those beside them: they may have waited for a gap."""
    tracks = [track for k, track in enumerate(two_lanes([10.0])) if k % 3 != 1 or k in (37, 64)]
    tracks += [drive(EAST - np.array([0.0, 3.5]), cycle * CYCLE_S + 12.0) for cycle in range(12)]
    analysis = TrafficAnalysis(gather(tracks))
    (said,) = (a.text for a in find_answers(analysis) if a.topic == "signal" and a.state == "found")
    assert "2 phases" in said
    assert "; from W, straight on (lane 2): green not known" in said
