"""The map of a traffic analysis: lanes with arrows and numbers, junctions and roads, none over another."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from schemas.arrays import FloatArray, GreyImage, Mask
from velfield.analysis.lanes.model import Lane
from velfield.analysis.traffic_analysis import TrafficAnalysis

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_INK = "#1b1f24"
_PALE_BOX = {"facecolor": "white", "edgecolor": "none", "boxstyle": "round,pad=0.1", "alpha": 0.8}
_LEAST_PT = (460.0, 240.0)
"""Width and height that the map has at least, of the page of the PDF."""
_MARGIN = 0.05
"""Margin around lanes without a picture, as a fraction of their extent."""
_ARROW_PT, _STEP_PT, _APART_PT = 7.0, 2.0, 9.0
"""Length of an arrow; places for one, or for a number, along a lane; how far arrows lie apart where there is room."""
_LINE = 1.25
"""Height of a line, in font sizes."""
_NUMBER_SIZE, _ARM_SIZE, _JUNCTION_SIZE, _MERGE_SIZE = 6.5, 8.0, 11.0, 6.5
_NUMBER_AT = (0.33, 0.5, 0.67, 0.2, 0.8, 0.1, 0.9)
"""Shares of a lane's length before its first junction where its number stands best."""
_LONG_M = 12.0
"""Lanes from this length on are numbered first."""
_ASIDE_PT = (0.0, 24.0, 40.0, 60.0)
"""A label stands so far from its place: the nearest where it hides no lane and no other label."""
_ASIDE_M = 12.0


@dataclass(frozen=True)
class Label:
    """A text of the map: what it says, its middle (2,) m, the place (2,) m that it is of, and its font size, pt."""

    text: str
    xy_m: FloatArray
    of_m: FloatArray
    size_pt: float


@dataclass(frozen=True)
class MapLabels:
    """Where the labels and the arrows of a map stand."""

    junctions: tuple[Label, ...]
    arms: tuple[Label, ...]
    numbers: tuple[Label, ...]
    """Labels of the junctions, of the roads by which vehicles enter and leave, and of lanes."""
    arrows_m: FloatArray
    """(n, 2, 2) tail and tip of the arrows of the lanes."""
    unnumbered: int
    """Number of lanes without a number for want of room."""


class _Boxes:
    """Boxes (n, 4): left, top, right, bottom, m."""

    def __init__(self, m_per_pt: float) -> None:
        self.m_per_pt = m_per_pt
        self.all = np.empty((0, 4))

    def of(self, text: str, size_pt: float, xy_m: FloatArray, pad: float) -> FloatArray:
        """The boxes (n, 4) of a text about positions (n, 2) or (2,); ``pad``: about it, in font sizes."""
        half = np.array([_width(text) + 2 * pad, _LINE + 2 * pad]) * size_pt * self.m_per_pt / 2
        xy = np.atleast_2d(xy_m)
        return np.hstack([xy - half, xy + half])

    def add(self, box: FloatArray) -> None:
        self.all = np.vstack([self.all, box])

    def free(self, boxes: FloatArray) -> Mask:
        """(n,) whether boxes (n, 4) overlap none."""
        a, b = boxes[:, None], self.all[None]
        over = np.all(a[..., :2] < b[..., 2:], axis=-1) & np.all(b[..., :2] < a[..., 2:], axis=-1)
        return np.asarray(~np.any(over, axis=1))


