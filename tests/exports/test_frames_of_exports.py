"""Axes, north and units of what is exported: positions read back move as the file says that they do."""

import io
import json
import struct
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from rasterio.crs import CRS
from rasterio.warp import transform

from schemas.arrays import FloatArray
from tests.exports.test_exports import PIXELS, UTM, tracklets_of
from tests.field_runs import field_run, tracklets_along
from velfield.exports.export import export_run
from velfield.exports.georeference import Georeference
from velfield.exports.gis.arrows import arrows_geojson
from velfield.exports.gis.geoparquet import tracklets_geoparquet
from velfield.exports.tracks.geotrax import geotrax_csv
from velfield.exports.tracks.sumo import sumo_fcd
from velfield.run.run import Run
from velfield.sources.tracks.read import read_tracks

SHAPE, TURN_DEG = (200, 300), 26.0
PATHS = {1: (10.0, 100.0, 40.0, 0.0, 9), 2: (200.0, 150.0, 0.0, -30.0, 9), 3: (250.0, 20.0, -20.0, 25.0, 9)}


def placed(crs: CRS, lonlat: tuple[float, float], gsd_m: float, unit_m: float, turn_deg: float = 0.0) -> Georeference:
    """A map whose top is ``turn_deg`` clockwise from the grid's north, with units of the reference system of so many
    metres on the ground."""
    (x,), (y,) = transform(CRS.from_epsg(4326), crs, [lonlat[0]], [lonlat[1]])
    c, s = (gsd_m / unit_m * f(np.radians(turn_deg)) for f in (np.cos, np.sin))
    return Georeference(SHAPE, crs.to_wkt(), (c, -s, x, -s, -c, y), gsd_m)


MAPS = {
    "pixels": PIXELS,
    "north up": placed(UTM, (34.8, 32.0), 0.25, 1.0),
    "turned": placed(UTM, (34.8, 32.0), 0.25, 1.0, TURN_DEG),
    "Web Mercator": placed(CRS.from_epsg(3857), (34.8, 32.0), 0.25, float(np.cos(np.radians(32.0)))),
    "feet": placed(CRS.from_epsg(2263), (-73.9, 40.7), 0.25, 0.3048, -TURN_DEG),
}
maps = pytest.mark.parametrize("georeference", [pytest.param(one, id=name) for name, one in MAPS.items()])
on_earth = pytest.mark.parametrize(
    "georeference", [pytest.param(one, id=name) for name, one in MAPS.items() if one.has_crs]
)


def bearing_deg(step: FloatArray) -> FloatArray:
    """Of steps (n, 2) to the right and up, degrees clockwise from up."""
    return np.asarray(np.degrees(np.arctan2(step[:, 0], step[:, 1])))


def ground_steps(lonlat: FloatArray) -> FloatArray:
    """Steps (n - 1, 2) east and north, m, of longitudes and latitudes (n, 2)."""
    east = np.diff(lonlat[:, 0]) * np.cos(np.radians(lonlat[:-1, 1]))
    return np.asarray(np.column_stack([east, np.diff(lonlat[:, 1])]) * 111_200.0)


def assert_same_deg(one: FloatArray, other: FloatArray, within: float) -> None:
    assert np.abs((np.asarray(one) - np.asarray(other) + 180) % 360 - 180).max() < within


@maps
def test_sumo_has_one_frame_for_positions_and_angles(georeference: Georeference) -> None:
    rows = [
        {name: float(vehicle.get(name, "nan")) for name in ("id", "x", "y", "angle", "speed")}
        | {"t": float(step.get("time", "nan"))}
        for step in ET.fromstring(sumo_fcd(tracklets_of(PATHS), georeference))
        for vehicle in step
    ]
    for _, car in pd.DataFrame(rows).groupby("id"):
        steps = np.diff(car[["x", "y"]], axis=0)
        assert_same_deg(bearing_deg(steps), car["angle"].iloc[1:], within=1.0)
        assert np.allclose(np.hypot(*steps.T) / np.diff(car["t"]), car["speed"].iloc[1:], atol=0.1)


@maps
def test_geotrax_is_read_back_as_it_was(georeference: Georeference, tmp_path: Path) -> None:
    """Not mirrored, in metres and km/h, whatever the unit of the map's reference system."""
    (tmp_path / "t.csv").write_text(geotrax_csv(tracklets_of(PATHS), georeference))
    read = read_tracks(tmp_path / "t.csv")
    assert read.unit == "m"
    assert read.speed.factor is not None
    for (_, car), (_, _, vx, vy, _) in zip(read.table.groupby("track_id"), PATHS.values(), strict=True):
        step = car[["x", "y"]].to_numpy()[-1] - car[["x", "y"]].to_numpy()[0]
        speed = np.hypot(*step) / np.ptp(car["time_s"])
        assert speed == pytest.approx(np.hypot(vx, vy) * 0.25, rel=0.01)
        assert read.speed.values[car.index[0]] * read.speed.factor == pytest.approx(speed, rel=0.02)
        turned = bearing_deg(step[None] * (1, -1)) - bearing_deg(np.array([[vx, -vy]]))
        assert_same_deg(turned, np.full(1, expected_turn(georeference)), within=1.5)


def expected_turn(georeference: Georeference) -> float:
    """Degrees clockwise from the grid's north to the map's top."""
    if georeference.affine is None:
        return 0.0
    return float(bearing_deg(np.array([[-georeference.affine[1], -georeference.affine[4]]]))[0])


