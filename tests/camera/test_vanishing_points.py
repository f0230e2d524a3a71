"""Families of parallels: their directions mend a lens that straightness left uncertain, and leave alone a sure one."""

import numpy as np
from numpy.typing import NDArray

from velfield.camera import vanishing_points
from velfield.camera.lens import HarrisLens
from velfield.camera.lines import LineSet
from velfield.camera.straighten import LensFamily, PlumbLineFit
from velfield.camera.vanishing_points import MIN_FAMILY_LINES, refine_by_vanishing_points

MIDDLE, HALF = (639.5, 479.5), 800.0
TRUE = HarrisLens(0.2, 648.5, 473.5, HALF)
FAMILY = LensFamily("harris", 1, MIDDLE, HALF)
TRUTH = np.array([0.2, 9.0 / HALF, -6.0 / HALF])


def streets(
    angles: NDArray[np.float64], seed: int, *, frames: int = 6, crooked_deg: float = 0.15, tilt: float = 0.05
) -> LineSet:
    """Lines of 60 to 120 px that run along ``angles`` (lines,), rad, give or take ``crooked_deg``, seen askew by the
    true lens; their points are off by 0.2 px."""
    random = np.random.default_rng(seed)
    parts = []
    for frame in range(frames):
        turn, lean = random.uniform(0, np.pi), random.uniform(-tilt, tilt, 2)
        for angle in angles + turn:
            direction = angle + np.radians(crooked_deg) * random.normal()
            along = np.array([np.cos(direction), np.sin(direction)])
            length = random.uniform(60, 120) / HALF
            ground = random.uniform((-0.6, -0.45), (0.6, 0.45)) + np.linspace(-0.5, 0.5, 12)[:, None] * length * along
            seen = MIDDLE + HALF * ground / (1.0 + ground @ lean)[:, None]
            xy = TRUE.distort_points(seen) + 0.2 * random.normal(size=seen.shape)
            tangents = np.broadcast_to((xy[-1] - xy[0]) / np.hypot(*(xy[-1] - xy[0])), xy.shape)
            parts.append((xy, tangents, frame))
    count = np.array([len(xy) for xy, _, _ in parts])
    return LineSet(
        np.concatenate([xy for xy, _, _ in parts]),
        np.concatenate([tangents for _, tangents, _ in parts]),
        np.repeat(np.arange(len(parts)), count),
        np.array([frame for _, _, frame in parts]),
    )


def by_straightness(lines: LineSet, a_sd: float, off: float) -> PlumbLineFit:
    """A possible fit by straightness: wrong by ``off`` of its deviations, and the centre by as much of 4 px."""
    spread = np.array([a_sd, 4.0 / HALF, 4.0 / HALF])
    return PlumbLineFit(FAMILY, TRUTH + off * spread * (1, -1, 1), np.diag(spread**2), 0.2, np.ones(lines.count))


def test_streets_of_two_directions_tell_the_lens() -> None:
    before, after, deviations = [], [], []
    for seed in range(6):
        lines = streets(np.repeat([0.1, 0.1 + np.pi / 2], 40), seed)
        fit = by_straightness(lines, 0.004, 1.5)
        refined = refine_by_vanishing_points(fit, lines)
        before.append(fit.parameters - TRUTH)
        after.append(refined.parameters - TRUTH)
        deviations.append(np.sqrt(np.diag(refined.covariance)))
    rms = [np.sqrt(np.mean(np.square(errors), axis=0)) for errors in (before, after)]
    assert np.all(rms[1] < (0.4, 0.6, 0.6) * rms[0])
    assert np.all(np.abs(after) < 3.0 * np.array(deviations))
    assert np.all(np.array(deviations)[:, 0] < 0.004)


def test_a_tilted_camera_makes_no_lens() -> None:
    """Parallels that run together in the picture are what a vanishing point is for."""
    lines = streets(np.repeat([0.1, 0.1 + np.pi / 2], 40), 3, tilt=0.4)
    refined = refine_by_vanishing_points(by_straightness(lines, 0.004, 1.5), lines)
    assert abs(refined.parameters[0] - 0.2) < 0.002


def test_crooked_streets_say_less() -> None:
    spread = []
    for crooked_deg in (0.1, 1.0):
        lines = streets(np.repeat([0.1, 0.1 + np.pi / 2], 40), 5, crooked_deg=crooked_deg)
        refined = refine_by_vanishing_points(by_straightness(lines, 0.02, 0.0), lines)
        spread.append(float(np.sqrt(refined.covariance[0, 0])))
    assert spread[1] > 2.0 * spread[0]


def test_lines_that_run_anywhere_hardly_move_the_lens() -> None:
    lines = streets(np.random.default_rng(0).uniform(0, np.pi, 60), 6)
    fit = by_straightness(lines, 0.004, 0.0)
    refined = refine_by_vanishing_points(fit, lines)
    assert abs(refined.parameters[0] - fit.parameters[0]) < 2.0 * 0.004


