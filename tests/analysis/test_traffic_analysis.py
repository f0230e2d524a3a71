"""Answers about constructed traffic: a signal of known cycle, turning counts, free flow, a U-turn, a wrong way."""

import re
from dataclasses import replace

import numpy as np
import pytest

from schemas.arrays import FloatArray
from velfield.analysis.answers import find_answers
from velfield.analysis.approaches import lanes_text
from velfield.analysis.changes import find_changes
from velfield.analysis.flow.conflicts import find_conflicts, persistent, positions_on_lanes
from velfield.analysis.flow.passings import LaneTraffic
from velfield.analysis.flow.speeds import FreeFlow
from velfield.analysis.flow.volume import flow_slices
from velfield.analysis.intervals import (
    Estimate,
    estimate_censored_quantile,
    estimate_quantile,
    estimate_rate,
    estimate_share,
)
from velfield.analysis.movements.gates import Arm, Gate, Gates
from velfield.analysis.movements.movements import furness
from velfield.analysis.movements.reversals import Reversal, seen_whole_s
from velfield.analysis.signals.coordination import queue_growth
from velfield.analysis.signals.cycles import find_signal, queues
from velfield.analysis.signals.phases import START_DELAY_S, fit_phases
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import Trajectories, group_rows, make_trajectories, moving
from velfield.pipeline.analysis.tables import unusual_table

STEP_S, CYCLE_S, SPEED = 0.2, 40.0, 12.0
Track = tuple[FloatArray, FloatArray]
"""Times (n,) and positions (n, 2) m."""


def drive(
    path: FloatArray,
    start_s: float,
    *,
    stop_at_m: float | None = None,
    go_s: float = 0.0,
    waits: tuple[float, float] | None = None,
) -> Track:
    """Along a path at 12 m/s; a stop at a place until a time, with comfortable braking and starting. ``waits``: place
    of a second stop, m, and its end, s."""
    along = np.concatenate([[0.0], np.hypot(*np.diff(path, axis=0).T).cumsum()])
    stops = ([] if stop_at_m is None else [(stop_at_m, go_s)]) + ([waits] if waits else [])
    s, v, t, out = 0.0, SPEED, start_s, []
    while s < along[-1]:
        out.append((t, s))
        held = [at for at, until_s in stops if t < until_s and s <= at + 1.0]
        limit = min((np.sqrt(2 * 2.5 * max(at - s, 0.0)) for at in held), default=SPEED)
        v = max(min(v + 2.0 * STEP_S, limit, SPEED), 0.0)
        v = 0.0 if held and v < 0.4 else v
        s, t = s + v * STEP_S, t + STEP_S
    times, s_at = np.array(out).T
    return times, np.column_stack([np.interp(s_at, along, path[:, k]) for k in (0, 1)])


def gather(tracks: list[Track], *, sd_m: float = 0.03) -> Trajectories:
    rng = np.random.default_rng(3)
    owner = np.repeat(np.arange(len(tracks)), [len(times) for times, _ in tracks])
    time = np.concatenate([times for times, _ in tracks])
    xy = np.concatenate([xy for _, xy in tracks]) + rng.normal(0, sd_m, (len(time), 2))
    return moving(make_trajectories(owner, np.round(time / STEP_S).astype(np.int64), time, xy, gsd_m=0.2))


def corner(x: float, y: float, to_y: float) -> FloatArray:
    angle = np.linspace(-np.pi / 2, 0, 20)
    arc = np.array([x, y + 10.0]) + 10.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.concatenate([[[0.0, y]], arc, [[x + 10.0, to_y]]])


EAST = np.array([[0.0, 100.0], [260.0, 100.0]])
SOUTH = np.array([[150.0, 0.0], [150.0, 220.0]])
RIGHT = corner(140.0, 100.0, 220.0)


def crossroads(*, waits_s: float = 0.0) -> list[Track]:
    """Twelve cycles: to the east green from 0 to 18 s of each, to the south from 20 to 38 s. In two of three the first
    of each queue waits after green for the junction to clear."""
    out = []
    for cycle in range(12):
        begin = cycle * CYCLE_S
        go = begin + 1.8 + (waits_s if cycle % 3 else 0.0)
        for k in range(4):  # a queue before each green, 7 m apart, 2 s apart
            path = RIGHT if k == 2 else EAST
            out.append(drive(path, begin - 24 + 3 * k, stop_at_m=128.0 - 7 * k, go_s=go + 1.8 * k))
            out.append(drive(SOUTH, begin - 4 + 3 * k, stop_at_m=78.0 - 7 * k, go_s=go + 20 + 1.8 * k))
        out.append(drive(EAST, begin + 1.0 + cycle % 3))
    return out


@pytest.fixture(scope="module")
def analysis() -> TrafficAnalysis:
    return TrafficAnalysis(gather(crossroads()))


def test_turning_counts_and_shares(analysis: TrafficAnalysis) -> None:
    found = {
        (m.arm_in, m.arm_out): m for j in analysis.movements for m in j.movements if j.junction.kind == "intersection"
    }
    assert found["W", "E"].seen == 48
    assert found["W", "S"].seen == 12
    assert found["W", "S"].turn == "right"
    assert found["N", "S"].seen == 48
    share = found["W", "S"].share
    assert share.value == pytest.approx(0.2)
    assert share.low < 0.2 < share.high
    # 60 m and the junction at 12 m/s are some 6 s
    delay, travel = found["W", "E"].delay_s, found["W", "E"].travel_time_s
    assert travel.value - delay.value == pytest.approx(6.0, abs=0.7)


