"""Origins and destinations of constructed traffic, of which some tracks are cut; counts by slice of time."""

from dataclasses import replace

import numpy as np
import pytest

from tests.analysis.test_traffic_analysis import CYCLE_S, EAST, SOUTH, Track, crossroads, drive, gather
from velfield.analysis.movements.gates import ArmNames
from velfield.analysis.movements.scene import find_scene_gates
from velfield.analysis.movements.time_slices import slice_edges
from velfield.analysis.traffic_analysis import TrafficAnalysis


def cut(track: Track, *, begin: float, end: float) -> list[Track]:
    """The two parts of a track without the fractions of its positions in between."""
    times, xy = track
    a, b = int(begin * len(times)), int(end * len(times))
    return [(times[:a], xy[:a]), (times[b:], xy[b:])]


def along_the_way(track: Track, y_m: float) -> float:
    """Fraction of a track's positions before it passes a height."""
    return float(np.searchsorted(track[1][:, 1], y_m)) / len(track[0])


@pytest.fixture(scope="module")
def whole() -> TrafficAnalysis:
    return TrafficAnalysis(gather(crossroads()), slice_s=100.0)


def counts(analysis: TrafficAnalysis) -> dict[tuple[str, str], float]:
    scene = analysis.scene
    return {(r.origin.name, r.destination.name): r.vehicles for r in scene.relations}


def test_entries_and_exits_are_found_and_counted(whole: TrafficAnalysis) -> None:
    scene = whole.scene
    assert {(arm.name, tuple(np.round(arm.xy_m, -1))) for arm in scene.arms} == {
        ("N", (150, 0)),
        ("E", (260, 100)),
        ("S", (150, 220)),
        ("W", (0, 100)),
    }
    # the first vehicle of all is there at the first frame
    assert counts(whole) == {("W", "E"): 47, ("W", "S"): 12, ("N", "S"): 48}
    assert scene.before == 1
    assert scene.unknown == 0
    share = next(r.share for r in scene.relations if (r.origin.name, r.destination.name) == ("W", "S"))
    assert share.value == pytest.approx(12 / 59)


def test_two_clips_of_the_same_traffic_have_the_flows_of_one(whole: TrafficAnalysis) -> None:
    """An hour apart: the time between counts nowhere."""
    begin, end = whole.window_s
    later = [(times + end + 3600, xy) for times, xy in crossroads()]
    both = replace(gather([*crossroads(), *later]), gaps_s=np.array([[end, end + 3600 + begin]]))
    twice = TrafficAnalysis(both, slice_s=100.0)
    assert twice.trajectories.duration_s == pytest.approx(2 * whole.trajectories.duration_s, abs=0.1)

    def flows(analysis: TrafficAnalysis) -> dict[tuple[str, str], float]:
        scene = analysis.scene
        moves = [m for found in analysis.movements for m in found.movements]
        return {("junction", m.arm_in + m.arm_out): m.flow_veh_per_h.value for m in moves if m.flow_veh_per_h} | {
            (r.origin.name, r.destination.name): r.flow_veh_per_h.value for r in scene.relations if r.flow_veh_per_h
        }

    expected = flows(whole)
    assert len(expected) == 6
    assert flows(twice) == pytest.approx(expected, rel=0.03)
    assert {c.begin_s > end + 600 for c in twice.counts_by_time} == {False, True}
    assert all(c.end_s <= end + 100 or c.begin_s >= end + 3500 for c in twice.counts_by_time)


def test_tracks_that_are_cut_go_where_the_others_went(whole: TrafficAnalysis) -> None:
    tracks = crossroads()
    turning = [k for k, (_, xy) in enumerate(tracks) if xy[0, 0] == 0 and xy[-1, 1] > 200]
    straight = [k for k, (_, xy) in enumerate(tracks) if xy[-1, 0] > 240]
    made = [track for k, track in enumerate(tracks) if k not in (*turning[:4], *straight[1:9])]
    for k in turning[:4]:  # lost after the turn: they can only go south
        at = along_the_way(tracks[k], 150.0)
        made += cut(tracks[k], begin=at, end=at + 0.02)
    for k in straight[1:9]:  # lost before the junction: a fifth or so turns
        made += cut(tracks[k], begin=0.3, end=0.9)
    analysis = TrafficAnalysis(gather(made))
    scene = analysis.scene
    found = {(r.origin.name, r.destination.name): r for r in scene.relations}
    assert found["W", "S"].seen == 8
    assert found["W", "E"].seen == 39
    assert found["W", "S"].cut + found["W", "E"].cut == pytest.approx(12.0)
    assert found["W", "S"].cut == pytest.approx(4 + 8 * 8 / 47, abs=0.7)
    assert found["N", "S"].cut == 0
    assert scene.unknown == 8  # the four that turned are found again behind the gap


