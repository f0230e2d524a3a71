"""The report of a traffic analysis: what the first page says, what the diagrams show, and that files do not change."""

import re
from dataclasses import replace

import numpy as np
import pytest

from schemas.analysis import AnalysisRecord, EstimateRecord
from tests.analysis.test_traffic_analysis import CYCLE_S, analysis, corner, crossroads, drive, gather
from velfield.analysis.answers import duration_text, find_answers
from velfield.analysis.approaches import approach_delays, arms_without_delay, lane_names
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.pipeline.analysis.tables import all_tables, flow_table, limit_table
from velfield.report.drawing import new_figure, pages_bytes
from velfield.report.traffic.diagrams import draw_delays, draw_queues, draw_time_space, red_times, traffic_diagrams
from velfield.report.traffic.first_page import FirstPage, first_page
from velfield.report.traffic.place import place_labels
from velfield.report.traffic.report import report_html

__all__ = ["analysis"]


def test_the_first_page_answers_five_questions_and_says_what_is_missing(analysis: TrafficAnalysis) -> None:
    page = first_page(analysis)
    answers = {question: " ".join(lines) for question, lines in page.answers}
    assert len(answers) == 5
    assert "cycle 40.0 s" in answers["Is there a signal, and is it fair?"]
    assert re.search(
        r"from W, straight on and right \(lane \d+\): green and yellow for 1[234] s from N, straight on \(lane \d+\): "
        r"green and yellow for 1[23] s, beginning 20 s after the first",
        answers["Is there a signal, and is it fair?"],
    )
    waits = dict(page.answers)["Which approach waits longest, and how long are the queues?"]
    assert re.fullmatch(
        r"junction 0: the longest queue is from W, straight on to E and right to S \(lane \d\): "
        "4 vehicles, 2[56] m; the longest from N may be as long",
        waits[0],
    )
    assert waits[1] == "junction 0: vehicles from N wait longest"
    assert [line.split(";")[0] for line in waits[2:]] == ["from N: 48 vehicles", "from W: 60 vehicles"]
    assert answers["Where do vehicles go?"].startswith("junction 0: 108 of the 108 vehicles were seen to enter it, ")
    assert answers["Where is it dangerous?"].startswith("nothing dangerous was seen in 8.5 min: ")
    assert "even 16 near misses an hour may not show" in answers["Where is it dangerous?"]
    assert any(line.startswith("classes") for line in page.withheld)
    assert page.sections[-1][0].startswith("What is not known")


def test_which_approach_waits_longest_is_not_said_where_a_delay_is_not_known() -> None:
    """From the north all come into view when they brake: from the west vehicles wait less, or longer."""
    near = TrafficAnalysis(gather([(t[xy[:, 1] >= 35.0], xy[xy[:, 1] >= 35.0]) for t, xy in crossroads()]))
    (found,) = near.movements
    assert arms_without_delay(found, approach_delays(near, found)) == ["N"]
    page = first_page(near)
    answers = dict(page.answers)
    assert answers["Which approach waits longest, and how long are the queues?"][1] == (
        "junction 0: which approach waits longest is not known, as the delay from N is not"
    )
    assert answers["Is there a signal, and is it fair?"][1] == (
        "junction 0: whether it is fair is not known: the delay from N is not"
    )
    assert sum(line.startswith("delay: junction 0 from N: too little data") for line in page.withheld) == 1


def test_vehicles_on_lanes_without_a_junction_are_counted(analysis: TrafficAnalysis) -> None:
    tracks = [*crossroads(), *(drive(np.array([[0.0, 30.0], [100.0, 30.0]]), 11.0 * k) for k in range(9))]
    (where,) = (lines for question, lines in first_page(TrafficAnalysis(gather(tracks))).answers if "go?" in question)
    assert re.fullmatch(r"lane \d+: 9 vehicles towards E; no junction was found on it", where[-1])
    assert "no junction" not in " ".join(dict(first_page(analysis).answers)["Where do vehicles go?"])


