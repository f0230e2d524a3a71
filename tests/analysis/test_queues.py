"""Queues of vehicles that are hidden, long, or still there when the film ends: their intervals hold the truth."""

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.analysis.test_traffic_analysis import CYCLE_S, EAST, SOUTH, Track, crossroads, drive, gather
from velfield.analysis.answers import find_answers
from velfield.analysis.changes import find_changes
from velfield.analysis.signals.cycles import StreamSignal, least_green_s, queues
from velfield.analysis.signals.queues import Stream
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import VEHICLE_LENGTH_M
from velfield.report.traffic.first_page import first_page


def signals_from_the_north(analysis: TrafficAnalysis) -> list[StreamSignal]:
    """The streams down the image: four vehicles stand there at each green."""
    streams = [s for signal in analysis.signals.values() for s in signal.streams]
    return [s for s in streams if abs(np.diff(s.stream.approach.path_m[[0, -30]], axis=0)[0, 0]) < 2]


def queue_answers(analysis: TrafficAnalysis) -> dict[str, str]:
    return {answer.subject: answer.text for answer in find_answers(analysis) if answer.topic == "queue"}


@pytest.fixture(scope="module")
def stream() -> Stream:
    (found,) = signals_from_the_north(TrafficAnalysis(gather(crossroads())))
    return found.stream


def only(stream: Stream, keep: np.ndarray) -> Stream:
    columns = ("track", "start_s", "end_s", "along_m", "length_m", "seen_s")
    return replace(stream, **{f"stop_{name}": getattr(stream, f"stop_{name}")[keep] for name in columns})


def test_who_stands_as_the_film_ends_stands_to_its_end() -> None:
    last_s = 10 * CYCLE_S + 20.0
    tracks = [(t[t <= last_s], xy[t <= last_s]) for t, xy in crossroads()]
    (found,) = signals_from_the_north(TrafficAnalysis(gather([track for track in tracks if len(track[0]) > 5])))
    (queue,) = queues(found.stream, np.array([last_s - 0.5]))
    assert queue.vehicles.value == queue.vehicles.low == 4


def test_who_sets_off_about_that_time_may_stand(stream: Stream) -> None:
    first_s = stream.stop_end_s[stream.stop_along_m > stream.stop_along_m.max() - 3.0][5]
    early, late = queues(stream, np.array([first_s - 0.05, first_s + 0.05]))
    for queue in (early, late):
        assert (queue.vehicles.low, queue.vehicles.high) == (3, 4)
    (sure,) = queues(stream, np.array([first_s - 1.0]))
    assert sure.vehicles.low == sure.vehicles.high == 4


def test_a_long_vehicle_hides_nobody(stream: Stream) -> None:
    """Every other one is missed: a lorry of 11.5 m stands in its place, and in that of the next, or nobody is seen."""
    second = np.argsort(np.argsort(-stream.stop_along_m)) >= 0
    for start in np.unique(np.round(stream.stop_start_s / CYCLE_S)):
        cycle = np.flatnonzero(np.round(stream.stop_start_s / CYCLE_S) == start)
        second[cycle[np.argsort(-stream.stop_along_m[cycle])][1::2]] = False
    fewer = only(stream, second)
    time = np.array([5 * CYCLE_S + 19.0])
    (cars,) = queues(fewer, time)
    assert cars.vehicles.n == cars.vehicles.low == 2
    assert cars.vehicles.value == 3
    lorry = fewer.stop_length_m.copy() + 7.0
    moved = replace(fewer, stop_length_m=lorry, stop_along_m=fewer.stop_along_m - 3.5)  # the same front bumpers
    (lorries,) = queues(moved, time)
    assert lorries.vehicles.value == lorries.vehicles.high == 2
    assert fewer.stop_length_m == pytest.approx(VEHICLE_LENGTH_M)


def test_a_queue_that_ends_where_the_view_begins_is_a_lower_bound(stream: Stream) -> None:
    seen = [(t[xy[:, 1] >= 40.0], xy[xy[:, 1] >= 40.0]) for t, xy in crossroads()]
    cut = TrafficAnalysis(gather([track for track in seen if len(track[0]) > 5]))
    (found,) = signals_from_the_north(cut)
    junction = found.stream.approach.junction
    for queue, whole in zip(*(queues(s, found.green_s[1:-1]) for s in (found.stream, stream)), strict=True):
        assert (queue.vehicles.value, queue.reaches_edge, whole.reaches_edge) == (4, True, False)
    assert cut.delay_is_partial(junction, "N")
    assert not cut.delay_is_partial(junction, "W")
    said = queue_answers(cut)
    assert "straight on to S (lane 2): at least 4 vehicles" in said[f"junction {junction} from N"]
    assert "straight on to E and right to S (lane 0): 4 vehicles" in said[f"junction {junction} from W"]


