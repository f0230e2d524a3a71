"""The field as a prior: gates for another tracker, anomaly scores of tracks, and held-out log-likelihood."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from schemas.flight import FieldConfig
from tests.field.test_field_statistics import GSD_M, drive, field, polar
from tests.field_runs import flight, traffic_tracklets
from velfield.errors import InputError
from velfield.field.heldout import heldout_log_likelihood
from velfield.field.segments import segment_table
from velfield.field.view import VelocityField

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def one_way() -> VelocityField:
    """Thirty vehicles that pass (80, 50) towards +x at about 13 m/s."""
    rng = np.random.default_rng(2)
    return field(drive(polar(rng.normal(13, 1.5, 30), rng.normal(0, 3, 30))))


def test_a_gate_accepts_usual_velocities_and_rejects_the_wrong_way(one_way: VelocityField) -> None:
    gate = one_way.gate(np.array([80.0, 50.0]))
    ways = polar(np.array([13.0, 10.0, 13.0, 13.0, 0.0]), np.array([0.0, 2.0, 180.0, 40.0, 0.0]))
    assert gate.accepts(ways).tolist() == [True, True, False, False, False]
    assert gate.mean_px_per_s * GSD_M == pytest.approx([13.0, 0.0], abs=1.0)
    assert np.sqrt(gate.covariance[0, 0]) * GSD_M == pytest.approx(2.3, abs=1.2)


def test_a_gate_is_wider_where_the_field_is_empty_or_the_position_uncertain(one_way: VelocityField) -> None:
    """In an empty region it accepts what drives anywhere on the map; with the position's covariance it grows."""
    across = polar(np.array([13.0]), np.array([0.0]))
    nowhere = one_way.gate(np.array([20.0, 10.0]))
    assert nowhere.accepts(across)[0]
    assert nowhere.expected_log_density < one_way.gate(np.array([80.0, 50.0])).expected_log_density
    sizes = []
    speeds = polar(np.linspace(0, 30, 61), np.zeros(61))
    for sd_px in (0.0, 8.0):
        gate = one_way.gate(np.array([80.0, 50.0]), np.eye(2) * sd_px**2)
        sizes.append(int(gate.accepts(speeds).sum()))
    assert sizes[1] >= sizes[0]


def test_a_gate_accepts_the_fraction_of_its_coverage(one_way: VelocityField) -> None:
    rng = np.random.default_rng(8)
    others = polar(rng.normal(13, 1.5, 400), rng.normal(0, 3, 400))
    passed = [
        one_way.gate(np.array([80.0, 50.0]), coverage=coverage).accepts(others).mean() for coverage in (0.6, 0.99)
    ]
    assert passed[0] < 0.95 < passed[1]


def test_where_all_are_stationary_the_density_is_finite_and_highest_at_zero() -> None:
    stationary = field(drive(np.zeros((5, 2))))
    where = np.full((2, 2), [80.0, 50.0])
    stands, drives = stationary.log_density(where, np.array([[0.0, 0.0], [40.0, 0.0]]))
    assert np.isfinite([stands, drives]).all()
    assert stands > drives + 3
    assert stationary.gate(where[0]).accepts(np.zeros((1, 2)))[0]


def test_stopping_is_possible_but_anomalous_where_none_has_stopped(one_way: VelocityField) -> None:
    where, at_rest, wrong_way = np.array([[80.0, 50.0]]), np.zeros((1, 2)), polar(np.array([13.0]), np.array([180.0]))
    assert one_way.log_density(where, at_rest)[0] > one_way.log_density(where, wrong_way)[0] + 1.0
    gate = one_way.gate(where[0])
    assert one_way.log_density(where, at_rest)[0] > gate.log_density(at_rest)[0] + 1.0
    times_s = np.array([0.0, 0.2, 0.4])
    assert one_way.anomaly(times_s, np.repeat(where, 3, axis=0)) > 3.0


def test_invalid_positions_and_covariances_are_refused(one_way: VelocityField) -> None:
    with pytest.raises(InputError, match="finite position"):
        one_way.gate(np.array([np.nan, 3.0]))
    for covariance in (np.eye(3), -np.eye(2), np.array([[1.0, 2.0], [0.0, 1.0]])):
        with pytest.raises(InputError, match="covariance"):
            one_way.gate(np.array([80.0, 50.0]), covariance)
    line = np.outer([3.0, 0.1], [3.0, 0.1])  # of rank one, an eigenvalue rounded to slightly below zero
    assert np.isfinite(one_way.gate(np.array([80.0, 50.0]), line).mean_px_per_s).all()
    with pytest.raises(InputError, match="ascending times"):
        one_way.anomaly(np.array([0.0, 0.0]), np.zeros((2, 2)))


def test_a_wrong_way_driver_is_anomalous_and_a_usual_one_is_not(one_way: VelocityField) -> None:
    times_s = np.array([0.0, 0.2, 0.4])
    along = np.column_stack([80 + np.array([-10.0, 0.0, 10.0]), np.full(3, 50.0)])
    assert one_way.anomaly(times_s, along) < 1.0
    assert one_way.anomaly(times_s, along[::-1]) > 3.0
    unknown = along - np.array([0.0, 40.0])
    assert one_way.anomaly(times_s, unknown[::-1]) < one_way.anomaly(times_s, along[::-1])


def test_the_field_has_a_higher_held_out_likelihood_than_simpler_models() -> None:
    """Nats a track: against one distribution for the whole map, and against a Gaussian a pixel."""
    table = segment_table(traffic_tracklets(6, 150), FieldConfig())
    result = heldout_log_likelihood(table, FieldConfig(), gsd_m=CITY_GSD_M, shape=flight(6, 150).base_shape)
    assert result.tracks > 20
    assert result.field - result.whole_map > 0.7
    assert result.field - result.gaussian > 0.0


CITY_GSD_M = 0.23


def test_the_example_finds_fewer_wrong_links_at_no_lower_recall() -> None:
    spec = importlib.util.spec_from_file_location("prior_for_a_tracker", ROOT / "examples" / "prior_for_a_tracker.py")
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    plain, helped = example.measure(5, frames=300, size=(240, 180))
    assert plain.wrong >= 20
    assert helped.wrong < 0.7 * plain.wrong
    assert helped.recall >= plain.recall
