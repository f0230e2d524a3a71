"""Smoothing of positions whose errors last: against the least squares that it solves, and against the truth."""

import numpy as np
import pytest

from schemas.arrays import FloatArray
from tests.analysis.noisy_tracks import Noise, add_noise, driven
from velfield.tracking.smoothing import (
    ACCELERATION_NOISE,
    PositionErrors,
    clean_tracks,
    measure_errors,
    smooth_paths,
)


def covariance(errors: PositionErrors, time_s: FloatArray) -> FloatArray:
    """(n, n) of the errors at the times (n,)."""
    lag_s = np.abs(time_s[:, None] - time_s)
    return np.asarray(errors.white_m**2 * (lag_s == 0) + errors.lasting_covariance(lag_s))


def test_it_is_the_least_squares_of_the_whole_track() -> None:
    rng = np.random.default_rng(5)
    time_s = np.cumsum(rng.choice([0.2, 0.3, 0.4], 40))
    seen = np.column_stack([8 * time_s, 0.2 * time_s**2]) + rng.normal(0, 0.4, (40, 2))
    errors = PositionErrors(0.2, 0.4, 1.1)
    found = smooth_paths(np.array([0, 25, 40]), time_s, seen, errors)[0]
    for rows in (slice(0, 25), slice(25, 40)):
        t = time_s[rows]
        n, precision = len(t), np.linalg.inv(covariance(errors, t))
        bend = np.zeros((n - 2, n))
        for i in range(1, n - 1):
            before, after = t[i] - t[i - 1], t[i + 1] - t[i]
            row = np.array([1 / before, -1 / before - 1 / after, 1 / after]) / np.sqrt((before + after) / 2)
            bend[i - 1, i - 1 : i + 2] = row / np.sqrt(ACCELERATION_NOISE)
        expected = np.linalg.solve(precision + bend.T @ bend, precision @ seen[rows])
        assert np.abs(found[rows] - expected).max() < 1e-4


@pytest.mark.parametrize(
    "noise", [Noise(0.2), Noise(0.5), Noise(1.0), Noise(0.05, 0.3, 1.0), Noise(0.05, 0.6, 1.5)], ids=str
)
def test_errors_are_measured_and_made_smaller(noise: Noise) -> None:
    tracks = driven()
    seen = add_noise(tracks, noise, seed=1)
    errors = measure_errors(tracks.first, tracks.time_s, seen)
    assert errors.total_m == pytest.approx(np.hypot(noise.white_m, noise.lasting_m), rel=0.35)
    smoothed, position_sd_m, _ = smooth_paths(tracks.first, tracks.time_s, seen, errors)
    left, before = (float(np.sqrt(np.mean((xy - tracks.xy_m) ** 2))) for xy in (smoothed, seen))
    assert left < (0.95 if noise.lasting_m else 0.6) * before
    assert 0.6 * left < position_sd_m < 1.9 * left


def test_a_vehicle_that_stands_is_at_one_place() -> None:
    time_s = np.arange(0, 40, 0.2)
    along = np.where(time_s < 12, 10 * time_s, np.where(time_s < 30, 120.0, 120.0 + 10 * (time_s - 30)))
    true = np.column_stack([along, 0 * along])
    rng = np.random.default_rng(0)
    errors = PositionErrors(0.05, 0.3, 1.0)
    seen = true + rng.normal(size=(2, len(time_s))).T @ np.diag([0.05, 0.05])
    seen += np.linalg.cholesky(covariance(errors, time_s)) @ rng.normal(size=true.shape)
    found = smooth_paths(np.array([0, len(time_s)]), time_s, seen, errors)[0]
    waits = (time_s > 16) & (time_s < 26)
    assert np.ptp(seen[waits], axis=0).min() > 0.5
    assert np.ptp(found[waits], axis=0).max() < 0.02


def test_positions_without_errors_stay_and_a_jump_is_cut() -> None:
    tracks = driven()
    owner = np.repeat(np.arange(len(tracks.first) - 1), np.diff(tracks.first))
    clean = clean_tracks(owner, tracks.time_s, tracks.xy_m)
    assert clean.errors is None
    assert clean.cuts == 0
    np.testing.assert_array_equal(clean.xy_m, tracks.xy_m)
    jumped = tracks.xy_m.copy()
    a, b = tracks.first[3], tracks.first[4]
    middle = (a + b) // 2
    jumped[middle:b] += [0.0, 7.0]
    cut = clean_tracks(owner, tracks.time_s, jumped)
    assert cut.cuts == 1
    assert (cut.track[a:middle] == 3).all()
    assert len(np.unique(cut.track[middle:b])) == 1
    assert cut.track[middle] not in owner


def test_of_few_positions_nothing_is_known() -> None:
    time_s = 0.2 * np.arange(8)
    assert measure_errors(np.array([0, 4, 8]), time_s, np.column_stack([time_s, time_s])) is None


def test_tracks_do_not_touch_each_other() -> None:
    tracks = driven()
    seen, errors = add_noise(tracks, Noise(0.3, 0.3, 1.0), seed=2), PositionErrors(0.3, 0.3, 1.0)
    whole = smooth_paths(tracks.first, tracks.time_s, seen, errors)[0]
    a, b = int(tracks.first[5]), int(tracks.first[6])
    alone = smooth_paths(np.array([0, b - a]), tracks.time_s[a:b], seen[a:b], errors)[0]
    assert np.abs(whole[a:b] - alone).max() < 1e-5