def test_a_short_clip_is_answered_by_what_is_missing() -> None:
    east = np.array([[0.0, 10.0], [100.0, 10.0]])
    short = TrafficAnalysis(gather([drive(east, 2.0 * k) for k in range(3)]))
    page, seconds = first_page(short), duration_text(short.trajectories.duration_s)
    assert any("too few" in line for line in page.withheld)
    assert [lines for _, lines in page.answers[1:]] == [
        ("Not known: no junction of lanes was found.",),
        ("Not known: no junction of lanes was found.",),
        ("Not known: no free-flow speed, as no road has 8 vehicles that go freely and steadily.",),
        (f"Not known: conflicts: none was seen in {seconds}, too short a time to say how rare they are.",),
    ]
    assert {d.name for d in traffic_diagrams(short, None)} <= {"place", "speed-profile"}


def test_a_turn_that_two_of_many_take_is_rare_and_no_danger(analysis: TrafficAnalysis) -> None:
    left = corner(140.0, 100.0, 220.0) * [1.0, -1.0] + [0.0, 200.0]
    tracks = [*crossroads(), *(drive(left, 100.0 + 150.0 * k) for k in range(2))]
    tracks += [drive(np.array([[150.0, 100.0], [150.0, 0.0]]), 30.0 * k) for k in range(4)]
    rare = TrafficAnalysis(gather(tracks))
    answers = dict(first_page(rare).answers)
    assert any(
        re.match(r"rare: from W to N: 2 of 6\d vehicles, at ", line) for line in answers["Where do vehicles go?"]
    )
    assert "from W to N" not in " ".join(answers["Where is it dangerous?"])
    (answer,) = (a for a in find_answers(rare) if a.topic == "wrong way")
    assert answer.state == "none"
    (answer,) = (a for a in find_answers(analysis) if a.topic == "conflicts")
    assert answer.text.startswith("none in 8.5 min on ways that three vehicles or more drive, so fewer than ")


def test_the_map_numbers_the_lanes_that_answers_name_first(analysis: TrafficAnalysis) -> None:
    named = {str(lane) for found in analysis.movements for lane in found.gates.arms_in}
    numbers = [label.text for label in place_labels(analysis, None).numbers]
    assert set(numbers[: len(named)]) == named


def test_rows_and_columns_without_a_number_are_one_line_of_the_report() -> None:
    busy, quiet = (np.array([[0.0, y], [100.0, y]]) for y in (10.0, 40.0))
    drives = [drive(busy, 4.0 * k) for k in range(8)] + [drive(quiet, 4.0 * k) for k in range(3)]
    flow = flow_table(TrafficAnalysis(gather(drives)))
    assert [row.unknown for row in flow.rows] == [False, True]
    assert [column.name for column in flow.columns if column.unknown] == ["flow", "density", "gap"]
    record = AnalysisRecord(code_version="", gsd_m=1, gsd_known=True, duration_s=30, tracks=11, tables=(flow,))
    html = report_html(record, FirstPage("", (), ()), [])
    assert html.count("<td") == 3  # the lane, its speed, its headway
    assert "left out here (analysis.xlsx has all): 1 row, “Flow”, “Density”, “Gap of those that follow”." in html


def test_of_lanes_that_merge_it_does_not_say_that_there_is_no_junction() -> None:
    road, ramp = np.array([[0.0, 0.0], [200.0, 0.0]]), np.array([[0.0, 50.0], [90.0, 0.0], [200.0, 0.0]])
    merging = TrafficAnalysis(
        gather([drive(road, 9.0 * k) for k in range(9)] + [drive(ramp, 9.0 * k) for k in range(9)])
    )
    assert merging.movements
    answers = dict(first_page(merging).answers)
    assert answers["Is there a signal, and is it fair?"] == ("Not known: no junction was found where lanes cross.",)
    assert answers["Where do vehicles go?"][-1] == (
        "lanes only merge, each vehicle has one way to go: 18 vehicles at junction 0; see the table Turning counts"
    )


def test_every_diagram_is_drawn_and_two_pdfs_are_the_same(analysis: TrafficAnalysis) -> None:
    made = list(traffic_diagrams(analysis, np.full((1100, 1300), 128, np.uint8), unit="mph"))
    kinds = {re.sub(r"-\d+$", "", diagram.name) for diagram in made}
    assert kinds >= {"place", "turning", "delay", "time-space", "queue", "speed-profile", "fundamental", "flow"}
    files = []
    for _ in range(2):
        pages = [new_figure(7, diagram.height_in) for diagram in made]
        for page, diagram in zip(pages, made, strict=True):
            diagram.draw(page.add_subplot())
            assert any(len(axes.get_children()) > 10 for axes in page.axes), diagram.name
        files.append(pages_bytes(pages))
    assert files[0] == files[1]
    assert files[0].count(b"/Type /Page\n") + files[0].count(b"/Type /Page ") == len(made)


