"""Phases of a signal: which streams have green together, and when; the cycle fitted to their starts.

The lanes of a phase start together in each cycle, all late where the junction is still to clear: a phase in a cycle is
one observation, however many lanes it has. A start is the green, a driver's reaction, and a time of waiting that is
exponential over the cycles: the earliest starts show the green, and by the others alone a cycle would be too long where
the waits grow by chance. Cycle, greens and mean wait are found together, as probabilities on a grid.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import special

from schemas.arrays import FloatArray
from velfield.analysis.intervals import LEVEL, Estimate

START_DELAY_S, START_DELAY_SD_S = 1.6, 0.5
"""From green to the moment at which the first vehicle has visibly moved off, where nothing is in its way: its driver's
reaction, and the time to reach walking speed. It differs from junction to junction by so much."""
_TOGETHER_S = 4.0
_START_SD_S, _WAIT_S = (0.25, 0.5, 1.0), (0.2, 0.7, 2.0, 5.0)
"""Standard deviations of prompt starts, and mean waits for the junction to clear: any is as likely before any start is
seen."""
_ODD_SHARE = 0.03
"""Share of the cycles in which none of the first vehicles looked, or one crept: they start at any time."""
_GRID, _GRID_SD = 41, 6.0
"""Values tried of the cycle and of each green, and how far from the mean ones at most, in standard deviations."""
_EARLY_S, _LATE_S = 4.0, 3.0
"""The first starts are earlier than their green and its delay by no more, and half of them not later."""
_NEGLIGIBLE = 1e-4
"""A value is left out below this part of the probability of the best one."""
_TABLE_STEP_S, _TABLE_S = 0.02, (-30.0, 90.0)
"""The density of starts about their green is tabulated so finely, and from where to where."""


@dataclass(frozen=True)
class Phase:
    """Streams that start together: their numbers, and the ``green_s`` onset after the start of a cycle."""

    streams: tuple[int, ...]
    green_s: Estimate


def fit_phases(
    starts_s: Sequence[FloatArray], cycle_s: float, *, time_sd_s: float = 0.0
) -> tuple[Estimate, tuple[Phase, ...]]:
    """The cycle, and the phases in the order of their green.

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
    rows = [_one_a_cycle([starts_s[k] for k in streams], cycle_s) for streams in groups]
    known = [k for k, (number, _) in enumerate(rows) if len(number) >= 2]
    cycle, greens = _fit([rows[k] for k in known], cycle_s, time_sd_s)
    phases = [Phase(tuple(groups[k]), green) for k, green in zip(known, greens, strict=True)]
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


def _one_a_cycle(starts_s: Sequence[FloatArray], cycle_s: float) -> tuple[FloatArray, FloatArray]:
    """Numbers (n,) of the cycles in which a phase starts, and times (n,): of half its lanes, if others are blocked."""
    every = np.concatenate(starts_s)
    number = np.round((every - _circular_median(every, cycle_s)) / cycle_s)
    cycles = np.unique(number)
    return cycles, np.array([np.quantile(every[number == k], 0.5, method="lower") for k in cycles])


