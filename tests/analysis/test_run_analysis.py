"""`Run.analysis`: carriageways, stops, bottlenecks and U-turns of a run folder with known traffic."""

from pathlib import Path

import numpy as np
import pytest

from schemas.arrays import FloatArray
from tests.field_runs import field_run, tracklets_along
from velfield.run.run import Run

GSD_M = 0.25
SHAPE = (160, 400)
STOP_X_PX, SLOW_X_PX = 200.0, 220.0


def drive(speeds_px_per_s: FloatArray, start_xy: tuple[float, float], direction: float) -> FloatArray:
    """Positions (n, 2) along x, five a second."""
    x = start_xy[0] + direction * np.concatenate([[0.0], np.cumsum(speeds_px_per_s) / 5])
    return np.column_stack([x, np.full(len(x), start_xy[1])])


def traffic() -> list[FloatArray]:
    """East: 12 m/s, then 4 m/s from x = 220. West: 12 m/s, every second vehicle waits 4 s at x = 200. One U-turn."""
    fast, slow = 12 / GSD_M, 4 / GSD_M
    east = [drive(np.repeat([fast, slow], [22, 45]), (10.0 + k, 40.0), 1.0) for k in range(8)]
    waits = [drive(np.repeat([fast, 0.0, fast], [19, 20, 20]), (STOP_X_PX + 19 * fast / 5, 80.0), -1.0)] * 4
    passes = [drive(np.full(40, fast), (390.0 - k, 80.0), -1.0) for k in range(4)]
    angle = np.linspace(-np.pi / 2, np.pi / 2, 15)
    arc = np.array([330.0, 130.0]) + 20 * np.column_stack([np.cos(angle), np.sin(angle)])
    away = arc[0] - np.arange(8, 0, -1)[:, None] * [6.0, 0.0]
    return [*east, *waits, *passes, np.concatenate([away, arc, arc[-1] - np.arange(1, 9)[:, None] * [6.0, 0.0]])]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    root: Path = tmp_path_factory.mktemp("analysis") / "run"
    return field_run(root, tracklets_along(traffic()), shape=SHAPE, gsd_m=GSD_M)


def test_the_two_directions_are_two_carriageways_with_their_headings_and_speeds(run: Run) -> None:
    found = run.analysis.carriageways(min_area_m2=20.0)
    assert len(found.table) == 2
    assert found.labels.shape == SHAPE
    table = found.table.set_index("region")
    east, west = table.loc[found.labels[40, 100]], table.loc[found.labels[80, 100]]
    assert (east.heading_deg, west.heading_deg) == pytest.approx((90.0, 270.0), abs=0.5)
    assert (east.tracks, west.tracks) == (8, 8)
    assert west.speed_p50_px_per_s * GSD_M == pytest.approx(12.0, abs=0.5)


def test_the_stop_is_where_half_of_the_vehicles_wait(run: Run) -> None:
    stops = run.analysis.traffic.stops
    assert len(stops.track) == 4
    assert stops.xy_m / GSD_M == pytest.approx(np.tile([STOP_X_PX, 80.0], (4, 1)), abs=2)
    assert (stops.end_s > stops.start_s + 1.5).all()


def test_the_bottleneck_begins_where_traffic_slows_down(run: Run) -> None:
    found = run.analysis.bottlenecks(distance_m=10.0)
    eastbound = np.flatnonzero(found.labels[40])
    assert eastbound.min() == pytest.approx(SLOW_X_PX, abs=12)
    assert np.ptp(eastbound) == pytest.approx(10.0 / GSD_M, abs=14)  # beyond, upstream is as slow
    row = found.table.set_index("region").loc[found.labels[40, int(np.median(eastbound))]]
    assert row.ratio == pytest.approx(1 / 3, abs=0.05)
    assert row.upstream_speed_px_per_s * GSD_M == pytest.approx(12.0, abs=0.5)
