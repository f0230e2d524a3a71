"""The turning-movement diagram of a junction: arrows as wide as the flow, arms where their roads lead."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from schemas.arrays import FloatArray
from velfield.analysis.movements.gates import Arm
from velfield.analysis.movements.movements import JunctionMovements, Movement
from velfield.report.colours import TONES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_APART_RAD = np.radians(30)
"""Arms are drawn at least this far apart."""
_ACROSS, _LABEL_AT, _LINE = 4.4, 1.12, 0.12
"""Width of the diagram, distance of its labels from the middle and height of a line of them, in lengths of an arm."""
_MARGIN = 0.1
_FROM, _FROM_STEP, _TO, _TO_STEP = 0.1, 0.09, 0.1, 0.06
"""The arrow of an arm that turns farthest to the left begins so far to the right of it, each next a step farther; where
arrows end likewise: so those of one arm do not cross."""
_THIN, _THICK, _HEAD = 0.006, 0.06, 0.06
"""Half of the width of the thinnest and the thickest shaft; a head is wider by this to each side."""


def turning_height_in(found: JunctionMovements, width_in: float) -> float:
    """Height of the diagram where it is so wide: no more than its arms and labels need."""
    top, bottom = _vertical_range(found)
    return width_in * (bottom - top) / _ACROSS


def arm_directions(arms: tuple[Arm, ...], centre_m: FloatArray) -> dict[str, float]:
    """Direction, rad, in which each arm is drawn, by name: that of its road; parallel roads are turned apart.

    The direction from a junction's centre (2,) to an arm's gates is another one where the gates are only metres away.
    """
    if not arms:
        return {}
    outward = np.array([arm.outward_rad for arm in arms])
    bearing = np.array([np.arctan2(*(arm.xy_m - centre_m)[::-1]) for arm in arms])
    # roads of one direction are in the order in which they lie beside each other
    order = np.argsort((outward + 0.1 * np.angle(np.exp(1j * (bearing - outward)))) % (2 * np.pi))
    angle = outward[order] % (2 * np.pi)
    apart = min(_APART_RAD, 2 * np.pi / len(arms))
    for _ in range(100):
        ahead = (np.roll(angle, -1) - angle + apart) % (2 * np.pi) - apart
        lack = np.clip(apart - ahead, 0, None) / 2 if len(arms) > 1 else np.zeros(1)
        angle += np.roll(lack, 1) - lack
    return {arms[k].name: float(a) for k, a in zip(order, angle, strict=True)}


def draw_turning(axes: "Axes", *, found: JunctionMovements) -> None:
    """The turning-movement diagram of a junction."""
    from matplotlib.patches import Polygon
    from scipy.interpolate import BPoly

    angle = arm_directions(found.gates.arms, found.junction.centre_m)
    most = max(m.seen + m.inferred for m in found.movements)
    for k, arm in enumerate(found.gates.arms):
        outward, aside = _axes_of(angle[arm.name])
        tone = TONES[k % len(TONES)]
        mine = _movements(found, arm_in=arm.name)
        for rank, m in enumerate(_by_turn(mine, angle)):
            out, out_aside = _axes_of(angle[m.arm_out])
            begin = -aside * (_FROM + _FROM_STEP * rank)
            end = out_aside * (_TO + _TO_STEP * _by_turn(_movements(found, arm_out=m.arm_out), angle).index(m))
            bent = np.stack([outward + begin, 0.25 * outward + begin, 0.25 * out + end, out + end])
            line = BPoly(bent[:, None], [0, 1])(np.linspace(0, 1, 60))
            half = _THIN + (_THICK - _THIN) * (m.seen + m.inferred) / most
            axes.add_patch(Polygon(_arrow(line, half), facecolor=tone, alpha=0.8, edgecolor="none"))
        side = "left" if outward[0] > 0.3 else "right" if outward[0] < -0.3 else "center"
        up = "top" if outward[1] > 0.7 else "bottom" if outward[1] < -0.7 else "center"
        x, y = _LABEL_AT * outward
        axes.text(x, y, "\n".join(_label(arm, mine, found)), ha=side, va=up, fontsize=9, color=tone)
    top, bottom = _vertical_range(found)
    axes.set(xlim=(-_ACROSS / 2, _ACROSS / 2), ylim=(bottom, top), aspect="equal")
    axes.axis("off")


def _axes_of(angle_rad: float) -> tuple[FloatArray, FloatArray]:
    """Unit vectors (2,) along an arm, away from the junction, and to the right of who leaves by it."""
    along = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    return along, np.array([-along[1], along[0]])


def _movements(found: JunctionMovements, *, arm_in: str | None = None, arm_out: str | None = None) -> list[Movement]:
    """Those from an arm, or to one, with most vehicles first."""
    mine = [m for m in found.movements if arm_in in (None, m.arm_in) and arm_out in (None, m.arm_out)]
    return sorted(mine, key=lambda m: -(m.seen + m.inferred))


def _by_turn(movements: list[Movement], angle: Mapping[str, float]) -> list[Movement]:
    """Those that turn farthest to the left first, those that turn back before all."""
    return sorted(movements, key=lambda m: (angle[m.arm_out] - angle[m.arm_in] + 1e-6) % (2 * np.pi))


def _label(arm: Arm, movements: list[Movement], found: JunctionMovements) -> list[str]:
    if not movements:
        comes = arm.name in found.gates.arms_in.values()
        return [f"{arm.name}: no turns known from there" if comes else f"{arm.name}: vehicles only leave by it"]
    counted = sum(m.seen + m.inferred for m in movements)
    total = found.entered(arm.name)
    lines = [
        f"to {m.arm_out}: {m.seen + m.inferred:.0f}" + (f" ({100 * m.share.value:.0f} %)" if m.share else "")
        for m in movements
    ]
    rare = [f"by rare ways: {total - counted:.0f}"] if total - counted >= 0.5 else []
    return [f"from {arm.name}: {total:.0f}", *lines, *rare]


def _vertical_range(found: JunctionMovements) -> tuple[float, float]:
    """Top and bottom of the diagram, y down from the middle, in lengths of an arm."""
    angle = arm_directions(found.gates.arms, found.junction.centre_m)
    ends = [0.0]
    for arm in found.gates.arms:
        down = float(np.sin(angle[arm.name]))
        high = _LINE * len(_label(arm, _movements(found, arm_in=arm.name), found))
        at = _LABEL_AT * down
        ends += [at, at + high] if down > 0.7 else [at - high, at] if down < -0.7 else [at - high / 2, at + high / 2]
        ends.append(down - 0.3 * abs(np.cos(angle[arm.name])))  # arrows lie to both sides of an arm
        ends.append(down + 0.3 * abs(np.cos(angle[arm.name])))
    return min(ends) - _MARGIN, max(ends) + _MARGIN


def _arrow(line: FloatArray, half: float) -> FloatArray:
    """Outline (n, 2) of an arrow along a line (k, 2): a shaft of this half width, and a head that begins at its end."""
    length = 1.3 * (half + _HEAD)
    along = np.r_[0.0, np.hypot(*np.diff(line, axis=0).T).cumsum()]
    at = np.r_[along[along < along[-1] - length], along[-1] - length]
    shaft = np.column_stack([np.interp(at, along, line[:, k]) for k in (0, 1)])
    step = np.gradient(shaft, axis=0)
    across = np.column_stack([-step[:, 1], step[:, 0]]) / np.hypot(*step.T)[:, None]
    head = line[-1] - shaft[-1]
    wide = np.array([-head[1], head[0]]) / np.hypot(*head) * (half + _HEAD)
    left, right = shaft + across * half, shaft - across * half
    return np.concatenate([left, [shaft[-1] + wide, line[-1], shaft[-1] - wide], right[::-1]])
