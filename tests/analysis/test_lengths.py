"""Gaps, queues and conflicts by the measured lengths of vehicles: of lorries they are not those of cars."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from tests.analysis.test_traffic_analysis import EAST, approach, crossroads, drive, gather
from velfield.analysis.signals.cycles import queues
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import VEHICLE_LENGTH_M

LORRY_M = 12.0


def with_lengths(analysis: TrafficAnalysis, length_m: float) -> TrafficAnalysis:
    tracks = analysis.trajectories
    return TrafficAnalysis(replace(tracks, measured_length_m=np.full(len(tracks), length_m)))


def test_the_gap_is_from_bumper_to_bumper() -> None:
    cars = TrafficAnalysis(gather([drive(EAST, 2.0 * k) for k in range(30)]))
    lorries = with_lengths(cars, LORRY_M)
    (car,), (lorry,) = cars.flows, lorries.flows
    assert car.gap_s.value == pytest.approx(2.0 - VEHICLE_LENGTH_M / 12.0, abs=0.05)
    assert lorry.gap_s.value == pytest.approx(2.0 - LORRY_M / 12.0, abs=0.05)
    assert car.headway_s.value == lorry.headway_s.value


def test_a_mixed_pair_has_the_mean_of_both_lengths() -> None:
    tracks = gather([drive(EAST, 2.0 * k) for k in range(30)])
    mixed = replace(tracks, measured_length_m=np.where(np.arange(30) % 2, LORRY_M, np.nan))
    (flow,) = TrafficAnalysis(mixed).flows
    assert flow.gap_s.value == pytest.approx(2.0 - (LORRY_M + VEHICLE_LENGTH_M) / 2 / 12.0, abs=0.05)


def test_a_queue_ends_at_its_last_vehicles_rear() -> None:
    cars = TrafficAnalysis(gather(crossroads()))
    longer = with_lengths(cars, 6.5)
    for a, b in zip(cars.signals.values(), longer.signals.values(), strict=True):
        for s, t in zip(a.streams, b.streams, strict=True):
            # the same centres: both bumpers are a metre farther out
            assert t.stream.stop_line_m - s.stream.stop_line_m == pytest.approx(1.0, abs=0.3)
            rows = zip(queues(s.stream, s.green_s[1:-1]), queues(t.stream, t.green_s[1:-1]), strict=True)
            more = [y.length_m - x.length_m for x, y in rows if x.vehicles.value == y.vehicles.value > 0]
            assert np.median(more) == pytest.approx(2.0, abs=0.5)


def test_a_long_leader_is_nearer() -> None:
    pair = approach(0.0, 60.0, 14.0, 6.0, 12.0)
    cars = TrafficAnalysis(gather([*pair, *(drive(EAST, 60.0 + 8.0 * k) for k in range(6))]))
    lorries = with_lengths(cars, 10.0)
    first, second = (
        min((c.value_s for c in a.conflicts if c.kind == "following"), default=np.inf) for a in (cars, lorries)
    )
    assert second < first


def test_lengths_that_are_hardly_known_are_not_used() -> None:
    tracks = gather([drive(EAST, 4.0 * k) for k in range(3)])
    ids = tracks.track_id
    table = pd.DataFrame({"track_id": ids[:2], "length_px": [60.0, 60.0], "length_sd_px": [1.0, 9.0]})
    found = tracks.with_lengths(table)  # 0.2 m a pixel
    assert found.length_m.tolist() == pytest.approx([12.0, VEHICLE_LENGTH_M, VEHICLE_LENGTH_M])
    assert found.select(np.array([True, False, True])).length_m.tolist() == pytest.approx([12.0, VEHICLE_LENGTH_M])
