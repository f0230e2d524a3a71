"""CLEAR MOT and identity metrics on cases that are counted by hand."""

import numpy as np
import pytest

from velfield.synthetic.track_score import FrameObjects, TrackScore, score_tracks

VEHICLES = np.array([1, 2])
PLACES = np.array([[0.0, 0.0], [20.0, 0.0]])


def score(
    frames: list[tuple[list[int], list[float]]],
    counts: tuple[bool, bool] = (True, True),
    lengths_px: tuple[float, float] = (16.0, 16.0),
) -> TrackScore:
    """Score of two stationary vehicles at x = 0 and 20; each frame gives the ids and the x of track positions."""
    objects = [
        FrameObjects(
            vehicle=VEHICLES,
            vehicle_xy=PLACES,
            counts=np.array(counts),
            direction_rad=np.zeros(2),
            length_px=np.array(lengths_px),
            track=np.array(ids, np.int64),
            track_xy=np.column_stack([x, np.zeros(len(x))]),
        )
        for ids, x in frames
    ]
    return score_tracks(iter(objects), match_px=8.0)


def test_perfect_tracks() -> None:
    made = score([([7, 8], [0.0, 20.0])] * 4)
    assert (made.mota, made.idf1, made.tracks_per_vehicle) == (1.0, 1.0, 1.0)
    assert (made.switches, made.misses, made.false_positives, made.positions, made.mixed_tracks) == (0, 0, 0, 8, 0.0)


def test_two_tracks_that_change_places_switch_twice_and_share_half() -> None:
    made = score([([7, 8], [0.0, 20.0])] * 3 + [([7, 8], [20.0, 0.0])] * 3)
    assert made.switches == 2
    assert made.mota == pytest.approx(1 - 2 / 12)
    assert made.idf1 == pytest.approx(2 * 6 / 24)
    assert made.mixed_tracks == 1.0


def test_a_vehicle_missed_for_a_while_and_followed_by_the_same_track_again_does_not_switch() -> None:
    made = score([([7, 8], [0.0, 20.0]), ([8], [20.0]), ([7, 8], [0.0, 20.0])])
    assert (made.switches, made.misses, made.false_positives) == (0, 1, 0)
    assert made.idf1 == pytest.approx(2 * 5 / (6 + 5))


def test_a_match_is_kept_while_in_reach_though_another_track_comes_nearer() -> None:
    made = score([([7, 8], [0.0, 20.0]), ([7, 8, 9], [6.0, 20.0, 0.0])])
    assert (made.switches, made.false_positives) == (0, 1)


def test_positions_on_vehicles_that_do_not_count_are_neither_right_nor_wrong() -> None:
    made = score([([7, 8, 9], [0.0, 20.0, 50.0])] * 2, counts=(True, False))
    assert (made.positions, made.misses, made.false_positives) == (2, 0, 2)
    assert made.idf1 == pytest.approx(2 * 2 / (2 + 4))


def test_one_track_over_two_vehicles_counts_for_one_of_them() -> None:
    made = score([([7], [0.0])] * 3 + [([7], [20.0])] * 2)
    assert made.idf1 == pytest.approx(2 * 3 / (10 + 5))
    assert (made.mixed_tracks, made.tracks_per_vehicle) == (1.0, 1.0)
    assert made.switches == 0


def test_along_a_long_vehicle_a_third_of_its_length_is_near() -> None:
    frames = [([7], [29.0])] * 3
    assert score(frames).false_positives == 3
    assert score(frames, lengths_px=(16.0, 30.0)).false_positives == 0
