"""Through traffic of a constructed car park of known vehicles."""

import numpy as np
import pytest

from schemas.arrays import FloatArray
from tests.analysis.test_traffic_analysis import EAST, Track, drive, gather
from velfield.analysis.movements.car_parks import find_car_parks
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.pipeline.analysis.scene_tables import car_park_table

ROWS = np.array([(x, y) for y in (93.5, 106.5) for x in np.arange(80.0, 140.0, 3.0)])
"""Two rows on either side of the way to the east, from 80 to 137 m."""


def traffic() -> list[Track]:
    """Ten vehicles drive through; four stop inside for 30 s; three come in and stay; two turn off before."""
    out = [drive(EAST, 5.0 * k) for k in range(10)]
    out += [drive(EAST, 60.0 + 40 * k, stop_at_m=110.0, go_s=60.0 + 40 * k + 40) for k in range(4)]
    for k in range(3):
        times, xy = drive(EAST, 300.0 + 5 * k)
        out.append((times[xy[:, 0] < 115], xy[xy[:, 0] < 115]))
    before = np.array([[0.0, 100.0], [60.0, 100.0], [60.0, 200.0]])
    return out + [drive(before, 350.0 + 5 * k) for k in range(2)]


def analyse(parked: FloatArray, axis_rad: float = np.pi / 2) -> TrafficAnalysis:
    known = np.column_stack([parked, np.full(len(parked), axis_rad)])
    return TrafficAnalysis(gather(traffic()), parked=known)


def test_who_drives_through_is_counted() -> None:
    analysis = analyse(ROWS)
    (park,) = analysis.car_parks
    assert park.parked == len(ROWS)
    assert (park.entered, park.through) == (17, 10)
    assert park.tracks.tolist() == list(range(10))
    assert park.through_share.value == pytest.approx(10 / 17)
    assert park.time_s.value == pytest.approx(61.0 / 12.0, abs=0.4)
    (row,) = car_park_table(analysis).rows
    assert row.cells["through"] == 10
    assert row.geometry.type == "Polygon"


def test_a_row_along_a_kerb_and_few_vehicles_are_no_car_park() -> None:
    assert analyse(ROWS[:20]).car_parks == []
    assert analyse(ROWS[[0, 1, 2, 20, 21]]).car_parks == []
    assert find_car_parks(np.empty((0, 2)), np.empty(0), analyse(ROWS).samples, 60.0) == []


def test_kerbs_on_both_sides_of_a_street_are_no_car_park() -> None:
    assert analyse(ROWS, axis_rad=0.0).car_parks == []
    assert len(analyse(ROWS, axis_rad=float("nan")).car_parks) == 1  # not known to be at a kerb


def test_unknown_parking_is_reported_as_such() -> None:
    table = car_park_table(TrafficAnalysis(gather(traffic())))
    assert table.rows == ()
    assert table.note.startswith("Parked vehicles are not known")
