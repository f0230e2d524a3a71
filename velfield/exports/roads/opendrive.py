"""The lane graph as OpenDRIVE 1.7: a road a lane, and short connecting roads in junctions where lanes meet or part."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from scipy.interpolate import BPoly

from schemas.arrays import FloatArray, Points
from schemas.export import ExportOptions
from velfield.exports.georeference import Georeference
from velfield.exports.roads.network import RoadLane, RoadNetwork, road_network
from velfield.exports.roads.sumo_network import lane_nodes
from velfield.run.run import Run

FILE_NAME = "roads.xodr"
_CUT_M = 1.0
"""A lane is cut so much short where it is connected: connecting roads have a length."""
_CONNECTING = 100_000
"""Connecting roads are numbered from here."""
_CURVE_M, _PIECES = 4.0, 8
"""A longer connecting road is a curve of so many straight pieces."""


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    return opendrive_xml(road_network(run), Georeference.from_grid(run.grid))


def opendrive_xml(network: RoadNetwork, georeference: Georeference) -> bytes:
    """OpenDRIVE's XML; x to the right of the map and y up, in metres from its lower left corner.

    Where the map has a place, the header's ``userData`` has the corner's longitude and latitude, and the bearing of +y
    in degrees clockwise from north.
    """
    root = ET.Element("OpenDRIVE")
    header = ET.SubElement(root, "header", revMajor="1", revMinor="7", name="velfield", vendor="velfield")
    if georeference.has_crs:
        corner = np.array([[-0.5, georeference.shape[0] - 0.5]])
        longitude, latitude = georeference.to_lonlat(corner)[0]
        bearing_deg = georeference.heading_deg(corner, np.array([[0.0, -1.0]]))[0]
        ET.SubElement(header, "userData", code="origin", value=f"{longitude:.7f} {latitude:.7f}")
        ET.SubElement(header, "userData", code="bearing_of_y_deg", value=f"{bearing_deg:.3f}")
    nodes, lines = lane_nodes(network), {lane.number: _left_border(lane, network) for lane in network.lanes}
    for lane in network.lanes:
        road = _road(root, lane.number, lane.name, lines[lane.number], lane.width_m, lane.high_speed_m_per_s)
        link = ET.Element("link")
        if any(end == lane.number for _, end in network.connections):
            junction = str(nodes[lane.number, "start"] + 1)
            ET.SubElement(link, "predecessor", elementType="junction", elementId=junction)
        if any(start == lane.number for start, _ in network.connections):
            ET.SubElement(link, "successor", elementType="junction", elementId=str(nodes[lane.number, "end"] + 1))
        road.insert(0, link)
    _junctions(root, network, nodes, lines)
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True))


def _junctions(
    root: ET.Element, network: RoadNetwork, nodes: dict[tuple[int, str], int], lines: dict[int, Points]
) -> None:
    lanes = {lane.number: lane for lane in network.lanes}
    junctions: dict[int, ET.Element] = {}
    for k, (start, end) in enumerate(network.connections):
        number = nodes[start, "end"] + 1
        name, before = f"{lanes[start].name} to {lanes[end].name}", lanes[start]
        line = _connecting_line(lines[start], lines[end])
        road = _road(root, _CONNECTING + k, name, line, before.width_m, before.high_speed_m_per_s, junction=number)
        link = ET.Element("link")
        ET.SubElement(link, "predecessor", elementType="road", elementId=str(start), contactPoint="end")
        ET.SubElement(link, "successor", elementType="road", elementId=str(end), contactPoint="start")
        road.insert(0, link)
        lane_link = road.find("lanes/laneSection/right/lane/link")
        assert lane_link is not None
        ET.SubElement(lane_link, "predecessor", id="-1")
        ET.SubElement(lane_link, "successor", id="-1")
        if number not in junctions:
            junctions[number] = ET.Element("junction", id=str(number), name=f"junction{number}")
        connection = ET.SubElement(
            junctions[number],
            "connection",
            id=str(len(junctions[number])),
            incomingRoad=str(start),
            connectingRoad=str(_CONNECTING + k),
            contactPoint="start",
        )
        ET.SubElement(connection, "laneLink", {"from": "-1", "to": "-1"})
    root.extend(junctions.values())


def _left_border(lane: RoadLane, network: RoadNetwork) -> Points:
    """The reference line: half a width to the left of the centre line, cut short where the lane is connected."""
    xy, step = lane.xy_m, np.diff(lane.xy_m, axis=0)
    along = np.concatenate([[0.0], np.hypot(*step.T).cumsum()])
    cut = min(_CUT_M, along[-1] / 4)
    first = cut if any(end == lane.number for _, end in network.connections) else 0.0
    last = along[-1] - (cut if any(start == lane.number for start, _ in network.connections) else 0.0)
    kept = along[(along > first + 0.1) & (along < last - 0.1)]
    at = np.concatenate([[first], kept, [last]])
    line = np.column_stack([np.interp(at, along, xy[:, axis]) for axis in (0, 1)])
    direction = np.gradient(line, axis=0)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    return np.asarray(line + 0.5 * lane.width_m * np.column_stack([-direction[:, 1], direction[:, 0]]))


def _connecting_line(before: Points, after: Points) -> Points:
    """(n, 2) from the end of one line to the start of another: across an intersection a curve along both."""
    a, b = before[-1], after[0]
    length = float(np.hypot(*(b - a)))
    if length < _CURVE_M:
        return np.stack([a, b])
    ways = before[-1] - before[-2], after[1] - after[0]
    u, v = (way / max(float(np.hypot(*way)), 1e-9) * length / 3 for way in ways)
    return np.asarray(BPoly(np.stack([a, a + u, b - v, b])[:, None], [0, 1])(np.linspace(0, 1, _PIECES + 1)))


def _road(
    root: ET.Element, number: int, name: str, line: Points, width_m: float, speed_m_per_s: float, *, junction: int = -1
) -> ET.Element:
    step = np.diff(line, axis=0)
    lengths: FloatArray = np.maximum(np.hypot(*step.T), 1e-3)
    total = f"{lengths.sum():.4f}"
    road = ET.SubElement(root, "road", id=str(number), name=name, length=total, junction=str(junction))
    kind = ET.SubElement(road, "type", s="0", type="town")
    ET.SubElement(kind, "speed", max=f"{speed_m_per_s:.2f}", unit="m/s")
    plan = ET.SubElement(road, "planView")
    for s, (x, y), (dx, dy), length in zip(np.cumsum(lengths) - lengths, line[:-1], step, lengths, strict=True):
        place = {"s": f"{s:.4f}", "x": f"{x:.4f}", "y": f"{y:.4f}", "hdg": f"{np.arctan2(dy, dx):.6f}"}
        ET.SubElement(ET.SubElement(plan, "geometry", {**place, "length": f"{length:.4f}"}), "line")
    section = ET.SubElement(ET.SubElement(road, "lanes"), "laneSection", s="0")
    ET.SubElement(ET.SubElement(section, "center"), "lane", id="0", type="none", level="false")
    lane = ET.SubElement(ET.SubElement(section, "right"), "lane", id="-1", type="driving", level="false")
    ET.SubElement(lane, "link")
    ET.SubElement(lane, "width", sOffset="0", a=f"{width_m:.3f}", b="0", c="0", d="0")
    return road
