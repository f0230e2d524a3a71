"""Tracklets: three detections of one car in three consecutive registered frames (paper: tracking).

A window is three consecutive registered frames, each no more than ``max_interval_s`` after the one before; a frame
that is not registered breaks it by the time it costs, not by its place in the row. Nothing is carried from window to
window, so tracklets do not depend on how the flight is cut: whoever cuts it gives each part the frames up to the end
of its last window.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from schemas.arrays import ByteArray, FloatArray, IntArray
from schemas.flight import TrackingConfig
from velfield.errors import InputError
from velfield.tracking.appearance import Looks, faces, look_differences
from velfield.tracking.choice import (
    HOPELESS_COST,
    Triples,
    best_triples,
    looks_cost,
    mutual_best_links,
    usual_difference,
)
from velfield.tracking.gates import LinkPairs, Links, Places, gated_links, gated_pairs
from velfield.tracking.limits import GateLog, Limits
from velfield.tracking.table import Found, tracklet_table
from velfield.tracking.windows import FrameTable, window_frames

__all__ = ["FrameTable", "link_windows", "window_frames"]


@dataclass(frozen=True)
class _Pair:
    """Two consecutive registered frames: their candidate links, and how much alike their detections look.

    ``rejected`` counts links: tried, by speed, by axis, by looks (the paper's mutual best only).
    """

    links: Links
    differences: FloatArray
    usual: float
    rejected: tuple[int, int, int, int]


class _Frames:
    """The registered frames, with what several windows read of them made once and kept while it is needed."""

    def __init__(self, tables: Sequence[FrameTable], limits: Limits, config: TrackingConfig) -> None:
        self.tables = tables
        self.limits = limits
        self.config = config
        self.places: list[Places] = [t.places(limits) for t in tables]
        self._looks: dict[int, Looks] = {}
        self._pairs: dict[int, _Pair] = {}

    def joined(self, i: int) -> bool:
        """Whether frame i and the next may stand in one window. An interval of zero has no velocity."""
        return 0.0 < self.tables[i + 1].time_s - self.tables[i].time_s <= self.limits.max_interval_s

    def looks(self, i: int) -> Looks:
        """What the detections of frame i look like; the paper's way knows the patches only."""
        if i not in self._looks:
            table = self.tables[i]
            crops = None if self.config.linking == "links" else table.chips
            prepared = None if crops is None else faces(crops, self.places[i].axis_rad)
            self._looks[i] = Looks(table.patches, prepared)
        return self._looks[i]

    def pair(self, i: int) -> _Pair:
        """Candidate links from frame i to the next."""
        if i not in self._pairs:
            links = gated_links(self.places[i], self.places[i + 1], self.limits)
            differences = look_differences(self.looks(i), self.looks(i + 1), links.first, links.second)
            pair = _Pair(links, differences, usual_difference(differences, links.first), (*links.rejected, 0))
            self._pairs[i] = _only_mutual(pair) if self.config.linking == "links" else pair
        return self._pairs[i]

    def forget(self, i: int) -> None:
        """Frame i is done with."""
        self._looks.pop(i, None)
        self._pairs.pop(i, None)


def _only_mutual(pair: _Pair) -> _Pair:
    """The paper's links: each frame to frame the mutual best."""
    links = pair.links
    keep = mutual_best_links(pair.differences, links.first, links.second)
    kept = Links(links.first[keep], links.second[keep], links.axis_cost[keep], links.interval_s, links.rejected)
    return _Pair(kept, pair.differences[keep], pair.usual, (*links.rejected, int(np.sum(~keep))))


def link_windows(
    tables: Sequence[FrameTable], config: TrackingConfig, *, gsd_m: float | None, starts: range
) -> tuple[pd.DataFrame, GateLog]:
    """Tracklets of every window that starts in ``starts``.

    Parameters
    ----------
    tables
        Frames in time order, registered or not; at least those of `window_frames`.
    config
        Limits and choices of tracking.
    gsd_m
        Metres a base pixel; none: limits are the paper's in pixels.
    starts
        Frames (their ``frame``) at which a window may start.

    Returns
    -------
    DataFrame, GateLog
        Columns of `schemas.tables.TRACKLET_COLUMNS` sorted by frame, ``passage_id`` still -1; and the counts by gate,
        which add up over the parts of a flight.

    Raises
    ------
    InputError
        Where the frames are not in time order.
    """
    _check_order(tables)
    limits = Limits.of(config, gsd_m)
    log = GateLog()
    log.add("frames_not_registered", sum(not t.registered and t.frame in starts for t in tables))
    good = _Frames([t for t in tables if t.registered], limits, config)
    found: list[Found] = []
    for i, table in enumerate(good.tables[:-1]):
        if table.frame not in starts:
            continue
        if not good.joined(i):
            log.add("gaps_too_long", 1)
            continue
        pair = good.pair(i)
        for gate, count in zip(("links_tried", "speed", "axis", "appearance"), pair.rejected, strict=True):
            log.add(gate, count)
        if i + 2 < len(good.tables) and good.joined(i + 1):
            found.append(_choose(i, good, config.min_confidence, log))
        good.forget(i)
    rows, refined = tracklet_table(good.tables, found, limits, refine=config.refine)
    log.add("links_refined", refined)
    log.add("links_not_refined", 2 * len(rows) - refined)
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


def _choose(start: int, frames: _Frames, min_confidence: float, log: GateLog) -> Found:
    """Gated pairs of links of the window that starts at ``start``, and of them those that are believed."""
    before, after = frames.pair(start), frames.pair(start + 1)
    places = (frames.places[start], frames.places[start + 1], frames.places[start + 2])
    pairs = gated_pairs(places, before.links, after.links, frames.limits)
    log.add("windows", 1)
    for gate, count in zip(("pairs_tried", "turn", "acceleration"), pairs.rejected, strict=True):
        log.add(gate, count)
    triples = _triples(frames.looks(start), frames.looks(start + 2), before, after, pairs)
    counts = (places[0].x_px.size, places[1].x_px.size, places[2].x_px.size)
    best, confidence = best_triples(triples, counts)
    sure = best & (confidence >= min_confidence)
    log.add("not_best", int(np.sum(~best)))
    log.add("confidence", int(np.sum(best & ~sure)))
    log.add("tracklets", int(np.sum(sure)))
    chosen = np.flatnonzero(sure)[np.argsort(triples.detections[sure, 1], kind="stable")]
    picked = triples.detections[chosen]
    patches = [frames.tables[start + k].patches for k in range(3)]
    differences = [_patch_differences(patches[k], patches[k + 1], picked[:, k], picked[:, k + 1]) for k in (0, 1)]
    return Found(start, picked, np.stack(differences, axis=1), confidence[chosen])


def _patch_differences(
    before: ByteArray | None, after: ByteArray | None, first: IntArray, second: IntArray
) -> FloatArray:
    return look_differences(Looks(before, None), Looks(after, None), first, second)


def _triples(first: Looks, last: Looks, before: _Pair, after: _Pair, pairs: LinkPairs) -> Triples:
    a = before.links.first[pairs.link_01]
    b = before.links.second[pairs.link_01]
    c = after.links.second[pairs.link_12]
    usual = 0.5 * (before.usual + after.usual)
    cost = (
        pairs.motion_cost
        + before.links.axis_cost[pairs.link_01]
        + after.links.axis_cost[pairs.link_12]
        + looks_cost(before.differences[pairs.link_01], usual)
        + looks_cost(after.differences[pairs.link_12], usual)
    )
    likely = cost < HOPELESS_COST  # what two pairs of looks rule out needs no third
    cost[likely] += looks_cost(look_differences(first, last, a[likely], c[likely]), usual)
    return Triples(np.stack([a, b, c], axis=1), cost)