def test_where_all_stop_the_delay_is_against_the_pace_at_which_they_come(analysis: TrafficAnalysis) -> None:
    """Every vehicle from the north waits: none shows how long the way through takes freely."""
    south = [(t, xy) for t, xy in crossroads() if np.ptp(xy[:, 0]) < 1.0]
    lost_s = [times[-1] - times[0] - 220.0 / SPEED for times, _ in south]
    (found,) = (j for j in analysis.movements if j.junction.kind == "intersection")
    delay = found.delays_s["N"]
    assert delay.n == len(south) == 48
    assert delay.value == pytest.approx(np.mean(lost_s), abs=1.0)
    assert found.timed("N") == 48
    near = [(t[xy[:, 1] >= 35.0], xy[xy[:, 1] >= 35.0]) for t, xy in crossroads()]  # they come into view to stop
    (cut,) = TrafficAnalysis(gather(near)).movements
    assert "N" not in cut.delays_s
    assert "W" in cut.delays_s
    long = gather([track for track in crossroads() if track[0][0] > 35.0 and track[0][-1] < 165.0])
    assert "N" in TrafficAnalysis(long).movements[0].delays_s
    (brief,) = TrafficAnalysis(replace(long, gaps_s=np.array([[40.0, 50.0]]))).movements  # two films, none of 120 s
    assert brief.timed("N") == 12
    assert not brief.delays_s
    assert {m.delay_s for m in brief.movements} == {None}


def test_vehicles_too_few_for_a_delay_of_each_turn_give_that_of_their_approach() -> None:
    tracks = [drive(EAST, 20.0 * k, stop_at_m=130.0, go_s=20.0 * k + 25.0) for k in range(8)]
    tracks += [drive(RIGHT, 20.0 * k + 9.0, stop_at_m=130.0, go_s=20.0 * k + 30.0) for k in range(8)]
    tracks += [drive(SOUTH, 11.0 * k + 1.5) for k in range(12)]
    (found,) = (j for j in TrafficAnalysis(gather(tracks)).movements if j.junction.kind == "intersection")
    assert {m.delay_s for m in found.movements if m.arm_in == "W"} == {None}
    lost_s = [times[-1] - times[0] - 260.0 / SPEED for times, _ in tracks[:8]]  # those who turn lose about as much
    assert found.delays_s["W"].n == 16
    assert found.delays_s["W"].value == pytest.approx(np.mean(lost_s), rel=0.3)


def test_a_few_starts_that_recur_show_a_signal_but_not_at_a_roundabout(analysis: TrafficAnalysis) -> None:
    seen = np.array([[-30.0, 4 * CYCLE_S]])
    streams = [
        replace(
            s,
            head_time_s=s.head_time_s[s.head_time_s < seen[0, 1]],
            head_track=s.head_track[s.head_time_s < seen[0, 1]],
        )
        for s in next(streams for streams in analysis.streams.values() if len(streams) == 2)
    ]
    assert find_signal(0, streams, seen).signalised
    found = find_signal(0, streams, seen, roundabout=True)
    assert found.signalised is None
    assert "16 needed" in found.reason


def test_one_early_and_one_late_start_make_no_phase_of_their_own() -> None:
    prompt = 6.0 + 60.0 * np.arange(4.0)
    early, late = np.array([65.7, 119.3, 186.5]), np.sort(np.append(prompt, 137.1))
    _, phases = fit_phases([prompt, late, early, prompt + 31.0], 60.0)
    assert [set(phase.streams) for phase in phases] == [{0, 1, 2}, {3}]


def test_who_waits_far_before_a_junction_is_delayed_too() -> None:
    """Every other vehicle from the west stands 100 m before the junction for 20 s; it loses 5 s to brake and start."""
    tracks = [drive(EAST, 9.0 * k) for k in range(12)]
    tracks += [drive(EAST, 9.0 * k + 3.0, stop_at_m=30.0, go_s=9.0 * k + 28.0) for k in range(12)]
    tracks += [drive(RIGHT, 15.0 * k + 1.5) for k in range(5)] + [drive(SOUTH, 11.0 * k + 1.5) for k in range(10)]
    analysis = TrafficAnalysis(gather(tracks))
    found = {(m.arm_in, m.arm_out): m for j in analysis.movements for m in j.movements}
    delay, travel = found["W", "E"].delay_s, found["W", "E"].travel_time_s
    assert travel.value == pytest.approx(6.0, abs=0.7)  # over 60 m, on which nobody stands
    lost_s = [times[-1] - times[0] - 260.0 / SPEED for times, _ in tracks[12:24]]
    assert delay.value == pytest.approx(np.mean(lost_s) / 2, rel=0.15)


def test_who_waits_at_the_junction_before_is_not_delayed_at_the_next() -> None:
    """A crossing road 75 m before the junction: who stands there for 20 s is delayed there."""
    before = np.array([[75.0, 0.0], [75.0, 220.0]])
    west = corner(65.0, 100.0, 220.0)
    tracks = [drive(EAST, 9.0 * k) for k in range(12)]
    tracks += [drive(EAST, 9.0 * k + 3.0, stop_at_m=55.0, go_s=9.0 * k + 29.0) for k in range(12)]
    tracks += [drive(path, 15.0 * k + 1.5) for path in (RIGHT, west) for k in range(5)]
    tracks += [drive(path, 11.0 * k + 1.5) for path in (SOUTH, before) for k in range(10)]
    analysis = TrafficAnalysis(gather(tracks))
    found = sorted(
        (j.junction.centre_m[0], m.delay_s)
        for j in analysis.movements
        for m in j.movements
        if (m.arm_in, m.arm_out) == ("W", "E") and m.delay_s
    )
    (_, first), (_, second) = found
    assert first.value > 8.0
    assert second.value < 1.0


