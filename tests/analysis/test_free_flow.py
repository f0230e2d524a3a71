"""Free flow of constructed traffic: drivers who happen to go alike do not make a narrow interval."""

import numpy as np

from schemas.arrays import FloatArray
from tests.analysis.test_traffic_analysis import EAST, SOUTH, STEP_S, Track, gather
from velfield.analysis.traffic_analysis import TrafficAnalysis


def steady(path: FloatArray, start_s: float, speed_m_per_s: float) -> Track:
    along = np.concatenate([[0.0], np.hypot(*np.diff(path, axis=0).T).cumsum()])
    time = np.arange(0.0, along[-1] / speed_m_per_s, STEP_S)
    return start_s + time, np.column_stack([np.interp(speed_m_per_s * time, along, path[:, k]) for k in (0, 1)])


def test_platoons_whose_leaders_were_not_seen_do_not_pass_for_free_drivers() -> None:
    """Every other vehicle of platoons that go as slowly as their first one, beside drivers who go freely."""
    rng = np.random.default_rng(5)
    free = [steady(EAST, 60.0 * k + 20.0, speed) for k, speed in enumerate(rng.normal(14.0, 1.0, 24))]
    platoons = [steady(EAST, 60.0 * k + 40.0 + 5.0 * j, 10.0) for k in range(12) for j in range(3)]
    (road,) = TrafficAnalysis(gather([*free, *platoons])).free_flow
    assert road.speed_m_per_s.low <= 14.0 <= road.speed_m_per_s.high


def test_few_drivers_who_go_alike_by_chance_differ_as_others_do() -> None:
    alike = [steady(EAST, 10.0 * k, 14.0 + 0.01 * k) for k in range(9)]
    others = [steady(SOUTH, 5.0 + 10.0 * k, speed) for k, speed in enumerate(np.linspace(12.0, 16.0, 12))]
    found = TrafficAnalysis(gather([*alike, *others])).free_flow
    widths = [float(np.ptp([e.low, e.high])) for e in (road.speed_m_per_s for road in found) if e]
    assert len(widths) == 2
    # one of twelve such drivers differs from their mean by 1.26 m/s: the median of nine has a deviation of 0.5 m/s
    assert 1.2 < min(widths) < 2.5
