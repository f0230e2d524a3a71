"""Doubtful tracks: by hand-made tracks beside a road that ten vehicles drive."""

import numpy as np
import pandas as pd
import pytest

from velfield.tracking.doubtful import find_doubtful, find_lone

METRES, FRAMES = 0.25, 20


class Flight:
    """Tracks made by hand, positions in metres: ten vehicles of score 0.3 drive along y = 50 m, and one stands."""

    def __init__(self, traffic: int = 10, score: float = 0.3) -> None:
        self.positions: list[pd.DataFrame] = []
        self.scores: dict[int, float] = {}
        for track in range(traffic):
            self.add(track, 20 + 2.0 * np.arange(21), 50.0, score)

    def add(self, track: int, x_m: np.ndarray, y_m: float, score: float) -> None:
        """A track and the mean score of its detections."""
        self.positions.append(
            pd.DataFrame(
                {"track_id": track, "time_s": 0.2 * np.arange(len(x_m)), "x_px": x_m / METRES, "y_px": y_m / METRES}
            )
        )
        self.scores[track] = score

    def doubts(self, y_m: float, score: float, seen: int = FRAMES) -> bool:
        """Whether a thing that stands there, and is found in so many frames, is doubtful; nothing else ever is."""
        self.add(51, 40.0 + np.random.default_rng(0).normal(0, 0.08, seen), y_m, score)
        found = find_doubtful(
            pd.concat(self.positions), pd.Series(self.scores), METRES, lambda xy: np.full(len(xy), float(FRAMES))
        )
        assert set(found.tolist()) <= {51}
        return len(found) > 0


@pytest.mark.parametrize(
    ("y_m", "score", "doubtful"),
    [
        (70.0, 0.05, True),  # on a roof, with a sixth of the usual score
        (65.0, 0.13, False),  # in a drive, with two fifths
        (120.0, 0.13, True),  # far from everything it has to look more like a car
        (120.0, 0.25, False),
        (55.0, 0.05, False),  # at the kerb
        (54.0, -0.2, False),  # whatever its score
        (94.0, 0.05, False),  # next to a car in a yard
    ],
)
def test_what_stands_needs_a_higher_score_the_farther_it_is_from_vehicles(
    y_m: float, score: float, doubtful: bool
) -> None:
    made = Flight()
    made.add(50, np.full(FRAMES, 40.0), 98.0, 0.4)
    assert made.doubts(y_m, score) == doubtful


def test_what_is_found_in_few_of_the_frames_needs_a_higher_score() -> None:
    assert not Flight().doubts(68.0, 0.15)
    assert Flight().doubts(68.0, 0.15, seen=FRAMES // 2)
    assert not Flight().doubts(68.0, 0.26, seen=FRAMES // 2)


def test_what_moves_is_never_doubtful() -> None:
    made = Flight()
    made.add(50, 40.0 + 0.3 * np.arange(15), 150.0, -0.2)
    assert not made.doubts(50.0, 0.3)


@pytest.mark.parametrize("made", [Flight(traffic=9), Flight(score=-0.02), Flight(traffic=0)])
def test_without_a_usual_score_nothing_is_doubtful(made: Flight) -> None:
    assert not made.doubts(120.0, 0.01)


def test_a_detection_in_no_track_needs_a_score_above_that_of_a_tenth_of_the_tracks() -> None:
    detections = pd.DataFrame({"detection_id": range(5), "frame": [3, 3, 3, 3, 9], "score": [0.0, 0.1, 0.2, 0.1, 0.0]})
    in_tracks = detections[["detection_id", "frame"]].take([3])  # none in frame 9: nothing could be followed there
    lone = find_lone(detections, in_tracks, pd.Series([0.14, *[0.15] * 18]))
    assert lone["detection_id"].tolist() == [0, 1]
    assert not len(find_lone(detections, in_tracks, pd.Series([0.15] * 9)))  # too few to tell what is usual