@on_earth
def test_lines_and_arrows_point_where_their_headings_do(georeference: Georeference) -> None:
    table = pq.read_table(io.BytesIO(tracklets_geoparquet(tracklets_of(PATHS), georeference)))
    for wkb, heading in zip(table["geometry"].to_pylist(), table["heading_deg"].to_pylist(), strict=True):
        line = np.reshape(struct.unpack("<BII6d", wkb)[3:], (3, 2))
        crs = CRS.from_wkt(georeference.crs_wkt)
        steps = ground_steps(np.column_stack(transform(crs, CRS.from_epsg(4326), line[:, 0], line[:, 1])))
        assert_same_deg(bearing_deg(steps), np.full(2, heading), within=1.0)
    velocity = np.full((*SHAPE, 2), np.nan, np.float32)
    velocity[50, 60], velocity[150, 200] = (30.0, -40.0), (-20.0, 0.0)
    for arrow in arrows_geojson(velocity, np.ones(SHAPE, np.int32), georeference)["features"]:
        step = ground_steps(np.array(arrow["geometry"]["coordinates"][0]))
        assert_same_deg(bearing_deg(step), np.full(1, arrow["properties"]["heading_deg"]), within=1.5)
        assert np.hypot(*step[0]) == pytest.approx(arrow["properties"]["speed_km_per_h"] / 3.6 * 0.5, rel=0.02)


@pytest.mark.parametrize(
    ("north_rad", "since", "heading"),
    [(None, "top of the image", 90.0), (0.0, "north", 0.0), (np.pi / 2, "north", 270.0)],
)
def test_headings_without_a_reference_system_say_where_they_begin(
    north_rad: float | None, since: str, heading: float
) -> None:
    to_the_right = tracklets_of({1: (10.0, 100.0, 40.0, 0.0, 9)})
    table = pq.read_table(io.BytesIO(tracklets_geoparquet(to_the_right, replace(PIXELS, north_rad=north_rad))))
    assert set(table["heading_from"].to_pylist()) == {since}
    np.testing.assert_allclose(table["heading_deg"].to_numpy(), heading, atol=0.5)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Cars to the right and up on a map whose top is turned from north."""
    rng = np.random.default_rng(0)
    paths = [
        np.column_stack([np.arange(10, 280, 8.0), 190 - np.arange(0, 136, 4.0)]) + rng.normal(0, 0.1, (34, 2))
        for _ in range(6)
    ]
    written = field_run(tmp_path_factory.mktemp("frames") / "run", tracklets_along(paths), shape=SHAPE, gsd_m=0.25)
    turned = MAPS["turned"]
    written.__dict__["grid"] = written.grid.model_copy(update={"crs_wkt": turned.crs_wkt, "affine": turned.affine})
    return written


def test_trajectories_of_a_turned_map(run: Run, tmp_path: Path) -> None:
    """x and y along the map, headings from north, longitude and latitude on Earth: each agrees with the motion."""
    table = pd.read_csv(export_run(run, "trajectories", tmp_path / "t.csv"))
    highd = pd.read_csv(export_run(run, "highd", tmp_path / "h.csv"))
    features = json.loads(export_run(run, "moving_features", tmp_path / "t.json").read_bytes())["features"]
    for (_, car), (_, box), feature in zip(table.groupby("track_id"), highd.groupby("id"), features, strict=True):
        lonlat = car[["longitude_deg", "latitude_deg"]].to_numpy()
        along = ground_steps(lonlat[[0, -1]])
        assert_same_deg(bearing_deg(along), np.full(1, car["heading_deg"].median()), within=1.5)
        step = car[["x_m", "y_m"]].to_numpy()[-1] - car[["x_m", "y_m"]].to_numpy()[0]
        assert step[1] < 0
        assert np.hypot(*step) == pytest.approx(np.hypot(*along[0]), rel=0.005)
        mean = car[["vx_m_per_s", "vy_m_per_s"]].mean() * np.ptp(car["time_s"])
        assert mean.to_numpy() == pytest.approx(step, abs=1.0)
        assert box[["xVelocity", "yVelocity"]].mean().to_numpy() * np.ptp(box["time"]) == pytest.approx(step, abs=1.0)
        assert np.array(feature["temporalGeometry"]["coordinates"]) == pytest.approx(lonlat, abs=2e-7)
    again = read_tracks(tmp_path / "h.csv").table
    assert again["x"].to_numpy() == pytest.approx(table["x_m"].to_numpy(), abs=0.01)
    assert again["y"].to_numpy() == pytest.approx(table["y_m"].to_numpy(), abs=0.01)


def test_opendrive_says_where_its_y_points(run: Run, tmp_path: Path) -> None:
    root = ET.parse(export_run(run, "opendrive", tmp_path / "x.xodr")).getroot()
    said = {one.get("code"): one.get("value") for one in root.iter("userData")}
    assert float(said["bearing_of_y_deg"] or "nan") == pytest.approx(TURN_DEG, abs=1.5)  # and the zone's convergence
    first = root.find("road/planView/geometry")
    heading = np.degrees(float(first.get("hdg", "nan")))
    assert heading == pytest.approx(np.degrees(np.arctan2(4, 8)), abs=3)  # y up