def test_a_vehicle_that_stands_for_most_of_a_clip_does_not_outweigh_the_others() -> None:
    """Eleven vehicles of 6 s and one of 49 s in a clip of 60 s: 9.6 s in the mean, 12 s with those that were cut."""
    tracks = [drive(EAST, 3.5 * k - 3.0) for k in range(11)] + [drive(EAST, -2.0, stop_at_m=131.0, go_s=49.0)]
    tracks += [drive(RIGHT, 3.5 * k - 1.0) for k in range(5)] + [drive(SOUTH, 4.0 * k + 1.5) for k in range(8)]
    in_clip = ((times, xy, (times >= 0.0) & (times < 60.0)) for times, xy in tracks)
    analysis = TrafficAnalysis(gather([(times[rows], xy[rows]) for times, xy, rows in in_clip]))
    found = {(m.arm_in, m.arm_out): m for j in analysis.movements for m in j.movements}
    travel = found["W", "E"].travel_time_s
    assert travel.n == 12
    assert 9.6 < travel.value < 13.0
    assert travel.low < 9.6


def test_turns_from_a_lane_that_two_vehicles_drove_are_of_its_road() -> None:
    beside = corner(140.0, 103.3, 220.0)
    (junction,) = TrafficAnalysis(gather([*crossroads(), drive(beside, 7.0), drive(beside, 47.0)])).movements
    right = next(m for m in junction.movements if (m.arm_in, m.arm_out) == ("W", "S"))
    assert right.seen == 14
    assert right.share.value == pytest.approx(14 / 62, abs=1e-6)


def test_a_tree_that_cuts_one_movement_leaves_shares_and_counts_as_they_are() -> None:
    cut: list[Track] = []
    for k, (times, xy) in enumerate(crossroads()):
        hidden = np.hypot(*(xy - [158.0, 100.0]).T) < 6.0  # over the way out to the east
        if hidden.any() and k % 3:
            first, last = np.flatnonzero(hidden)[[0, -1]]
            cut += [(times[:first], xy[:first]), (times[last + 1 :], xy[last + 1 :])]
        else:
            cut.append((times, xy))
    found = TrafficAnalysis(gather([track for track in cut if len(track[0]) > 3]))
    joined = found.cut_tracks
    assert np.bincount(joined.vehicle).max() == 2
    assert len(np.unique(joined.vehicle)) == len(crossroads())
    movements = {
        (m.arm_in, m.arm_out): m for j in found.movements for m in j.movements if j.junction.kind == "intersection"
    }
    straight, right = movements["W", "E"], movements["W", "S"]
    assert straight.seen < 25
    assert straight.seen + straight.inferred == pytest.approx(48)
    assert right.seen == 12
    assert right.share.value == pytest.approx(0.2)


def test_the_cycle_green_and_queues(analysis: TrafficAnalysis) -> None:
    junction = next(j for j in analysis.lanes.junctions if j.kind == "intersection")
    signal = analysis.signals[junction.number]
    assert signal.signalised
    assert signal.cycle_s.value == pytest.approx(CYCLE_S, abs=0.3)
    assert signal.cycle_s.low < CYCLE_S < signal.cycle_s.high
    greens = sorted((s.green_phase_s.value + 5) % CYCLE_S - 5 for s in signal.streams)
    assert greens == pytest.approx([0.0, 20.0], abs=1.0)
    for stream in signal.streams:
        found = [queue.vehicles.value for queue in queues(stream.stream, stream.green_s[1:-1])]
        assert np.median(found) == 4
        assert stream.stream.stop_line_m is not None


def test_without_a_cycle_there_is_no_signal(analysis: TrafficAnalysis) -> None:
    streams = next(s for s in analysis.streams.values() if any(len(x.head_time_s) for x in s))
    rng = np.random.default_rng(0)
    scattered = [replace(s, head_time_s=np.sort(rng.uniform(0, 480, len(s.head_time_s)))) for s in streams]
    found = find_signal(0, scattered, np.array([[0.0, 480.0]]))
    assert found.signalised is False
    assert re.fullmatch(
        r"no signal was found: vehicles start at any time, \d+ queues in no fixed cycle \(an actuated signal has none "
        r"either\)",
        found.reason,
    )
    few = [replace(s, head_time_s=s.head_time_s[:1]) for s in streams]
    assert find_signal(0, few, np.array([[0.0, 480.0]])).signalised is None


def test_free_flow_and_edie(analysis: TrafficAnalysis) -> None:
    known = [road.speed_m_per_s for road in analysis.free_flow if road.speed_m_per_s]
    assert known
    assert known[0].value == pytest.approx(SPEED, abs=0.4)
    lane = max(analysis.lanes, key=lambda lane: lane.tracks)
    slices = flow_slices(analysis.lane_traffic, lane.number, analysis.trajectories.observed_s)
    driven = (slices.flow_veh_per_h / 3600).mean() * (analysis.window_s[1] - analysis.window_s[0])
    assert driven == pytest.approx(lane.tracks, rel=0.1)
    used = slices.density_veh_per_km > 0
    product = slices.density_veh_per_km[used] * slices.speed_m_per_s[used] * 3.6
    assert product == pytest.approx(slices.flow_veh_per_h[used])


@pytest.mark.parametrize("length_m", [18.0, 40.0, 120.0])
def test_the_mean_speed_of_a_short_lane_is_that_of_its_vehicles(length_m: float) -> None:
    """A lane ends before the paths that made it do: the time beyond its ends counted, the distance did not."""
    path = np.array([[0.0, 100.0], [length_m, 100.0]])
    (flow,) = TrafficAnalysis(gather([drive(path, 6.0 * k) for k in range(30)])).flows
    assert flow.space_mean_speed_m_per_s.value == pytest.approx(SPEED, rel=0.01)


