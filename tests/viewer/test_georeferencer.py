"""The georeferencing page: what it serves and refuses, the fit it shows, what it saves."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
from rasterio.transform import Affine
from rasterio.warp import transform

from flows.cli import app
from schemas.georeference import ControlPoint, ControlPointsRecord, MarkedPoint, MarkedPoints
from tests.browser import NEEDS_PAGE, Page, browser
from tests.viewer.test_accessibility import AXE, FINDINGS
from tests.viewer.test_reference_map import squares, write_geotiff
from tests.viewer.test_viewer_server import Client, command, served
from velfield import open_run
from velfield.errors import InputError
from velfield.pipeline.georeference import fit_run_points
from velfield.sources.control_points import fit_control_points
from velfield.viewer.georeferencer import georeference_app, marked_points, read_marked_points
from velfield.viewer.reference_map import ReferenceMap, TileServer, open_map

PIXELS = ((60, 50), (580, 70), (560, 430), (80, 400))
LON, LAT, GSD_M = 13.4, 52.5, 0.25


def lonlat(x: float, y: float) -> str:
    """Coordinates of a pixel of a map whose top is north."""
    east, north = 111_320 * np.cos(np.radians(LAT)), 111_262.0
    return f"{LON + x * GSD_M / east:.8f}, {LAT - y * GSD_M / north:.8f}"


def body(*coordinates: str, order: str = "longitude_latitude", epsg: int | None = None) -> str:
    points = [{"x_px": x, "y_px": y, "coordinates": text} for (x, y), text in zip(PIXELS, coordinates, strict=False)]
    return json.dumps({"points": points, "order": order, "epsg": epsg})


GOOD = tuple(lonlat(x, y) for x, y in PIXELS)


def token_of(client: Client) -> dict[str, str]:
    found = re.search(r'id="server-data">(.*?)</script>', client.ask("/")[1])
    return {"X-Token": json.loads(found.group(1))["token"]}


def files(root: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in root.rglob("*") if path.is_file()}


def made_app(
    saves: list[Sequence[ControlPoint]],
    before: MarkedPoints | None = None,
    reference: ReferenceMap | TileServer | None = None,
) -> Any:
    """The page of an image of noise, without a run."""

    def fit(points: Sequence[ControlPoint], epsg: int) -> ControlPointsRecord:
        return fit_control_points(points, epsg, shape=(480, 640), base_digest="")

    def save(points: Sequence[ControlPoint], epsg: int) -> tuple[ControlPointsRecord, Sequence[str]]:
        record = fit(points, epsg)
        saves.append(points)
        return record, ["the scale was not known when vehicles were tracked"]

    image = np.random.default_rng(1).integers(60, 180, (480, 640), dtype=np.uint8)
    begin = before or marked_points(None, None)
    return georeference_app(image, begin, title="Control points", fit=fit, save=save, reference=reference)


@NEEDS_PAGE
def test_the_page_of_a_run_fits_saves_and_begins_with_what_was_saved(copy: Path) -> None:
    before, registered = files(copy), files(copy / "registration")
    with command("georeference", str(copy)) as address:
        client = Client(int(address.rstrip("/").rpartition(":")[2]))
        token = token_of(client)
        status, text, _ = client.ask("/fit", "POST", token, body(*GOOD))
        assert status == 200
        fit = json.loads(text)
        run = open_run(copy)
        expected = fit_run_points(run, *read_marked_points(MarkedPoints.model_validate_json(body(*GOOD))))
        assert fit["text"] == expected.text()
        assert [point["residual_m"] for point in fit["residuals"]] == [e.residual_m for e in expected.residuals]
        assert files(copy) == before  # the fit writes nothing
        assert client.status("/save", "POST", token, body(*GOOD[:2])) == 422
        assert files(copy) == before
        status, text, _ = client.ask("/save", "POST", token, body(*GOOD))
        assert status == 200
        assert json.loads(text)["text"] == expected.text()
        assert open_run(copy).grid.gsd_m == pytest.approx(GSD_M, rel=2e-3)
        assert open_run(copy).grid.crs_wkt is not None
        assert files(copy / "registration") == registered
    record = ControlPointsRecord.model_validate_json((copy / "base" / "control_points.json").read_bytes())
    read, code = read_marked_points(marked_points(record, None))
    assert (read, code) == (record.points, 4326)


@NEEDS_PAGE
def test_only_the_page_it_served_may_fit_or_save() -> None:
    saves: list[Sequence[ControlPoint]] = []
    with served(made_app(saves)) as client:
        for path in ("/fit", "/save"):
            assert client.status(path, "POST", {}, body(*GOOD)) == 403
            assert client.status(path, "POST", {"X-Token": "guess"}, body(*GOOD)) == 403
            assert client.status(path) == 405
        token = token_of(client)
        assert client.status("/save", "POST", {**token, "Host": "elsewhere.example"}, body(*GOOD)) == 400
        for path in ("/frame/1.png", "/frame/-1.png", "/frame/", "/base/", "/../x", "/%2e%2e/x", "/.git", "/labels"):
            assert client.status(path) in (404, 405), path
        assert client.status("/", "POST", token, body(*GOOD)) == 405
        for path in ("/", "/frame/0.png"):
            headers = client.ask(path)[2]
            assert headers["content-security-policy"].startswith("default-src 'none'"), path
            assert "http" not in headers["content-security-policy"]
        assert saves == []


@NEEDS_PAGE
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (body(*GOOD[:2]), "found 2 control points, expected 3"),
        (body(*GOOD[:3], "here"), "control point 4: found 'here', expected two decimal numbers"),
        (body(*GOOD[:3], ""), "control point 4: found no coordinates"),
        (body(*GOOD[:3], "13,4 52,5"), "control point 4: found '13,4 52,5'"),
        (body(*GOOD[:3], "nan, 52"), "control point 4: found 'nan, 52'"),
        (body(*GOOD[:3], "13.4, 97"), "expected degrees, longitude first"),
        (body(*GOOD, order="latitude_longitude"), "mirror the map"),
        (body(*GOOD, order="x_y"), "found no EPSG code"),
        (body(*GOOD, order="x_y", epsg=999999), "--epsg 999999: found no such reference system"),
        (body(*GOOD, order="x_y", epsg=-1), "epsg"),
        (body("9e7 5", order="x_y", epsg=32633), "control point 1: found '9e7 5'"),
        (
            body("90000000 5", "90000100 5", "90000100 4", order="x_y", epsg=32633),
            "EPSG:32633: found a reference system that does not",
        ),
        (
            body("9" * 150 + " 1", "1 2", "3 4", order="x_y", epsg=3857),
            "control point 1: found coordinates (1e+150, 1)",
        ),
        (body(*GOOD).replace('"x_px": 60', '"x_px": 6000'), "control point 1: found the pixel"),
        (re.sub(r'"y_px": \d+', '"y_px": 9', body(*GOOD)), "on one line"),
        ("{}", "points"),
        ("nothing", "Invalid JSON"),
    ],
)
def test_points_that_cannot_be_are_refused_in_one_line(wrong: str, message: str) -> None:
    saves: list[Sequence[ControlPoint]] = []
    with served(made_app(saves)) as client:
        token = token_of(client)
        for path in ("/fit", "/save"):
            status, text, _ = client.ask(path, "POST", token, wrong)
            assert (status, message in text, "\n" in text) == (422, True, False), text
    assert saves == []


@pytest.mark.parametrize(
    "text", ["13.4, 52.5", "13.4 52.5", "13.4;52.5", "13.4\t52.5\n", "(13.4,52.5)", "13.4 , +52.5"]
)
def test_coordinates_are_read_as_they_are_copied(text: str) -> None:
    point = MarkedPoint(x_px=1, y_px=2, coordinates=text)
    ((read,), code) = read_marked_points(MarkedPoints(points=(point,), order="longitude_latitude"))
    assert (read.x, read.y, code) == (13.4, 52.5, 4326)
    minus = MarkedPoint(x_px=1, y_px=2, coordinates="\N{MINUS SIGN}13.4, -52.5")
    ((read,), code) = read_marked_points(MarkedPoints(points=(minus,), order="x_y", epsg=32633))
    assert (read.x, read.y, code) == (-13.4, -52.5, 32633)


def test_check_needs_a_file_of_points(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--check needs --points"):
        app(["georeference", str(tmp_path), "--check"], result_action="return_value")


def test_a_map_is_for_the_page(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--map cannot be combined with --points"):
        app(["georeference", str(tmp_path), "--points", "p.csv", "--map", "m.tif"], result_action="return_value")


def own_map(folder: Path) -> ReferenceMap:
    """A map in UTM of the place that the control points are in, 240 m wide."""
    (east,), (north,) = transform("EPSG:4326", "EPSG:32633", [LON], [LAT])
    grid = Affine(0.4, 0, east - 40, 0, -0.4, north + 40)
    return ReferenceMap(write_geotiff(folder / "own.tif", squares(3), transform=grid, photometric="RGB"))


@NEEDS_PAGE
def test_the_users_map_is_served_by_tiles_and_nothing_else_is(tmp_path: Path) -> None:
    reference = own_map(tmp_path)
    zoom = reference.native_zoom
    column = int((LON + 180) / 360 * 2**zoom)
    row = int((1 - np.arcsinh(np.tan(np.radians(LAT))) / np.pi) / 2 * 2**zoom)
    with served(made_app([], reference=reference)) as client:
        with urlopen(f"http://127.0.0.1:{client.port}/map/{zoom}/{column}/{row}.png") as answer:
            tile = cv2.imdecode(np.frombuffer(answer.read(), np.uint8), cv2.IMREAD_UNCHANGED)
            assert answer.headers["content-type"] == "image/png"
            assert answer.headers["cross-origin-resource-policy"] == "same-origin"
        np.testing.assert_array_equal(cv2.cvtColor(tile, cv2.COLOR_BGRA2RGBA), reference.tile(zoom, column, row))
        for path in ("/map/0/1/0.png", "/map/99999999/0/0.png", "/map/2/0/4.png", "/map/-1/0/0.png", "/map/"):
            assert client.status(path) == 404, path
        for path in ("/map/../own.tif", "/map/own.tif", "/own.tif", f"/map/{zoom}/{column}/../../own.tif"):
            assert client.status(path) == 404, path
        assert client.status(f"/map/{zoom}/{column}/{row}.png", "POST", token_of(client)) == 405
        assert client.status(f"/map/{zoom}/{column}/{row}.png", "GET", {"Host": "elsewhere.example"}) == 400
        for path in ("/places", "/coordinates"):
            assert client.status(path, "POST", {}, "{}") == 403
            assert client.status(path, "POST", token_of(client), "{}") == 422
        assert "http" not in client.ask("/")[2]["content-security-policy"]
    with served(made_app([])) as client:  # without a map there are no such routes
        for path in ("/map/0/0/0.png", "/places", "/coordinates"):
            assert client.status(path, "POST", token_of(client), "{}") == 404


@NEEDS_PAGE
def test_a_tile_server_alone_may_be_asked_for_images() -> None:
    server = open_map("https://tiles.example:8443/{z}/{x}/{y}.png?key=1")
    with served(made_app([], reference=server)) as client:
        _, html, headers = client.ask("/")
        for policy in (headers["content-security-policy"], html):
            assert "img-src 'self' data: blob: https://tiles.example:8443;" in policy
            assert "connect-src 'self' data:;" in policy
        assert client.status("/map/0/0/0.png") == 404


@NEEDS_PAGE
def test_places_on_the_map_become_coordinates_and_back(tmp_path: Path) -> None:
    with served(made_app([], reference=own_map(tmp_path))) as client:
        token = token_of(client)
        for order, epsg, text in (
            ("longitude_latitude", None, "13.40000000, 52.50000000"),
            ("latitude_longitude", None, "52.50000000, 13.40000000"),
            ("x_y", 32633, "391390.731, 5817855.241"),
        ):
            asked = json.dumps({"longitude": LON, "latitude": LAT, "order": order, "epsg": epsg})
            status, answer, _ = client.ask("/coordinates", "POST", token, asked)
            assert (status, json.loads(answer)) == (200, {"coordinates": text})
            status, answer, _ = client.ask("/places", "POST", token, body(text, "nowhere", "", order=order, epsg=epsg))
            first, *others = json.loads(answer)["places"]
            assert first == pytest.approx((LON, LAT), abs=1e-8)
            assert others == [None, None]
        asked = json.dumps({"longitude": LON, "latitude": LAT, "order": "x_y"})
        status, answer, _ = client.ask("/coordinates", "POST", token, asked)
        assert (status, answer) == (422, "found no EPSG code for x, y, expected one such as 32633; fill it in")


def screen(page: Page) -> list[tuple[float, float]]:
    """Where the control points' pixels are on the screen."""
    left, top, width = page.value(
        "(({left, top, width}) => [left, top, width])(document.querySelector('img.frame').getBoundingClientRect())"
    )
    scale = width / 640
    return [(left + (x + 0.5) * scale, top + (y + 0.5) * scale) for x, y in PIXELS]


