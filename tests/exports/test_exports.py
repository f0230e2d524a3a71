"""Exports read back: each format has its columns, units and coordinates."""

import io
import json
import math
import struct
import xml.etree.ElementTree as ET
from datetime import UTC, datetime

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import rasterio
from rasterio.crs import CRS
from rasterio.warp import transform

from schemas.tables import TRACKLET_COLUMNS
from velfield.errors import InputError
from velfield.exports.georeference import Georeference
from velfield.exports.gis.arrows import arrows_geojson
from velfield.exports.gis.cog import write_cog
from velfield.exports.gis.geoparquet import tracklets_geoparquet
from velfield.exports.gis.stac import stac_item
from velfield.exports.tracks.geotrax import geotrax_csv, geotrax_table
from velfield.exports.tracks.points import track_points
from velfield.exports.tracks.sumo import sumo_fcd

GSD_M = 0.25
UTM = CRS.from_epsg(32636)
GEOREFERENCED = Georeference((200, 300), UTM.to_wkt(), (GSD_M, 0.0, 700_000.0, 0.0, -GSD_M, 3_500_000.0), GSD_M)
PIXELS = Georeference((200, 300), gsd_m=GSD_M)


def tracklets_of(paths):
    """Tracklets of vehicles at constant velocity, 5 frames a second; track -> (x, y, vx, vy, frames)."""
    rows = []
    for track, (x, y, vx, vy, frames) in paths.items():
        for first in range(frames - 2):
            row = dict.fromkeys(TRACKLET_COLUMNS, 0.0) | {
                "tracklet_id": track * 100 + first + 1,
                "track_id": track,
            }
            for k in range(3):
                time_s = 10 + 0.2 * (first + k)
                row |= {f"frame_{k}": first + k, f"detection_id_{k}": track * 100 + first + k, f"time_{k}_s": time_s}
                row |= {f"x_{k}_px": x + vx * (time_s - 10), f"y_{k}_px": y + vy * (time_s - 10)}
            for part in ("01", "12"):
                row |= {f"vx_{part}_px_per_s": vx, f"vy_{part}_px_per_s": vy}
            rows.append(row)
    return pd.DataFrame(rows, columns=list(TRACKLET_COLUMNS)).astype(TRACKLET_COLUMNS)


@pytest.fixture
def tracklets():
    return tracklets_of({1: (10.0, 100.0, 40.0, 0.0, 5), 2: (200.0, 150.0, 0.0, -30.0, 3)})


def test_a_track_has_each_of_its_detections_once(tracklets):
    points = track_points(tracklets)
    assert points.groupby("track_id").size().to_dict() == {1: 5, 2: 3}
    first = points[points["track_id"] == 1]
    np.testing.assert_allclose(first["x_px"], 10 + 8 * np.arange(5))
    assert first["time_s"].is_monotonic_increasing
    assert set(first["vx_px_per_s"]) == {40.0}


def test_geotrax_csv_has_its_columns_and_units(tracklets):
    table = pd.read_csv(io.StringIO(geotrax_csv(tracklets, GEOREFERENCED)))
    expected = "Vehicle_ID,Timestamp,Frame_Number,Ortho_X,Ortho_Y,Local_X,Local_Y,Latitude,Longitude,Vehicle_Length,"
    expected += "Vehicle_Width,Vehicle_Class,Vehicle_Speed,Vehicle_Acceleration,Road_Section,Lane_Number,Visibility"
    assert ",".join(table.columns) == expected
    car = table[table["Vehicle_ID"] == 1]
    assert car["Vehicle_Speed"].tolist() == [36.0] * 5  # 40 px/s x 0.25 m x 3.6
    assert math.isnan(car["Vehicle_Acceleration"].iloc[0])
    assert car["Vehicle_Acceleration"].iloc[1:].abs().max() < 1e-6
    assert car["Local_X"].iloc[0] == pytest.approx(700_000 + 10.5 * GSD_M, abs=0.01)
    (x,), (y,) = transform(CRS.from_epsg(4326), UTM, car["Longitude"].iloc[:1], car["Latitude"].iloc[:1])
    assert (x, y) == pytest.approx((700_000 + 10.5 * GSD_M, 3_500_000 - 100.5 * GSD_M), abs=0.02)


