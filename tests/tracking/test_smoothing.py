"""Smoothing of positions: against the least squares that it solves, and against the truth."""

import numpy as np
import pytest

from velfield.tracking.smoothing import ACCELERATION_NOISE, estimate_position_error, smooth_paths


def true_path(seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Uneven times (n,), and positions (n, 2) of a vehicle that brakes, waits, and turns off."""
    rng = np.random.default_rng(seed)
    time_s = np.cumsum(rng.choice([0.2, 0.3, 0.4], n, p=[0.8, 0.1, 0.1]))
    fine = np.arange(0, time_s[-1] + 0.02, 0.01)
    speed = 6 + 6 * np.cos(fine * 2 * np.pi / 20)
    heading = 0.8 * np.tanh((fine - 14) / 2)
    steps = 0.01 * speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    path = np.cumsum(steps, axis=0)
    return time_s, np.column_stack([np.interp(time_s, fine, path[:, k]) for k in range(2)])


def least_squares(time_s: np.ndarray, x: np.ndarray, error: float) -> np.ndarray:
    """The positions that agree best with the measured ones and with a velocity that changes by white noise."""
    n = len(x)
    rows, values = [], []
    for i in range(n):
        row = np.zeros(2 * n)
        row[2 * i] = 1 / error
        rows.append(row)
        values.append(x[i] / error)
    first_speed = np.zeros(2 * n)
    first_speed[1] = 1 / 20.0
    rows.append(first_speed)
    values.append(0.0)
    for i in range(n - 1):
        dt = time_s[i + 1] - time_s[i]
        covariance = ACCELERATION_NOISE * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        motion = np.array([[1, dt], [0, 1]])
        block = np.zeros((2, 2 * n))
        block[:, 2 * i : 2 * i + 2], block[:, 2 * i + 2 : 2 * i + 4] = -motion, np.eye(2)
        rows.extend(whiten @ block)
        values.extend([0.0, 0.0])
    return np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0][::2]


def test_it_is_the_least_squares_of_the_whole_track() -> None:
    time_s, xy = true_path(5, 40)
    rng = np.random.default_rng(5)
    seen = xy + rng.normal(0, 0.4, xy.shape)
    found = smooth_paths(np.array([0, 25, 40]), time_s, seen, 0.4).xy_m
    for rows in (slice(0, 25), slice(25, 40)):
        for axis in range(2):
            expected = least_squares(time_s[rows], seen[rows, axis], 0.4)
            assert np.abs(found[rows, axis] - expected).max() < 1e-6


@pytest.mark.parametrize("error_m", [0.1, 0.3, 0.6])
def test_the_error_is_measured_and_halved(error_m: float) -> None:
    found, before, after, claimed = [], [], [], []
    for seed in range(20):
        time_s, xy = true_path(seed, 110)
        seen = xy + np.random.default_rng(seed).normal(0, error_m, xy.shape)
        first = np.array([0, len(xy)])
        estimate = estimate_position_error(first, time_s, seen)
        assert estimate is not None
        smoothed = smooth_paths(first, time_s, seen, estimate)
        found.append(estimate)
        before.append(seen - xy)
        after.append(smoothed.xy_m - xy)
        claimed.append(smoothed.position_sd_m)
    assert np.mean(found) == pytest.approx(error_m, rel=0.1)
    left = float(np.sqrt(np.mean(np.square(after))))
    assert left < {0.1: 0.75, 0.3: 0.6, 0.6: 0.5}[error_m] * float(np.sqrt(np.mean(np.square(before))))
    assert left == pytest.approx(float(np.sqrt(np.mean(np.square(claimed)))), rel=0.25)


def test_positions_without_errors_have_none() -> None:
    time_s, xy = true_path(1, 110)
    estimate = estimate_position_error(np.array([0, len(xy)]), time_s, xy)
    assert estimate is not None
    assert estimate < 0.01


def test_of_four_positions_nothing_is_known() -> None:
    time_s, xy = true_path(1, 8)
    assert estimate_position_error(np.array([0, 4, 8]), time_s, xy) is None
    smoothed = smooth_paths(np.array([0, 1, 8]), time_s, xy, 0.2)  # a track of one position stays where it is
    assert smoothed.xy_m[0] == pytest.approx(xy[0])


def test_a_vehicle_twice_at_one_time_is_one_more_measurement() -> None:
    time_s, xy = true_path(2, 60)
    seen = xy + np.random.default_rng(2).normal(0, 0.3, xy.shape)
    time_s, seen = np.insert(time_s, 30, time_s[30]), np.insert(seen, 30, seen[30] + 0.2, axis=0)
    error = estimate_position_error(np.array([0, 61]), time_s, seen)
    assert error == pytest.approx(0.3, rel=0.25)
    smoothed = smooth_paths(np.array([0, 61]), time_s, seen, 0.3)
    assert np.isfinite(smoothed.xy_m).all()
    assert smoothed.xy_m[30] == pytest.approx(smoothed.xy_m[31], abs=1e-9)