def test_a_road_under_a_tree_is_no_exit() -> None:
    """All tracks are cut there: the lane ends before it, and another begins behind it."""
    pieces = [part for k in range(12) for part in cut(drive(EAST, 4.0 * k), begin=0.45, end=0.55)]
    analysis = TrafficAnalysis(gather(pieces))
    gates, arms = find_scene_gates(analysis.trajectories, analysis.samples, analysis.lanes)
    assert [arm.name for arm in arms] == ["E", "W"]
    assert len(gates) == 2


def test_a_stop_line_where_vehicles_wait_at_the_end_or_the_beginning_is_no_place_that_they_go_to() -> None:
    """A clip of 40 s: red on the way east to its end, on the way south from its beginning to 20 s; all go west."""
    waits = [drive(EAST, 2.5 * k, stop_at_m=140.0 - 7 * k, go_s=200.0) for k in range(8)]
    waits += [drive(SOUTH, -40.0 + 2.5 * k, stop_at_m=85.0 - 7 * k, go_s=20.0 + 2 * k) for k in range(6)]
    waits += [drive(EAST[::-1] - [0.0, 8.0], 2.5 * k) for k in range(8)]
    tracks = [(times[seen], xy[seen]) for times, xy in waits for seen in [(times >= 0) & (times < 40)]]
    trajectories = gather(tracks)
    analysis = TrafficAnalysis(trajectories)
    _, arms = find_scene_gates(trajectories, analysis.samples, analysis.lanes)
    assert "inside" not in {arm.name.rstrip("12") for arm in arms}


def test_who_leaves_by_a_road_that_hardly_anybody_takes_went_elsewhere(whole: TrafficAnalysis) -> None:
    """Two vehicles from the west turn north; without them all of 12 would seem to go on as the ten do."""
    north = np.concatenate([EAST[:1], [[60.0, 100.0], [70.0, 90.0], [70.0, 0.0]]])
    tracks = [drive(EAST, 5.0 + 8.0 * k) for k in range(10)] + [drive(north, 9.0 + 40.0 * k) for k in range(2)]
    scene = TrafficAnalysis(gather([drive(SOUTH, 0.0), *tracks])).scene
    assert int(scene.trips.elsewhere.sum()) == 2
    (east,) = [r for r in scene.relations if r.origin.name == "W"]
    assert east.vehicles == 10
    assert east.share.value == pytest.approx(10 / 12)


def test_who_is_still_there_at_the_end_is_told_apart() -> None:
    tracks = [drive(EAST, 4.0 * k) for k in range(20)]
    last = float(tracks[-1][0][0]) + 7.0
    shown = [(t[t <= last], xy[t <= last]) for t, xy in tracks]
    scene = TrafficAnalysis(gather([track for track in shown if len(track[0]) > 5])).scene
    (only,) = scene.relations
    assert only.cut == 0
    assert only.remaining == 4  # who entered after 61 s: a vehicle needs 21.7 s, one comes every 4 s
    assert only.seen + only.remaining == 19


def test_slices_add_up(whole: TrafficAnalysis) -> None:
    edges = whole.slice_edges_s
    assert len(edges) == 6
    assert np.diff(edges)[:-1] == pytest.approx(100.0)
    for junction in whole.movements:
        for m in junction.movements:
            mine = [
                c
                for c in whole.counts_by_time
                if (c.junction, c.arm_in, c.arm_out) == (m.junction, m.arm_in, m.arm_out)
            ]
            assert sum(c.seen for c in mine) == m.seen
            assert sum(c.inferred for c in mine) == pytest.approx(m.inferred)
    by_time = [c.seen for c in whole.scene_by_time if (c.arm_in, c.arm_out) == ("N", "S")]
    # four a cycle of 40 s, which enter from 4 s before its start to 5 s after it
    begins = np.arange(12) * CYCLE_S
    expected = np.histogram((begins[:, None] - 4 + 3 * np.arange(4)).ravel(), edges)[0]
    assert by_time == pytest.approx(expected, abs=1)
    assert sum(by_time) == 48


def test_a_short_flight_has_no_slices(whole: TrafficAnalysis) -> None:
    assert len(slice_edges(0.0, 480.0, 300.0)) == 0
    assert TrafficAnalysis(whole.trajectories).counts_by_time == []


def test_arms_are_named_by_the_compass_where_north_is_known(whole: TrafficAnalysis) -> None:
    turned = replace(whole, arm_names=ArmNames(north_rad=0.0))  # north is right in the image
    name = {"E": "N", "S": "E", "W": "S", "N": "W"}
    before, after = ({(m.arm_in, m.arm_out) for f in a.movements for m in f.movements} for a in (whole, turned))
    assert before
    assert after == {(name[a], name[b]) for a, b in before}
    assert whole.scene
    assert turned.scene
    assert {arm.name for arm in turned.scene.arms} == {name[arm.name] for arm in whole.scene.arms}