def test_a_green_lasts_at_least_as_long_as_queues_drive_off() -> None:
    """The fourth of each queue sets off 5.4 s after the first, and has 21 m more to go; a late car is of no queue."""
    (found,) = signals_from_the_north(TrafficAnalysis(gather(crossroads())))
    least = least_green_s([found], CYCLE_S)
    assert 7.0 < least < 13.0
    late = np.append(found.stream.cross_time_s, found.green_s[3] + 30.0)
    assert least_green_s([replace(found, stream=replace(found.stream, cross_time_s=np.sort(late)))], CYCLE_S) == least
    alone = replace(found, stream=replace(found.stream, cross_time_s=found.green_s + 20.0))
    assert least_green_s([alone], CYCLE_S) == 0.0


def test_the_green_of_a_lane_that_ends_before_the_others_of_its_phase_is_said() -> None:
    """On a second lane from the west two go at green, and nobody later; on the first one comes 19 s after green."""
    beside = [
        drive(EAST - [0.0, 3.5], CYCLE_S * n - 24 + 3 * k, stop_at_m=128.0 - 7 * k, go_s=CYCLE_S * n + 1.8 + 1.8 * k)
        for n in range(12)
        for k in range(2)
    ]
    late = [drive(EAST, CYCLE_S * n + 8.5) for n in range(12)]
    analysis = TrafficAnalysis(gather(crossroads() + beside + late))
    (said,) = [answer.text for answer in find_answers(analysis) if answer.topic == "signal"]
    assert re.search(
        r"from W, straight on and right \(lanes 0, (\d)\): green and yellow for (19|20|21) s, on lane \1 for [5-8] s;",
        said,
    )


def test_where_some_are_hidden_others_may_be_behind_the_last() -> None:
    rng = np.random.default_rng(5)
    tracks = [track for track in crossroads() if rng.uniform() < 0.6]
    (found,) = signals_from_the_north(TrafficAnalysis(gather(tracks)))
    assert found.stream.hidden_share > 0.1
    held = [q.vehicles.low <= 4 <= q.vehicles.high for q in queues(found.stream, found.green_s[1:-1])]
    assert np.mean(held) >= 0.8


def blocked_lane(n: int = 6) -> list[Track]:
    """From the north, on a second lane, ``n`` vehicles stand until the seventh minute: they start once in the film."""
    lane = SOUTH - [3.5, 0.0]
    return [drive(lane, -4.0 + 3 * k, stop_at_m=78.0 - 7 * k, go_s=425.0 + 1.8 * k) for k in range(n)]


def test_the_queue_of_a_lane_of_unknown_green_is_counted() -> None:
    analysis = TrafficAnalysis(gather(crossroads() + blocked_lane()))
    assert len(signals_from_the_north(analysis)) == 1
    said = queue_answers(analysis)
    (lane,) = {k for k, queue in analysis.lane_queues[0].items() if queue and queue.vehicles.n == 6}
    assert said["junction 0 from N"] == f"longest, straight on to S (lane {lane}): 6 vehicles, 39 m"
    waits = dict(first_page(analysis).answers)["Which approach waits longest, and how long are the queues?"]
    assert waits[0] == f"junction 0: the longest queue is from N, straight on to S (lane {lane}): 6 vehicles, 39 m"


def test_no_queue_is_the_longest_where_another_is_not_known() -> None:
    """Those that drive on are tracked under the trees over the stop line; those that stand are lost before them."""
    lost = [(t[xy[:, 1] < 48.0], xy[xy[:, 1] < 48.0]) for t, xy in blocked_lane(8)]
    drive_on = [drive(SOUTH - [3.5, 0.0], 440.0 + 4.0 * k) for k in range(5)]
    analysis = TrafficAnalysis(gather(crossroads() + lost + drive_on))
    (found,) = analysis.movements
    lane = next(k for k, queue in analysis.lane_queues[found.junction.number].items() if queue is None)
    assert found.gates.arms_in[lane] == "N"
    (line,) = [a for a in find_answers(analysis) if a.topic == "queue" and a.state == "too little data"]
    assert f"vehicles stand on lane {lane}" in line.text
    waits = dict(first_page(analysis).answers)["Which approach waits longest, and how long are the queues?"]
    assert waits[0].startswith("junction 0: the longest queue is from W")
    assert waits[0].endswith("the longest from N may be as long")
    assert any(f"longest queue at least 4 vehicles, 25 m; on lane {lane} it may have been as long" in w for w in waits)


def test_of_a_wait_out_of_view_no_upper_bound_is_said() -> None:
    longer = [
        drive(SOUTH, 40.0 * n - 4 + 3 * k, stop_at_m=78.0 - 7 * k, go_s=40.0 * n + 21.8 + 1.8 * k)
        for n in range(12)
        for k in (4, 5)
    ]
    free = [drive(SOUTH, 490.0 + 10.0 * k) for k in range(5)]
    seen = [(t[xy[:, 1] >= 30.0], xy[xy[:, 1] >= 30.0]) for t, xy in crossroads() + longer + free]
    cut = TrafficAnalysis(gather(seen))
    delay = next(a for a in find_answers(cut) if a.topic == "delay" and a.subject.endswith("from N"))
    assert delay.text.startswith("mean at least")
    assert delay.estimate is None
    assert not any(change.what.startswith("delay from N") for change in find_changes(cut, cut))
    (fair,) = [line for line in dict(first_page(cut).answers)["Is there a signal, and is it fair?"] if "fair" in line]
    assert "at most" not in fair
