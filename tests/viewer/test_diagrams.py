"""The pictures of a report: arms where roads lead, arrows on all lanes, no label over another, nothing cut off."""

import re
from typing import Any

import numpy as np
import pytest

from schemas.report import ResidualSeries
from tests.analysis.test_traffic_analysis import drive, gather
from tests.turning_crossroads import apart_deg, sides, turning_crossroads
from velfield.analysis.movements.gates import Arm
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.report import plots
from velfield.report.drawing import figure_bytes, new_figure
from velfield.report.traffic.diagrams import WIDTH_IN, Diagram, draw_flow, traffic_diagrams
from velfield.report.traffic.turning import arm_directions


def drawn(diagram: Diagram, *, of_pdf: bool = False) -> Any:
    """The axes of a diagram, laid out as in the HTML report, or in the PDF."""
    if of_pdf:
        figure = new_figure(8.27, 11.69)
        axes = figure.add_axes((0.13, 0.4, 0.8, (diagram.height_in - 0.65) / 11.69))
        diagram.draw(axes)
    else:
        figure = new_figure(WIDTH_IN, diagram.height_in)
        axes = figure.add_subplot()
        diagram.draw(axes)
        figure.tight_layout()
    figure.canvas.draw()
    return axes


def named(analysis: TrafficAnalysis, name: str) -> Diagram:
    return next(d for d in traffic_diagrams(analysis, None) if d.name.startswith(name))


@pytest.mark.parametrize("turned_deg", [0.0, 20.0, -20.0])
def test_arms_of_a_turning_diagram_lie_where_their_roads_lead(turned_deg: float) -> None:
    """Gates are metres from the junction's centre: the direction to that of the north was 41 degrees off."""
    axes = drawn(named(turning_crossroads(turned_deg), "turning"))
    road = dict(zip("ESWN", sides(turned_deg), strict=True))
    labels = {re.sub(r"^from |:.*", "", t.get_text().split("\n")[0]): t for t in axes.texts}
    assert set(labels) == set("NESW")
    assert {arm for arm, t in labels.items() if "only leave" in t.get_text()} == {"N", "E"}
    for arm, text in labels.items():
        x, y = text.get_position()
        assert apart_deg(np.arctan2(y, x), road[arm]) < 2
    ends = [max(patch.get_xy(), key=lambda xy: apart_from(patch.get_xy()[0], xy)) for patch in axes.patches]
    # 60 to the north, 45 to the east, 15 to the south: beside the middle of the road by a tenth of an arm
    for arm in "NES":
        assert min(apart_deg(np.arctan2(y, x), road[arm]) for x, y in ends) < 8


def apart_from(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.hypot(*(a - b)))


def test_arrows_of_a_turning_diagram_are_whole_and_it_is_no_higher_than_they_are() -> None:
    analysis = turning_crossroads()
    diagram = named(analysis, "turning")
    axes = drawn(diagram)
    (found,) = analysis.movements
    assert len(axes.patches) == len(found.movements) == 3  # a shaft and its head are one outline
    boxes = [thing.get_window_extent() for thing in (*axes.texts, *axes.patches)]
    low, high = min(box.y0 for box in boxes), max(box.y1 for box in boxes)
    within = axes.figure.bbox
    assert low > 0
    assert high < within.y1
    assert max(low, within.y1 - high) < 0.12 * within.height


def test_parallel_roads_are_drawn_apart_and_others_where_they_are() -> None:
    north, south = -np.pi / 2, np.pi / 2
    arms = (
        Arm(0, "N2", np.array([20.0, -10.0]), north + 0.01),
        Arm(1, "S", np.array([3.0, 9.0]), south),
        Arm(2, "N1", np.array([-20.0, -10.0]), north + 0.02),
    )
    angle = arm_directions(arms, np.zeros(2))
    assert apart_deg(angle["S"], 90) < 0.1
    ahead = np.degrees(angle["N2"] - angle["N1"])
    assert ahead % 360 == pytest.approx(30, abs=0.5)
    assert arm_directions((), np.zeros(2)) == {}


def crossing() -> TrafficAnalysis:
    """Two roads that cross in their middles, too few vehicles for more than the map."""
    east, north = np.array([[0.0, 200.0], [400.0, 200.0]]), np.array([[200.0, 400.0], [200.0, 0.0]])
    return TrafficAnalysis(gather([drive(road, 5.0 * k) for k in range(4) for road in (east, north)]))