def test_flow_is_of_the_times_that_are_seen() -> None:
    """Two clips of three minutes, half an hour apart: a vehicle every 4 s is 900 an hour."""
    clips = [drive(EAST, begin + 4.0 * k) for begin in (0.0, 1980.0) for k in range(45)]
    whole = gather(clips)
    last = float(whole.time_s[whole.time_s < 1000].max())
    analysis = TrafficAnalysis(replace(whole, gaps_s=np.array([[last, 1980.0]])), slice_s=100.0)
    assert analysis.trajectories.duration_s == pytest.approx(2 * last, abs=1.0)
    flow = max(analysis.flows, key=lambda one: one.flow_veh_per_h.value if one.flow_veh_per_h else 0.0)
    assert flow.flow_veh_per_h.value == pytest.approx(90 / (2 * last) * 3600, rel=0.02)
    assert flow.flow_veh_per_h.low > 600
    assert flow.headway_s.value == pytest.approx(4.0, abs=0.05)
    slices = flow_slices(analysis.lane_traffic, flow.lane, analysis.trajectories.observed_s)
    assert len(slices.slices) == 6
    assert slices.flow_veh_per_h.min() > 600
    edges = np.array([0.0, 100.0, 1000.0, 2000.0])
    np.testing.assert_allclose(analysis.trajectories.observed_within(edges), [100, last - 100, 20], atol=0.5)


def test_a_u_turn_a_wrong_way_and_a_conflict() -> None:
    half = np.linspace(np.pi / 2, -np.pi / 2, 20)
    back = np.array([[0.0, 86.0]])
    turn = np.array([140.0, 93.0]) + 7.0 * np.column_stack([np.cos(half), np.sin(half)])
    u_turn = drive(np.concatenate([[[0.0, 100.0]], turn, back]), 5.0)
    tracks = [drive(EAST, 4.0 * k) for k in range(12)] + [drive(EAST[::-1], 20.0), u_turn]
    tracks += [drive(SOUTH, 4.0 * k + 5.7) for k in range(12)]
    analysis = TrafficAnalysis(gather(tracks))
    assert [r.left for r in analysis.reversals] == [True]
    (answer,) = (a for a in find_answers(analysis) if a.topic == "u-turns")
    assert answer.text.endswith(": 1 at crossing 0")
    alone = TrafficAnalysis(gather([*(drive(EAST, 4.0 * k) for k in range(12)), u_turn]))
    (answer,) = (a for a in find_answers(alone) if a.topic == "u-turns")
    assert answer.text.endswith(": 1 on lane 0, away from junctions")
    # half a circle of 7 m radius and 8 m of each leg, at 12 m/s, with what smoothing adds
    assert analysis.reversals[0].takes_s == pytest.approx((np.pi * 7 + 16) / 12, abs=1.0)
    assert "wrong way" in {u.kind for u in analysis.unusual}
    assert {u.track for u in analysis.unusual if u.kind == "wrong way"} == {12}
    crossing = [c for c in find_conflicts(analysis.trajectories, analysis.lane_traffic) if c.kind == "crossing"]
    # at (150, 100): east at 4 k + 12.5 s, south at 4 k + 14.03 s; each holds the place for 6.3 m at 12 m/s
    assert len(crossing) >= 12
    first = min(crossing, key=lambda c: c.value_s)
    assert first.value_s == pytest.approx(14.03 - 12.5 - 6.3 / 12, abs=0.1)
    assert 0.5 < first.probability <= 1.0


def test_who_leaves_a_roundabout_by_the_arm_of_entry_makes_a_u_turn() -> None:
    """Three go round a ring of four arms, of 18 m radius, back to the west; eight each go straight on from each arm."""

    def way(arm: int, parts: int) -> FloatArray:
        begin, end = np.radians(90 * arm + 20), np.radians(90 * (arm + parts) - 20)
        ring = 18.0 * np.column_stack([np.cos(t := np.linspace(begin, end, 60)), np.sin(t)])
        out, into = (np.array([np.cos(a), np.sin(a)]) for a in np.radians([90 * (arm + parts), 90 * arm]))
        side = 2.2 * np.array([[-into[1], into[0]], [out[1], -out[0]]])
        return np.array([200.0, 150.0]) + np.vstack([120 * into + side[0], 32 * into + side[0], ring,
                                                     32 * out + side[1], 120 * out + side[1]])  # fmt: skip

    tracks = [drive(way(arm, 2), 40.0 * k + 10.0 * arm) for k in range(8) for arm in range(4)]
    tracks += [drive(way(2, 4), 95.0 * k + 5.0) for k in range(3)]
    analysis = TrafficAnalysis(gather(tracks))
    assert [junction.kind for junction in analysis.lanes.junctions] == ["roundabout"]
    assert [turn.track for turn in analysis.reversals] == [32, 33, 34]
    assert [turn.left for turn in analysis.reversals] == [False] * 3  # y down: the circle is driven to the right
    (answer,) = (a for a in find_answers(analysis) if a.topic == "u-turns")
    assert re.fullmatch(r"3 seen, 3\d an hour \(\d+ to \d+\): 3 at junction 0", answer.text)
    (answer,) = (a for a in find_answers(analysis) if a.topic == "queue")
    assert answer.text == "too little data: queues are measured before a signal whose cycle is known"
    ring = {
        lanes_text(road.lanes)
        for road in analysis.free_flow
        if road.lanes[0] in analysis.lanes.junctions[0].lanes_inside
    }
    told = {a.subject: "limit" in a.text for a in find_answers(analysis) if a.topic == "speed" and a.estimate}
    assert {told[subject] for subject in ring & set(told)} == {False}
    assert {told[subject] for subject in set(told) - ring} == {True}


def test_of_three_speed_limits_none_is_named(analysis: TrafficAnalysis) -> None:
    found = TrafficAnalysis(analysis.trajectories)
    free = [Estimate(14.0, low, 15.6, 12) for low in (12.0, 13.5)]
    found.__dict__["free_flow"] = [FreeFlow((k,), one, None) for k, one in enumerate(free)]
    said = [a.text for a in find_answers(found) if a.topic == "speed" and a.estimate]
    assert [text.split(", n 12)")[1] for text in said] == [
        "; the limit is not known",
        ", as under a limit of 50 or 60 km/h",
    ]


