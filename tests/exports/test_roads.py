"""Lanes and trajectories for other programs, each read back by its own: SUMO, OpenDRIVE's reader, pandas."""

import os
import shutil
import subprocess
import xml.etree.ElementTree as ET
import zipfile
from collections import Counter
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from schemas.tables import DIMENSION_COLUMNS
from tests.analysis.test_lanes import AVENUE, BESIDE, GSD_M, LEAVES, OPPOSITE, driven
from tests.exports.test_exports import UTM
from tests.field_runs import field_run, tracklets_along
from tests.pipeline.test_given_tracks import process
from tests.turning_crossroads import EASTWARDS, NORTHWARDS, RIGHT, write_tracks
from velfield.analysis.lanes.model import Connection, Lane, LaneGraph, LaneSamples
from velfield.exports.export import export_run
from velfield.exports.roads.network import RoadLane, RoadNetwork, road_network
from velfield.exports.roads.parts import cut_at_intersections
from velfield.run.run import Run, open_run
from velfield.run.tables import write_table

SHAPE = (400, 640)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """An avenue of two lanes, one that comes the other way, and a street that leaves."""
    rng = np.random.default_rng(5)
    paths = [driven(path) for path in [AVENUE] * 8 + [BESIDE] * 8 + [OPPOSITE] * 8 + [LEAVES] * 5]
    noisy = [path + rng.normal(0, 0.2 / GSD_M, (1, 2)) + rng.normal(0, 0.05 / GSD_M, path.shape) for path in paths]
    return field_run(tmp_path_factory.mktemp("roads") / "run", tracklets_along(noisy), shape=SHAPE, gsd_m=GSD_M)


@pytest.fixture(scope="module")
def network(run: Run) -> RoadNetwork:
    return road_network(run)


def sumo_tool(name: str) -> str:
    """Path of a program of SUMO's; skips the test where it is not installed, in CI it fails."""
    home = os.environ.get("SUMO_HOME")
    found = shutil.which(name) or shutil.which(name, path=str(Path(home) / "bin") if home else None)
    if found is None:
        leave = pytest.fail if os.environ.get("VELFIELD_CI") else pytest.skip
        leave(f"{name} is not installed (pip install eclipse-sumo)")
    return found


def test_trips_follow_connections(network: RoadNetwork) -> None:
    assert len(network.trips) == 29
    for trip in network.trips:
        assert set(zip(trip.lanes[:-1], trip.lanes[1:], strict=True)) <= set(network.connections)
    turning = [trip for trip in network.trips if len(trip.lanes) == 2]
    assert len(turning) == 13  # along the lane that the street leaves: 8 straight on, 5 into it
    speeds = [lane.speed_m_per_s for lane in network.lanes]
    assert speeds == pytest.approx([10.0] * len(speeds), abs=0.5)
    assert all(lane.xy_m[:, 1].min() >= 0 and lane.xy_m[:, 1].max() <= SHAPE[0] * GSD_M for lane in network.lanes)


def test_the_network_is_whole(run: Run, network: RoadNetwork, tmp_path: Path) -> None:
    unpack(run, tmp_path)
    edges = {edge.get("id"): edge for edge in ET.parse(tmp_path / "velfield.edg.xml").getroot()}
    nodes = {node.get("id") for node in ET.parse(tmp_path / "velfield.nod.xml").getroot()}
    assert len(edges) == len(network.lanes)
    assert all({edge.get("from"), edge.get("to")} <= nodes for edge in edges.values())
    for connection in ET.parse(tmp_path / "velfield.con.xml").getroot():
        assert edges[connection.get("from")].get("to") == edges[connection.get("to")].get("from")
    measured = ET.parse(tmp_path / "velfield.edgedata.xml").getroot().find("interval")
    assert measured is not None
    assert {edge.get("id") for edge in measured} == set(edges)


def test_sumolib_reads_the_turn_counts_as_its_route_sampler_does(
    run: Run, network: RoadNetwork, tmp_path: Path
) -> None:
    unpack(run, tmp_path)
    intervals = import_module("sumolib").xml.parse(str(tmp_path / "velfield.turns.xml"), "interval", heterogeneous=True)
    counted = {(turn.attr_from, turn.to): int(turn.count) for one in intervals for turn in one.edgeRelation}
    driven = Counter((f"lane{a}", f"lane{b}") for trip in network.trips for a, b in pairwise(trip.lanes))
    assert counted == driven
    assert sorted(counted.values()) == [5, 8]