def _fit(
    starts: Sequence[tuple[FloatArray, FloatArray]], cycle_s: float, time_sd_s: float
) -> tuple[Estimate, list[Estimate]]:
    """The cycle, and the onset of green of each phase after the start of a cycle, from the numbers of the cycles in
    which it starts and the times at which it does.

    On the grid the green is that of the phase's mean cycle: there it hardly depends on how long a cycle is.
    """
    tables = _log_densities(cycle_s, time_sd_s)
    centre = [float(number.mean()) for number, _ in starts]
    k = [number - c for (number, _), c in zip(starts, centre, strict=True)]
    spread = sum(float((own**2).sum()) for own in k)
    mean_s = sum(float((own * time).sum()) for own, (_, time) in zip(k, starts, strict=True)) / spread
    off = [time - number * mean_s for number, time in starts]
    n = sum(map(len, off))
    square = sum(float(((one - one.mean()) ** 2).sum()) for one in off) + max(_START_SD_S) ** 2
    reach = _GRID_SD * float(np.sqrt(square / max(n - len(off), 1) / spread))
    longer = np.linspace(-reach, reach, _GRID)
    onsets = [np.linspace(one.min() - _EARLY_S, np.median(one) + _LATE_S, _GRID) for one in off]
    while True:
        fits = [_log_likelihood(tables, *one, longer) for one in zip(k, off, onsets, strict=True)]
        joint = sum(special.logsumexp(fit, axis=2) for fit in fits)  # (densities, cycles)
        weight = np.exp(joint - np.max(joint))
        by_onset = [
            (np.exp(fit - special.logsumexp(fit, axis=2, keepdims=True)) * weight[:, :, None]).sum(axis=0)
            for fit in fits
        ]
        finer = _likely(longer, weight.sum(axis=0)), *map(_likely, onsets, [one.sum(axis=0) for one in by_onset])
        if all(np.ptp(new) > np.ptp(old) / 2 for new, old in zip(finer, (longer, *onsets), strict=True)):
            break
        longer, *onsets = finer
    cycle = _quantiles(longer, weight.sum(axis=0))
    greens = []
    for c, onset, by, one in zip(centre, onsets, by_onset, off, strict=True):
        early, value, late = _quantiles(onset - c * longer[:, None], by)
        systematic = float(special.ndtri((1 + LEVEL) / 2) * np.hypot(START_DELAY_SD_S, time_sd_s))
        green = (value + time_sd_s - START_DELAY_S) % (mean_s + cycle[1])
        reach_s = (float(np.hypot(end - value, systematic)) for end in (early, late))
        greens.append(Estimate(green, green - next(reach_s), green + next(reach_s), len(one)))
    return Estimate(mean_s + cycle[1], mean_s + cycle[0], mean_s + cycle[2], n), greens


def _log_densities(cycle_s: float, time_sd_s: float) -> FloatArray:
    """Logarithms (densities, steps) of the densities of starts about their green and its delay, by the standard
    deviation of prompt ones and the mean wait."""
    x = np.arange(*_TABLE_S, _TABLE_STEP_S)
    out = []
    for own, wait in product(_START_SD_S, _WAIT_S):
        sd = float(np.hypot(own, time_sd_s))
        log = sd**2 / (2 * wait**2) - x / wait + special.log_ndtr(x / sd - sd / wait) - np.log(wait)
        out.append(np.log((1 - _ODD_SHARE) * np.exp(log) + _ODD_SHARE / cycle_s))
    return np.array(out)


def _log_likelihood(
    tables: FloatArray, number: FloatArray, off_s: FloatArray, onset_s: FloatArray, longer_s: FloatArray
) -> FloatArray:
    """Logarithm (densities, cycles, onsets) of the likelihood of the starts of a phase: in cycles (n,) from the mean
    one, ``off_s`` (n,) after their begin, if a cycle is longer by ``longer_s``."""
    out = np.zeros((len(tables), len(longer_s), len(onset_s)))
    for k, off in zip(number.tolist(), off_s.tolist(), strict=True):
        step = np.rint((off - k * longer_s[:, None] - onset_s - _TABLE_S[0]) / _TABLE_STEP_S).astype(np.int64)
        out += tables[:, np.clip(step, 0, tables.shape[1] - 1)]
    return out


def _likely(values: FloatArray, weight: FloatArray) -> FloatArray:
    """As many values over the part (n,) of a grid that is not negligible."""
    kept = np.flatnonzero(weight > _NEGLIGIBLE * weight.max())
    return np.linspace(values[max(kept[0] - 1, 0)], values[min(kept[-1] + 1, len(values) - 1)], len(values))


def _quantiles(values: FloatArray, weight: FloatArray) -> tuple[float, float, float]:
    """Ends and middle of the interval that holds `LEVEL` of the weight."""
    order = np.argsort(values, axis=None)
    share = np.cumsum(weight.ravel()[order])
    share = (share - weight.ravel()[order] / 2) / share[-1]
    low, middle, high = np.interp([(1 - LEVEL) / 2, 0.5, (1 + LEVEL) / 2], share, values.ravel()[order])
    return float(low), float(middle), float(high)
