"""Gates: physical limits times the true interval, and jitter that does not shrink with it."""

import numpy as np
import pytest

from schemas.flight import TrackingConfig
from velfield.tracking.gates import DetectionStates, Limits, gate_link_pairs, gate_links, triples_pass

PAPER = Limits.from_config(TrackingConfig(), None)


def states(xy: list[tuple[float, float]], time_s: float, axis: float = 0.0, sd_px: float = 1.0) -> DetectionStates:
    at = np.array(xy, np.float64).reshape(-1, 2)
    return DetectionStates(at[:, 0], at[:, 1], np.full(len(at), axis), np.full(len(at), 0.05), sd_px, time_s)


def test_without_ground_sample_distance_the_limits_are_the_papers_in_pixels() -> None:
    assert PAPER.max_speed_px_per_s == pytest.approx(150)
    assert PAPER.stationary_speed_px_per_s == pytest.approx(5)
    assert PAPER.max_acceleration_px_per_s2 == pytest.approx(100)


@pytest.mark.parametrize(("interval_s", "limit_px"), [(0.04, 6.0), (0.2, 30.0), (0.4, 60.0)])
def test_the_reach_is_speed_times_interval_plus_jitter(interval_s: float, limit_px: float) -> None:
    reach = limit_px + 3 * np.sqrt(2)
    after = states([(reach - 0.1, 0), (reach + 0.1, 0)], interval_s)
    links = gate_links(states([(0, 0)], 0.0), after, PAPER)
    assert links.second.tolist() == [0]
    assert links.rejected == (2, 1, 0)


def test_motion_across_the_axis_is_rejected_unless_slow() -> None:
    before = states([(0, 0)], 0.0, axis=np.pi / 2)
    assert gate_links(before, states([(25, 0)], 0.2, axis=np.pi / 2), PAPER).rejected == (1, 0, 1)
    assert gate_links(before, states([(4, 0)], 0.2, axis=np.pi / 2), PAPER).second.size == 1


def test_an_unknown_axis_is_not_tested() -> None:
    links = gate_links(states([(0, 0)], 0.0, axis=np.nan), states([(25, 0)], 0.2, axis=np.nan), PAPER)
    assert links.second.size == 1


def test_links_equal_a_double_loop() -> None:
    rng = np.random.default_rng(3)
    before = states([tuple(p) for p in rng.uniform(0, 200, (60, 2))], 0.0, axis=np.nan)
    after = states([tuple(p) for p in rng.uniform(0, 200, (50, 2))], 0.2, axis=np.nan)
    links = gate_links(before, after, PAPER)
    apart = np.hypot(after.x_px[None] - before.x_px[:, None], after.y_px[None] - before.y_px[:, None])
    assert np.array_equal(np.stack([links.first, links.second], 1), np.argwhere(apart <= 30 + 3 * np.sqrt(2)))


def window(second: tuple[float, float], third: tuple[float, float], times: tuple[float, float] = (0.2, 0.4)):
    """Pairs of links of one car detected at the origin and at two further positions; negligible jitter."""
    p = [states([(0, 0)], 0.0, np.nan, 0.01), states([second], times[0], np.nan, 0.01)]
    p.append(states([third], times[1], np.nan, 0.01))
    return gate_link_pairs((p[0], p[1], p[2]), gate_links(p[0], p[1], PAPER), gate_links(p[1], p[2], PAPER), PAPER)


def test_turn_and_acceleration_have_their_limits() -> None:
    angle = np.radians(25)
    assert window((12, 0), (24, 0)).link_01.size == 1
    assert window((12, 0), (12 + 12 * np.cos(angle), 12 * np.sin(angle))).rejected == (1, 0, 1)  # 5.2 px off, limit 4
    assert window((8, 0), (8 + 8 * np.cos(angle), 8 * np.sin(angle))).link_01.size == 1
    assert window((8, 0), (8, 8)).rejected == (1, 1, 0)
    assert window((12, 0), (12 + 15.9, 0)).link_01.size == 1
    assert window((12, 0), (12 + 16.2, 0)).rejected == (1, 0, 1)


def test_gates_follow_the_time_of_a_late_frame() -> None:
    assert window((12, 0), (12 + 24, 0), times=(0.2, 0.6)).link_01.size == 1
    assert window((12, 0), (12 + 24, 0), times=(0.2, 0.4)).link_01.size == 0


@pytest.mark.parametrize("interval_s", [0.04, 0.2, 0.4])
def test_jitter_rejects_few_true_tracklets_at_any_frame_rate(interval_s: float) -> None:
    """The paper's acceleration gate alone would reject 99 of 100 at 25 frames a second."""
    rng = np.random.default_rng(1)
    kept = 0
    for _ in range(400):
        speed = rng.uniform(0, 80)
        x = speed * interval_s * np.arange(3)[:, None] * [1, 0] + rng.normal(0, 1, (3, 2))
        p = [states([tuple(x[k])], interval_s * k, axis=0.0) for k in range(3)]
        before, after = gate_links(p[0], p[1], PAPER), gate_links(p[1], p[2], PAPER)
        kept += gate_link_pairs((p[0], p[1], p[2]), before, after, PAPER).link_01.size
    assert kept >= 0.97 * 400


def test_triples_that_are_chosen_otherwise_pass_the_gates_one_by_one() -> None:
    """A steady car, one too fast, one that stops dead, and the steady one's detections in another's company."""
    first = states([(0, 0), (0, 50), (0, 100), (0, 0)], 0.0, sd_px=0.1)
    second = states([(20, 0), (40, 50), (25, 100), (20, 0)], 0.2, sd_px=0.1)
    third = states([(40, 0), (80, 50), (25, 100), (40, 50)], 0.4, sd_px=0.1)
    assert triples_pass((first, second, third), PAPER).tolist() == [True, False, False, False]
    order = np.array([3, 0])
    assert triples_pass((first.take(order), second.take(order), third.take(order)), PAPER).tolist() == [False, True]