def test_red_is_where_vehicles_stand_and_queues_are_of_four(analysis: TrafficAnalysis) -> None:
    junction = next(n for n, s in analysis.signals.items() if s.signalised)
    stream = next(s for s in analysis.signals[junction].streams if s.red_phase_s)
    reds = red_times(stream, CYCLE_S)
    assert all(15 < end - begin < 30 for begin, end in reds)
    axes = new_figure(7, 3).add_subplot()
    draw_queues(axes, analysis=analysis, streams=[stream], names={})
    times, counts = (np.asarray(values, np.float64) for values in axes.lines[0].get_data())
    shown = [(begin, end) for begin, end in reds if times[0] < begin and end < times[-1]]
    assert len(shown) >= 5
    for begin, end in shown:  # none stands when red begins, four when it ends
        assert counts[np.searchsorted(times, begin) - 1] == 0
        assert counts[np.searchsorted(times, end) - 1] == 4
    axes = new_figure(7, 3).add_subplot()
    draw_time_space(axes, analysis=analysis, stream=stream)
    assert len(axes.collections[0].get_paths()) > 20


def test_delay_of_an_approach_is_the_mean_over_its_vehicles(
    analysis: TrafficAnalysis, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = next(m for m in analysis.movements if m.junction.kind == "intersection")
    number = found.junction.number
    delays = {d.arm: d for d in approach_delays(analysis, found)}
    of_movements = [m.delay_s.value for m in found.movements if m.arm_in == "W" and m.delay_s]
    assert len(of_movements) == 2
    assert min(of_movements) < delays["W"].delay_s.value < max(of_movements)
    assert set(delays["W"].level.split(" to ")) <= {"A", "B"}
    monkeypatch.setitem(analysis.signals, number, replace(analysis.signals[number], signalised=None))
    without_level = approach_delays(analysis, found)
    assert {d.level for d in without_level} == {""}
    axes = new_figure(7, 3).add_subplot()
    draw_delays(axes, delays=without_level[:1])
    assert axes.get_xlim()[1] > without_level[0].delay_s.high
    assert sorted(name.split(",")[0] for name in lane_names(found).values()) == ["from N", "from W"]


def test_the_caption_of_delays_says_of_queues_out_of_view_only_where_one_is(
    analysis: TrafficAnalysis, monkeypatch: pytest.MonkeyPatch
) -> None:
    def caption() -> str:
        (delay,) = [one for one in traffic_diagrams(analysis, None) if one.name.startswith("delay")]
        return delay.caption

    assert "Or worse" not in caption()
    monkeypatch.setattr(TrafficAnalysis, "delay_is_partial", lambda *_: True)
    assert "Or worse: the queue ends out of view." in caption()


def test_speeds_are_in_the_unit_of_choice_everywhere(analysis: TrafficAnalysis) -> None:
    """43 km/h are 27 mph: the nearest sign is one of 25 mph where signs are in mph."""
    page = first_page(analysis, unit="mph")
    (speeds,) = [lines for question, lines in page.answers if question.startswith("How fast")]
    assert all(" mph (" in line and "km/h" not in line for line in speeds)
    for km_per_h, mph in zip(all_tables(analysis), all_tables(analysis, unit="mph"), strict=True):
        for a, b in zip(km_per_h.columns, mph.columns, strict=True):
            assert b.unit == ("mph" if a.unit == "km/h" else a.unit)
            for row, other in zip(km_per_h.rows, mph.rows, strict=True):
                value, same = row.cells[a.name], other.cells[b.name]
                if a.unit == "km/h" and isinstance(value, EstimateRecord) and value.value:
                    assert same.value == pytest.approx(value.value / 1.609344, rel=1e-3)
    limits = {row.cells["limit"] for row in limit_table(analysis, "mph").rows}
    assert 25.0 in limits
    assert limits <= {None, 25.0}
