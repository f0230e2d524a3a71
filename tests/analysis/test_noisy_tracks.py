"""Answers about tracks with errors, and about short clips, are true or withheld."""

import numpy as np
import pytest

from tests.analysis.noisy_tracks import CYCLE_S, Noise, analyse, clip, driven
from tests.benchmarks.short_clips import make_cases
from velfield.analysis.traffic_analysis import TrafficAnalysis

NOISES = [
    Noise(0.2),
    Noise(0.5),
    Noise(1.0),
    Noise(0.05, 0.3, 1.0),
    Noise(0.05, 0.6, 1.5),
    Noise(0.05, 0.35, 0.5, True),
]


@pytest.fixture(scope="module")
def truth() -> TrafficAnalysis:
    return analyse(driven(), Noise())


def signals_are_true_or_withheld(analysis: TrafficAnalysis) -> int:
    """Asserts that no signal is denied and no cycle is wrong; the number of cycles that are found."""
    found = 0
    for signal in analysis.signals.values():
        assert signal.signalised is not False, signal.reason
        if signal.signalised is None:
            assert signal.reason.startswith("too little data")
        else:
            assert signal.cycle_s.low - 0.5 <= CYCLE_S <= signal.cycle_s.high + 0.5
            found += 1
    return found


@pytest.mark.parametrize("noise", NOISES, ids=str)
def test_errors_make_no_lanes_u_turns_or_cycles(noise: Noise, truth: TrafficAnalysis) -> None:
    analysis = analyse(driven(), noise)
    driven_m = [sum(lane.length_m for lane in a.lanes) for a in (truth, analysis)]
    assert driven_m[1] == pytest.approx(driven_m[0], rel=0.1)
    assert len(analysis.lanes) == pytest.approx(len(truth.lanes), rel=0.25)
    assert sorted(turn.round_circle for turn in analysis.reversals) == [False, True]
    assert len(truth.reversals) == 2
    assert signals_are_true_or_withheld(analysis) == 1


def test_two_cycles_give_a_cycle_with_its_interval() -> None:
    analysis = analyse(clip(driven(), 0.0, 63.0), Noise())
    cycles = [s.cycle_s for s in analysis.signals.values() if s.cycle_s]
    assert len(cycles) == 1
    assert cycles[0].low < CYCLE_S < cycles[0].high
    assert np.ptp([cycles[0].low, cycles[0].high]) > 0.3


@pytest.mark.parametrize("seed", [3009, 7446, 7521, 7533])
def test_every_statement_about_short_sparse_and_noisy_clips_is_true_or_withheld(seed: int) -> None:
    said: set[str] = set()
    for case in make_cases(seed):
        for statement in case.statements():
            assert statement.true, f"{case.name}: {statement.kind}: {statement.text}"
            said.add(statement.kind)
    assert {"signal", "u-turns", "limit", "speed", "count", "flow", "words"} <= said
