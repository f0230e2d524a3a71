"""A map of the user's own: what its tiles show where, and what is refused in one line."""

import os
import sqlite3
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.transform import Affine
from rasterio.warp import transform

from velfield.errors import InputError
from velfield.viewer import reference_map
from velfield.viewer.reference_map import ReferenceMap, change_coordinates, open_map

EAST, NORTH, GSD_M = 391_000.0, 5_819_000.0, 0.25
SIDE, SQUARE = 600, 100
UTM = 32633


def north_up(east: float, north: float, pixel: float) -> Affine:
    return Affine(pixel, 0, east, 0, -pixel, north)


def squares(bands: int) -> NDArray[np.uint8]:
    """A board of squares, each of another colour; (bands, 600, 600)."""
    colours = np.random.default_rng(3).integers(1, 255, (bands, SIDE // SQUARE, SIDE // SQUARE), dtype=np.uint8)
    return np.kron(colours, np.ones((1, SQUARE, SQUARE), np.uint8))


def write_geotiff(path: Path, data: NDArray[Any], **options: Any) -> Path:
    profile = {"crs": f"EPSG:{UTM}", "transform": north_up(EAST, NORTH, GSD_M), **options}
    count, height, width = data.shape
    with rasterio.open(
        path, "w", driver="GTiff", width=width, height=height, count=count, dtype=data.dtype.name, **profile
    ) as file:
        file.write(data)
    return path


def write_mbtiles(path: Path, tiles: dict[tuple[int, int, int], bytes], **metadata: str) -> Path:
    """By the specification: zoom, column, and row from the south."""
    database = sqlite3.connect(path)
    with database:
        database.execute("CREATE TABLE metadata (name text, value text)")
        database.execute(
            "CREATE TABLE tiles (zoom_level integer, tile_column integer, tile_row integer, tile_data blob)"
        )
        rows = [(zoom, column, 2**zoom - 1 - row, data) for (zoom, column, row), data in tiles.items()]
        database.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", rows)
        zooms = sorted(zoom for zoom, _, _ in tiles)
        known = {"name": "a map", "format": "png", "minzoom": str(zooms[0]), "maxzoom": str(zooms[-1]), **metadata}
        database.executemany("INSERT INTO metadata VALUES (?, ?)", list(known.items()))
    database.close()
    return path


def web_pixel(longitude: float, latitude: float, zoom: int) -> tuple[int, int, int, int]:
    """Column and row of a tile and in it, by the formula of web maps."""
    n = 256 * 2**zoom
    x = (longitude + 180) / 360 * n
    y = (1 - np.arcsinh(np.tan(np.radians(latitude))) / np.pi) / 2 * n
    return int(x // 256), int(y // 256), int(x % 256), int(y % 256)


def colour_at(reference: ReferenceMap, longitude: float, latitude: float, zoom: int) -> NDArray[np.uint8]:
    column, row, x, y = web_pixel(longitude, latitude, zoom)
    tile = reference.tile(zoom, column, row)
    assert (tile.shape, tile.dtype) == ((256, 256, 4), np.uint8)
    return np.asarray(tile[y, x], np.uint8)


@pytest.mark.parametrize(("bands", "dtype"), [(1, "uint8"), (3, "uint8"), (4, "uint8"), (1, "uint16"), (1, "float32")])
@pytest.mark.parametrize("finer", [-2, 0, 2])
def test_a_geotiffs_tiles_show_each_place_where_it_is(tmp_path: Path, bands: int, dtype: str, finer: int) -> None:
    data = squares(bands)
    if bands == 4:
        data[3] = 255
    stored = data.astype(dtype) * (1 if dtype == "uint8" else 100)
    options = {"photometric": "RGB"} if bands >= 3 else {}
    reference = ReferenceMap(write_geotiff(tmp_path / "map.tif", stored, **options))
    west, south, east, north = reference.bounds
    assert west < 13.396 < east
    assert south < 52.509 < north
    rng = np.random.default_rng(5)
    for row, column in rng.integers(0, SIDE // SQUARE, (6, 2)):
        x, y = column * SQUARE + SQUARE // 2, row * SQUARE + SQUARE // 2
        (longitude,), (latitude,) = transform(f"EPSG:{UTM}", "EPSG:4326", [EAST + x * GSD_M], [NORTH - y * GSD_M])
        shown = colour_at(reference, longitude, latitude, reference.native_zoom + finer)
        expected = data[: min(bands, 3), y, x].astype(float)
        if dtype != "uint8":
            low, high = np.percentile(data, (0.5, 99.5))
            expected = np.clip((expected - low) * 255 / (high - low), 0, 255)
        np.testing.assert_allclose(shown[:3].astype(float), np.broadcast_to(expected, 3), atol=1.5)
        assert shown[3] == 255
    elsewhere = reference.tile(reference.native_zoom, 0, 0)
    assert not elsewhere.any()
    for zoom, column, row in ((-1, 0, 0), (2, 4, 0), (2, 0, -1), (25, 0, 0), (10**6, 1, 1)):
        assert reference.tile(zoom, column, row) is None


def test_a_tile_with_the_maps_edge_is_transparent_beyond_it(tmp_path: Path) -> None:
    reference = ReferenceMap(write_geotiff(tmp_path / "map.tif", squares(3)))
    west, _, _, north = reference.bounds
    column, row, x, y = web_pixel(west, north, reference.native_zoom)
    tile = reference.tile(reference.native_zoom, column, row)
    assert 0 < x < 250  # the test is of an edge within the tile
    assert not tile[: max(y - 2, 0), :, 3].any()
    assert not tile[:, : max(x - 2, 0), 3].any()
    assert tile[..., 3].max() == 255


def test_a_palette_and_nodata_are_shown_as_the_file_says(tmp_path: Path) -> None:
    path = tmp_path / "palette.tif"
    data = np.full((1, SIDE, SIDE), 7, np.uint8)
    data[:, :, : SIDE // 2] = 0
    write_geotiff(path, data, nodata=0)
    with rasterio.open(path, "r+") as file:
        file.write_colormap(1, {0: (9, 9, 9, 255), 7: (10, 200, 30, 255)})
    reference = ReferenceMap(path)
    for x, expected in ((SIDE * 3 // 4, (10, 200, 30, 255)), (SIDE // 4, None)):
        (longitude,), (latitude,) = transform(f"EPSG:{UTM}", "EPSG:4326", [EAST + x * GSD_M], [NORTH - 75.0])
        shown = colour_at(reference, longitude, latitude, reference.native_zoom)
        assert tuple(shown) == expected if expected else shown[3] == 0


def test_mbtiles_are_shown_as_they_are(tmp_path: Path) -> None:
    rng, zoom = np.random.default_rng(8), 18
    column, row, _, _ = web_pixel(13.4, 52.5, zoom)
    images = {
        (zoom, column + i, row + j): rng.integers(0, 255, (256, 256, 3), dtype=np.uint8)
        for i in range(2)
        for j in range(2)
    }
    tiles = {key: cv2.imencode(".png", image[..., ::-1])[1].tobytes() for key, image in images.items()}
    reference = ReferenceMap(write_mbtiles(tmp_path / "map.mbtiles", tiles))
    assert reference.native_zoom == zoom
    for key, image in images.items():
        tile = reference.tile(*key)
        np.testing.assert_array_equal(tile[..., :3], image)
        assert tile[..., 3].min() == 255
    beside = reference.tile(zoom, column + 4, row)
    assert not beside.any()
    west, _, _, north = reference.bounds
    assert web_pixel(west + 1e-6, north - 1e-6, zoom)[:2] == (column, row)


def _text(path: Path) -> Path:
    path.write_text("<VRTDataset/>")
    return path


def _truncated(path: Path) -> Path:
    write_geotiff(path, squares(3), compress="deflate")
    path.write_bytes(path.read_bytes()[:40])
    return path


def _database(path: Path) -> Path:
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE other (a)")
    return path


def _vector_tiles(path: Path) -> Path:
    return write_mbtiles(path, {(3, 4, 2): b"\x1f\x8b\x08\x00not an image"}, format="pbf", json='{"vector_layers": []}')


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")  # of the writer
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: path, "found no map"),
        (lambda path: path.parent, "found a folder, expected a GeoTIFF"),
        (_text, "found neither a TIFF nor an SQLite file"),
        (_truncated, "could not be read"),
        (_database, "could not be read"),
        (_vector_tiles, "could not be read"),
        (lambda path: write_geotiff(path, squares(1), crs=None), "found no reference system"),
        (lambda path: write_geotiff(path, squares(1), transform=Affine.identity()), "found no reference system"),
        (lambda path: write_geotiff(path, squares(1).astype(np.complex64)), "found complex pixels"),
        (lambda path: write_geotiff(path, squares(1), transform=north_up(0, 9.9e6, 1.0)), "found latitudes"),
        (lambda path: write_geotiff(path, np.full((1, 9, 9), np.nan, np.float32)), "found no pixel with data"),
    ],
)
def test_what_is_no_map_is_refused_in_one_line(tmp_path: Path, make: Any, message: str) -> None:
    with pytest.raises(InputError) as refused:
        ReferenceMap(make(tmp_path / "map.dat"))
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_large_map_without_overviews_is_refused_and_with_them_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_geotiff(tmp_path / "map.tif", squares(3))
    monkeypatch.setattr(reference_map, "_MAX_PX_WITHOUT_OVERVIEWS", SIDE * SIDE - 1)
    with pytest.raises(InputError, match=r"found 600x600 px without overviews.*gdaladdo"):
        ReferenceMap(path)
    with rasterio.open(path, "r+") as file:
        file.build_overviews([2, 4])
    assert ReferenceMap(path).native_zoom == 19


@pytest.mark.skipif(not hasattr(os, "truncate"), reason="a file cannot be cut on this system")
def test_a_damaged_part_is_told_when_it_is_shown(tmp_path: Path) -> None:
    data = np.random.default_rng(2).integers(0, 255, (3, SIDE, SIDE), dtype=np.uint8)
    path = write_geotiff(tmp_path / "map.tif", data, compress="deflate", tiled=True, blockxsize=256, blockysize=256)
    content = bytearray(path.read_bytes())
    content[len(content) // 2 :] = bytes(len(content) - len(content) // 2)
    path.write_bytes(content)
    reference = ReferenceMap(path)
    west, south, east, north = reference.bounds
    column, row, _, _ = web_pixel((west + east) / 2, (south * 3 + north) / 4, 18)
    with pytest.raises(InputError, match=r"the tile 18/\d+/\d+ could not be read"):
        reference.tile(18, column, row)


@pytest.mark.parametrize(
    ("given", "origin"),
    [
        ("https://tiles.example/{z}/{x}/{y}.png", "https://tiles.example"),
        ("HTTP://Localhost:8080/{z}/{x}/{-y}?key=a1", "http://localhost:8080"),
        ("http://[::1]:90/{z}{x}{y}", "http://[::1]:90"),
    ],
)
def test_a_tile_servers_address_gives_its_origin(given: str, origin: str) -> None:
    server = open_map(given)
    assert server.origin == origin
    assert server.template.startswith(origin + "/")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("https://tiles.example/{z}/{x}.png", "found no {y}"),
        ("https://tiles.example/", "found no {z} and no {x} and no {y}"),
        ("https://{s}.tiles.example/{z}/{x}/{y}.png", "a host or a character that no address has"),
        ("https://tiles.example/{s}/{z}/{x}/{y}{r}.png", "found {s}"),
        ("https://tiles.example; script-src *//{z}/{x}/{y}", "a host or a character that no address has"),
        ("https://user@tiles.example/{z}/{x}/{y}", "a host or a character that no address has"),
        ("https:///{z}/{x}/{y}", "a host or a character that no address has"),
        ("https://tiles.example:99999/{z}/{x}/{y}", "expected an address"),
        ("https://tiles.example/'{z}/{x}/{y}", "a host or a character that no address has"),
        ("ftp://tiles.example/{z}/{x}/{y}", "ftp"),
        ("/vsicurl/https://tiles.example/map.tif", "found no map"),
    ],
)
def test_another_address_is_refused_in_one_line(given: str, message: str) -> None:
    with pytest.raises(InputError) as refused:
        open_map(given)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_coordinates_are_those_of_the_reference_system() -> None:
    x, y = change_coordinates(13.4, 52.5, 4326, UTM)
    (east,), (north,) = transform("EPSG:4326", f"EPSG:{UTM}", [13.4], [52.5])
    assert (x, y) == (east, north)
    assert change_coordinates(x, y, UTM, 4326) == pytest.approx((13.4, 52.5), abs=1e-9)
    with pytest.raises(InputError, match="found no such reference system"):
        change_coordinates(13.4, 52.5, 4326, 999_999)
    with pytest.raises(InputError, match="expected a place in the area"):
        change_coordinates(1e12, 5, UTM, 4326)
