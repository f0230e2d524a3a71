"""Intervals hold the long run: of vehicles that are alike as they come in platoons, and of simulated traffic."""

from collections import defaultdict

import numpy as np
import pytest

from schemas.arrays import FloatArray
from tests.benchmarks.intervals import make_clips
from velfield.analysis.intervals import (
    estimate_event_rate,
    estimate_mean,
    estimate_quantile,
    independent_vehicles,
)

CASES, PLATOONS, IN_PLATOON = 400, 12, 6


def platoons(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Speeds and times of vehicles, 2 s apart in platoons 40 s apart: half the variance is between platoons."""
    time_s = 40.0 * np.repeat(np.arange(PLATOONS), IN_PLATOON) + 2.0 * np.tile(np.arange(IN_PLATOON), PLATOONS)
    speed = 14 + np.repeat(rng.normal(size=PLATOONS), IN_PLATOON) + rng.normal(size=len(time_s))
    order = rng.permutation(len(time_s))
    return speed[order], time_s[order]


def test_intervals_of_vehicles_in_platoons_hold_the_long_run() -> None:
    rng = np.random.default_rng(0)
    held = defaultdict(list)
    for _ in range(CASES):
        speed, time_s = platoons(rng)
        for name, found in (
            ("mean", estimate_mean(speed, time_s)), ("median", estimate_quantile(speed, 0.5, time_s)),
            ("as if independent", estimate_mean(speed)),
        ):  # fmt: skip
            assert found.n == len(speed)
            held[name].append(found.low <= 14 <= found.high)
    assert 0.84 <= np.mean(held["mean"]) <= 0.97
    assert 0.84 <= np.mean(held["median"]) <= 0.97
    assert np.mean(held["as if independent"]) < 0.8


@pytest.mark.parametrize("n", [4, 6, 12])
def test_intervals_of_few_skewed_values_hold_their_mean_and_stay_in_reach(n: int) -> None:
    """Hall's correction has no bound: five vehicles of 34 to 41 km/h had a mean "of 29 to 79 km/h", queues of -37 m."""
    found = [estimate_mean(values, min_n=3) for values in np.random.default_rng(4).exponential(size=(1000, n))]
    assert 0.82 <= np.mean([one.low <= 1.0 <= one.high for one in found if one]) <= 0.96
    assert min(one.low for one in found if one) >= 0.0
    in_platoon = estimate_mean(np.array([34.0, 34.0, 35.0, 36.0, 41.0]), 2.0 * np.arange(5), spread=(9.0, 8))
    assert 18 < in_platoon.low < in_platoon.high < 57


def test_vehicles_far_apart_are_independent_and_a_platoon_of_one_speed_is_one() -> None:
    rng = np.random.default_rng(1)
    assert independent_vehicles(rng.normal(size=50), 60.0 * np.arange(50)) == pytest.approx(50, rel=0.01)
    alike = independent_vehicles(np.repeat([1.0, 2.0, 3.0, 4.0], 10), np.repeat([0.0, 90.0, 180.0, 270.0], 10))
    assert alike == pytest.approx(4, rel=0.1)


def test_a_quantile_beyond_which_no_value_need_lie_is_withheld() -> None:
    values = np.random.default_rng(2).normal(size=19)
    assert estimate_quantile(values, 0.85) is not None
    assert estimate_quantile(values[:18], 0.85) is None
    assert estimate_quantile(values, 0.85, np.arange(19.0)) is None  # 19 that pass within 19 s


@pytest.mark.parametrize("bunched", [1.001, 1.15, 1.2])
def test_the_rate_of_events_holds_the_true_one_though_they_come_in_bunches(bunched: float) -> None:
    rng = np.random.default_rng(3)
    true = rng.uniform(4.0, 20.0, 4000)
    counts = rng.negative_binomial(0.5 * true / (bunched - 1), 1 / bunched)
    found = [estimate_event_rate(int(n), 0.5) for n in counts]
    assert 0.87 <= np.mean([e.low <= t <= e.high for e, t in zip(found, true, strict=True)]) <= 0.93
    assert estimate_event_rate(0, 0.5).high == pytest.approx(4.6, abs=0.01)


def test_intervals_of_simulated_clips_hold_the_long_run() -> None:
    """One crossroads, five clips with the errors of the benchmark, which has bounds for more of them."""
    held: defaultdict[str, list[bool]] = defaultdict(list)
    for clip in make_clips(5003, 5, long_run=4):
        for i in clip.intervals():
            held[i.kind.split(":")[0]].append(i.estimate.low <= i.truth <= i.estimate.high)
    assert {"movement", "lane", "station", "queue", "signal", "free flow", "U-turns an hour"} <= set(held)
    assert 0.82 <= np.mean([hit for hits in held.values() for hit in hits]) <= 0.96
    for kind in ("movement", "lane", "station", "queue", "signal"):
        assert np.mean(held[kind]) >= 0.75, kind