def test_u_turns_that_the_ends_of_short_clips_cut_do_not_bias_their_rate() -> None:
    rng = np.random.default_rng(3)
    takes_s, clip_s, clips, per_s = 20.0, 60.0, 4000, 1 / 30
    begin = np.sort(rng.uniform(0, clip_s * clips, rng.poisson(clip_s * clips * per_s)))
    whole = np.floor(begin / clip_s) == np.floor((begin + takes_s) / clip_s)
    found = [Reversal(0, float(t), np.zeros(2), True, takes_s) for t in begin[whole]]
    clips_s = clip_s * np.arange(clips)[:, None] + [0, clip_s]
    assert len(found) / seen_whole_s(found, clips_s) == pytest.approx(per_s, rel=0.05)
    assert seen_whole_s([], clips_s[:1]) < clip_s
    assert seen_whole_s([], clips_s[:0]) == 0


@pytest.mark.parametrize("wobble_m", [0.0, 0.5])
def test_who_goes_round_a_circle_and_back_makes_no_u_turn_though_errors_straighten_the_circle(wobble_m: float) -> None:
    angle = np.linspace(0.75 * np.pi, -0.75 * np.pi, 80)  # from the bend of one arm to the same arm's other side
    radius = 13.0 + wobble_m * np.sin(5.0 * angle)
    circle = np.array([130.0, 100.0]) + radius[:, None] * np.column_stack([-np.cos(angle), np.sin(angle)])[::-1]
    arm = np.array([[230.0, 98.0], [152.0, 98.0], [142.0, 104.0]])
    path = np.concatenate([arm * [1, -1] + [0, 200], circle, arm[::-1]])
    analysis = TrafficAnalysis(gather([drive(path, 30.0 * k) for k in range(2)]))
    assert len(analysis.trajectories) == 2
    assert analysis.reversals == []


def test_a_vehicle_that_touches_the_end_of_another_lane_merges_by_its_own() -> None:
    angle = np.linspace(np.pi, np.pi / 2, 20)
    arc = np.array([160.0, 90.0]) + 10.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    join = np.concatenate([[[150.0, 0.0]], arc, [[260.0, 100.0]]])
    early = np.array(
        [[150.0, 0.0], [150.0, 92.0], [151.0, 98.0], [153.0, 100.0], [260.0, 100.0]]
    )  # 7 m before the others
    tracks = [drive(EAST, 4.0 * k) for k in range(12)]
    tracks += [drive(early if k == 5 else join, 4.0 * k + 6.5) for k in range(11)]
    analysis = TrafficAnalysis(gather(tracks))
    merging = {(c.first, c.second): c.value_s for c in analysis.conflicts if c.kind == "merging"}
    assert (5, 17) in merging
    assert (17, 6) in merging
    # at (165, 100): east at 4 k + 13.75 s, the others, 110.7 m from their start, at 4 k + 15.73 s
    assert merging[4, 16] == pytest.approx(6.5 + 110.7 / 12 - 13.75 - 4.5 / 12, abs=0.1)


def approach(start_s: float, gap_m: float, follower: float, leader: float, final_gap_m: float) -> list[Track]:
    """A leader to the east, and a follower that closes up on it until a gap from bumper to bumper is left."""
    times = np.arange(start_s, start_s + 250.0 / max(leader, 1.0), STEP_S)
    front = leader * (times - start_s)
    rear = front - 4.5 - np.maximum(gap_m - (follower - leader) * (times - start_s), final_gap_m)
    return [
        (times[x < 250], np.column_stack([x, np.full(len(x), 100.0)])[x < 250]) for x in (front + 10.0, rear + 10.0)
    ]


def test_a_fast_approach_is_a_conflict_and_a_queue_and_a_double_are_none() -> None:
    free = [drive(EAST, 8.0 * k) for k in range(12)]
    near = approach(120.0, 30.0, 12.0, 6.0, 1.0)  # 1 m at 6 m/s: 0.17 s, and 3.4 m before, which need 5.3 m/s2
    creeping = approach(200.0, 12.0, 2.5, 1.5, 1.0)  # below 3 m/s: closing up in a queue
    double = approach(420.0, -2.5, 8.0, 8.0, -2.5)  # 2 m from centre to centre
    analysis = TrafficAnalysis(gather([*free, *near, *creeping, *double]))
    found = find_conflicts(analysis.trajectories, analysis.lane_traffic)
    following = [(c.first, c.second) for c in found if c.kind == "following"]
    assert following == [(12, 13)]
    conflict = next(c for c in found if c.kind == "following")
    assert conflict.value_s == pytest.approx(1.0 / 6.0 + 0.4, abs=0.15)  # what it is below for 0.4 s
    assert conflict.probability > 0.9


@pytest.mark.parametrize("radius_m", [4.0, 8.0])
def test_the_few_who_turn_off_at_a_tight_corner_have_a_lane_there(radius_m: float) -> None:
    """They leave the lane within two metres, half of them from one node of it and half from the next."""
    angle = np.linspace(-np.pi / 2, 0, 20)
    arc = [150.0 - radius_m, 100.0 + radius_m] + radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    turns = [np.concatenate([[[0.27 * k, 100.0]], arc, [[150.0, 220.0]]]) for k in range(4)]
    tracks = [drive(path, 6.0 * k + s) for path, s in ((EAST, 0.0), (SOUTH, 3.0)) for k in range(20)]
    graph = TrafficAnalysis(
        gather([*tracks, *(drive(path, 200.0 + 10.0 * k) for k, path in enumerate(turns))], sd_m=0.01)
    ).lanes
    (turn,) = (lane.number for lane in graph if lane.tracks <= 4)
    assert len(graph) == 5
    assert {(c.start == turn, c.end == turn) for c in graph.connections} == {
        (True, False),
        (False, True),
        (False, False),
    }


