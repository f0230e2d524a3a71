"""Data association: costs, mutual best triples and their confidence, against plain definitions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.flight import PAPER_GSD_M, TrackingConfig
from tests.tracking_scenes import Detector, car, watch
from velfield.tracking.association import (
    APPEARANCE_EXPONENT,
    FALSE_ALARM_COST,
    MIN_TYPICAL_DIFFERENCE,
    appearance_cost,
    best_triples,
    mutual_best_links,
    typical_difference,
)
from velfield.tracking.gates import DEFAULT_AXIS_SD_RAD, DetectionStates, Limits, gate_link_pairs, gate_links
from velfield.tracking.tracklets import link_windows

LIMITS = Limits.from_config(TrackingConfig(), None)


def triples(*rows: tuple[int, int, int, float]) -> tuple[np.ndarray, np.ndarray]:
    table = np.array(rows, np.float64)
    return table[:, :3].astype(np.int64), table[:, 3].copy()


def test_a_single_triple_is_the_best_and_as_confident_as_against_a_false_alarm() -> None:
    best, confidence = best_triples(*triples((0, 0, 0, 5.0)), (1, 1, 1))
    assert best.tolist() == [True]
    assert confidence[0] == pytest.approx(1 / (1 + np.exp(5.0 - FALSE_ALARM_COST)))
    _, even = best_triples(*triples((0, 0, 0, FALSE_ALARM_COST)), (1, 1, 1))
    assert even[0] == pytest.approx(0.5)


def test_a_competitor_through_one_detection_halves_the_confidence_and_a_tie_leaves_none() -> None:
    rivals = triples((0, 0, 0, 4.0), (1, 0, 1, 4.0 + np.log(3)), (2, 2, 2, 4.0))
    best, confidence = best_triples(*rivals, (3, 3, 3))
    assert best.tolist() == [True, False, True]
    assert confidence == pytest.approx([3 / 4, 1 / 4, 1.0], abs=1e-5)
    tied, _ = best_triples(*triples((0, 0, 0, 4.0), (1, 0, 1, 4.0)), (2, 1, 2))
    assert not tied.any()


@settings(max_examples=60)
@given(seed=st.integers(0, 10_000), m=st.integers(1, 25))
def test_the_best_triples_and_confidences_are_those_of_their_definition(seed: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    detections, cost = rng.integers(0, 4, (m, 3)), rng.uniform(0, 20, m).round(1)
    best, confidence = best_triples(detections, cost, (4, 4, 4))
    likelihood = np.exp(-cost)
    for t in range(m):
        through = [np.flatnonzero(detections[:, k] == detections[t, k]) for k in range(3)]
        others = [rows[rows != t] for rows in through]
        assert best[t] == all((cost[rows] > cost[t]).all() for rows in others)
        competing = sum(likelihood[rows].sum() for rows in others)
        expected = likelihood[t] / (likelihood[t] + competing + np.exp(-FALSE_ALARM_COST))
        assert confidence[t] == pytest.approx(expected, rel=1e-6, abs=1e-12)


@settings(max_examples=60)
@given(seed=st.integers(0, 10_000), m=st.integers(1, 20))
def test_the_cross_check_keeps_links_that_are_each_others_only_best(seed: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = rng.integers(0, 4, m), rng.integers(0, 4, m)
    difference = rng.integers(0, 8, m).astype(np.float64)
    kept = mutual_best_links(difference, first, second)
    for k in range(m):
        rivals = (first == first[k]) | (second == second[k])
        rivals[k] = False
        assert kept[k] == (difference[rivals] > difference[k]).all()


def test_the_typical_difference_is_the_median_of_the_best_and_not_below_noise() -> None:
    first = np.array([0, 0, 1, 1, 2])
    assert typical_difference(np.array([9.0, 5.0, 7.0, 30.0, 11.0]), first) == 7.0
    assert typical_difference(np.array([0.1, 0.2, 0.1, 0.1, 0.3]), first) == MIN_TYPICAL_DIFFERENCE
    assert typical_difference(np.full(5, np.nan), first) == MIN_TYPICAL_DIFFERENCE
    assert typical_difference(np.array([9.0, np.nan, np.nan, np.nan, 11.0]), first) == 10.0


def test_the_appearance_cost_is_logarithmic_and_zero_where_unknown() -> None:
    cost = appearance_cost(np.array([0.0, 6.0, 18.0, np.nan]), 6.0)
    assert cost == pytest.approx([0.0, APPEARANCE_EXPONENT * np.log(2), APPEARANCE_EXPONENT * np.log(4), 0.0])


def state(
    x: float, y: float, time_s: float, axis: float = np.nan, axis_sd: float = np.nan, sd: float = 0.5
) -> DetectionStates:
    return DetectionStates(*(np.array([v]) for v in (x, y, axis, axis_sd)), sd, time_s)


def test_the_axis_cost_is_half_the_squared_sideways_motion_in_standard_deviations() -> None:
    """8 px along and 1 px across the axis of the earlier detection; the later one has none."""
    links = gate_links(state(0, 0, 0.0, 0.0, 0.1), state(8, 1, 0.2), LIMITS)
    variance = 2 * 0.5**2 + (np.hypot(8, 1) * 0.1) ** 2
    assert links.axis_cost[0] == pytest.approx(0.5 * 0.5 * 1.0 / variance)
    unknown_sd = gate_links(state(0, 0, 0.0, 0.0), state(8, 1, 0.2), LIMITS)
    variance = 2 * 0.5**2 + (np.hypot(8, 1) * DEFAULT_AXIS_SD_RAD) ** 2
    assert unknown_sd.axis_cost[0] == pytest.approx(0.25 / variance)


def test_the_motion_cost_grows_with_the_deviation_from_constant_velocity() -> None:
    start, middle = state(0, 0, 0.0), state(10, 0, 0.2)
    costs = []
    for x in (20.0, 22.0, 24.0):
        end = state(x, 0, 0.4)
        pairs = gate_link_pairs(
            (start, middle, end), gate_links(start, middle, LIMITS), gate_links(middle, end, LIMITS), LIMITS
        )
        costs.append(float(pairs.motion_cost[0]))
    assert costs[0] == 0.0
    assert costs[2] == pytest.approx(4 * costs[1])


@pytest.mark.parametrize("gsd_m", [0.1, 0.5])
def test_limits_in_pixels_are_metres_over_the_ground_sample_distance(gsd_m: float) -> None:
    config = TrackingConfig(max_speed_m_per_s=30.0, max_acceleration_m_per_s2=20.0)
    limits = Limits.from_config(config, gsd_m)
    assert limits.max_speed_px_per_s == pytest.approx(30.0 / gsd_m)
    assert limits.max_acceleration_px_per_s2 == pytest.approx(20.0 / gsd_m)
    assert limits.position_sd_px(0.4) == pytest.approx(np.hypot(config.jitter_px, 0.4))
    assert Limits.from_config(config, None) == Limits.from_config(config, PAPER_GSD_M)


def test_unaligned_crops_keep_the_displacement_and_deviation_of_the_detections() -> None:
    """Crops of noise: no link is refined, and the standard deviation is that of two positions."""
    rng = np.random.default_rng(0)
    detector = Detector(recall=1.0, false_alarms=0.0, jitter_px=0.3)
    seen = watch([car(rng, (60.0, 60.0), (50.0, 0.0))], [0.0, 0.2, 0.4], rng=rng, detector=detector)
    for table in seen.tables:
        table.crops[:] = rng.integers(0, 255, table.crops.shape)
    config = TrackingConfig(min_confidence=0.0)
    found, log = link_windows(seen.tables, config, gsd_m=None, starts=range(1))
    assert log["links_not_refined"] == 2 * len(found)
    limits = Limits.from_config(config, None)
    expected = np.sqrt(2) * limits.position_sd_px(seen.tables[0].residual_px)
    assert found["displacement_sd_01_px"].to_numpy() == pytest.approx(expected, rel=1e-6)
    moved = (found["x_1_px"] - found["x_0_px"]) / (found["time_1_s"] - found["time_0_s"])
    assert found["vx_01_px_per_s"].to_numpy() == pytest.approx(moved.to_numpy(), rel=1e-5)


def test_refinement_can_be_turned_off() -> None:
    rng = np.random.default_rng(1)
    seen = watch(
        [car(rng, (60.0, 60.0), (50.0, 0.0))], [0.0, 0.2, 0.4], rng=rng, detector=Detector(recall=1.0, false_alarms=0.0)
    )
    logs = [link_windows(seen.tables, TrackingConfig(refine=r), gsd_m=None, starts=range(1))[1] for r in (True, False)]
    assert [log["links_refined"] for log in logs] == [2, 0]


def test_crops_know_their_centre_in_base_pixels() -> None:
    rng = np.random.default_rng(2)
    seen = watch([car(rng, (60.0, 60.0), (50.0, 0.0))], [0.0], rng=rng, detector=Detector(recall=1.0, false_alarms=0.0))
    table = seen.tables[0]
    crops = table.upright_crops()
    assert crops.centre_x_px == pytest.approx(np.rint(table.x_px))
    assert crops.centre_y_px == pytest.approx(np.rint(table.y_px))
