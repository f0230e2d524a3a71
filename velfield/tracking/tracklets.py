"""Tracklets: three detections of one car in three consecutive registered frames (paper: tracking).

A window is three consecutive registered frames, each no more than ``max_interval_s`` after the one before; a missing
frame breaks it only if the interval gets too long. No state is carried from window to window, so tracklets do not
depend on how the flight is cut into parts, as long as each part has the frames up to the end of its last window.

Candidates that the detector was not sure of are linked after its detections, with those of them that are left: where
three seem to move as a vehicle does, that is evidence of one. What stands is no evidence: so does what is on roofs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree
from scipy.special import expit, logit

from schemas.arrays import FloatArray, IntArray, Mask
from schemas.flight import TrackingConfig, assumed_gsd_m
from velfield.errors import InputError
from velfield.tracking.appearance import Appearance, appearance_differences, prepare_crops
from velfield.tracking.association import (
    MAX_COST,
    FrameTable,
    LinkedTriples,
    appearance_cost,
    best_triples,
    mutual_best_links,
    tracklet_table,
    typical_difference,
)
from velfield.tracking.gates import DetectionStates, GateLog, Limits, LinkPairs, Links, gate_link_pairs, gate_links


@dataclass(frozen=True)
class _FramePair:
    """Candidate links of two consecutive registered frames, and their appearance differences.

    ``rejected`` counts links: tried, by speed, by axis, by appearance (pairwise linking only).
    """

    links: Links
    differences: FloatArray
    typical: float
    rejected: tuple[int, int, int, int]


_STANDS_M = 0.6
"""What is no farther from where something was in another frame may stand."""
_CONSTANT, _OF_SCORE, _OF_ODDS = 0.15, 10.6, 0.17
"""Logistic regression, over 211 triples that move, of whether all three are on one vehicle: simulated cities of seeds
7101 to 7103, both sequences of KIT AIS. Of those above 0.9, 86 of 87 are."""


class _Frames:
    """The registered frames, with a cache of what several windows share."""

    def __init__(self, tables: Sequence[FrameTable], limits: Limits, config: TrackingConfig) -> None:
        self.tables = tables
        self.limits = limits
        self.config = config
        self.states: list[DetectionStates] = [t.states(limits) for t in tables]
        self._features: dict[int, Appearance | None] = {}
        self._pairs: dict[int, _FramePair] = {}

    def adjacent(self, i: int) -> bool:
        """Whether frame i and the next may be in one window. An interval of zero has no velocity."""
        return 0.0 < self.tables[i + 1].time_s - self.tables[i].time_s <= self.limits.max_interval_s

    def features(self, i: int) -> Appearance | None:
        """Appearance of the detections of frame i: crops, or for pairwise linking, as in the paper, patches."""
        if i not in self._features:
            table = self.tables[i]
            if self.config.linking == "pairwise":
                self._features[i] = table.oriented_patches()
            else:
                crops = table.crops
                self._features[i] = None if crops is None else prepare_crops(crops, self.states[i].axis_rad)
        return self._features[i]

    def pair(self, i: int) -> _FramePair:
        """Candidate links from frame i to the next."""
        if i not in self._pairs:
            links = gate_links(self.states[i], self.states[i + 1], self.limits)
            differences = appearance_differences(self.features(i), self.features(i + 1), links.first, links.second)
            pair = _FramePair(links, differences, typical_difference(differences, links.first), (*links.rejected, 0))
            self._pairs[i] = _keep_mutual_best(pair) if self.config.linking == "pairwise" else pair
        return self._pairs[i]

    def release(self, i: int) -> None:
        """Drop frame i from the cache."""
        self._features.pop(i, None)
        self._pairs.pop(i, None)


def _keep_mutual_best(pair: _FramePair) -> _FramePair:
    """Frame-to-frame links that pass the cross-check (paper: tracking)."""
    links = pair.links
    keep = mutual_best_links(pair.differences, links.first, links.second)
    kept = Links(links.first[keep], links.second[keep], links.axis_cost[keep], links.interval_s, links.rejected)
    return _FramePair(kept, pair.differences[keep], pair.typical, (*links.rejected, int(np.sum(~keep))))


def link_windows(
    tables: Sequence[FrameTable],
    config: TrackingConfig,
    *,
    gsd_m: float | None,
    starts: range,
    weak: Sequence[FrameTable] = (),
) -> tuple[pd.DataFrame, GateLog]:
    """Tracklets of every window that starts in ``starts``.

    Parameters
    ----------
    tables
        Frames in time order, registered or not; at least those of `window_frames`.
    config
        Limits and methods of tracking.
    gsd_m
        Metres a base pixel; None: limits are the paper's in pixels.
    starts
        Frames (their ``frame``) at which a window may start.
    weak
        Candidates below the detector's threshold, of the same frames; none: they are not used. They never change a
        tracklet of the detections.

    Returns
    -------
    DataFrame, GateLog
        Columns of `schemas.tables.TRACKLET_COLUMNS` sorted by frame, ``track_id`` still -1; and the counts by gate,
        which add up over the parts of a flight.

    Raises
    ------
    InputError
        The frames are not in time order.
    """
    _check_order(tables)
    limits = Limits.from_config(config, gsd_m)
    log = GateLog()
    log["frames_not_registered"] += sum(not t.registered and t.frame in starts for t in tables)
    good = _Frames([t for t in tables if t.registered], limits, config)
    every = [t.with_weak(one) for t, one in zip(tables, weak, strict=True) if t.registered] if weak else good.tables
    triples: list[LinkedTriples] = []
    for i, table in enumerate(good.tables[:-1]):
        if table.frame not in starts:
            continue
        if not good.adjacent(i):
            log["gaps_too_long"] += 1
            continue
        pair = good.pair(i)
        for gate, count in zip(("links_tried", "speed", "axis", "appearance"), pair.rejected, strict=True):
            log[gate] += count
        if i + 2 < len(good.tables) and good.adjacent(i + 1):
            triples.append(_select_triples(i, good, config.min_confidence, log))
            if weak:
                stands_px = _STANDS_M / assumed_gsd_m(gsd_m)
                triples.append(_select_moving(every, triples[-1], good, stands_px, log))
        good.release(i)
    rows, refined = tracklet_table(every, triples, limits, refine=config.refine)
    log["links_refined"] += refined
    log["links_not_refined"] += 2 * len(rows) - refined
    return rows, log


def _check_order(tables: Sequence[FrameTable]) -> None:
    times = np.array([t.time_s for t in tables], dtype=np.float64)
    wrong = np.flatnonzero(np.diff(times) < 0)
    if wrong.size:
        at = tables[int(wrong[0]) + 1]
        raise InputError(
            f"frame {at.frame} at {at.time_s:.3f} s comes after one at {times[wrong[0]]:.3f} s: "
            "expected frames in time order, sort them by time_s"
        )


def _select_triples(start: int, frames: _Frames, min_confidence: float, log: GateLog) -> LinkedTriples:
    """Gate the pairs of links of the window that starts at ``start``, and select the tracklets among them."""
    pairs, triples, best, confidence = _link_window(start, frames)
    log["windows"] += 1
    for gate, count in zip(("pairs_tried", "turn", "acceleration"), pairs.rejected, strict=True):
        log[gate] += count
    accepted = best & (confidence >= min_confidence)
    log["not_best"] += int(np.sum(~best))
    log["confidence"] += int(np.sum(best & ~accepted))
    log["tracklets"] += int(np.sum(accepted))
    selected = np.flatnonzero(accepted)[np.argsort(triples[accepted, 1], kind="stable")]
    differences = np.stack(
        [frames.pair(start).differences[pairs.link_01], frames.pair(start + 1).differences[pairs.link_12]], axis=1
    )
    return LinkedTriples(start, triples[selected], differences[selected], confidence[selected])


def _link_window(start: int, frames: _Frames) -> tuple[LinkPairs, IntArray, Mask, FloatArray]:
    """Pairs of links of the window that starts at ``start``, and its triples (m, 3): which are best, and how likely."""
    before, after = frames.pair(start), frames.pair(start + 1)
    states = (frames.states[start], frames.states[start + 1], frames.states[start + 2])
    pairs = gate_link_pairs(states, before.links, after.links, frames.limits)
    triples, cost = _triples(frames.features(start), frames.features(start + 2), before, after, pairs)
    counts = states[0].x_px.size, states[1].x_px.size, states[2].x_px.size
    return pairs, triples, *best_triples(triples, cost, counts)


def _select_moving(
    tables: Sequence[FrameTable], selected: LinkedTriples, frames: _Frames, stands_px: float, log: GateLog
) -> LinkedTriples:
    """Tracklets of vehicles that move, among what those of a window leave: detections and weak candidates.

    ``tables``, of all frames, with the weak candidates. What is about where something is in both other frames stands
    there: it takes no part.
    """
    window = tables[selected.start : selected.start + 3]
    places = [np.column_stack([t.x_px, t.y_px]) for t in window]
    trees = [cKDTree(xy) for xy in places]
    movable = _movable(trees, stands_px)
    rows = [np.setdiff1d(movable[k], selected.detections[:, k]) for k in range(3)]
    left = _Frames([t.take(one) for t, one in zip(window, rows, strict=True)], frames.limits, frames.config)
    _, triples, best, likely = _link_window(0, left)
    found = np.stack([rows[k][triples[:, k]] for k in range(3)], axis=1)
    moved_px = np.hypot(*(places[2][found[:, 2]] - places[0][found[:, 0]]).T)
    score = np.mean([window[k].score[found[:, k]] for k in range(3)], axis=0)
    confidence = _moving_vehicle(score, likely)
    accepted = best & (moved_px > 2 * stands_px) & (confidence >= frames.config.min_confidence)
    accepted &= ~_meet_others(trees, found, stands_px)
    log["moving_candidates"] += int(np.sum(accepted))
    chosen = np.flatnonzero(accepted)[np.argsort(found[accepted, 1], kind="stable")]
    nothing = np.full((len(chosen), 2), np.nan)
    return LinkedTriples(selected.start, found[chosen], nothing, confidence[chosen])


def _movable(trees: Sequence[cKDTree], stands_px: float) -> list[IntArray]:
    """Rows of each of three frames where, in another frame, there is nothing; ``trees`` of the places in each."""
    out = []
    for k, mine in enumerate(trees):
        others = [tree for j, tree in enumerate(trees) if j != k]
        near = [np.isfinite(tree.query(mine.data, distance_upper_bound=stands_px)[0]) for tree in others]
        out.append(np.flatnonzero(~(near[0] & near[1])))
    return out


def _meet_others(trees: Sequence[cKDTree], triples: IntArray, stands_px: float) -> Mask:
    """Whether something else is, in another of the three frames, at one of the places of a triple (n, 3).

    Nothing drives up within two frames to where a vehicle was. A row of like things on a roof, of which each is seen
    now and then, looks like one that moves from place to place.
    """
    taken = np.zeros(len(triples), np.bool_)
    for k in range(3):
        for j in {0, 1, 2} - {k}:
            distance, row = trees[j].query(trees[k].data[triples[:, k]], k=2, distance_upper_bound=stands_px)
            taken |= (np.isfinite(distance) & (row != triples[:, j, None])).any(axis=1)
    return taken


def _moving_vehicle(score: FloatArray, likely: FloatArray) -> FloatArray:
    """Probability (n,) that three candidates which seem to move are on one vehicle, from the mean of their scores and
    the probability that they belong together."""
    odds = logit(np.clip(likely, 1e-9, 1 - 1e-9))
    return np.asarray(expit(_CONSTANT + _OF_SCORE * score + _OF_ODDS * odds))


def _triples(
    first: Appearance | None, last: Appearance | None, before: _FramePair, after: _FramePair, pairs: LinkPairs
) -> tuple[IntArray, FloatArray]:
    """(m, 3) detections and (m,) cost, as of `best_triples`."""
    a = before.links.first[pairs.link_01]
    b = before.links.second[pairs.link_01]
    c = after.links.second[pairs.link_12]
    typical = 0.5 * (before.typical + after.typical)
    cost = (
        pairs.motion_cost
        + before.links.axis_cost[pairs.link_01]
        + after.links.axis_cost[pairs.link_12]
        + appearance_cost(before.differences[pairs.link_01], typical)
        + appearance_cost(after.differences[pairs.link_12], typical)
    )
    likely = cost < MAX_COST  # a triple that two pairs rule out needs no third
    cost[likely] += appearance_cost(appearance_differences(first, last, a[likely], c[likely]), typical)
    return np.stack([a, b, c], axis=1), cost