def test_fewer_lines_than_a_family_leave_the_fit_as_it_was() -> None:
    lines = streets(np.full(MIN_FAMILY_LINES - 1, 0.1), 7)
    fit = by_straightness(lines, 0.004, 1.0)
    assert refine_by_vanishing_points(fit, lines) is fit


def test_a_fit_that_is_surer_than_streets_are_parallel_stays() -> None:
    lines = streets(np.repeat([0.1, 0.1 + np.pi / 2], 40), 8)
    fit = by_straightness(lines, 0.0005, 1.0)
    assert refine_by_vanishing_points(fit, lines) is fit


def undistorted_towards(point: NDArray[np.float64], seed: int, count: int = 30) -> vanishing_points._UndistortedLines:
    """Lines through a common point, in half-diagonals."""
    random = np.random.default_rng(seed)
    midpoint = random.uniform((-0.6, -0.45), (0.6, 0.45), (count, 2))
    direction = point - midpoint
    return vanishing_points._UndistortedLines(midpoint, direction / np.linalg.norm(direction, axis=1, keepdims=True))


def test_lines_through_a_point_intersect_there() -> None:
    point = np.array([2.5, -1.5])
    lines = undistorted_towards(point, 0)
    pairs = np.random.default_rng(1).integers(0, 30, (2, 200))
    found = vanishing_points._intersections(lines, pairs)
    assert len(found) == int((pairs[0] != pairs[1]).sum())  # a line does not intersect itself
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)
    np.testing.assert_allclose(found[:, :2] / found[:, 2:], np.tile(point, (len(found), 1)), atol=1e-6)


def test_angles_to_the_common_point_are_zero_and_have_a_sign_beside_it() -> None:
    lines = undistorted_towards(np.array([3.0, 0.0]), 2)
    at = np.array([3.0, 0.0, 1.0])
    assert np.abs(vanishing_points._angles(lines, np.arange(30), at)).max() < 1e-9
    above, below = (vanishing_points._angles(lines, np.arange(30), at + np.array([0.0, dy, 0.0])) for dy in (-0.1, 0.1))
    assert (above < 0).all()
    assert (below > 0).all()
    reverse = vanishing_points._UndistortedLines(lines.midpoint, -lines.direction)
    np.testing.assert_allclose(vanishing_points._angles(reverse, np.arange(30), at + np.array([0.0, 0.1, 0.0])), below)


def test_a_point_at_infinity_is_a_direction() -> None:
    parallel = vanishing_points._UndistortedLines(np.array([[0.0, 0.0], [0.3, -0.4]]), np.tile([0.6, 0.8], (2, 1)))
    (point,) = vanishing_points._intersections(parallel, np.array([[0], [1]]))
    np.testing.assert_allclose(np.abs(point), [0.6, 0.8, 0.0], atol=1e-12)
    np.testing.assert_allclose(vanishing_points._angles(parallel, np.arange(2), point), 0.0, atol=1e-9)


def test_each_direction_of_a_frame_is_a_family_of_its_own_lines() -> None:
    lines = streets(np.repeat([0.1, 0.1 + np.pi / 2], 40), 9, frames=2, crooked_deg=0.05)
    fit = by_straightness(lines, 0.004, 0.0)
    families = vanishing_points._find_families(lines, vanishing_points._undistort_lines(lines, fit, TRUTH), 0)
    assert len(families) == 4
    for family in families:
        assert len(family.lines) > 30
        assert len(set(lines.frame[family.lines].tolist())) == 1
        assert len({int(line) % 80 // 40 for line in family.lines}) == 1  # of one direction


def test_the_equations_of_a_family_are_the_derivatives_of_its_angles() -> None:
    """With the vanishing point eliminated, a step of the lens leaves the right-hand side of the linear prediction."""
    lines = streets(np.full(40, 0.3), 10, frames=1, crooked_deg=0.05)
    fit, off = by_straightness(lines, 0.004, 0.0), TRUTH + np.array([0.02, 0.0, 0.0])
    families = vanishing_points._find_families(lines, vanishing_points._undistort_lines(lines, fit, TRUTH), 0)
    (part,) = vanishing_points._linearise_families(lines, fit, off, families[:1])
    np.testing.assert_allclose(part.normal, part.normal.T, rtol=1e-6)
    assert np.linalg.eigvalsh(part.normal).min() > -1e-6 * np.linalg.eigvalsh(part.normal).max()
    (at_truth,) = vanishing_points._linearise_families(lines, fit, TRUTH, families[:1])
    assert abs(at_truth.right[0]) < 0.5 * abs(part.right[0])
    assert part.right[0] < 0  # the distortion is too large: the step lowers it