def cells(page: Page) -> list[list[str]]:
    found: list[list[str]] = page.value(
        "[...document.querySelectorAll('#points tbody tr')].map((row) => "
        "[...row.querySelectorAll('td')].slice(1, 3).map((cell) => cell.textContent))"
    )
    return found


def type_text(page: Page, text: str) -> None:
    page.call("Input.insertText", text=text)


@NEEDS_PAGE
def test_points_are_clicked_typed_moved_removed_and_saved(tmp_path: Path) -> None:
    saves: list[Sequence[ControlPoint]] = []
    with (
        served(made_app(saves)) as client,
        browser(tmp_path / "profile") as chromium,
        chromium.page(width=1400, height=900) as page,
    ):
        page.open(f"http://127.0.0.1:{client.port}/")
        page.wait("document.querySelector('img.frame')?.naturalWidth === 640")
        at = screen(page)
        for place, text in list(zip(at, GOOD, strict=True))[:2]:
            page.click(*place)
            type_text(page, text)
        page.wait("document.getElementById('problem').textContent.startsWith('found 2 control points')")
        page.click(*at[2])
        type_text(page, GOOD[2])
        page.wait("document.getElementById('fit').textContent.startsWith('3 control points, similarity')")
        assert page.value("document.getElementById('problem').hidden")
        assert page.value("document.getElementById('scale').textContent").startswith("0.2")
        good = np.array(cells(page), float)
        assert good.shape == (3, 2)
        assert good.max() < 1.0  # a click is within a screen pixel

        page.mouse("mouseMoved", *at[2])
        page.mouse("mousePressed", *at[2], 1)
        page.mouse("mouseMoved", at[2][0] - 30, at[2][1] + 5, 1)
        page.mouse("mouseMoved", at[2][0] - 60, at[2][1] + 5, 1)
        page.mouse("mouseReleased", at[2][0] - 60, at[2][1] + 5)
        page.wait("Number(document.querySelector('#points tbody tr:last-child').cells[3].textContent) > 3")
        page.click(*at[3])
        page.key("x")
        page.wait("document.getElementById('problem').textContent.startsWith('control point 4')")
        assert cells(page) == [["", ""]] * 4
        if AXE.exists():
            page.value(f"{AXE.read_text()};0")
            assert page.value(FINDINGS)["violations"] == []
        page.value("document.querySelector('#points tbody tr:nth-child(3) button').click()")
        page.value("document.querySelector('#points tbody tr:nth-child(3) input').select()")
        type_text(page, GOOD[3])
        page.wait("document.getElementById('fit').textContent.startsWith('3 control points')")
        assert saves == []
        page.value("document.getElementById('save').click()")
        page.wait("document.getElementById('saved').textContent.startsWith('Saved: 3')")
        assert page.value("document.getElementById('notes').textContent").startswith("the scale was not known")
        assert [line for line in page.complaints if "422" not in line] == []
    (points,) = saves
    pixels = [[point.x_px, point.y_px] for point in points]
    np.testing.assert_allclose(pixels, [PIXELS[0], PIXELS[1], PIXELS[3]], atol=1.0)
    assert (points[2].x, points[2].y) == tuple(map(float, GOOD[3].split(",")))


