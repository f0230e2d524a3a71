"""The ground sample distance by the lengths of vehicles: right, with an honest interval; a wrong one is reported."""

import numpy as np
import pytest

from schemas.arrays import FloatArray
from schemas.scale import CAR_LENGTH_M, ScaleEstimate
from velfield.analysis.vehicle_scale import MIN_VEHICLES, POPULATION_SD, estimate_vehicle_scale
from velfield.sources.scale import choose_scale

GSD_M = 0.23


def traffic(seed: int, count: int = 120) -> tuple[FloatArray, FloatArray]:
    """Lengths of vehicles and their standard deviations, px: of a place whose cars differ by 3 % from the usual."""
    rng = np.random.default_rng(seed)
    usual_m = CAR_LENGTH_M * np.exp(rng.normal(0, POPULATION_SD))
    length_m = usual_m * np.exp(rng.normal(0, 0.08, count))
    large = rng.uniform(size=count) < 0.12
    length_m[large] = rng.uniform(5.5, 12.0, large.sum())
    measured = length_m * np.exp(rng.normal(0, 0.06, count)) / GSD_M
    return measured, 0.06 * measured


def estimate(seed: int) -> ScaleEstimate:
    found = estimate_vehicle_scale(*traffic(seed))
    assert isinstance(found, ScaleEstimate)
    return found


def test_the_scale_is_right_and_its_interval_covers_it_nine_times_in_ten() -> None:
    found = [estimate(seed) for seed in range(60)]
    errors = np.array([one.gsd_m / GSD_M - 1 for one in found])
    assert np.sqrt(np.mean(errors**2)) < 0.05
    covered = np.mean([one.low_m <= GSD_M <= one.high_m for one in found])
    assert 0.85 <= covered <= 0.95


def test_lengths_that_scatter_more_than_they_say_give_the_scale_and_its_interval() -> None:
    """As of cars of 10 px: without an extra scatter short cars pass for the usual ones, and the usual ones for vans."""
    rng, errors, held = np.random.default_rng(8), [], []
    for seed in range(60):
        length, _ = traffic(seed)
        blurred = length * np.exp(rng.normal(0, 0.18, len(length)))
        found = estimate_vehicle_scale(blurred, 0.04 * blurred)
        errors.append(found.gsd_m / GSD_M - 1)
        held.append(found.low_m <= GSD_M <= found.high_m)
    assert abs(np.mean(errors)) < 0.02
    assert np.sqrt(np.mean(np.square(errors))) < 0.05
    assert np.mean(held) >= 0.85


def test_a_ground_sample_distance_wrong_by_a_fifth_is_reported_and_the_right_one_is_not() -> None:
    reported = {
        factor: np.mean(
            [len(choose_scale([given(factor * GSD_M), estimate(seed)]).disagreements) for seed in range(60)]
        )
        for factor in (1.0, 1.2, 1 / 1.2)
    }
    assert reported[1.2] >= 0.95
    assert reported[1 / 1.2] >= 0.95
    assert reported[1.0] <= 0.05


def given(gsd_m: float) -> ScaleEstimate:
    return ScaleEstimate(gsd_m=gsd_m, low_m=gsd_m, high_m=gsd_m, source="given")


def test_a_street_full_of_buses_is_taken_for_no_other_scale() -> None:
    rng = np.random.default_rng(5)
    length_m = np.concatenate([rng.normal(CAR_LENGTH_M, 0.35, 60), rng.normal(12.0, 0.5, 25)])
    found = estimate_vehicle_scale(length_m / GSD_M)
    assert found.gsd_m == pytest.approx(GSD_M, rel=0.04)


def test_too_few_vehicles_give_none() -> None:
    assert estimate_vehicle_scale(np.append(np.full(MIN_VEHICLES - 1, 20.0), np.nan)) is None