def test_geotrax_csv_has_the_measured_dimensions(tracklets):
    vehicles = pd.DataFrame({"track_id": [2, 1], "length_m": [np.nan, 4.518], "width_m": [np.nan, 1.8]})
    table = pd.read_csv(io.StringIO(geotrax_csv(tracklets, GEOREFERENCED, vehicles)))
    dimensions = table.groupby("Vehicle_ID")[["Vehicle_Length", "Vehicle_Width"]].first()
    assert dimensions.loc[1].tolist() == [4.52, 1.8]
    assert dimensions.loc[2].isna().all()


def test_without_a_reference_system_geotrax_has_pixels_and_metres(tracklets):
    table = geotrax_table(tracklets, PIXELS)
    assert table["Latitude"].isna().all()
    assert table["Local_Y"].iloc[0] == pytest.approx((199.5 - 100) * GSD_M)
    assert geotrax_table(tracklets, Georeference((200, 300)))["Vehicle_Speed"].isna().all()


def test_geoparquet_has_its_metadata_and_its_lines_are_the_tracklets(tracklets):
    table = pq.read_table(io.BytesIO(tracklets_geoparquet(tracklets, GEOREFERENCED)))
    geo = json.loads(table.schema.metadata[b"geo"])
    column = geo["columns"][geo["primary_column"]]
    assert (geo["version"], column["encoding"], column["geometry_types"]) == ("1.1.0", "WKB", ["LineString"])
    assert column["crs"]["id"] == {"authority": "EPSG", "code": 32636}
    line = struct.unpack("<BII6d", table["geometry"][0].as_py())
    assert line[:3] == (1, 2, 3)
    assert line[3:5] == pytest.approx((700_000 + 10.5 * GSD_M, 3_500_000 - 100.5 * GSD_M))
    boxes = table["bbox"].to_pylist()
    assert boxes[0]["xmin"] == pytest.approx(line[3])
    assert boxes[0]["xmax"] == pytest.approx(line[7])
    assert column["bbox"][0] == min(box["xmin"] for box in boxes)
    assert set(TRACKLET_COLUMNS) <= set(table.column_names)
    # The grid's north is not quite true north: the convergence of the zone here is about one degree.
    np.testing.assert_allclose(table["heading_deg"].to_numpy(), [91, 91, 91, 1], atol=0.5)


def test_geoparquet_without_a_reference_system_declares_none(tracklets):
    table = pq.read_table(io.BytesIO(tracklets_geoparquet(tracklets, PIXELS)))
    assert json.loads(table.schema.metadata[b"geo"])["columns"]["geometry"]["crs"] is None
    assert pq.read_table(io.BytesIO(tracklets_geoparquet(tracklets.iloc[:0], PIXELS))).num_rows == 0


def test_sumo_fcd_is_in_metres_seconds_and_navigational_degrees(tracklets):
    root = ET.fromstring(sumo_fcd(tracklets, PIXELS))
    assert root.tag == "fcd-export"
    steps = root.findall("timestep")
    assert [step.get("time") for step in steps] == ["0.000", "0.200", "0.400", "0.600", "0.800"]
    east, north = steps[0].findall("vehicle")
    assert {key: east.get(key) for key in ("id", "angle", "speed", "type")} == {
        "id": "1",
        "angle": "90.00",
        "speed": "10.00",
        "type": "car",
    }
    assert (north.get("angle"), north.get("speed")) == ("0.00", "7.50")
    assert float(north.get("y")) == pytest.approx((199.5 - 150) * GSD_M, abs=0.01)
    with pytest.raises(InputError, match="no scale"):
        sumo_fcd(tracklets, Georeference((200, 300)))