def unpack(run: Run, folder: Path) -> None:
    with zipfile.ZipFile(export_run(run, "sumo_network", folder / "x.zip")) as archive:
        archive.extractall(folder)


def test_sumo_builds_the_network_and_drives_all_vehicles(run: Run, network: RoadNetwork, tmp_path: Path) -> None:
    netconvert, sumo = sumo_tool("netconvert"), sumo_tool("sumo")
    unpack(run, tmp_path)
    subprocess.run([netconvert, "-c", "velfield.netccfg"], cwd=tmp_path, check=True, capture_output=True, timeout=120)
    options = ["--tripinfo-output", "trips.xml", "--no-step-log", "--random", "false"]
    done = subprocess.run(
        [sumo, "-c", "velfield.sumocfg", *options],
        cwd=tmp_path,
        check=True,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "Error" not in done.stderr
    trips = ET.parse(tmp_path / "trips.xml").getroot()
    assert {trip.get("id") for trip in trips} == {str(trip.track_id) for trip in network.trips}


def test_sumolib_reads_the_built_network(run: Run, network: RoadNetwork, tmp_path: Path) -> None:
    sumolib = pytest.importorskip("sumolib")
    netconvert = sumo_tool("netconvert")
    unpack(run, tmp_path)
    subprocess.run([netconvert, "-c", "velfield.netccfg"], cwd=tmp_path, check=True, capture_output=True, timeout=120)
    net = sumolib.net.readNet(str(tmp_path / "velfield.net.xml"))
    assert {edge.getID() for edge in net.getEdges()} == {f"lane{lane.number}" for lane in network.lanes}


def test_opendrive_has_a_road_a_lane_and_its_connections(run: Run, network: RoadNetwork, tmp_path: Path) -> None:
    root = ET.parse(export_run(run, "opendrive", tmp_path / "x.xodr")).getroot()
    roads = {road.get("id"): road for road in root.findall("road")}
    assert len(roads) == len(network.lanes) + len(network.connections)
    for lane in network.lanes:
        geometry = roads[str(lane.number)].findall("planView/geometry")
        total = sum(float(one.get("length", "nan")) for one in geometry)
        assert total == pytest.approx(float(roads[str(lane.number)].get("length", "nan")), abs=1e-3)
        first = np.array([float(geometry[0].get(name, "nan")) for name in "xy"])
        assert np.linalg.norm(first - lane.xy_m[0]) < lane.width_m / 2 + 1.1
    links = [(one.get("incomingRoad"), one.get("connectingRoad")) for one in root.findall("junction/connection")]
    assert sorted(int(start or -1) for start, _ in links) == sorted(start for start, _ in network.connections)
    assert all(road in roads for _, road in links)


def test_netconvert_reads_opendrive(run: Run, network: RoadNetwork, tmp_path: Path) -> None:
    netconvert = sumo_tool("netconvert")
    path = export_run(run, "opendrive", tmp_path / "x.xodr")
    command = [netconvert, "--opendrive-files", str(path), "-o", str(tmp_path / "x.net.xml")]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    edges = ET.parse(tmp_path / "x.net.xml").getroot().findall("edge")
    own = [edge for edge in edges if edge.get("function") != "internal"]
    assert len(own) == len(network.lanes)


def test_tables_of_trajectories(run: Run, tmp_path: Path) -> None:
    table = pd.read_parquet(export_run(run, "trajectories", tmp_path / "x.parquet"))
    as_text = pd.read_csv(export_run(run, "trajectories", tmp_path / "x.csv"))
    assert as_text.columns.tolist() == table.columns.tolist()
    np.testing.assert_allclose(as_text[["time_s", "x_m", "y_m"]], table[["time_s", "x_m", "y_m"]])
    assert table["track_id"].nunique() == 29
    assert table["speed_m_per_s"].median() == pytest.approx(10.0, abs=0.3)
    assert set(table["lane"]) == {-1, *range(5)} or set(table["lane"]) == set(range(5))
    highd = pd.read_csv(export_run(run, "highd", tmp_path / "x.csv"))
    assert list(highd)[:8] == ["frame", "id", "x", "y", "width", "height", "xVelocity", "yVelocity"]
    assert np.allclose(highd["x"] + highd["width"] / 2, table["x_m"], atol=2e-3)
    assert highd["width"].max() <= np.hypot(4.5, 1.8) + 1e-3
    eastwards = highd[highd["yVelocity"].abs() < 0.2]
    assert np.allclose(eastwards["height"], 1.8, atol=0.2)


def test_a_measured_vehicle_has_its_own_box_and_class(run: Run, tmp_path: Path) -> None:
    lorry, *others = run.analysis.trajectories.track_id.tolist()
    sizes = {"length_px": 11.0, "length_sd_px": 0.3, "width_px": 2.5, "width_sd_px": 0.1}
    row = {"track_id": lorry, **{name: size / GSD_M for name, size in sizes.items()}, "strips": 16}
    write_table(run.layout.dimensions, pd.DataFrame([row]), DIMENSION_COLUMNS)
    measured = open_run(run.layout.root)
    try:
        table = pd.read_parquet(export_run(measured, "trajectories", tmp_path / "x.parquet"))
        highd = pd.read_csv(export_run(measured, "highd", tmp_path / "x.csv"))
    finally:
        run.layout.dimensions.unlink()
    own = table[table["track_id"] == lorry]
    assert own["length_m"].to_numpy() == pytest.approx(11.0, abs=1e-3)
    assert set(own["vehicle_class"]) == {"lorry or bus"}
    assert own["class_probability"].min() > 0.9
    assert table.loc[table["track_id"].isin(others), ["length_m", "vehicle_class"]].isna().all(axis=None)
    long = np.hypot(highd["width"], highd["height"]) > 9
    assert long.tolist() == (table["track_id"] == lorry).tolist()


def test_a_table_with_a_reference_system_has_coordinates(run: Run) -> None:
    from velfield.exports.tracks.table import trajectory_table

    affine = (GSD_M, 0.0, 700_000.0, 0.0, -GSD_M, 3_500_000.0)
    placed = Run(run.layout, run.record)
    placed.__dict__["grid"] = run.grid.model_copy(update={"crs_wkt": UTM.to_wkt(), "affine": affine})
    table = trajectory_table(placed)
    assert table["latitude_deg"].between(31, 32).all()
    assert table["longitude_deg"].between(35, 36).all()


@pytest.fixture(scope="module")
def crossroads_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    root = tmp_path_factory.mktemp("crossroads")
    write_tracks(root / "tracks.csv")
    return process(root / "tracks.csv", root / "run", position_y_axis="down")


def by_way(network: RoadNetwork) -> dict[str, RoadLane]:
    """The lanes by the way that they lead, from the crossroads or to them."""
    out = {}
    for lane in network.lanes:
        x, y = lane.xy_m[-1] - lane.xy_m[0]
        way = "N" if y > abs(x) else "E" if x > abs(y) else "S"
        out[("from " if lane.begins_at is not None else "to ") + way] = lane
    return out


def test_traffic_that_goes_straight_on_meets_at_a_node_and_is_counted(crossroads_run: Run, tmp_path: Path) -> None:
    network = road_network(crossroads_run)
    assert len(network.lanes) == 5
    lanes = by_way(network)
    assert set(lanes) == {"to N", "from N", "to E", "from E", "from S"}
    unpack(crossroads_run, tmp_path)
    edges = {edge.get("id"): edge for edge in ET.parse(tmp_path / "velfield.edg.xml").getroot()}
    assert len({edges[lanes[f"to {way}"].name].get("to") for way in "NE"}) == 1
    assert len({edges[lanes[one].name].get("to" if one.startswith("to") else "from") for one in lanes}) == 1
    kinds = {node.get("id"): node.get("type") for node in ET.parse(tmp_path / "velfield.nod.xml").getroot()}
    met = edges[lanes["to N"].name].get("to")
    assert {node for node, kind in kinds.items() if kind == "traffic_light"} == {met}
    turns = {
        (turn.get("from"), turn.get("to")): int(turn.get("count", ""))
        for turn in ET.parse(tmp_path / "velfield.turns.xml").getroot().iter("edgeRelation")
    }
    assert turns == {
        (lanes["to N"].name, lanes["from N"].name): NORTHWARDS,
        (lanes["to E"].name, lanes["from E"].name): EASTWARDS,
        (lanes["to E"].name, lanes["from S"].name): RIGHT,
    }


def test_the_speed_of_an_edge_is_the_distance_driven_over_the_time_spent(crossroads_run: Run) -> None:
    """Stops are in it, as in SUMO's own results; the mean of the speeds along the lane is higher."""
    tracks, height_m = crossroads_run.analysis.trajectories, crossroads_run.grid.height_px * crossroads_run.gsd_m
    for lane in road_network(crossroads_run).lanes:
        axis = int(abs(np.ptp(lane.xy_m[:, 1])) > abs(np.ptp(lane.xy_m[:, 0])))
        begin, end = lane.xy_m[0, axis], lane.xy_m[-1, axis]
        spent = []
        for rows in tracks:
            xy, time = tracks.xy_m[rows] * [1, -1] + [0, height_m], tracks.time_s[rows]
            beside = np.abs(np.interp(xy[:, axis], *sorted_line(lane, axis)) - xy[:, 1 - axis]) < 2
            s = (xy[beside, axis] - begin) / (end - begin)
            if beside.any() and s.min() < 0.05 and s.max() > 0.95:
                spent.append(np.ptp(np.interp([0.05, 0.95], np.maximum.accumulate(s), time[beside])))
        assert lane.speed_m_per_s == pytest.approx(0.9 * abs(end - begin) / np.mean(spent), rel=0.08)
        assert lane.vehicles == pytest.approx(len(spent), abs=1)


def sorted_line(lane: RoadLane, axis: int) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(lane.xy_m[:, axis])
    return lane.xy_m[order, axis], lane.xy_m[order, 1 - axis]


def test_sumo_knows_that_ways_cross_and_drives_all_vehicles(crossroads_run: Run, tmp_path: Path) -> None:
    netconvert, sumo = sumo_tool("netconvert"), sumo_tool("sumo")
    unpack(crossroads_run, tmp_path)
    subprocess.run([netconvert, "-c", "velfield.netccfg"], cwd=tmp_path, check=True, capture_output=True, timeout=120)
    requests = ET.parse(tmp_path / "velfield.net.xml").getroot().findall("junction/request")
    assert sorted(one.get("foes") for one in requests) == ["001", "001", "110"]  # one way crosses two others
    command = [sumo, "-c", "velfield.sumocfg", "--tripinfo-output", "trips.xml", "--no-step-log"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, timeout=120)
    assert len(ET.parse(tmp_path / "trips.xml").getroot().findall("tripinfo")) == NORTHWARDS + EASTWARDS + RIGHT
    path = export_run(crossroads_run, "opendrive", tmp_path / "x.xodr")
    command = [netconvert, "--opendrive-files", str(path), "-o", str(tmp_path / "x.net.xml")]
    subprocess.run(command, check=True, capture_output=True, timeout=120)


def test_lanes_are_cut_at_intersections_and_those_within_have_no_part() -> None:
    """Lane 0 runs through two squares, lane 1 ends in the first, lane 2 lies in it, lane 3 leads out of it."""
    square = np.array([[-5.0, -5.0], [5.0, -5.0], [5.0, 5.0], [-5.0, 5.0]])
    lines = [
        np.column_stack([np.arange(-40.0, 101, 2), np.zeros(71)]),
        np.column_stack([np.zeros(21), np.arange(-40.0, 1, 2)]),
        np.array([[0.0, 0.0], [1.0, 1.0]]),
        np.column_stack([np.ones(20), np.arange(1.0, 41, 2)]),
    ]
    lanes = tuple(Lane(k, line, 4, 3.0, "spread") for k, line in enumerate(lines))
    rows = [(t, 0, s) for t in range(4) for s in range(140)]
    for t in range(4, 8):
        rows += [(t, 1, s) for s in range(40)] + [(t, 2, 0.5)] + [(t, 3, s) for s in range(38)]
    track, lane, along = np.array(rows, float).T
    zero = np.zeros(len(track))
    samples = LaneSamples(track.astype(np.int64), lane.astype(np.int64), along, zero, along, zero + 1)
    links = (Connection(1, 2, 4, 1.0, "straight"), Connection(2, 3, 4, 1.0, "straight"))
    parts = cut_at_intersections(LaneGraph(lanes, links, (), samples), {0: square, 3: square + np.array([60.0, 0.0])})
    assert parts.names == ("lane0#0", "lane0#1", "lane0#2", "lane1", "lane3")
    assert parts.ends == ((None, 0), (0, 3), (3, None), (None, 0), (0, None))
    assert parts.connections == ((0, 1), (1, 2), (3, 4))
    assert [part.tracks for part in parts.graph] == [4] * 5
    assert parts.graph.samples.along_m.max() <= max(part.length_m for part in parts.graph)
    whole = cut_at_intersections(LaneGraph(lanes, links, (), samples), {})
    assert whole.names == ("lane0", "lane1", "lane2", "lane3")
    assert whole.connections == ((1, 2), (2, 3))
