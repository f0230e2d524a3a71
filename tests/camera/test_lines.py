"""Straight lines: their fit, their residuals, and which arcs are collinear."""

import numpy as np
import pytest

from velfield.camera.edges import Arcs
from velfield.camera.lens import DivisionLens, HarrisLens, pinhole
from velfield.camera.lines import (
    LineSet,
    chord_lengths,
    fit_lines,
    line_residuals,
    line_rms,
    merge_collinear_arcs,
)

SHAPE = (480, 640)
NONE = pinhole(SHAPE)
MERGE = {"tolerance_px": 2.0, "max_angle_rad": 0.03, "min_length_px": 20.0}


def segment(start: tuple[float, float], end: tuple[float, float], count: int = 20) -> np.ndarray:
    return np.linspace(start, end, count)


def line_set(parts: list[np.ndarray]) -> LineSet:
    """Each part is a line; tangents along its chord."""
    tangents = [np.broadcast_to((p[-1] - p[0]) / np.linalg.norm(p[-1] - p[0]), p.shape) for p in parts]
    number = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
    return LineSet(np.concatenate(parts), np.concatenate(tangents), number, np.zeros(len(parts), int))


def arcs(parts: list[np.ndarray], frames: list[int] | None = None) -> Arcs:
    lines = line_set(parts)
    frame = np.zeros(len(parts), int) if frames is None else np.array(frames)
    return Arcs(lines.xy, lines.tangents, lines.line, frame, chord_lengths(lines))


def test_fitted_lines_are_those_of_the_singular_vectors() -> None:
    rng = np.random.default_rng(0)
    parts = [segment((10, 20), (200, 90)), segment((50, 300), (55, 20)), segment((0, 0), (0, 90))]
    noisy = [part + rng.normal(0, 1.0, part.shape) for part in parts]
    lines = line_set(noisy)
    mean, direction = fit_lines(lines.xy, lines.line, 3)
    for k, part in enumerate(noisy):
        np.testing.assert_allclose(mean[k], part.mean(axis=0))
        expected = np.linalg.svd(part - part.mean(axis=0))[2][0]
        assert abs(expected @ direction[k]) == pytest.approx(1.0)


def test_residuals_are_the_distances_from_the_line() -> None:
    part = segment((10, 20), (210, 20), 41)
    offsets = np.where(np.arange(41) % 2 == 0, 0.5, -0.5)
    offsets[20] = 0.0
    lines = line_set([part + np.stack([np.zeros(41), offsets], axis=1)])
    residuals = line_residuals(lines, NONE)
    np.testing.assert_allclose(np.abs(residuals), np.abs(offsets), atol=0.02)
    assert line_rms(lines, residuals)[0] == pytest.approx(np.sqrt((offsets**2).mean()), rel=0.02)


@pytest.mark.parametrize(
    "lens", [HarrisLens(0.3, 319.5, 239.5, 400.0), DivisionLens(0.2, 330.0, 230.0, 400.0)], ids=str
)
def test_lines_are_straight_under_their_own_lens_alone(lens: HarrisLens | DivisionLens) -> None:
    straight = [segment((20, 40), (600, 60), 60), segment((100, 470), (610, 200), 60)]
    parts = [lens.distort_points(part) for part in straight]
    lines = line_set(parts)
    assert np.abs(line_residuals(lines, lens)).max() < 1e-6
    assert line_rms(lines, line_residuals(lines, NONE)).min() > 0.5


def test_residuals_are_in_raw_pixels_whatever_the_lens_stretches() -> None:
    """Near the border the lens stretches along the radius: undistorted distances of the same noise are larger."""
    lens, rng = HarrisLens(0.4, 319.5, 239.5, 400.0), np.random.default_rng(1)
    part = lens.distort_points(segment((640, 160), (640, 320), 400))
    chord = (part[-1] - part[0]) / np.linalg.norm(part[-1] - part[0])
    noisy = part + rng.normal(0, 0.3, (400, 1)) * np.array([-chord[1], chord[0]])
    lines = line_set([noisy])
    assert line_rms(lines, line_residuals(lines, lens))[0] == pytest.approx(0.3, rel=0.15)
    undistorted = lens.undistort_points(noisy)
    mean, direction = fit_lines(undistorted, lines.line, 1)
    across = (undistorted - mean[0]) @ np.array([-direction[0, 1], direction[0, 0]])
    assert across.std() > 1.2 * 0.3


def test_chord_lengths_and_selection() -> None:
    lines = line_set([segment((0, 0), (30, 40)), segment((5, 5), (5, 105)), segment((0, 9), (10, 9))])
    np.testing.assert_allclose(chord_lengths(lines), [50.0, 100.0, 10.0])
    kept = lines.select(np.array([False, True, True]))
    assert kept.count == 2
    np.testing.assert_allclose(chord_lengths(kept), [100.0, 10.0])


def test_arcs_that_continue_each_other_are_one_line() -> None:
    dashes = [segment((40 * k, 100), (40 * k + 24, 100)) for k in range(5)]
    merged = merge_collinear_arcs(arcs(dashes), NONE, **MERGE)
    assert merged.count == 1
    assert chord_lengths(merged)[0] == pytest.approx(184.0)


@pytest.mark.parametrize(
    "second",
    [
        segment((60, 104), (120, 104)),  # beside it
        segment((60, 100), (120, 110)),  # at an angle
        segment((300, 100), (360, 100)),  # too far along it
    ],
    ids=["beside", "angle", "far"],
)
def test_other_arcs_are_lines_of_their_own(second: np.ndarray) -> None:
    merged = merge_collinear_arcs(arcs([segment((0, 100), (50, 100)), second]), NONE, **MERGE)
    assert merged.count == 2


def test_arcs_of_two_frames_are_never_one_line() -> None:
    parts = [segment((0, 100), (50, 100)), segment((60, 100), (120, 100))]
    assert merge_collinear_arcs(arcs(parts, [0, 1]), NONE, **MERGE).frame.tolist() == [0, 1]
    assert merge_collinear_arcs(arcs(parts, [1, 1]), NONE, **MERGE).frame.tolist() == [1]


def test_arcs_are_merged_under_the_lens_and_short_lines_dropped() -> None:
    lens = HarrisLens(0.3, 319.5, 239.5, 400.0)
    pieces = [lens.distort_points(segment((60 * k, 20), (60 * k + 50, 20), 30)) for k in range(10)]
    joined = merge_collinear_arcs(arcs(pieces), lens, **MERGE)
    assert joined.count == 1
    strict = {**MERGE, "tolerance_px": 0.5, "max_angle_rad": 0.01}
    assert merge_collinear_arcs(arcs(pieces), lens, **strict).count == 1
    assert merge_collinear_arcs(arcs(pieces), NONE, **strict).count > 1
    assert merge_collinear_arcs(arcs(pieces), lens, **{**MERGE, "min_length_px": 1000.0}).count == 0


def test_arcs_outside_the_domain_of_the_lens_are_left_out() -> None:
    lens = HarrisLens(3.0, 319.5, 239.5, 400.0)  # defined to 231 px from its centre
    parts = [segment((300, 240), (400, 240)), segment((0, 10), (90, 10))]
    merged = merge_collinear_arcs(arcs(parts), lens, **MERGE)
    assert merged.count == 1
    assert merged.xy[:, 0].min() >= 300
