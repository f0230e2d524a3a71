"""Ground control points: read in every form, fitted with their errors, refused where they cannot be right."""

from pathlib import Path

import numpy as np
import pytest
from rasterio.crs import CRS
from rasterio.warp import transform

from schemas.georeference import ControlPoint, ControlPointsRecord
from velfield.errors import InputError
from velfield.sources.control_points import Model, fit_control_points, read_control_points, residual_table

SHAPE = (600, 800)
GSD_M, HEADING_DEG = 0.08, 33.0
"""Of a made map in UTM zone 33N; the heading of its top."""
PIXELS = np.array([[40.0, 30.0], [760.0, 50.0], [700.0, 560.0], [60.0, 540.0], [420.0, 300.0], [300.0, 90.0]])


def ground(pixels: np.ndarray) -> np.ndarray:
    """Coordinates in the zone of base pixels (n, 2)."""
    c, s = np.cos(np.radians(HEADING_DEG)), np.sin(np.radians(HEADING_DEG))
    x, y = pixels.T * GSD_M
    return np.column_stack([390_000 + c * x - s * y, 5_820_000 - s * x - c * y])


def points(count: int, error_m: float = 0.0, seed: int = 0) -> list[ControlPoint]:
    east, north = (ground(PIXELS) + np.random.default_rng(seed).normal(0, error_m, PIXELS.shape)).T
    longitude, latitude = transform(CRS.from_epsg(32633), CRS.from_epsg(4326), east, north)
    rows = list(zip(PIXELS, longitude, latitude, strict=True))[:count]
    return [ControlPoint(x_px=p[0], y_px=p[1], x=lon, y=lat) for p, lon, lat in rows]


def fit(given: list[ControlPoint], epsg: int = 4326, model: Model | None = None) -> ControlPointsRecord:
    return fit_control_points(given, epsg, shape=SHAPE, base_digest="0", model=model)


@pytest.mark.parametrize("model", ["similarity", "affine"])
def test_exact_points_give_the_map(model: Model) -> None:
    found = fit(points(4), model=model)
    corner = np.reshape(found.affine, (2, 3)) @ (100.5, 200.5, 1.0)  # pixel (100, 200) by its corner's convention
    assert corner == pytest.approx(ground(np.array([[100.0, 200.0]]))[0], abs=0.01)
    assert found.gsd_m == pytest.approx(GSD_M, rel=1e-3)
    assert CRS.from_wkt(found.crs_wkt).to_epsg() == 32633
    assert found.rms_m < 0.005


def test_the_error_at_left_out_points_is_that_of_the_points() -> None:
    found = [fit(points(6, error_m=0.3, seed=seed), model="similarity") for seed in range(40)]
    assert np.mean([record.rms_m for record in found]) < 0.45
    left_out = np.sqrt(np.mean([record.left_out_rms_m**2 for record in found if record.left_out_rms_m]))
    assert 0.42 < left_out < 0.75  # a point's own error of 0.3 m in either axis, and that of the fit without it
    off = np.array([(record.gsd_m - GSD_M) / record.gsd_sd_m for record in found])
    assert 0.5 < off.std() < 1.7


def test_a_wrong_point_shows() -> None:
    given = points(6)
    given[2] = given[2].model_copy(update={"x": given[2].x + 0.0002})  # 13 m east
    errors = [error.left_out_m or 0.0 for error in fit(given, model="similarity").residuals]
    assert int(np.argmax(errors)) == 2
    assert errors[2] > 10
    assert "13" in residual_table(fit(given, model="similarity")).splitlines()[3]


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        (points(2), "found 2 control points"),
        ([ControlPoint(x_px=k, y_px=k, x=13 + k / 1e5, y=52) for k in (1, 200, 500)], "on one line"),
        ([*points(3), ControlPoint(x_px=900, y_px=3, x=13, y=52)], r"expected one of the map of 800 x 600"),
        ([ControlPoint(x_px=p.x_px, y_px=599 - p.y_px, x=p.x, y=p.y) for p in points(4)], "mirror"),
        ([ControlPoint(x_px=p.x_px, y_px=p.y_px, x=390_000, y=p.y) for p in points(4)], "longitude first"),
    ],
)
def test_points_that_cannot_be_right_are_refused(given: list[ControlPoint], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        fit(given)


def test_every_form_of_the_table_gives_the_same_points(tmp_path: Path) -> None:
    degrees, metres = points(4), ground(PIXELS[:4])
    tables = {
        "x_px,y_px,longitude,latitude": [f"{p.x_px},{p.y_px},{p.x:.9f},{p.y:.9f}" for p in degrees],
        "lat,lon,x_px,y_px,name": [f"{p.y:.9f},{p.x:.9f},{p.x_px},{p.y_px},kerb" for p in degrees],
        "x_px,y_px,x,y,epsg": [f"{p.x_px},{p.y_px},{m[0]},{m[1]},32633" for p, m in zip(degrees, metres, strict=True)],
    }
    fits = []
    for number, (header, rows) in enumerate(tables.items()):
        path = tmp_path / f"{number}.csv"
        path.write_text("\n".join([header, *rows]))
        fits.append(fit(*map(list, [read_control_points(path)[0]]), epsg=read_control_points(path)[1]))
    for other in fits[1:]:
        assert other.affine == pytest.approx(fits[0].affine, abs=1e-3)
    assert fits[1].points[0].name == "kerb"
    path.write_text("x_px,y_px,x,y\n1,2,3,4\n")
    with pytest.raises(InputError, match="--epsg"):
        read_control_points(path)
