"""`find_lanes`: the lane graph of a flight's tracks."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.spatial import cKDTree

from schemas.analysis import Turn, WidthSource
from schemas.arrays import FloatArray, IntArray
from velfield.analysis.lanes.graph import Chains, count_links, link_chains, make_chains, number_chains
from velfield.analysis.lanes.junctions import find_junctions
from velfield.analysis.lanes.model import LANE_MAX_M, Connection, Lane, LaneGraph, LaneSamples
from velfield.analysis.lanes.ridges import Nodes, bin_keys, bin_samples, find_nodes
from velfield.analysis.lanes.turns import add_turns
from velfield.analysis.trajectories import VEHICLE_WIDTH_M, PathSamples, Trajectories, group_rows, sample_paths
from velfield.compiled import kernel

MIN_TRACKS = 3
"""A lane, or a connection, that fewer tracks drove is not one: an error of tracking or of a driver."""
_LANE_MIN_M = 2.2
"""Neighbouring lanes of one carriageway are at least so far apart."""
_MARGIN_M = 0.6
"""To either side of a car, where a lane's width is taken from the spread of paths."""
_TURN_RAD, _U_TURN_RAD = np.radians(40), np.radians(150)
_LOOK_M = 12.0
"""A turn is the change of direction from so far before a connection to so far after it."""
_MIN_LENGTH_M = 8.0
"""A track shorter than this drives on no lane."""
_THREADS = 2


def find_lanes(
    trajectories: Trajectories, *, min_tracks: int = MIN_TRACKS, samples: PathSamples | None = None
) -> LaneGraph:
    """The lane graph of the tracks.

    Parameters
    ----------
    trajectories
        Tracks of moving vehicles.
    min_tracks
        Fewest tracks of a lane and of a connection.
    samples
        `sample_paths` of the tracks, where they are known already.
    """
    samples = _long_enough(sample_paths(trajectories) if samples is None else samples)
    if not len(samples):
        return LaneGraph((), (), (), _no_samples())
    keys = bin_keys(samples.xy_m, samples.direction_rad)
    bins, bin_of = bin_samples(samples, keys)
    nodes = find_nodes(bins, min_weight=float(min_tracks), position_sd_m=trajectories.position_sd_m)
    node = nodes.of_bin[bin_of]
    ridges = link_chains(nodes, count_links(samples.track, node, nodes))
    nodes, node = add_turns(nodes, node, samples, ridges, min_tracks=min_tracks)
    chains = make_chains(nodes, count_links(samples.track, node, nodes), min_tracks=min_tracks)
    chains = _drop_rare(chains, samples.track, node, len(nodes), min_tracks)
    if not chains.nodes:
        return LaneGraph((), (), (), _no_samples())
    centre_lines = _centre_lines(chains, nodes)
    on_lanes = _place(samples, node, chains, len(nodes), centre_lines)
    lanes = _lanes(centre_lines, on_lanes)
    connections = _connections(chains, centre_lines)
    return LaneGraph(lanes, connections, find_junctions(lanes, connections), on_lanes)


def _long_enough(samples: PathSamples) -> PathSamples:
    if not len(samples):
        return samples
    count = np.bincount(samples.track)
    keep = count[samples.track] >= _MIN_LENGTH_M
    if keep.all():
        return samples
    return PathSamples(
        *(np.compress(keep, getattr(samples, name), axis=0) for name in PathSamples.__dataclass_fields__)
    )


def _no_samples() -> LaneSamples:
    none, number = np.empty(0), np.empty(0, np.int64)
    return LaneSamples(number, number, none, none, none, none)


def _drop_rare(chains: Chains, track: IntArray, node: IntArray, n: int, min_tracks: int) -> Chains:
    """Without the lanes of a single node or of too few tracks, which nothing connects."""
    lane_of = number_chains(chains.nodes, n)
    tracks = _tracks_on(track, np.where(node >= 0, lane_of[node], -1), len(chains.nodes))
    linked = {i for a, b, _ in chains.links for i in (a, b)}
    keep = [k for k, c in enumerate(chains.nodes) if tracks[k] >= min_tracks and (len(c) > 2 or k in linked)]
    number = {k: i for i, k in enumerate(keep)}
    links, changes = (
        [(number[a], number[b], n) for a, b, n in pairs if a in number and b in number]
        for pairs in (chains.links, chains.changes)
    )
    return Chains([chains.nodes[k] for k in keep], links, changes)