def test_who_closes_up_beside_another_vehicle_is_no_conflict() -> None:
    free = [drive(EAST, 8.0 * k) for k in range(12)]
    leader, follower = approach(120.0, 30.0, 12.0, 6.0, 1.0)
    behind = TrafficAnalysis(gather([*free, leader, follower])).conflicts
    beside = TrafficAnalysis(gather([*free, leader, (follower[0], follower[1] + [0.0, 2.8])])).conflicts
    assert [c.probability > 0.9 for c in behind if c.kind == "following"] == [True]
    assert max((c.probability for c in beside if c.kind == "following"), default=0.0) < 0.1


def test_a_vehicle_that_leaves_its_lane_and_comes_back_is_not_on_it_between() -> None:
    detour = np.array([[0.0, 100.0], [100.0, 100.0], [100.0, 130.0], [130.0, 130.0], [130.0, 100.0], [260.0, 100.0]])
    analysis = TrafficAnalysis(gather([*(drive(EAST, 8.0 * k) for k in range(12)), drive(detour, 100.0)]))
    paths = analysis.trajectories
    lane, _, _ = positions_on_lanes(paths, analysis.lanes)
    away = np.abs(paths.xy_m[:, 1] - 100.0) > 4.0
    assert away.sum() > 20
    assert (lane[away] < 0).all()
    assert (lane[~away] >= 0).mean() > 0.95


def test_a_vehicle_beside_the_lane_of_a_gate_does_not_cross_there() -> None:
    middle, road = np.array([10.0, 5.0]), np.array([10.0, -15.0])
    gates = Gates((Gate(0, True, middle, np.pi / 2, 0),), (Arm(0, "N", middle, -np.pi / 2),), road[None])
    at = np.array([[10.0, 5.5], [12.0, 5.0], [13.5, 5.0], [10.0, 12.0]])
    before = at - [0.0, 20.0]
    assert gates.nearest(at, np.full(4, np.pi / 2), before, inwards=True).tolist() == [0, 0, -1, -1]
    assert gates.nearest(at, np.full(4, -np.pi / 2), before, inwards=True).tolist() == [-1] * 4


def test_queues_behind_a_signal_are_no_conflicts(analysis: TrafficAnalysis) -> None:
    following = [c for c in analysis.conflicts if c.kind == "following"]
    assert sum(c.value_s < 1.5 for c in following) > 10  # who stops behind another has less than 1.5 s to collision
    assert [c for c in following if c.probability >= 0.5] == []


def test_a_changed_cycle_and_nothing_else_is_a_change(analysis: TrafficAnalysis) -> None:
    assert [c.what for c in find_changes(analysis, analysis) if c.significant] == []
    slow = [(times * 1.25, xy) for times, xy in crossroads()]
    changes = {c.what.split(",")[0]: c for c in find_changes(analysis, TrafficAnalysis(gather(slow)))}
    assert changes["cycle"].significant
    assert changes["cycle"].change == pytest.approx(0.25 * CYCLE_S, abs=1.0)
    assert not changes["share from W to S"].significant


