"""Greens of the lanes of one approach: whether a lane that seems to start later than another has a green of its own.

A lane in which vehicles give way starts when there is a gap. It crosses its line while it seems to have red.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from schemas.arrays import FloatArray
from velfield.analysis.signals.phases import START_DELAY_S, Phase
from velfield.analysis.signals.queues import Approach, Stream

_SAME_RAD, _ASIDE_M, _AHEAD_M = np.radians(30), 12.0, 25.0
"""Lanes of one approach have this direction, and enter the junction so near to each other."""
_OWN_STARTS = 3
"""A lane with fewer starts of queues has no green other than that of the lane beside it."""
_RED_S = 12.0
"""Before a green of its own a lane has red for so long at least."""
_SOON_S = 8.0
"""The first vehicles of a queue cross within this time of their green."""
_CYCLES, _SHARE = 2, 1 / 3
"""Vehicles cross in so many cycles, and in such a share of them, where it is not by chance."""


def lanes_by_phase(
    streams: Sequence[Stream], starts_s: Sequence[FloatArray], phases: Sequence[Phase], cycle_s: float
) -> list[Phase]:
    """The phases of a junction with the lanes whose green is known.

    A lane whose own green is not shown has that of a lane beside it if its vehicles cross soon after that begins, and
    not before; else its green is not known.

    Parameters
    ----------
    streams, starts_s
        The lanes, and for each the times (n,) at which the first of a queue moves off.
    phases
        The lanes by the time of their starts.
    """
    members = [set(phase.streams) for phase in phases]
    count = [sum(len(starts_s[k]) for k in phase.streams) for phase in phases]
    for at in np.argsort(count, kind="stable").tolist():
        for k in phases[at].streams:
            own = streams[k]
            rivals = [
                other
                for other in range(len(phases))
                if other != at and any(_is_beside(own.approach, streams[m].approach) for m in members[other])
            ]
            green = [phase.green_s.value for phase in phases]
            if all(_has_own_green(own, count[at], green[at], green[other], cycle_s) for other in rivals):
                continue
            members[at].discard(k)
            same = [other for other in rivals if _begins_at(own, green[other], cycle_s)]
            if len(same) == 1:
                members[same[0]].add(k)
    return [replace(phase, streams=tuple(sorted(own))) for phase, own in zip(phases, members, strict=True) if own]


def _has_own_green(stream: Stream, starts: int, green_s: float, other_s: float, cycle_s: float) -> bool:
    """Whether a lane of a phase with so many starts has red before its green, where the lane beside it has green."""
    first_s = max(green_s - (green_s - other_s) % cycle_s + START_DELAY_S, green_s - _RED_S)
    return starts >= _OWN_STARTS and not _crosses(stream, first_s, green_s, cycle_s)


def _begins_at(stream: Stream, green_s: float, cycle_s: float) -> bool:
    """Whether vehicles cross soon after a green begins, and none do before."""
    after = _crosses(stream, green_s + START_DELAY_S, green_s + _SOON_S, cycle_s)
    return after and not _crosses(stream, green_s - _RED_S, green_s, cycle_s)


def _crosses(stream: Stream, begin_s: float, end_s: float, cycle_s: float) -> bool:
    """Whether vehicles cross the line between two times of the cycle in enough cycles."""
    number = np.floor((stream.cross_time_s - begin_s) / cycle_s)
    within = stream.cross_time_s - begin_s - number * cycle_s < end_s - begin_s
    cycles = len(np.unique(number))
    return len(np.unique(number[within])) >= max(_CYCLES, _SHARE * cycles)


def _is_beside(a: Approach, b: Approach) -> bool:
    """Whether two lanes lead into a junction side by side."""
    (at_a, along_a), (at_b, along_b) = _entry(a), _entry(b)
    step = at_b - at_a
    turn = abs(float(np.angle(np.exp(1j * (np.arctan2(*along_b[::-1]) - np.arctan2(*along_a[::-1]))))))
    aside = abs(float(along_a[0] * step[1] - along_a[1] * step[0]))
    return turn < _SAME_RAD and aside < _ASIDE_M and abs(float(along_a @ step)) < _AHEAD_M


def _entry(approach: Approach) -> tuple[FloatArray, FloatArray]:
    """Where a lane enters the junction, and its direction there (a unit vector)."""
    k = int(np.clip(approach.border_m, 1, len(approach.path_m) - 1))
    step = approach.path_m[k] - approach.path_m[max(k - 10, 0)]
    return approach.path_m[k], step / max(float(np.hypot(*step)), 1e-9)