def test_arrows_are_at_the_pixels_of_most_vehicles_and_point_along_their_direction(tracklets):
    velocity = np.full((200, 300, 2), np.nan, np.float32)
    count = np.zeros((200, 300), np.int32)
    velocity[50, :, :], count[50] = (40.0, 0.0), 3
    count[50, 100] = 9
    arrows = json.loads(json.dumps(arrows_geojson(velocity, count, GEOREFERENCED, spacing_px=20)))
    assert arrows["type"] == "FeatureCollection"
    assert len(arrows["features"]) == 15
    busiest = next(feature for feature in arrows["features"] if feature["properties"]["count"] == 9)
    assert (busiest["properties"]["x_px"], busiest["properties"]["y_px"]) == (100, 50)
    assert busiest["properties"]["speed_km_per_h"] == 36.0
    assert busiest["properties"]["heading_deg"] == pytest.approx(91, abs=0.5)
    (tail, tip), barbs = busiest["geometry"]["coordinates"]
    assert tip[0] > tail[0]
    assert barbs[1] == tip
    (x0, x1), _ = transform(CRS.from_epsg(4326), UTM, [tail[0], tip[0]], [tail[1], tip[1]])
    assert x1 - x0 == pytest.approx(40 * 0.5 * GSD_M, abs=0.05)
    assert arrows_geojson(velocity, count, GEOREFERENCED, min_count=10)["features"] == []
    with pytest.raises(InputError, match="--base GEOTIFF"):
        arrows_geojson(velocity, count, PIXELS)


def test_a_stac_item_has_footprint_time_and_assets():
    start = datetime(2024, 5, 1, 12, 0, tzinfo=UTC)
    item = stac_item(
        "flight", GEOREFERENCED, {"direction": "maps/direction.tif", "field": "field.zarr"}, start=start, duration_s=60
    )
    item = json.loads(json.dumps(item))
    assert (item["type"], item["stac_version"], item["id"]) == ("Feature", "1.1.0", "flight")
    assert item["properties"]["datetime"] is None
    assert item["properties"]["end_datetime"] == "2024-05-01T12:01:00Z"
    assert item["properties"]["proj:code"] == "EPSG:32636"
    west, south, east, north = item["bbox"]
    (x0, x1), (y0, y1) = transform(CRS.from_epsg(4326), UTM, [west, east], [south, north])
    assert (x1 - x0, y1 - y0) == pytest.approx((75, 50), abs=4)  # the box of a slightly turned grid
    ring = np.array(item["geometry"]["coordinates"][0])
    assert ring[0].tolist() == ring[-1].tolist()
    area = np.sum(ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1])
    assert area > 0  # counter-clockwise, by RFC 7946
    assert item["assets"]["direction"]["type"].startswith("image/tiff")
    with pytest.raises(InputError, match="without a time zone"):
        stac_item("f", GEOREFERENCED, {}, start=datetime(2024, 5, 1), duration_s=1)


def test_cog_keeps_names_units_nan_and_georeference(tmp_path):
    speed = np.full((600, 700), np.nan, np.float32)
    speed[100:200, 50:80] = 12.5
    path = tmp_path / "speed.tif"
    write_cog(
        path,
        [speed, speed * 2],
        names=["modal speed", "p85"],
        units=["m/s", "m/s"],
        crs_wkt=GEOREFERENCED.crs_wkt,
        affine=GEOREFERENCED.affine,
    )
    with rasterio.open(path) as dataset:
        assert dataset.descriptions == ("modal speed", "p85")
        assert dataset.units == ("m/s", "m/s")
        assert math.isnan(dataset.nodata)
        assert dataset.crs == UTM
        assert tuple(dataset.transform)[:6] == GEOREFERENCED.affine
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert dataset.overviews(1)
        np.testing.assert_array_equal(dataset.read(1), speed)