PLACE_ON_MAP = """((longitude, latitude) => {{
  const tile = [...document.querySelectorAll('#reference img.leaflet-tile')].find((one) => one.complete);
  const [zoom, column, row] = tile.src.match(/(\\d+)\\/(\\d+)\\/(\\d+)\\.png/).slice(1).map(Number);
  const {{left, top, width}} = tile.getBoundingClientRect();
  const x = (longitude + 180) / 360 * 2 ** zoom;
  const y = (1 - Math.asinh(Math.tan(latitude * Math.PI / 180)) / Math.PI) / 2 * 2 ** zoom;
  return [left + (x - column) * width, top + (y - row) * width].map(Math.round);
}})({place})"""
"""Nearest screen pixel of a place, by the address and position of a tile, not by what the page believes."""


@NEEDS_PAGE
def test_points_are_clicked_on_a_map_of_the_users_own(tmp_path: Path) -> None:
    saves: list[Sequence[ControlPoint]] = []
    with (
        served(made_app(saves, reference=own_map(tmp_path))) as client,
        browser(tmp_path / "profile") as chromium,
        chromium.page(width=1400, height=900) as page,
    ):
        page.open(f"http://127.0.0.1:{client.port}/")
        page.wait("document.querySelector('img.frame')?.naturalWidth === 640")
        page.wait(
            "document.querySelectorAll('#reference .leaflet-tile-loaded').length > 0 && "
            "!document.querySelector('#reference .leaflet-tile:not(.leaflet-tile-loaded)')"
        )
        page.click(*page.value(PLACE_ON_MAP.format(place=GOOD[0])))  # without a point in the picture
        page.wait("document.getElementById('problem').textContent.startsWith('Click the point in the run')")
        for k, place in enumerate(screen(page)[:3]):
            page.click(*place)
            page.click(*page.value(PLACE_ON_MAP.format(place=GOOD[k])))
            page.wait(f"document.querySelectorAll('#points input')[{k}].value !== ''")
            page.wait(f"document.querySelectorAll('#reference .point').length === {k + 1}")
        page.wait("document.getElementById('fit').textContent.startsWith('3 control points, similarity')")
        assert np.array(cells(page), float).max() < 1.5  # clicks within a screen pixel of either, 0.4 m at most
        typed = page.value("[...document.querySelectorAll('#points input')].map((one) => one.value)")
        for text, good in zip(typed, GOOD, strict=False):
            off = np.subtract(*(np.array(one.split(","), float) for one in (text, good)))
            assert np.abs(off * [67_800, 111_262]).max() < 0.73  # a screen pixel, where the whole map is shown
        page.value("document.querySelectorAll('#points input')[2].select()")
        type_text(page, GOOD[3])  # typed coordinates are shown on the map too
        x, y = page.value(PLACE_ON_MAP.format(place=GOOD[3]))
        marker = "document.querySelector('#reference .point[data-number=\"3\"]').getBoundingClientRect()"
        page.wait(f"(({{x, y, width}}) => Math.hypot(x + width / 2 - {x}, y + width / 2 - {y}) < 1.5)({marker})")
        if AXE.exists():
            page.value(f"{AXE.read_text()};0")
            assert page.value(FINDINGS)["violations"] == []
        assert [line for line in page.complaints if "422" not in line] == []
        assert all(address.startswith((f"http://127.0.0.1:{client.port}/", "data:")) for address in page.requests)
        for width, height in ((1400, 900), (390, 800)):
            page.call(
                "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
            )
            sizes = page.value(
                "['map', 'reference', 'side'].map((name) => document.getElementById(name).getBoundingClientRect())"
                ".map(({width, height}) => [width, height])"
            )
            assert np.min(sizes) > 180, sizes
            assert page.value(
                "document.getElementById('side').scrollWidth <= document.getElementById('side').clientWidth"
            )
            page.screenshot(tmp_path / f"{width}.png")
