"""Counts by class: shares fitted to measured dimensions, as uncertain as these are."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.arrays import FloatArray, IntArray
from tests.analysis.test_traffic_analysis import crossroads, gather
from velfield.analysis.answers import find_answers
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.vehicle_classes import COUNTED_CLASSES, HEAVY, find_classes
from velfield.pipeline.analysis.class_tables import class_table
from velfield.pipeline.analysis.tables import movement_table
from velfield.synthetic.traffic.traffic import draw_dimensions

CAR = COUNTED_CLASSES.index("car or van")


def measured(rng: np.random.Generator, n: int, heavy_share: float, sd: float = 0.06) -> tuple[FloatArray, FloatArray]:
    """Dimensions of simulated vehicles (n, 2), which are no draws of the classes' own distributions, with errors."""
    drawn = draw_dimensions(rng.uniform(size=n) < heavy_share, rng)
    true = np.column_stack([drawn.length_m, drawn.width_m])
    return true * (1 + rng.normal(0, sd, true.shape)), sd * true


def test_intervals_of_shares_hold_the_truth() -> None:
    rng, hits, n = np.random.default_rng(5), np.zeros(2), 150
    for _ in range(n):
        found = find_classes(*measured(rng, 300, 0.08))
        _, car, heavy = found.estimate_shares(np.arange(300))
        hits += [heavy.low <= 0.08 <= heavy.high, car.low <= 0.92 <= car.high]
    assert (hits / n >= 0.84).all()
    assert (hits / n <= 0.97).all()


def test_shares_of_a_part_are_its_own() -> None:
    rng = np.random.default_rng(6)
    parts = [measured(rng, 400, share) for share in (0.0, 0.3)]
    found = find_classes(*(np.concatenate([part[k] for part in parts]) for k in (0, 1)))
    few, many = (found.estimate_shares(np.arange(first, first + 400))[HEAVY] for first in (0, 400))
    assert few.low == pytest.approx(0.0, abs=0.002)
    assert few.high < 0.02
    assert many.low < 0.3 < many.high
    assert sum(share.value for share in found.estimate_shares(np.arange(800)) if share) == pytest.approx(1, abs=0.05)


def test_a_share_is_as_uncertain_as_the_dimensions() -> None:
    rng, every = np.random.default_rng(7), np.arange(200)
    sharp, rough = (find_classes(*measured(rng, 200, 0.2, sd=sd)) for sd in (0.04, 0.2))
    assert sharp.separability[HEAVY] > 0.97
    assert rough.separability[HEAVY] < 0.9
    one, other = (found.estimate_shares(every)[HEAVY] for found in (sharp, rough))
    assert other is not None
    width = [(e.high - e.low) / np.sqrt(e.value * (1 - e.value)) for e in (one, other)]  # of 200 certain ones: equal
    assert width[1] > 1.05 * width[0]
    assert one.low <= one.value <= one.high
    sizes, _ = measured(rng, 200, 0.2)
    assert find_classes(sizes, np.full((200, 2), 50.0)).estimate_shares(every) == (None,) * 3


def test_vehicles_that_were_not_measured_are_left_out() -> None:
    rng = np.random.default_rng(8)
    sizes, sd = measured(rng, 60, 0.1)
    holes = np.where((np.arange(60) % 2 == 0)[:, None], np.nan, sizes)
    found = find_classes(holes, sd)
    assert found.measured.tolist() == list(range(1, 60, 2))
    share = found.estimate_shares(np.arange(60))[CAR]
    assert share.n == 30
    assert found.estimate_shares(np.arange(0, 60, 2)) == (None,) * 3
    assert find_classes(np.full((4, 2), np.nan), np.full((4, 2), np.nan)).estimate_shares(np.arange(4)) == (None,) * 3


@pytest.fixture(scope="module")
def analysis() -> TrafficAnalysis:
    """A crossroads at which those who turn, and nobody else, are lorries."""
    tracks = gather(crossroads())
    found = TrafficAnalysis(tracks)
    turning = turning_tracks(found)
    size = np.where(np.isin(np.arange(len(tracks)), turning)[:, None], [9.5, 2.5], [4.3, 1.78])
    return replace(found, classes=find_classes(size, np.full(size.shape, [0.2, 0.08])))


def turning_tracks(found: TrafficAnalysis) -> IntArray:
    """Tracks of the movement from west to south."""
    (junction,) = [j for j in found.movements if j.junction.kind == "intersection"]
    (movement,) = [m for m in junction.movements if (m.arm_in, m.arm_out) == ("W", "S")]
    tracks = junction.tracks(movement)
    assert len(tracks) == movement.seen >= 5
    return tracks


def test_movements_are_counted_by_class(analysis: TrafficAnalysis) -> None:
    rows = {(r.cells["from"], r.cells["to"]): r.cells for r in movement_table(analysis).rows}
    assert rows["W", "S"]["heavy"].low > 60
    assert rows["W", "E"]["heavy"].value < 3
    table = {row.cells["where"]: row.cells for row in class_table(analysis).rows}
    (turn,) = [cells for where, cells in table.items() if where.endswith("W to S") and where.startswith("inter")]
    assert turn["lorry_or_bus"].value == pytest.approx(turn["vehicles"], rel=0.1)
    assert turn["measured"] == len(turning_tracks(analysis))
    whole = table["all vehicles that drive"]
    assert whole["vehicles"] == len(analysis.trajectories)
    assert whole["lorry_or_bus"].low <= len(turning_tracks(analysis)) <= whole["lorry_or_bus"].high
    assert any(a.topic == "classes" and "lorry or bus" in a.text for a in find_answers(analysis))


def test_without_dimensions_there_are_no_classes(analysis: TrafficAnalysis) -> None:
    unknown = replace(analysis, classes=None)
    assert class_table(unknown).rows == ()
    assert "not known" in class_table(unknown).note
    assert all(row.cells["heavy"].value is None for row in movement_table(unknown).rows)
    assert [a.state for a in find_answers(unknown) if a.topic == "classes"] == ["too little data"]