def _tracks_on(track: IntArray, lane: IntArray, n: int) -> IntArray:
    """Number of tracks on each of n lanes, from samples along the tracks; lane -1: none."""
    # a track is on a lane for many samples: first those at which it comes there, then each once
    comes = np.flatnonzero((lane >= 0) & np.r_[True, (np.diff(lane) != 0) | (np.diff(track) != 0)])
    return np.bincount(np.unique(track[comes] * np.int64(n) + lane[comes]) % n, minlength=n)


def _centre_lines(chains: Chains, nodes: Nodes) -> list[FloatArray]:
    """Points of each lane, from the last of its strongest predecessor to its own last."""
    before: dict[int, tuple[int, int]] = {}
    for a, b, n in chains.links:
        if n >= before.get(b, (0, -1))[1]:
            before[b] = (a, n)
    lines = []
    for lane, chain in enumerate(chains.nodes):
        head = [chains.nodes[before[lane][0]][-1]] if lane in before else []
        xy = nodes.xy_m[np.r_[np.array(head, np.int64), chain]]
        lines.append(_smooth(xy) if len(xy) > 1 else _short_line(nodes, int(chain[0])))
    return lines


def _short_line(nodes: Nodes, node: int) -> FloatArray:
    u = np.array([np.cos(nodes.direction_rad[node]), np.sin(nodes.direction_rad[node])])
    return np.asarray(nodes.xy_m[node] + np.array([[-1.0], [1.0]]) * u)


def _smooth(xy: FloatArray) -> FloatArray:
    """Mean of each point and the middle of its neighbours: node spacing leaves a jitter that lanes do not have."""
    if len(xy) < 4:
        return xy
    out = xy.copy()
    out[1:-1] = 0.5 * xy[1:-1] + 0.25 * (xy[:-2] + xy[2:])
    return out


def _place(samples: PathSamples, node: IntArray, chains: Chains, n: int, lines: list[FloatArray]) -> LaneSamples:
    """Samples on their lanes, each projected onto the piece of the centre line that is nearest."""
    lane = np.where(node >= 0, number_chains(chains.nodes, n)[node], -1)
    keep = lane >= 0
    lane, xy = lane[keep], samples.xy_m[keep]
    along, offset = np.empty(len(lane)), np.empty(len(lane))
    points, border = np.concatenate(lines), np.r_[0, np.cumsum([len(line) for line in lines])].astype(np.int64)

    def fill(rows: slice) -> None:
        _project(xy[rows], lane[rows], points, border, along[rows], offset[rows])

    half = len(lane) // 2
    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(fill, (slice(half), slice(half, None))))
    return LaneSamples(samples.track[keep], lane, along, offset, samples.time_s[keep], samples.speed_m_per_s[keep])