@cache
def _width(text: str) -> float:
    """Width of a bold text, in font sizes."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    return float(TextPath((0, 0), text, size=1, prop=FontProperties(weight="bold")).get_extents().x1)


def map_extent_m(analysis: TrafficAnalysis, picture: GreyImage | None) -> FloatArray:
    """(4,) left, top, right, bottom of the map: the base image, or the lanes with a margin."""
    if picture is not None:
        height, width = picture.shape
        return np.array([0.0, 0.0, width, height]) * analysis.trajectories.gsd_m
    if not len(analysis.lanes):
        return np.array([0.0, 0.0, 1.0, 1.0])
    points = np.concatenate([lane.xy_m for lane in analysis.lanes])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = _MARGIN * float((high - low).max())
    return np.concatenate([low - margin, high + margin])


def place_labels(analysis: TrafficAnalysis, picture: GreyImage | None) -> MapLabels:
    """Where the labels and arrows of the map stand, so that none hides another at the size of the PDF's page.

    Every lane that is longer than an arrow has one. A junction's label stands beside it, with a line to it, where it
    would hide a lane's arrow. A number that has no room is left out.
    """
    extent = map_extent_m(analysis, picture)
    m_per_pt = float(((extent[2:] - extent[:2]) / _LEAST_PT).max())
    lanes = [lane for lane in analysis.lanes if lane.length_m >= _ARROW_PT * m_per_pt]
    boxes = _Boxes(m_per_pt)
    spots = [_spots(lane, _ARROW_PT * m_per_pt, _STEP_PT * m_per_pt) for lane in lanes]
    points = np.concatenate([np.empty((0, 2)), *(lane.at(at) for lane, at in zip(lanes, spots, strict=True))])
    owner = np.repeat(np.arange(len(lanes)), [len(at) for at in spots])
    free = np.ones(len(points), bool)

    def stand(text: str, size: float, of_m: FloatArray, pad: float) -> Label:
        """The label at the nearest place where it hides no other, and no lane whole."""
        nonlocal free
        best, least, left = of_m, np.inf, free
        for aside in _ASIDE_PT:
            for turn in np.arange(8) * np.pi / 4 if aside else (0.0,):
                at = of_m + aside * m_per_pt * np.array([np.cos(turn), np.sin(turn)])
                box = boxes.of(text, size, at, pad)[0]
                near = np.abs(points - at) < (box[2:] - box[:2]) / 2 + _ARROW_PT * m_per_pt / 2
                still = free & ~near.all(axis=1)
                hidden = len(lanes) - np.count_nonzero(np.bincount(owner[still], minlength=len(lanes)))
                out = bool((box[:2] < extent[:2]).any() or (box[2:] > extent[2:]).any())
                cost = 10.0 * hidden + 10.0 * (not boxes.free(box[None])[0]) + out * bool(aside)
                if cost < least:
                    best, least, left = at, cost, still
            if not least:
                break
        free = left
        boxes.add(boxes.of(text, size, best, pad))
        return Label(text, best, of_m, size)

    sizes = _junction_sizes(analysis)
    junctions = [
        stand(f"J{j.number}", sizes[j.number], j.centre_m, 0.3)
        for j in sorted(analysis.lanes.junctions, key=lambda j: -sizes[j.number])
    ]
    arms = [stand(arm.name, _ARM_SIZE, arm.xy_m, 0.1) for arm in (analysis.scene.arms if analysis.scene else ())]
    arrows = np.empty((0, 2, 2))
    for k in sorted(range(len(lanes)), key=lambda k: lanes[k].length_m):
        mine = free[owner == k]
        if not mine.any():
            continue
        at, xy = spots[k][mine], points[owner == k][mine]
        away = np.hypot(*(xy[:, None] - arrows.mean(axis=1)[None]).transpose(2, 0, 1)).min(axis=1, initial=np.inf)
        along = at[np.argmax(np.minimum(away, _APART_PT * m_per_pt))]
        half = _ARROW_PT * m_per_pt / 2
        arrow = lanes[k].at(np.array([along - half, along + half]))
        arrows = np.concatenate([arrows, arrow[None]])
        boxes.add(np.hstack([arrow.mean(axis=0) - half, arrow.mean(axis=0) + half]))
    numbers = _numbers(analysis, boxes)
    return MapLabels(tuple(junctions), tuple(arms), tuple(numbers), arrows, len(analysis.lanes) - len(numbers))


def _numbers(analysis: TrafficAnalysis, boxes: _Boxes) -> list[Label]:
    """Numbers of lanes where there is room for them, before a lane's first junction where that can be; first of those
    into junctions where ways meet, which the answers on signals and queues name."""
    reach_m = {lane.number: lane.length_m for lane in analysis.lanes}
    named = {
        k for found in analysis.movements if analysis.ways_meet(found.junction.number) for k in found.gates.arms_in
    }
    for gate in (gate for found in analysis.movements for gate in found.gates.gates if gate.inwards):
        lane = analysis.lanes.lanes[gate.lane]
        at_m = float(lane.along_m[np.argmin(np.hypot(*(lane.xy_m - gate.xy_m).T))])
        reach_m[gate.lane] = min(reach_m[gate.lane], max(at_m, _LONG_M))
    out = []
    for lane in sorted(
        analysis.lanes, key=lambda lane: (lane.number not in named, lane.length_m < _LONG_M, lane.length_m)
    ):
        reach = reach_m[lane.number]
        further = np.arange(0, lane.length_m, 2 * _STEP_PT * boxes.m_per_pt)
        places = lane.at(np.r_[np.array(_NUMBER_AT) * reach, further[further < reach], further])
        free = boxes.free(boxes.of(str(lane.number), _NUMBER_SIZE, places, 0.15))
        if free.any():
            xy = places[int(np.argmax(free))]
            boxes.add(boxes.of(str(lane.number), _NUMBER_SIZE, xy, 0.15))
            out.append(Label(str(lane.number), xy, xy, _NUMBER_SIZE))
    return out


def _spots(lane: Lane, arrow_m: float, step_m: float) -> FloatArray:
    """Distances along a lane at which the middle of an arrow may lie, the best first: a lane's middle may be a
    junction."""
    low, high = arrow_m / 2, lane.length_m - arrow_m / 2
    every = np.arange(low, high, step_m)
    every = every[np.argsort(np.abs(every - lane.length_m / 2), kind="stable")]
    return np.asarray(np.r_[np.clip(np.array([0.5, 0.75, 0.25]) * lane.length_m, low, high), every])


def place_caption(analysis: TrafficAnalysis, labels: MapLabels) -> str:
    """What the map shows, and what it leaves out."""
    kinds = {analysis.junction_kind(junction.number) for junction in analysis.lanes.junctions}
    parts = ["Lanes with their direction of travel and their numbers"]
    if labels.junctions:
        parts.append("J: junctions, small where lanes only merge or part")
    if labels.arms:
        parts.append(f"in red, the roads by which vehicles enter and leave ({analysis.arm_names.legend})")
    out = f"{'; '.join(parts)}."
    if labels.junctions:
        legend = "" if labels.arms else f" ({analysis.arm_names.legend})"
        number = labels.junctions[0].text[1:]
        out += (
            f" J{number} is junction {number}, or crossing {number}, in the text; a junction's own arms are named by "
            f"the side that they lead to{legend}."
        )
    if "crossing" in kinds:
        out += " Dashed: roads that cross, perhaps on two levels, as nobody was seen to turn."
    if labels.unnumbered:
        one = labels.unnumbered == 1
        out += f" {labels.unnumbered} {'lane has' if one else 'lanes have'} no number for want of room."
    return out


def draw_map(axes: "Axes", analysis: TrafficAnalysis, picture: GreyImage | None) -> None:
    """The base image, pale, with the lanes' centre lines; metres, y down."""
    left, top, right, bottom = map_extent_m(analysis, picture)
    if picture is not None:
        step = max(1, max(picture.shape) // 1600)
        pale = 255 - (255 - picture[::step, ::step].astype(np.float32)) * 0.55
        axes.imshow(pale, cmap="gray", vmin=0, vmax=255, extent=(left, right, bottom, top))
    for lane in analysis.lanes:
        axes.plot(*lane.xy_m.T, color=_INK, linewidth=0.9)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.axis("off")


def draw_place(axes: "Axes", *, analysis: TrafficAnalysis, picture: GreyImage | None, labels: MapLabels) -> None:
    """Lanes with arrows and numbers, and the junctions' numbers, over the base image."""
    draw_map(axes, analysis, picture)
    style = {"arrowstyle": "-|>", "color": _INK, "mutation_scale": 11, "shrinkA": 0, "shrinkB": 0}
    for tail, tip in labels.arrows_m:
        axes.annotate("", xy=(tip[0], tip[1]), xytext=(tail[0], tail[1]), arrowprops=style)
    for label in labels.numbers:
        _write(axes, label, color="#0b4f8a", bbox=_PALE_BOX)
    _draw_junctions(axes, analysis, labels.junctions)
    for label in labels.arms:
        _write(axes, label, color="#7a1f1f", fontweight="bold", bbox=_PALE_BOX)
    _draw_scale(axes)
    _draw_north(axes, analysis.arm_names.north_rad)


def draw_junctions_aside(axes: "Axes", analysis: TrafficAnalysis) -> None:
    """Numbers of the junctions beside them, with lines to them: what lies in the junctions stays visible."""
    sizes = _junction_sizes(analysis)
    labels = [
        Label(f"J{j.number}", j.centre_m + _ASIDE_M, j.centre_m, sizes[j.number]) for j in analysis.lanes.junctions
    ]
    _draw_junctions(axes, analysis, labels)


def _junction_sizes(analysis: TrafficAnalysis) -> dict[int, float]:
    """Font size of each junction's number, pt: small where lanes only merge or part."""
    return {
        j.number: _MERGE_SIZE if analysis.junction_kind(j.number) in ("merge", "diverge") else _JUNCTION_SIZE
        for j in analysis.lanes.junctions
    }


def _draw_junctions(axes: "Axes", analysis: TrafficAnalysis, labels: Sequence[Label]) -> None:
    """Numbers of the junctions, small where lanes only merge or part, with a line to them from beside."""
    dashed = {f"J{j.number}" for j in analysis.lanes.junctions if analysis.junction_kind(j.number) == "crossing"}
    for label in labels:
        box = {"facecolor": "white", "edgecolor": _INK, "boxstyle": "round,pad=0.25"}
        box["linestyle"] = "--" if label.text in dashed else "-"
        _write(axes, label, fontweight="bold", bbox=box)


def _write(axes: "Axes", label: Label, **style: Any) -> None:
    """A label, with a line to its place where it stands beside."""
    x, y = label.xy_m
    if not np.array_equal(label.xy_m, label.of_m):
        axes.plot(*np.array([label.of_m, label.xy_m]).T, color=_INK, linewidth=0.8)
    axes.text(x, y, label.text, ha="center", va="center", fontsize=label.size_pt, **style)


def _draw_scale(axes: "Axes") -> None:
    """A bar of a round number of metres in the lower left corner, about a fifth as long as the picture is wide."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    if not right - left > 0:
        return
    longest = (right - left) / 5
    power = 10.0 ** np.floor(np.log10(longest))
    length = power * max(step for step in (1, 2, 5) if step * power <= longest)
    x, y = left + 0.03 * (right - left), bottom + 0.04 * (top - bottom)
    axes.plot([x, x + length], [y, y], color=_INK, linewidth=3, solid_capstyle="butt")
    above = y + 0.02 * (top - bottom)
    axes.text(x + length / 2, above, f"{length:g} m", ha="center", va="bottom", fontsize=7, bbox=_PALE_BOX)


def _draw_north(axes: "Axes", north_rad: float | None) -> None:
    """An arrow to the north in the upper right corner, where north is known."""
    if north_rad is None:
        return
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    size = 0.05 * (right - left)
    at = np.array([right - 1.5 * size, top + np.sign(bottom - top) * 1.5 * size])
    tip = at + size * np.array([np.cos(north_rad), np.sin(north_rad)])
    style = {"arrowstyle": "-|>", "color": _INK, "mutation_scale": 14}
    axes.annotate("N", xy=(tip[0], tip[1]), xytext=(at[0], at[1]), ha="center", va="center", fontsize=8,
                  arrowprops=style, bbox=_PALE_BOX)  # fmt: skip
