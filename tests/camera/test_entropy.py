"""The entropy of the Hough histogram against a plain loop, and where its minimum lies."""

import numpy as np
import pytest

from velfield.camera.edges import Arcs
from velfield.camera.entropy import hough_entropy, linear_bin_weights
from velfield.camera.lens import HarrisLens, pinhole

SHAPE = (480, 640)
HALF = 400.0


def bent_lines(a: float, seed: int, lines: int = 60) -> Arcs:
    """Straight lines of the scene as a lens of that distortion shows them, one frame each half."""
    lens, rng = HarrisLens(a, 319.5, 239.5, HALF), np.random.default_rng(seed)
    xy, tangents = [], []
    for _ in range(lines):
        angle, through = rng.uniform(0, np.pi), rng.uniform([60, 60], [580, 420])
        along = np.array([np.cos(angle), np.sin(angle)])
        points = through + np.linspace(-50, 50, 25)[:, None] * along
        xy.append(lens.distort_points(points))
        ahead, behind = lens.distort_points(points + 0.01 * along), lens.distort_points(points - 0.01 * along)
        tangents.append((ahead - behind) / np.linalg.norm(ahead - behind, axis=1, keepdims=True))
    return Arcs(
        xy=np.concatenate(xy),
        tangents=np.concatenate(tangents),
        arc=np.repeat(np.arange(lines), 25),
        frame=np.arange(lines) * 2 // lines,
        length_px=np.full(lines, 100.0),
    )


def test_the_minimum_is_at_the_lens_that_makes_lines_straight() -> None:
    arcs, grid = bent_lines(0.2, 2), np.arange(0.0, 0.41, 0.05)
    lenses = [HarrisLens(a, 319.5, 239.5, HALF) for a in grid]
    values = [hough_entropy(arcs, lens, angle_bins=720, distance_bin_px=2.0) for lens in lenses]
    assert grid[int(np.argmin(values))] == pytest.approx(0.2)


def test_a_lens_that_shrinks_the_image_gains_nothing() -> None:
    """Uniform scaling must not lower the entropy, though the distances fall into fewer bins."""
    arcs = bent_lines(0.0, 4)

    class Scaling:
        is_identity = False

        def __init__(self, factor: float) -> None:
            self.factor = factor

        def undistort_points(self, xy: np.ndarray) -> np.ndarray:
            centre = arcs.xy.mean(axis=0)
            return (xy - centre) * self.factor + centre

        def undistort_tangents(self, xy: np.ndarray, tangents: np.ndarray) -> np.ndarray:
            return tangents * self.factor

    plain, shrunk = (hough_entropy(arcs, Scaling(factor), angle_bins=180, distance_bin_px=0.5) for factor in (1.0, 0.5))
    assert shrunk > plain - 0.02


def test_outside_the_domain_the_entropy_is_infinite() -> None:
    far = HarrisLens(4.0, 319.5, 239.5, HALF)
    assert hough_entropy(bent_lines(0.0, 5), far, angle_bins=90, distance_bin_px=2.0) == float("inf")


def test_each_frame_has_a_histogram_of_its_own() -> None:
    arcs = bent_lines(0.0, 6, lines=2)
    twice = Arcs(
        np.concatenate([arcs.xy, arcs.xy]),
        np.concatenate([arcs.tangents, arcs.tangents]),
        np.concatenate([arcs.arc, arcs.arc + 2]),
        np.array([0, 0, 1, 1]),
        np.full(4, 100.0),
    )
    one = Arcs(arcs.xy, arcs.tangents, arcs.arc, np.zeros(2, int), arcs.length_px)
    single, double = (hough_entropy(part, pinhole(SHAPE), angle_bins=90, distance_bin_px=2.0) for part in (one, twice))
    assert double == pytest.approx(single + np.log(2.0))


def test_the_direction_of_a_tangent_has_no_sign() -> None:
    arcs = bent_lines(0.1, 7)
    flipped = Arcs(arcs.xy, -arcs.tangents, arcs.arc, arcs.frame, arcs.length_px)
    a, b = (hough_entropy(part, pinhole(SHAPE), angle_bins=90, distance_bin_px=2.0) for part in (arcs, flipped))
    assert a == pytest.approx(b)


def test_linear_binning_splits_a_value_between_its_neighbours() -> None:
    low, upper = linear_bin_weights(np.array([0.0, 2.5, -0.5]), 2.0)
    assert low.tolist() == [0, 1, -1]
    np.testing.assert_allclose(upper, [0.0, 0.25, 0.75])