def streets() -> TrafficAnalysis:
    """Six streets across six others, 60 m apart: their junctions' labels fill the map."""
    tracks = []
    for k in range(6):
        at = 60.0 + 60 * k
        tracks += [drive(np.array([[0.0, at], [420.0, at]]), 70.0 * n) for n in range(3)]
        tracks += [drive(np.array([[at, 420.0], [at, 0.0]]), 70.0 * n + 35) for n in range(3)]
    return TrafficAnalysis(gather(tracks))


@pytest.mark.parametrize("of_pdf", [False, True])
@pytest.mark.parametrize("scene", [crossing, turning_crossroads, streets])
def test_every_lane_of_the_map_has_an_arrow_and_no_label_hides_another(scene: Any, of_pdf: bool) -> None:
    analysis = scene()
    diagram = named(analysis, "place")
    axes = drawn(diagram, of_pdf=of_pdf)
    arrows = [t.arrow_patch for t in axes.texts if getattr(t, "arrow_patch", None)]
    texts = [t for t in axes.texts if t.get_text() and not t.get_text().endswith(" m")]
    boxes = [(t.get_bbox_patch() or t).get_window_extent() for t in texts]
    for k, box in enumerate(boxes):
        for other in boxes[:k]:
            assert not (box.x0 < other.x1 and other.x0 < box.x1 and box.y0 < other.y1 and other.y0 < box.y1)
    to_metres = axes.transData.inverted().transform
    directed = set()
    for arrow in arrows:
        low, high = (arrow.get_window_extent().min, arrow.get_window_extent().max)
        middle = (low + high) / 2
        assert not any(box.contains(*middle) for box in boxes)
        away = [float(np.hypot(*(lane.xy_m - to_metres(middle)).T).min()) for lane in analysis.lanes]
        directed.add(int(np.argmin(away)))
    assert directed == {lane.number for lane in analysis.lanes if lane.length_m > 15}
    numbers = [t.get_text() for t in texts if t.get_text().isdigit()]
    assert len(set(numbers)) == len(numbers)
    left_out = len(analysis.lanes) - len(numbers)
    assert (f"{left_out} lane" in diagram.caption) == bool(left_out)
    assert ("in red" in diagram.caption) == bool(analysis.scene and analysis.scene.arms)


def test_a_map_without_roads_into_the_scene_does_not_explain_them(monkeypatch: pytest.MonkeyPatch) -> None:
    analysis = crossing()
    assert "in red" in named(analysis, "place").caption
    monkeypatch.setitem(analysis.__dict__, "scene", None)
    assert "in red" not in named(analysis, "place").caption


@pytest.mark.parametrize(("end_s", "said"), [(345.5, "last 46 s are a part"), (309.0, "last 9 s are too short")])
def test_vehicles_by_minute_are_shown_to_the_end(end_s: float, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    analysis = turning_crossroads()
    monkeypatch.setitem(analysis.trajectories.__dict__, "seen_s", (0.0, end_s))
    assert said in named(analysis, "flow").caption
    axes = new_figure(7, 3).add_subplot()
    draw_flow(axes, analysis=analysis, found=analysis.movements[0])
    assert axes.get_xlim() == pytest.approx((0, end_s / 60))
    for line in axes.lines:
        times, counts = line.get_data()
        known = np.asarray(times)[np.isfinite(np.asarray(counts, np.float64))]
        assert known.max() == pytest.approx(end_s / 60 if end_s > 315 else 4.0)


@pytest.mark.parametrize("residual_px", [0.00125, 0.3, 1234.5])
def test_labels_of_the_registration_plot_are_within_it(residual_px: float, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    monkeypatch.setattr(
        plots, "figure_bytes", lambda figure, kind: (made.append(figure), figure_bytes(figure, kind))[1]
    )
    times = tuple(float(t) for t in range(20))
    plots.residual_plot(ResidualSeries(times_s=times, residual_px=(residual_px,) * 20, limit_px=None))
    (figure,) = made
    assert figure.axes[0].yaxis.label.get_window_extent().x0 > 0
    assert figure.axes[0].xaxis.label.get_window_extent().y0 > 0
