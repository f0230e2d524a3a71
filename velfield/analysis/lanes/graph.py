"""Links of nodes into lanes by the tracks that drive along them.

A node's best successor is the node that most of its tracks reach next. Nodes that are each other's best successor and
best predecessor are on one lane. Where tracks leave for, or come from, another lane, the lanes are cut and connected.
A track that changes from the middle of one lane to the middle of another makes no connection: it changes lanes.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd

from schemas.arrays import IntArray, Mask
from velfield.analysis.lanes.ridges import NODE_SPACING_M, Nodes

_MAX_STEP_M = 4 * NODE_SPACING_M
"""Farther nodes are not linked: the track had a gap between them."""
_MIN_FRACTION = 0.01
"""A connection that fewer of the tracks of both its lanes take is an error of tracking."""
_STUB_M = 6.0
"""A lane that ends in no connection after so short a length is an error of tracking."""


@dataclass(frozen=True)
class Links:
    """Numbers of tracks that go from one node to the next: ``start, end, tracks`` (n,)."""

    start: IntArray
    end: IntArray
    tracks: IntArray


@dataclass(frozen=True)
class Chains:
    """Lanes as chains of nodes and their connections."""

    nodes: list[IntArray]
    """Numbers of the nodes of each lane, in the direction of travel."""
    links: list[tuple[int, int, int]]
    """(start lane, end lane, tracks) of each connection."""
    changes: list[tuple[int, int, int]]
    """(lane, lane, tracks) of changes from lane to lane."""


def count_links(track: IntArray, node: IntArray, nodes: Nodes) -> Links:
    """Links of consecutive samples' nodes; samples are in order along each track, ``node`` -1: none."""
    first, second = _moves(track, node)
    # by hashing: there are few pairs of nodes
    number, pairs = pd.factorize(node[first] * np.int64(len(nodes)) + node[second])
    count = count_once(track[first], number, len(pairs))
    order = np.argsort(pairs)
    a, b = np.divmod(np.asarray(pairs, np.int64)[order], len(nodes))
    step = nodes.xy_m[b] - nodes.xy_m[a]
    # where a track leaves a lane, the node that it leaves may be farther along than the one that it goes to
    ways = [of(nodes.direction_rad[a]) + of(nodes.direction_rad[b]) for of in (np.cos, np.sin)]
    ahead = ways[0] * step[:, 0] + ways[1] * step[:, 1]
    ok = (np.hypot(step[:, 0], step[:, 1]) < _MAX_STEP_M) & (ahead > 0)
    return Links(a[ok], b[ok], count[order][ok])


def _moves(track: IntArray, node: IntArray) -> tuple[IntArray, IntArray]:
    """Rows at which a track leaves a node, and at which it is at the next; those without a node are passed over."""
    rows = np.flatnonzero(node >= 0)
    a, b = rows[:-1], rows[1:]
    moves = (track[a] == track[b]) & (node[a] != node[b])
    return a[moves], b[moves]


def count_once(owner: IntArray, number: IntArray, n: int) -> IntArray:
    """Number of owners that have each of n numbers."""
    return np.bincount(pd.unique(owner * np.int64(n) + number) % n, minlength=n)


def link_chains(nodes: Nodes, links: Links) -> list[IntArray]:
    """Numbers of the nodes of each chain of nodes that are each other's best successor and predecessor."""
    return _walk(*_best_links(nodes, links))


def _best_links(nodes: Nodes, links: Links) -> tuple[IntArray, IntArray]:
    """The node after, and before, each node (n,) on its chain; -1: none."""
    follows, precedes = (
        _best(links.start, links.end, links.tracks, len(nodes)),
        _best(links.end, links.start, links.tracks, len(nodes)),
    )
    linked = np.array([follows[i] >= 0 and precedes[follows[i]] == i for i in range(len(nodes))], bool)
    after = np.where(linked, follows, -1)
    before = np.full(len(nodes), -1)
    before[after[linked]] = np.flatnonzero(linked)
    return after, before


def make_chains(nodes: Nodes, links: Links, *, min_tracks: int) -> Chains:
    """Lanes and connections that at least ``min_tracks`` take."""
    after, before = _best_links(nodes, links)
    for _ in range(3):
        chains = _walk(after, before)
        drop = _stubs(chains, nodes, links, min_tracks)
        if not drop.any():
            break
        # what remains is linked again over the nodes left out
        after[drop], before[drop] = -1, -1
        gone = np.isin(after, np.flatnonzero(drop))
        after[gone] = -1
        before[np.isin(before, np.flatnonzero(drop))] = -1
        links = _without(links, drop)
        _relink(after, before, links, min_tracks)
    return _cut(_walk(after, before), nodes, links, after, before, min_tracks)


def _best(key: IntArray, value: IntArray, count: IntArray, n: int) -> IntArray:
    """For each key the value of the largest count, -1: none."""
    order = np.lexsort((value, -count, key))
    keys, first = np.unique(key[order], return_index=True)
    out = np.full(n, -1)
    out[keys] = value[order][first]
    return out


def _walk(after: IntArray, before: IntArray) -> list[IntArray]:
    """Chains of nodes; a ring begins anywhere."""
    seen = np.zeros(len(after), bool)
    chains = []
    for start in [*np.flatnonzero(before < 0), *range(len(after))]:
        if seen[start]:
            continue
        chain, i = [], int(start)
        while i >= 0 and not seen[i]:
            seen[i] = True
            chain.append(i)
            i = int(after[i])
        chains.append(np.array(chain, np.int64))
    return chains


