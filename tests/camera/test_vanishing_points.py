"""Families of parallels: their directions mend a lens that straightness left uncertain, and leave alone a sure one."""

import numpy as np
from numpy.typing import NDArray

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