def project(xy_m: FloatArray, line_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance (n,) along a line of points (k, 2), and to its right, of positions (n, 2)."""
    along, offset = np.empty(len(xy_m)), np.empty(len(xy_m))
    border = np.array([0, len(line_m)], np.int64)
    _project(xy_m, np.zeros(len(xy_m), np.int64), line_m, border, along, offset)
    return along, offset


@kernel
def _project(
    xy: FloatArray, line: IntArray, points: FloatArray, border: IntArray, out_along: FloatArray, out_offset: FloatArray
) -> None:
    """Positions onto the nearer of the two pieces whose middles are nearest, of the line of each.

    Line k has the points ``border[k]:border[k + 1]``, some hundred: trying them all takes less time than a tree.
    """
    begin = np.zeros(len(points))
    for k in range(len(border) - 1):
        for j in range(border[k] + 1, border[k + 1]):
            length = np.hypot(points[j, 0] - points[j - 1, 0], points[j, 1] - points[j - 1, 1])
            begin[j] = begin[j - 1] + max(length, 1e-9)
    for i in range(len(xy)):
        x, y = xy[i, 0], xy[i, 1]
        near = second = -1
        least = less = np.inf
        for j in range(border[line[i]], border[line[i] + 1] - 1):
            dx, dy = x - (points[j + 1, 0] + points[j, 0]) / 2, y - (points[j + 1, 1] + points[j, 1]) / 2
            d = dx * dx + dy * dy
            if d < least:
                near, second, least, less = j, near, d, least
            elif d < less:
                second, less = j, d
        best = np.inf
        out_along[i], out_offset[i] = 0.0, np.inf
        for j in (near, second):
            if j < 0:
                continue
            ux, uy = points[j + 1, 0] - points[j, 0], points[j + 1, 1] - points[j, 1]
            length = max(np.hypot(ux, uy), 1e-9)
            ux, uy = ux / length, uy / length
            dx, dy = x - points[j, 0], y - points[j, 1]
            s = min(max(dx * ux + dy * uy, 0.0), length)
            miss = np.hypot(dx - s * ux, dy - s * uy)
            if miss < best - 1e-9:
                best = miss
                out_along[i], out_offset[i] = begin[j] + s, np.copysign(miss, ux * dy - uy * dx)


def _lanes(lines: list[FloatArray], on_lanes: LaneSamples) -> tuple[Lane, ...]:
    tracks = _tracks_on(on_lanes.track, on_lanes.lane, len(lines))
    gaps = _neighbours(lines)
    order, borders = group_rows(on_lanes.lane, len(lines))
    out = []
    for k, line in enumerate(lines):
        left, right = gaps.get((k, -1)), gaps.get((k, 1))
        near = [gap for gap in (left, right) if gap]
        source: WidthSource = "neighbour" if near else "spread"
        if near:
            width = float(np.mean([gap for _, gap in near]))
        else:
            offsets = on_lanes.offset_m[order[borders[k] : borders[k + 1]]]
            spread = float(np.subtract(*np.quantile(offsets, [0.95, 0.05]))) if len(offsets) else 0.0
            width = float(np.clip(spread + VEHICLE_WIDTH_M + 2 * _MARGIN_M, 2.5, 5.5))
        out.append(Lane(k, line, int(tracks[k]), width, source, left[0] if left else None, right[0] if right else None))
    return tuple(out)


def _neighbours(lines: list[FloatArray]) -> dict[tuple[int, int], tuple[int, float]]:
    """For lane and side (-1 left, 1 right): the lane of the same direction that most of it runs beside, and how far."""
    points = np.concatenate(lines)
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    direction = np.concatenate([np.arctan2(*np.gradient(line, axis=0).T[::-1]) for line in lines])
    pairs = cKDTree(points).query_pairs(LANE_MAX_M, output_type="ndarray")
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = pairs[owner[pairs[:, 0]] != owner[pairs[:, 1]]]
    a, b = pairs.T
    d = points[b] - points[a]
    c, s = np.cos(direction[a]), np.sin(direction[a])
    along, across = d[:, 0] * c + d[:, 1] * s, d[:, 1] * c - d[:, 0] * s
    same = np.cos(direction[a] - direction[b]) > np.cos(np.radians(15))
    ok = same & (np.abs(along) < 2.0) & (np.abs(across) > _LANE_MIN_M)
    found: dict[tuple[int, int], dict[int, list[float]]] = {}
    for i, j, gap in zip(owner[a[ok]].tolist(), owner[b[ok]].tolist(), across[ok].tolist(), strict=True):
        found.setdefault((i, 1 if gap > 0 else -1), {}).setdefault(j, []).append(abs(gap))
    out = {}
    for (lane, side), gaps in found.items():
        other, values = max(gaps.items(), key=lambda item: len(item[1]))
        if len(values) >= 0.4 * len(lines[lane]):
            out[lane, side] = (other, float(np.median(values)))
    return out


def _connections(chains: Chains, lines: list[FloatArray]) -> tuple[Connection, ...]:
    leaving: dict[int, int] = {}
    for a, _, n in chains.links:
        leaving[a] = leaving.get(a, 0) + n
    return tuple(
        Connection(a, b, n, n / max(leaving[a], 1), _turn(lines[a], lines[b])) for a, b, n in sorted(chains.links)
    )


def _turn(a: FloatArray, b: FloatArray) -> Turn:
    change = float(np.angle(np.exp(1j * (_heading(b, 0, 1) - _heading(a, -1, -1)))))
    if abs(change) > _U_TURN_RAD:
        return "u-turn"
    if abs(change) < _TURN_RAD:
        return "straight"
    return "right" if change > 0 else "left"


def _heading(line: FloatArray, at: int, side: int) -> float:
    """Direction of a line ``_LOOK_M`` from its end (``at`` -1) or its start (0), or at its other end if shorter."""
    points = line if side > 0 else line[::-1]
    along = np.concatenate([[0.0], np.hypot(*np.diff(points, axis=0).T).cumsum()])
    k = min(int(np.searchsorted(along, _LOOK_M)), len(points) - 1)
    k = max(k, 1)
    step = (points[k] - points[k - 1]) * side
    return float(np.arctan2(step[1], step[0]))
