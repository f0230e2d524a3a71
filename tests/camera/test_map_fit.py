"""The lens by matches with a map: a lens of two terms where one was taken, and none where the one taken is right."""

import numpy as np
import pytest

from schemas.arrays import FloatArray
from tests.scenes import by_homography, frame_grid, rms_after_homography, similarity
from velfield.camera.lens import HarrisLens, Lens, PolynomialLens
from velfield.camera.map_fit import fit_lens_to_map

SHAPE = (960, 1280)
TRUE = PolynomialLens((-0.016, 0.144), 652.0, 479.7, 800.0)
TAKEN = HarrisLens(0.24, 638.3, 478.5, 800.0)
TO_MAP = similarity(0.9, 7.0, np.array([640.0, 480.0]), np.array([800.0, 700.0]))


def matches(lens: Lens, seed: int = 0, count: int = 400) -> tuple[FloatArray, FloatArray]:
    """Matches out to 0.85 half-diagonals, noisy, one in ten anywhere."""
    rng = np.random.default_rng(seed)
    raw = rng.uniform((0, 0), SHAPE[::-1], (4 * count, 2))
    raw = raw[np.hypot(*(raw - (639.5, 479.5)).T) < 0.85 * 800.0][:count]
    there = by_homography(TO_MAP, lens.undistort_points(raw)) + rng.normal(0, 0.5, raw.shape)
    wrong = rng.uniform(size=len(raw)) < 0.1
    there[wrong] += rng.uniform(-10, 10, (int(wrong.sum()), 2))
    return raw, there


def test_a_lens_of_two_terms_is_found_where_one_was_taken() -> None:
    fit = fit_lens_to_map(*matches(TRUE), TAKEN, SHAPE)
    assert fit.is_better
    assert fit.change_px > 2.0
    grid = frame_grid(SHAPE)
    true = TRUE.undistort_points(grid)
    assert rms_after_homography(TAKEN.undistort_points(grid), true) > 2.0
    assert rms_after_homography(fit.lens.undistort_points(grid), true) < 0.6


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_right_lens_stays(seed: int) -> None:
    fit = fit_lens_to_map(*matches(TRUE, seed), TRUE, SHAPE)
    assert not fit.is_better


def test_few_matches_decide_nothing() -> None:
    raw, there = matches(TRUE)
    assert fit_lens_to_map(raw[:99], there[:99], TAKEN, SHAPE) is None
