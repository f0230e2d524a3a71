"""Frame pairs for the multi-view lens estimate: which are informative, and how they are padded."""

import numpy as np
import pytest

from tests.scenes import by_homography, city, photograph, similarity
from velfield.camera.lens import HarrisLens, pinhole
from velfield.registration import pairing
from velfield.registration.pairing import match_frame_pairs, select_informative_pairs

SHAPE = (240, 320)
CENTRE = np.array([159.5, 119.5])


def test_the_most_sensitive_pairs_are_selected_in_order() -> None:
    pairs = [(1.0, 0, 1), (3.0, 0, 2), (2.0, 1, 2)]
    assert select_informative_pairs(pairs, 3) == [(1.0, 0, 1), (3.0, 0, 2), (2.0, 1, 2)]
    many = [(float(k), k, k + 1) for k in range(40)]
    selected = select_informative_pairs(many, 41)
    assert [k for k, _, _ in selected] == [float(k) for k in range(16, 40)]  # the 24 largest, in the order of i


def test_no_frame_is_in_more_than_six_pairs() -> None:
    pairs = [(100.0 - j, 0, j) for j in range(1, 15)] + [(1.0, 13, 14)]
    selected = select_informative_pairs(pairs, 15)
    assert [j for _, i, j in selected if i == 0] == [1, 2, 3, 4, 5, 6]
    assert (1.0, 13, 14) in selected


def matched_points(turn_deg: float, count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Points of two frames of a plane, the second rotated about the image centre."""
    rng = np.random.default_rng(0)
    source = rng.uniform([20, 20], [300, 220], (count, 2))
    return source, by_homography(similarity(1.0, turn_deg, CENTRE, CENTRE), source)


def test_a_pair_rotated_about_the_centre_tells_nothing_of_a_radial_lens() -> None:
    """Every point keeps its distance from the centre: the distortion of both frames is one rotation apart."""
    inliers, sensitivity_px = pairing._find_inliers(*matched_points(40.0), SHAPE)
    assert inliers.all()
    assert sensitivity_px < 1e-6


def test_the_farther_apart_a_pair_the_more_it_tells() -> None:
    source = np.random.default_rng(0).uniform([20, 20], [300, 220], (300, 2))
    near, far = (pairing._find_inliers(source, source + np.array([shift, 0.0]), SHAPE)[1] for shift in (5.0, 80.0))
    assert 0 < near < far
    assert far > 5 * near


def test_wrong_matches_are_no_inliers_and_few_matches_no_pair() -> None:
    source, target = matched_points(10.0)
    target[:60] += np.random.default_rng(1).uniform(30, 90, (60, 2))
    inliers, _ = pairing._find_inliers(source, target, SHAPE)
    assert not inliers[:60].any()
    assert inliers[60:].all()
    none, sensitivity_px = pairing._find_inliers(source[:19], target[:19], SHAPE)
    assert (none.any(), sensitivity_px) == (False, 0.0)


@pytest.fixture(scope="module")
def flight() -> tuple[list[np.ndarray], list[np.ndarray]]:
    ground, lens = city(5, 700, blocks=200), pinhole(SHAPE)
    views = [similarity(1.0, 3.0 * k, CENTRE, np.array([250.0 + 25 * k, 330.0])) for k in range(4)]
    return [photograph(ground, view, lens, SHAPE, k) for k, view in enumerate(views)], views


def test_pairs_are_padded_by_their_first_match(flight: tuple[list[np.ndarray], list[np.ndarray]]) -> None:
    frames, views = flight
    pairs = match_frame_pairs(frames)
    assert pairs.frame_shape == SHAPE
    assert pairs.valid.shape == pairs.xy_i.shape[:2] == pairs.xy_j.shape[:2]
    assert pairs.valid.any(axis=0).all()  # no column of padding alone
    for p, (i, j) in enumerate(pairs.frames):
        padding = ~pairs.valid[p]
        np.testing.assert_array_equal(pairs.xy_i[p][padding], np.repeat(pairs.xy_i[p, :1], padding.sum(), axis=0))
        there = by_homography(np.linalg.inv(views[j]) @ views[i], pairs.xy_i[p][pairs.valid[p]])
        assert np.median(np.linalg.norm(there - pairs.xy_j[p][pairs.valid[p]], axis=1)) < 0.5


def test_matches_survive_a_lens_not_yet_known(flight: tuple[list[np.ndarray], list[np.ndarray]]) -> None:
    """The inlier threshold leaves room for a distortion: nearly as many are found as without one."""
    ground, lens = city(5, 700, blocks=200), HarrisLens(0.15, *CENTRE, 200.0)
    frames, views = flight
    found = match_frame_pairs([photograph(ground, view, lens, SHAPE, k) for k, view in enumerate(views)])
    straight = match_frame_pairs(frames)
    assert found.valid.sum() > 0.8 * straight.valid.sum()
    for p, (i, j) in enumerate(found.frames):
        ends = [lens.undistort_points(xy[p][found.valid[p]]) for xy in (found.xy_i, found.xy_j)]
        there = by_homography(np.linalg.inv(views[j]) @ views[i], ends[0])
        assert np.median(np.linalg.norm(there - ends[1], axis=1)) < 0.5
