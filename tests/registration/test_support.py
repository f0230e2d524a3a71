"""A map's standard deviation by cell: small where control points are, none where they are not."""

import numpy as np
import pytest

from schemas.arrays import FloatArray
from velfield.registration.mesh import CELLS, measure_support, reach

WIDTH, HEIGHT = 1280, 960


def control_points(seed: int, count: int = 1500) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    return rng.uniform((0, 0), (WIDTH, HEIGHT), (count, 2)), rng.normal(0, 0.2, (count, 2))


def test_control_points_all_over_the_frame_bear_all_of_it_out() -> None:
    xy, residuals = control_points(1)
    support = measure_support(xy, residuals, width=WIDTH, height=HEIGHT)
    assert support.sd_px.shape == CELLS
    assert np.isfinite(support.sd_px).all()
    assert np.median(support.sd_px) < 0.2


def test_a_corner_without_control_points_is_not_answered_and_the_rest_is() -> None:
    xy, residuals = control_points(2)
    kept = np.hypot(xy[:, 0] - WIDTH, xy[:, 1] - HEIGHT) > 300
    support = measure_support(xy[kept], residuals[kept], width=WIDTH, height=HEIGHT)
    asked = np.array([[WIDTH - 20.0, HEIGHT - 20.0], [WIDTH / 2, HEIGHT / 2], [20.0, 20.0], [np.nan, 0.0]])
    assert np.isfinite(support.at(asked)).tolist() == [False, True, True, False]


def test_the_standard_deviation_grows_towards_the_end_of_the_control_points() -> None:
    xy, residuals = control_points(3, 3000)
    left = xy[:, 0] < WIDTH / 2
    support = measure_support(xy[left], residuals[left], width=WIDTH, height=HEIGHT)
    inside, near, beyond = support.at(
        np.array([[WIDTH / 2 + step, 500.0] for step in (-80.0, 20.0, 2 * reach(WIDTH, HEIGHT))])
    )
    assert near > 1.5 * inside
    assert np.isnan(beyond)


def test_two_chance_matches_bear_nothing_out() -> None:
    support = measure_support(np.array([[10.0, 10], [40, 40]]), np.zeros((2, 2)), width=WIDTH, height=HEIGHT)
    assert np.isnan(support.sd_px).all()


@pytest.mark.parametrize("residual_px", [0.2, 2.5])
def test_points_that_scatter_bear_the_map_out_with_a_larger_deviation(residual_px: float) -> None:
    xy, residuals = control_points(4)
    support = measure_support(xy, residuals * residual_px / 0.2, width=WIDTH, height=HEIGHT)
    assert np.isfinite(support.sd_px).mean() > 0.95
    assert np.nanmedian(support.sd_px) == pytest.approx(0.7 * residual_px, rel=0.4)


def test_a_hole_amid_control_points_is_bridged_and_one_at_the_border_is_not() -> None:
    xy, residuals = control_points(5, 3000)
    centres = np.array([[WIDTH / 2, HEIGHT / 2], [0.0, HEIGHT / 2]])
    kept = np.linalg.norm(xy[:, None] - centres, axis=2).min(axis=1) > 1.4 * reach(WIDTH, HEIGHT)
    support = measure_support(xy[kept], residuals[kept], width=WIDTH, height=HEIGHT)
    amid, border, beside = support.at(np.array([*centres, [0.75 * WIDTH, HEIGHT / 2]]))
    assert np.isfinite(amid)
    assert amid > 2 * beside
    assert np.isnan(border)