def test_furness_keeps_the_sums() -> None:
    seen = np.array([[0.0, 30.0, 10.0], [20.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    added = furness(seen, np.array([8.0, 4.0, 0.0]), np.zeros(3))
    assert added.sum(axis=1) == pytest.approx([8.0, 4.0, 0.0])
    assert (added[seen == 0] == 0).all()
    assert furness(seen, np.zeros(3), np.ones(3)).sum() == 0


@pytest.mark.parametrize("q", [0.15, 0.5, 0.85])
def test_intervals_of_quantiles_cover(q: float) -> None:
    rng = np.random.default_rng(1)
    hits = [
        e.low <= np.log(1 / (1 - q)) <= e.high
        for _ in range(400)
        if (e := estimate_quantile(rng.exponential(1, 40), q))
    ]
    assert 0.86 < np.mean(hits) < 0.95


def test_too_little_data_gives_none() -> None:
    assert estimate_quantile(np.arange(10.0), 0.15) is None
    assert estimate_share(2, 4) is None
    assert estimate_rate(np.array([1, 2]), 1.0) is None


def test_lower_bounds_do_not_draw_a_median_down() -> None:
    rng = np.random.default_rng(3)
    hits, errors, naive = [], [], []
    for _ in range(200):
        wish, ahead = rng.normal(50, 5, 120), rng.normal(50, 6, 120)
        free = ahead > wish
        found = estimate_censored_quantile(np.minimum(wish, ahead), free, 0.5)
        hits.append(found.low <= 50 <= found.high)
        errors.append(found.value - 50)
        naive.append(np.median(wish[free]) - 50)
    assert 0.84 < np.mean(hits) < 0.96
    assert abs(np.mean(errors)) < 0.3
    assert np.mean(naive) < -2


def test_a_quantile_above_all_observed_values_is_not_known() -> None:
    values = np.arange(40.0)
    assert estimate_censored_quantile(values, values < 10, 0.5) is None
    assert estimate_censored_quantile(values, values < 3, 0.05) is None


def test_lanes_of_a_phase_that_start_late_together_are_one_observation() -> None:
    rng = np.random.default_rng(4)
    covered, green = [], []
    for _ in range(200):
        starts = []
        for onset in (12.0, 42.0):
            late = onset + START_DELAY_S + 60.0 * np.arange(8) + np.abs(rng.normal(0, 0.8, 8))
            starts += [late + rng.normal(0, 0.1, 8) for _ in range(4)]
        cycle, phases = fit_phases(starts, 60.05)
        assert [len(phase.streams) for phase in phases] == [4, 4]
        covered.append(cycle.low <= 60.0 <= cycle.high)
        green.append(phases[0].green_s.low < 12.0 < phases[0].green_s.high)
    assert 0.85 < np.mean(covered) < 0.96
    assert np.mean(green) > 0.9


def test_rows_are_grouped_in_order() -> None:
    group = np.array([2, 0, 2, 1, 0])
    order, border = group_rows(group, 4)
    assert order.tolist() == [1, 4, 3, 0, 2]
    assert border.tolist() == [0, 2, 3, 5, 5]


def test_conflicts_do_not_depend_on_where_frames_are_counted_from(analysis: TrafficAnalysis) -> None:
    """The frames of these tracks begin below 0, which wrote beyond an array."""
    trajectories = analysis.trajectories
    assert trajectories.frame.min() < 0
    later = replace(trajectories, frame=trajectories.frame - trajectories.frame.min())
    shown = [
        [(c.kind, c.first, c.second, c.value_s) for c in one.conflicts] for one in (TrafficAnalysis(later), analysis)
    ]
    assert shown[0] == shown[1]


def test_a_time_to_collision_counts_where_it_lasts() -> None:
    pair = np.array([4, 4, 4, 4, 4, 9, 9, 9])
    time_s = np.array([0.0, 0.2, 0.4, 0.6, 2.0, 0.0, 0.2, 0.3])
    value_s = np.array([1.0, 3.0, 2.0, 1.0, 0.5, 1.0, 1.0, 1.0])
    expected = [3.0, 3.0] + 6 * [np.inf]  # within 0.4 s: rows 0 to 2, 1 to 3; then a gap, or the end
    order = np.random.default_rng(1).permutation(8)
    assert persistent(pair[order], time_s[order], value_s[order]).tolist() == np.array(expected)[order].tolist()


def test_an_unusual_track_is_named_as_in_the_file() -> None:
    tracks = [drive(EAST, 4.0 * k) for k in range(12)] + [drive(EAST[::-1], 20.0)]
    made = gather(tracks)
    named = replace(made, track_id=made.track_id * 7 + 100_000)
    answer = next(a for a in find_answers(TrafficAnalysis(named)) if a.topic == "wrong way")
    assert answer.state == "found"
    assert f"track {12 * 7 + 100_000})" in answer.text
    table = unusual_table(TrafficAnalysis(named))
    assert [row.cells["track"] for row in table.rows] == [12 * 7 + 100_000]


def test_a_road_above_another_makes_no_conflicts() -> None:
    tracks = [drive(EAST, 4.0 * k) for k in range(12)] + [drive(SOUTH, 4.0 * k + 4.2) for k in range(12)]
    analysis = TrafficAnalysis(gather(tracks))  # at (150, 100) both are there at once, at 4 k + 12.5 s
    assert [c for c in analysis.conflicts if c.kind == "crossing"] == []


def test_roads_that_cross_are_an_intersection_where_turns_a_signal_or_pairs_show_it(analysis: TrafficAnalysis) -> None:
    number = next(m.junction.number for m in analysis.movements if analysis.signals.get(m.junction.number))
    assert analysis.junction_kind(number) == "intersection"
    # a bridge, of which nothing but the lanes is seen
    bridge = TrafficAnalysis(
        gather([drive(EAST, 4.0 * k) for k in range(6)] + [drive(SOUTH, 4.0 * k + 4.2) for k in range(6)])
    )
    assert [bridge.junction_kind(k) for k in range(len(bridge.lanes.junctions))] == ["crossing"]
    answers = {(a.topic, a.subject): a for a in find_answers(bridge)}
    assert answers["signal", "crossing 0"].state == "too little data"
    assert "0 junctions, 1 crossing" in answers["lanes", ""].text
    # many pairs, none of which is there at once
    level = [drive(EAST, 12.0 * k) for k in range(40)] + [drive(SOUTH, 12.0 * k + 6.0) for k in range(40)]
    crossed = TrafficAnalysis(gather(level))
    assert [crossed.junction_kind(k) for k in range(len(crossed.lanes.junctions))] == ["intersection"]
    compared = [change.what for change in find_changes(crossed, crossed) if "share" in change.what]
    assert compared
    assert all(", intersection at " in what for what in compared)


def test_vehicles_that_cross_hardly_after_each_other_show_two_levels() -> None:
    """None drives through another beyond errors; but drivers who see each other leave more time."""
    tracks = [drive(EAST, 4.0 * k) for k in range(12)] + [drive(SOUTH, 4.0 * k + 4.95) for k in range(12)]
    assert [c for c in TrafficAnalysis(gather(tracks)).conflicts if c.kind == "crossing"] == []


def test_few_pairs_that_cross_where_levels_are_not_clear_are_neither_conflicts_nor_none() -> None:
    tracks = [drive(EAST, 30.0 * k) for k in range(4)] + [drive(SOUTH, 30.0 * k + 5.6) for k in range(4)]
    analysis = TrafficAnalysis(gather(tracks))
    (answer,) = (a for a in find_answers(analysis) if a.topic == "conflicts")
    assert answer.state == "too little data"
    assert "pairs below 1.5 s where it is not clear that the roads are on one level" in answer.text
    junction = analysis.lanes.junctions[0].hull_m
    signalised = find_conflicts(analysis.trajectories, analysis.lane_traffic, signalised_m=[junction])
    assert sum(c.kind == "crossing" and c.probability > 0.5 for c in signalised) == 4


@pytest.mark.parametrize(("gap_m", "state"), [(1.5, "found"), (2.1, "too little data"), (4.0, "none")])
def test_pairs_that_errors_leave_in_doubt_are_neither_counted_nor_denied(gap_m: float, state: str) -> None:
    tracks = [drive(EAST, 8.0 * k) for k in range(12)]
    tracks += approach(120.0, 30.0, 12.0, 6.0, gap_m)
    analysis = TrafficAnalysis(gather(tracks))
    (answer,) = (a for a in find_answers(analysis) if a.topic == "conflicts")
    assert answer.state == state
    assert sum(c.likely for c in analysis.conflicts) == (state == "found")
    # the interval of one event is wide, and an end of it would be quoted as if it were known
    assert ("1 seen, too few to say how often: " in answer.text) == (state == "found")


@pytest.mark.parametrize(("together_m", "found"), [(5.0, False), (20.0, True)])
def test_lanes_that_meet_at_the_edge_of_the_view_do_not_merge(together_m: float, found: bool) -> None:
    """Errors of the last positions may put two vehicles side by side onto one lane."""
    beside = np.array([[0.0, 3.6], [148.5 - together_m, 3.6], [150.0 - together_m, 0.3], [150.0, 0.1]])
    tracks = [drive(np.array([[0.0, 0.0], [150.0, 0.0]]), 9.0 * k) for k in range(9)]
    analysis = TrafficAnalysis(gather(tracks + [drive(beside, 9.0 * k + 0.5) for k in range(9)]))
    assert any(len(analysis.lanes.predecessors[lane.number]) == 2 for lane in analysis.lanes)
    assert any(c.kind == "merging" for c in analysis.conflicts) == found


@pytest.mark.parametrize(("stopping", "said"), [(0, False), (1, False), (6, True)])
def test_a_mean_speed_tells_of_stops_where_vehicles_stop(stopping: int, said: bool) -> None:
    halt = {k: {"stop_at_m": 120.0, "go_s": 12.0 * k + 20.0} if k < stopping else {} for k in range(25)}
    analysis = TrafficAnalysis(gather([drive(EAST, 12.0 * k, **halt[k]) for k in range(25)]))
    (answer,) = (one for one in find_answers(analysis) if one.topic == "mean speed")
    assert ("stops and queues included" in answer.text) == said


def test_vehicles_side_by_side_on_what_errors_made_one_lane_do_not_merge() -> None:
    joins = np.array([[0.0, 3.6], [128.5, 3.6], [130.0, 0.3], [150.0, 0.1]])
    tracks = [drive(np.array([[0.0, 0.0], [150.0, 0.0]]), 9.0 * k) for k in range(9)]
    analysis = TrafficAnalysis(gather(tracks + [drive(joins, 9.0 * k + 0.5) for k in range(9)]))
    samples = analysis.lanes.samples
    offset_m = np.where(samples.track == 13, 3.4, samples.offset_m)  # beside track 4
    graph = replace(analysis.lanes, samples=replace(samples, offset_m=offset_m))
    found = find_conflicts(analysis.trajectories, LaneTraffic(graph))
    merging = {(c.first, c.second) for c in found if c.kind == "merging" and c.likely}
    assert merging == {(k, k + 9) for k in range(9) if k != 4}


def in_two_clips(
    second_s: float, begin_s: float, cut_s: float, end_s: float, *, waits_s: float = 0.0
) -> TrafficAnalysis:
    """The crossroads as two clips, cut at ``cut_s``, of which the second is later by ``second_s``."""
    tracks = []
    for times, xy in crossroads(waits_s=waits_s):
        for rows, later in ((times >= begin_s) & (times < cut_s), 0.0), ((times >= cut_s) & (times < end_s), second_s):
            if rows.sum() > 2:
                tracks.append((times[rows] + later, xy[rows]))
    return TrafficAnalysis(replace(gather(tracks), gaps_s=np.array([[cut_s, cut_s + second_s]])))


def test_a_signal_is_found_in_both_clips_though_the_gap_is_no_whole_number_of_cycles() -> None:
    analysis = in_two_clips(1013.0, 0.0, 250.0, 500.0)
    (signal,) = (s for s in analysis.signals.values() if s.signalised)
    assert signal.cycle_s.value == pytest.approx(CYCLE_S, abs=0.15)
    for stream in signal.streams:
        green = stream.green_s
        assert not ((green > 250.0) & (green < 1263.0)).any()
        first, second = (np.exp(2j * np.pi * (g - shift) / CYCLE_S).mean() for g, shift in
                         ((green[green < 250.0], 0.0), (green[green > 1263.0], 1013.0)))  # fmt: skip
        assert abs(np.angle(second / first)) / (2 * np.pi) * CYCLE_S < 0.8
        assert stream.red_phase_s is not None
    growth = [g for g in queue_growth(signal) if g.vehicles]
    assert max(g.vehicles.value for g in growth if g.vehicles) == pytest.approx(4, abs=0.3)


def test_waits_of_first_vehicles_do_not_make_the_greens_of_the_other_clip_late() -> None:
    """The second clip is later by 25 cycles. The green is before the earliest starts, 1.3 s before the mean one."""
    analysis = in_two_clips(25 * CYCLE_S, 0.0, 250.0, 500.0, waits_s=2.0)
    (signal,) = (s for s in analysis.signals.values() if s.signalised)
    for stream in signal.streams:
        phases = (stream.green_s - stream.green_s[0] + CYCLE_S / 2) % CYCLE_S - CYCLE_S / 2
        first, second = (phases[(stream.green_s < 250.0) == of_first].mean() for of_first in (True, False))
        assert second == pytest.approx(first, abs=0.5)


def test_clips_that_hold_no_two_cycles_give_none_together() -> None:
    signals = in_two_clips(1013.0, 200.0, 245.0, 290.0).signals.values()
    assert len(signals) == 1
    assert all(s.signalised is None and s.reason.startswith("too little data") for s in signals)


def test_two_starts_do_not_make_a_certain_cycle() -> None:
    """Two starts lie on a line: how far each was late is not seen."""
    rng, held = np.random.default_rng(2), []
    for _ in range(200):
        starts = [np.sort(c * CYCLE_S + rng.normal(0, 1.0, 1)) for c in range(2)]
        cycle, _ = fit_phases([np.concatenate(starts)] * 2, CYCLE_S)
        held.append(cycle.low <= CYCLE_S <= cycle.high)
    assert np.mean(held) >= 0.9
