"""Phases of a signal: which streams have green together, and when; the cycle fitted to their starts.

The lanes of a phase start together in each cycle, all late where the junction is still to clear: a phase in a cycle is
one observation, however many lanes it has.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from schemas.arrays import FloatArray, IntArray
from velfield.analysis.intervals import LEVEL, Estimate

START_DELAY_S, START_DELAY_SD_S = 1.6, 0.5
"""From green to the moment at which the first vehicle has visibly moved off, where nothing is in its way: its driver's
reaction, and the time to reach walking speed. It differs from junction to junction by so much."""
_TOGETHER_S = 4.0
_PROMPT_S = 3.0
"""Starts that differ by more from the phase's median are of vehicles that crept, or did not look."""
_START_SD_S = 1.0
"""Standard deviation of prompt starts before any is seen, as of one degree of freedom."""
_CLEAR_QUANTILE = 0.2
"""In the earliest of so many cycles nothing is left in the junction at green."""


@dataclass(frozen=True)
class Phase:
    """Streams that start together: their numbers, and the ``green_s`` onset after the start of a cycle."""

    streams: tuple[int, ...]
    green_s: Estimate


def fit_phases(
    starts_s: Sequence[FloatArray], cycle_s: float, *, time_sd_s: float = 0.0
) -> tuple[Estimate, tuple[Phase, ...]]:
    """The cycle, by least squares over phases and cycles, and the phases in the order of their green.

    Parameters
    ----------
    starts_s
        For each stream the times (n,) at which the first of a queue moves off.
    cycle_s
        The cycle, nearly.
    time_sd_s
        Standard deviation of a start by the errors of the tracks: smoothed speeds rise too early by about as much.
    """
    groups = _group([_circular_median(times, cycle_s) for times in starts_s], cycle_s)
    number, time, group = _one_a_cycle(starts_s, groups, cycle_s)
    cycle = _fit_cycle(number, time, group)
    phases = []
    for k, streams in enumerate(groups):
        rows = group == k
        if rows.sum() >= 2:
            green = _green(number[rows], time[rows], cycle, time_sd_s)
            phases.append(Phase(tuple(streams), green))
    return cycle, tuple(sorted(phases, key=lambda phase: phase.green_s.value))


def _circular_mean(times: FloatArray, cycle_s: float) -> float:
    return float(np.angle(np.exp(2j * np.pi * times / cycle_s).mean()) / (2 * np.pi) * cycle_s)


def _circular_median(times: FloatArray, cycle_s: float) -> float:
    """Phase of most starts: one that is late, of a vehicle that did not look, does not move it."""
    mean = _circular_mean(times, cycle_s)
    return mean + float(np.median(_wrap(times - mean, cycle_s)))


def _group(phases_s: Sequence[float], cycle_s: float) -> list[list[int]]:
    """Streams whose starts are together, by their phases."""
    groups: list[tuple[float, list[int]]] = []
    for k in np.argsort(phases_s).tolist():
        for at, members in groups:
            if abs(_wrap(np.array(phases_s[k] - at), cycle_s)) < _TOGETHER_S:
                members.append(k)
                break
        else:
            groups.append((phases_s[k], [k]))
    return [members for _, members in groups]


def start_together(a_s: FloatArray, b_s: FloatArray, cycle_s: float) -> bool:
    """Whether most starts of two streams are in one part of the cycle."""
    apart = _circular_median(a_s, cycle_s) - _circular_median(b_s, cycle_s)
    return bool(abs(_wrap(np.array(apart), cycle_s)) < _TOGETHER_S)


def _wrap(value: FloatArray, cycle_s: float) -> FloatArray:
    return (value + cycle_s / 2) % cycle_s - cycle_s / 2


def _one_a_cycle(
    starts_s: Sequence[FloatArray], groups: Sequence[Sequence[int]], cycle_s: float
) -> tuple[IntArray, FloatArray, IntArray]:
    """Number of the cycle, time and group of each start of a phase: the median over its lanes."""
    number, time, group = [np.empty(0, np.int64)], [np.empty(0)], [np.empty(0, np.int64)]
    for k, members in enumerate(groups):
        every = np.concatenate([starts_s[m] for m in members])
        phase = _circular_mean(every, cycle_s)
        residual = _wrap(every - phase, cycle_s)
        every = every[np.abs(residual - np.median(residual)) < _PROMPT_S]
        cycles = np.round((every - phase) / cycle_s).astype(np.int64)
        for cycle in np.unique(cycles):
            number.append(np.array([cycle]))
            time.append(np.array([np.median(every[cycles == cycle])]))
            group.append(np.array([k]))
    return np.concatenate(number), np.concatenate(time), np.concatenate(group)


def _fit_cycle(number: IntArray, time: FloatArray, group: IntArray) -> Estimate:
    """Common slope of the groups' lines of time over the number of the cycle."""
    k, t = number.astype(np.float64), time.copy()
    for one in np.unique(group):
        rows = group == one
        k[rows] -= k[rows].mean()
        t[rows] -= t[rows].mean()
    # of few cycles the residuals are small by chance: two starts lie on a line
    free = len(k) - len(np.unique(group))
    slope = float((k * t).sum() / (k**2).sum())
    residual = float(np.sqrt((((t - slope * k) ** 2).sum() + _START_SD_S**2) / free))
    late = float(min(special.stdtrit(free, 0.95) * residual, special.ndtri(0.95) * _PROMPT_S / np.sqrt(3)))
    half = late / float(np.sqrt((k**2).sum()))
    return Estimate(slope, slope - half, slope + half, len(k))


def _green(number: IntArray, time: FloatArray, cycle: Estimate, time_sd_s: float) -> Estimate:
    """Onset of green after the start of a cycle: before the starts of the cycles in which the junction was clear."""
    onset = np.sort(time - number * cycle.value)
    early = float(np.quantile(onset, _CLEAR_QUANTILE))
    # A low quantile of few values: its error is about that of the mean.
    scatter = float(onset.std(ddof=1) / np.sqrt(len(onset))) * float(special.stdtrit(len(onset) - 1, 0.95))
    drift = float(np.abs(number.mean())) * (cycle.high - cycle.low) / 2
    systematic = special.ndtri((1 + LEVEL) / 2) * np.hypot(START_DELAY_SD_S, time_sd_s)
    half = float(np.sqrt(scatter**2 + drift**2 + systematic**2))
    value = (early + time_sd_s - START_DELAY_S) % cycle.value
    return Estimate(value, value - half, value + half, len(onset))
