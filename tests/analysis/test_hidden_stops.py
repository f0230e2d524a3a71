"""Stops that a tree hides, and the onset of red by crossings that thin out."""

import numpy as np
import pytest

from schemas.arrays import FloatArray
from tests.analysis.test_traffic_analysis import CYCLE_S, Track, crossroads, gather
from velfield.analysis.intervals import Estimate
from velfield.analysis.signals.cycles import _red_onset, queues
from velfield.analysis.signals.queues import Stream
from velfield.analysis.traffic_analysis import TrafficAnalysis


def without(track: Track, low_m: FloatArray, high_m: FloatArray) -> Track:
    """A track without its positions in a box."""
    times, xy = track
    seen = ~((xy > low_m) & (xy < high_m)).all(axis=1)
    return times[seen], xy[seen]


@pytest.fixture(scope="module")
def whole() -> TrafficAnalysis:
    return TrafficAnalysis(gather(crossroads()))


def first_stream(analysis: TrafficAnalysis) -> Stream:
    """The stream from the west: its approach runs along x."""
    streams = [s for signal in analysis.signals.values() for s in signal.streams]
    (found,) = [s for s in streams if abs(np.diff(s.stream.approach.path_m[[0, -30]], axis=0)[0, 1]) < 2]
    return found.stream


def test_a_tree_over_the_stop_line_does_not_move_it(whole: TrafficAnalysis) -> None:
    """The first of a queue is seen again where it drives already: it did not stand there."""
    stream = first_stream(whole)
    front = stream.approach.path_m[int(stream.stop_line_m)]
    tree = front + np.array([[-4.0, -3.0], [3.0, 3.0]])
    hidden = TrafficAnalysis(gather([without(track, *tree) for track in crossroads()]))
    found = first_stream(hidden)
    at, was = (s.approach.path_m[0, 0] + (s.stop_line_m or 0.0) for s in (found, stream))
    assert at == pytest.approx(was, abs=1.0)
    assert len(found.head_time_s) == len(stream.head_time_s)
    assert found.head_time_s == pytest.approx(stream.head_time_s, abs=1.0)
    (signal,) = [s for s in hidden.signals.values() if s.signalised]
    for one in signal.streams:
        counts = [queue.vehicles.value for queue in queues(one.stream, one.green_s[1:-1])]
        assert np.median(counts) == 4


def test_who_is_hidden_while_it_stands_crosses_the_line_after_it(whole: TrafficAnalysis) -> None:
    stream = first_stream(whole)
    front = stream.approach.path_m[int(stream.stop_line_m or 0)]
    tree = front + np.array([[-4.0, -3.0], [6.0, 3.0]])  # over the line too
    found = first_stream(TrafficAnalysis(gather([without(track, *tree) for track in crossroads()])))
    time = dict(zip(found.cross_track.tolist(), found.cross_time_s.tolist(), strict=True))
    ends = dict(zip(found.head_track.tolist(), found.head_time_s.tolist(), strict=True))
    assert len(ends) == len(stream.head_time_s) > 5
    was = dict(zip(stream.cross_track.tolist(), stream.cross_time_s.tolist(), strict=True))
    assert max(abs(time[track] - was[track]) for track in time) < 2.0
    assert all(0 < time[track] - end < 4 for track, end in ends.items())
    assert (np.diff(found.cross_time_s) >= 0).all()


def test_the_onset_of_red_is_where_crossings_end() -> None:
    """Crossings thin out linearly over the last 1.2 s before 18 s of a cycle; 90 % intervals hold that."""
    rng, red_s, thinning_s, cycles = np.random.default_rng(3), 18.0, 1.2, 12
    errors, held = [], []
    for _ in range(200):
        times = []
        for cycle in range(cycles):
            t = rng.uniform(2.0, red_s, rng.poisson(0.3 * (red_s - 2.0)))
            kept = rng.uniform(size=len(t)) < (red_s - t) / thinning_s
            times.append(t[kept] + cycle * CYCLE_S)
        crossings = np.sort(np.concatenate(times))
        found = _red_onset(crossings, 0.0, Estimate(CYCLE_S, CYCLE_S, CYCLE_S, cycles))
        errors.append(found.value - red_s)
        held.append(found.low <= red_s <= found.high)
    assert np.mean(errors) == pytest.approx(0.0, abs=0.1)
    assert 0.86 <= np.mean(held) <= 0.99
