"""SUMO's network and traffic: nodes, edges and connections for netconvert, routes, counts of edges and turns, as ZIP.

    unzip sumo-network.zip && netconvert -c velfield.netccfg && sumo -c velfield.sumocfg

Each lane is an edge with one lane, of the shape that vehicles drove. SUMO's sampler reads the counts:

    routeSampler.py -r velfield.rou.xml --edgedata-files velfield.edgedata.xml --turn-files velfield.turns.xml
"""

from collections import Counter, defaultdict
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from schemas.arrays import FloatArray
from schemas.export import ExportOptions
from velfield.exports.export import zip_bytes
from velfield.exports.junctions.turning_counts import BIN_S
from velfield.exports.roads.network import RoadNetwork, road_network
from velfield.run.run import Run

FILE_NAME = "sumo-network.zip"
_HEAD = '<?xml version="1.0" encoding="UTF-8"?>'
_NETCONVERT = f"""{_HEAD}
<configuration>
    <input>
        <node-files value="velfield.nod.xml"/>
        <edge-files value="velfield.edg.xml"/>
        <connection-files value="velfield.con.xml"/>
    </input>
    <output><output-file value="velfield.net.xml"/></output>
    <processing><no-turnarounds value="true"/></processing>
</configuration>
"""
_SUMO = """{head}
<configuration>
    <input>
        <net-file value="velfield.net.xml"/>
        <route-files value="velfield.rou.xml"/>
    </input>
    <time><begin value="0"/><end value="{end:.0f}"/></time>
    <processing><time-to-teleport value="120"/></processing>
</configuration>
"""
_END_LATER_S = 300.0
"""Simulated vehicles need longer than the measured ones where they wait for each other."""


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    return sumo_archive(road_network(run))


def sumo_archive(network: RoadNetwork) -> bytes:
    """All files of a network as a ZIP archive."""
    return zip_bytes(
        {
            "velfield.nod.xml": _nodes_xml(network),
            "velfield.edg.xml": _edges_xml(network),
            "velfield.con.xml": _connections_xml(network),
            "velfield.rou.xml": _routes_xml(network),
            "velfield.edgedata.xml": _edge_data_xml(network),
            "velfield.turns.xml": _turns_xml(network),
            "velfield.netccfg": _NETCONVERT,
            "velfield.sumocfg": _SUMO.format(head=_HEAD, end=network.duration_s + _END_LATER_S),
        }
    )


def lane_nodes(network: RoadNetwork) -> dict[tuple[int, str], int]:
    """The node of each lane's ``start`` and ``end``: ends at one intersection, or that are connected, share one."""
    parent = {(lane.number, end): (lane.number, end) for lane in network.lanes for end in ("start", "end")}

    def root(one: tuple[int, str]) -> tuple[int, str]:
        while parent[one] != one:
            one = parent[one]
        return one

    for before, after in network.connections:
        parent[root((after, "start"))] = root((before, "end"))
    at: dict[int, tuple[int, str]] = {}
    for lane in network.lanes:
        for junction, end in ((lane.begins_at, "start"), (lane.ends_at, "end")):
            if junction is not None:
                parent[root((lane.number, end))] = root(at.setdefault(junction, (lane.number, end)))
    numbers = {one: k for k, one in enumerate(sorted({root(one) for one in parent}))}
    return {one: numbers[root(one)] for one in parent}


def _nodes_xml(network: RoadNetwork) -> str:
    places: dict[int, list[FloatArray]] = {}
    nodes = lane_nodes(network)
    for lane in network.lanes:
        places.setdefault(nodes[lane.number, "start"], []).append(lane.xy_m[0])
        places.setdefault(nodes[lane.number, "end"], []).append(lane.xy_m[-1])
    signals = {nodes[lane.number, "start"] for lane in network.lanes if lane.begins_at in network.signalised}
    signals |= {nodes[lane.number, "end"] for lane in network.lanes if lane.ends_at in network.signalised}
    rows = []
    for number, xy in sorted(places.items()):
        x, y = np.mean(xy, axis=0)
        kind = "traffic_light" if number in signals else "priority"
        rows.append(f'<node id="n{number}" x="{x:.2f}" y="{y:.2f}" type="{kind}"/>')
    return _document("nodes", rows)


def _edges_xml(network: RoadNetwork) -> str:
    nodes, rows = lane_nodes(network), []
    for lane in network.lanes:
        shape = " ".join(f"{x:.2f},{y:.2f}" for x, y in lane.xy_m)
        ends = nodes[lane.number, "start"], nodes[lane.number, "end"]
        rows.append(
            f'<edge id="{lane.name}" from="n{ends[0]}" to="n{ends[1]}" numLanes="1" width="{lane.width_m:.2f}" '
            f'speed="{lane.high_speed_m_per_s:.2f}" spreadType="center" shape={quoteattr(shape)}/>'
        )
    return _document("edges", rows)


def _connections_xml(network: RoadNetwork) -> str:
    name = [lane.name for lane in network.lanes]
    rows = [
        f'<connection from="{name[start]}" to="{name[end]}" fromLane="0" toLane="0"/>'
        for start, end in network.connections
    ]
    return _document("connections", rows)


def _routes_xml(network: RoadNetwork) -> str:
    rows, name = ['<vType id="car" vClass="passenger"/>'], [lane.name for lane in network.lanes]
    for trip in network.trips:
        edges = " ".join(name[number] for number in trip.lanes)
        rows.append(
            f'<vehicle id={quoteattr(str(trip.track_id))} type="car" depart="{trip.depart_s:.2f}" departSpeed="max">'
            f'<route edges="{edges}"/></vehicle>'
        )
    return _document("routes", rows)


def _edge_data_xml(network: RoadNetwork) -> str:
    """Space-mean speed and vehicle count of each lane, in SUMO's format of results, to compare and to calibrate.

    As SUMO's own, ``speed`` is the distance driven over the time spent, stops included; it is left out where too few
    vehicles were seen.
    """
    rows = [f'<interval begin="0.00" end="{max(network.duration_s, 0.01):.2f}" id="velfield">']
    rows += [
        f'    <edge id="{lane.name}" '
        + (f'speed="{lane.speed_m_per_s:.2f}" ' if lane.speed_m_per_s is not None else "")
        + f'entered="{lane.vehicles}"/>'
        for lane in network.lanes
    ]
    return _document("meandata", [*rows, "</interval>"])


def _turns_xml(network: RoadNetwork) -> str:
    """Vehicles from lane to lane by 15 minutes of their departure, in SUMO's format of edge relations."""
    name = [lane.name for lane in network.lanes]
    turns: defaultdict[int, Counter[tuple[int, int]]] = defaultdict(Counter)
    for trip in network.trips:
        turns[int(trip.depart_s // BIN_S)].update(pairwise(trip.lanes))
    rows = []
    for k in range(max(int(np.ceil(network.duration_s / BIN_S)), 1)):
        end = min((k + 1) * BIN_S, max(network.duration_s, 0.01))
        rows.append(f'<interval begin="{k * BIN_S:.2f}" end="{end:.2f}" id="velfield">')
        rows += [
            f'    <edgeRelation from="{name[a]}" to="{name[b]}" count="{count}"/>'
            for (a, b), count in sorted(turns[k].items())
        ]
        rows.append("</interval>")
    return _document("data", rows)


def _document(root: str, rows: list[str]) -> str:
    return "\n".join([_HEAD, f"<{root}>", *(f"    {row}" for row in rows), f"</{root}>", ""])