def number_chains(chains: list[IntArray], n: int) -> IntArray:
    """(n + 1,) number of the chain of each of n nodes, -1 if none; the last is of nodes of number -1."""
    out = np.full(n + 1, -1, np.int64)
    for number, chain in enumerate(chains):
        out[chain] = number
    return out


def _stubs(chains: list[IntArray], nodes: Nodes, links: Links, min_tracks: int) -> Mask:
    """Nodes of short chains that lead from nowhere, or to nowhere, or from one chain to the same."""
    chain_of = number_chains(chains, len(nodes))
    entered = _linked(links.end, chain_of[links.start], links.tracks, len(nodes), min_tracks)
    left = _linked(links.start, chain_of[links.end], links.tracks, len(nodes), min_tracks)
    drop = np.zeros(len(nodes), bool)
    for chain in chains:
        length = np.hypot(*np.diff(nodes.xy_m[chain], axis=0).T).sum()
        ways = entered.get(int(chain[0]), set()), left.get(int(chain[-1]), set())
        if length < _STUB_M and (not all(ways) or len(set.union(*ways)) == 1):
            drop[chain] = True
    return drop


def _linked(node: IntArray, chain: IntArray, tracks: IntArray, n: int, min_tracks: int) -> dict[int, set[int]]:
    """Chains with which enough tracks link each node: few may leave a chain at the same one of its nodes."""
    pairs, number = np.unique(chain * np.int64(n) + node, return_inverse=True)
    out: dict[int, set[int]] = {}
    for pair in pairs[np.bincount(number, tracks) >= min_tracks].tolist():
        out.setdefault(pair % n, set()).add(pair // n)
    return out


def _without(links: Links, drop: Mask) -> Links:
    keep = ~drop[links.start] & ~drop[links.end]
    return Links(links.start[keep], links.end[keep], links.tracks[keep])


def _relink(after: IntArray, before: IntArray, links: Links, min_tracks: int) -> None:
    """Link the ends and starts of chains where most tracks go on from the one to the other."""
    order = np.argsort(-links.tracks, kind="stable")
    for k in order:
        a, b = int(links.start[k]), int(links.end[k])
        if links.tracks[k] >= min_tracks and after[a] < 0 and before[b] < 0:
            after[a], before[b] = b, a


def _cut(
    chains: list[IntArray], nodes: Nodes, links: Links, after: IntArray, before: IntArray, min_tracks: int
) -> Chains:
    """Cut the chains where others begin or end at them."""
    position, chain_of = np.empty(len(nodes), np.int64), number_chains(chains, len(nodes))
    for chain in chains:
        position[chain] = np.arange(len(chain))
    joins = _joins(links, after, before, chain_of, position, nodes, min_tracks)
    cut_after = {a for a, _, _ in joins}
    cut_before = {b for _, b, _ in joins}
    lanes: list[IntArray] = []
    found: list[tuple[int, int, int]] = []
    through = {(int(a), int(b)): int(n) for a, b, n in zip(links.start, links.end, links.tracks, strict=True)}
    lane_of = np.full(len(nodes), -1, np.int64)
    for chain in chains:
        pairs = list(pairwise(chain.tolist()))
        borders = [k for k, (a, b) in enumerate(pairs, start=1) if a in cut_after or b in cut_before]
        for part in np.split(chain, borders):
            lane_of[part] = len(lanes)
            lanes.append(part)
        for k in borders:
            a, b = int(chain[k - 1]), int(chain[k])
            found.append((lane_of[a], lane_of[b], through.get((a, b), 0)))
        if len(chain) > 2 and after[chain[-1]] == chain[0]:  # a ring
            a, b = int(chain[-1]), int(chain[0])
            found.append((lane_of[a], lane_of[b], through.get((a, b), 0)))
    found += [(lane_of[a], lane_of[b], n) for a, b, n in joins]
    links_of = {(int(a), int(b)): int(n) for a, b, n in found}
    changes: dict[tuple[int, int], int] = {}
    for a, b, n in zip(lane_of[links.start], lane_of[links.end], links.tracks, strict=True):
        if a != b and (int(a), int(b)) not in links_of:
            changes[int(a), int(b)] = changes.get((int(a), int(b)), 0) + int(n)
    return Chains(lanes, [(a, b, n) for (a, b), n in links_of.items()], [(a, b, n) for (a, b), n in changes.items()])


def _joins(
    links: Links,
    after: IntArray,
    before: IntArray,
    chain_of: IntArray,
    position: IntArray,
    nodes: Nodes,
    min_tracks: int,
) -> list[tuple[int, int, int]]:
    """Links to the start of a chain or from its end: the strongest of each pair of chains, with the tracks of all."""
    between: dict[tuple[int, int, bool], list[tuple[int, int, int]]] = {}
    for a, b, n in zip(links.start.tolist(), links.end.tolist(), links.tracks.tolist(), strict=True):
        if after[a] == b or (after[a] >= 0 and before[b] >= 0):
            continue
        if chain_of[a] == chain_of[b] and position[b] > position[a]:
            continue  # ahead on the same lane
        between.setdefault((int(chain_of[a]), int(chain_of[b]), bool(after[a] < 0)), []).append((n, a, b))
    joins = []
    for found in between.values():
        (_, a, b), total = max(found, key=lambda link: link[0]), sum(n for n, _, _ in found)
        if total >= max(min_tracks, _MIN_FRACTION * min(nodes.weight[a], nodes.weight[b])):
            joins.append((a, b, total))
    return joins
