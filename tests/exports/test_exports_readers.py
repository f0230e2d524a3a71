"""Exports read back by the libraries that their users use."""

import io
import json
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.exports.test_exports import GEOREFERENCED, GSD_M, PIXELS, UTM, tracklets_of
from velfield.exports.georeference import Georeference
from velfield.exports.gis.cog import write_cog
from velfield.exports.gis.geoparquet import tracklets_geoparquet
from velfield.exports.gis.gpkg import LAYER, tracklets_gpkg
from velfield.exports.gis.stac import stac_item
from velfield.exports.tracks.geotrax import geotrax_csv
from velfield.exports.tracks.sumo import sumo_fcd

PATHS = {1: (10.0, 100.0, 40.0, 0.0, 5), 2: (200.0, 150.0, 0.0, -30.0, 3)}
LENGTHS_M = [40.0 * 0.4 * GSD_M] * 3 + [30.0 * 0.4 * GSD_M]
"""Of the four tracklets: two intervals of 0.2 s each."""


def test_geopandas_reads_geoparquet_with_its_reference_system() -> None:
    geopandas = import_module("geopandas")
    frame = geopandas.read_parquet(io.BytesIO(tracklets_geoparquet(tracklets_of(PATHS), GEOREFERENCED)))
    assert frame.crs.to_epsg() == 32636
    np.testing.assert_allclose(frame.length, LENGTHS_M, rtol=1e-6)
    nearby = geopandas.read_parquet(
        io.BytesIO(tracklets_geoparquet(tracklets_of(PATHS), GEOREFERENCED)),
        bbox=(700_045, 3_499_900, 700_060, 3_500_000),
    )
    assert nearby["track_id"].tolist() == [2]


@pytest.mark.parametrize("georeference", [GEOREFERENCED, PIXELS])
def test_geopandas_reads_geopackage(tmp_path: Path, georeference: Georeference) -> None:
    geopandas = import_module("geopandas")
    path = tmp_path / "tracklets.gpkg"
    path.write_bytes(tracklets_gpkg(tracklets_of(PATHS), georeference))
    frame = geopandas.read_file(path, layer=LAYER)
    assert frame["track_id"].tolist() == [1, 1, 1, 2]
    if georeference is GEOREFERENCED:
        assert frame.crs.to_epsg() == 32636
        np.testing.assert_allclose(frame.length, LENGTHS_M, rtol=1e-6)
    else:
        np.testing.assert_allclose(frame.length, np.array(LENGTHS_M) / GSD_M, rtol=1e-6)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
def test_movingpandas_makes_trajectories_of_the_tracks() -> None:
    movingpandas = import_module("movingpandas")
    table = pd.read_csv(io.StringIO(geotrax_csv(tracklets_of(PATHS), GEOREFERENCED)))
    table["t"] = pd.Timestamp("2024-05-01") + pd.to_timedelta(table["Timestamp"], unit="s")
    tracks = movingpandas.TrajectoryCollection(
        table, "Vehicle_ID", t="t", x="Local_X", y="Local_Y", crs=GEOREFERENCED.crs_wkt
    )
    assert len(tracks) == 2
    first = tracks.trajectories[0]
    assert first.get_length() == pytest.approx(40.0 * 0.8 * GSD_M, rel=1e-3)
    assert first.get_duration().total_seconds() == pytest.approx(0.8)


def test_pystac_takes_the_item(tmp_path: Path) -> None:
    pystac = import_module("pystac")
    item = stac_item(
        "flight", GEOREFERENCED, {"field": "field.zarr"}, start=datetime(2024, 5, 1, 12, tzinfo=UTC), duration_s=60
    )
    path = tmp_path / "item.json"
    path.write_text(json.dumps(item))
    read = pystac.Item.from_file(str(path))
    assert read.id == "flight"
    assert read.properties["proj:code"] == "EPSG:32636"
    assert read.assets["field"].href.endswith("field.zarr")


def test_rio_cogeo_finds_the_geotiff_cloud_optimised(tmp_path: Path) -> None:
    cogeo = import_module("rio_cogeo.cogeo")
    path = tmp_path / "speed.tif"
    speed = np.full((1200, 1400), np.nan, np.float32)
    speed[100:200, 50:80] = 12.5
    write_cog(path, [speed], names=["speed"], units=["m s-1"], crs_wkt=UTM.to_wkt(), affine=GEOREFERENCED.affine)
    valid, errors, _ = cogeo.cog_validate(str(path), strict=True)
    assert (valid, errors) == (True, [])


def test_sumos_own_reader_gives_the_vehicles(tmp_path: Path) -> None:
    sumolib = import_module("sumolib")
    path = tmp_path / "tracks.fcd.xml"
    path.write_text(sumo_fcd(tracklets_of(PATHS), GEOREFERENCED))
    steps = list(sumolib.xml.parse(str(path), "timestep"))
    speeds = {vehicle.id: float(vehicle.speed) for step in steps for vehicle in (step.vehicle or [])}
    assert speeds == {"1": pytest.approx(40.0 * GSD_M, abs=0.01), "2": pytest.approx(30.0 * GSD_M, abs=0.01)}
