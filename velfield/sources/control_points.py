"""Ground control points: read from a CSV, and the map fitted to them, by a similarity or an affine transform."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from rasterio.crs import CRS
from rasterio.errors import CRSError
from rasterio.transform import Affine
from rasterio.warp import transform

from schemas.arrays import FloatArray, Points
from schemas.georeference import ControlPoint, ControlPointsRecord, PointResidual
from velfield.errors import InputError
from velfield.sources.frames import local_path
from velfield.sources.geo import ground_sample_distance_m, utm_crs
from velfield.sources.table import number_cell, read_csv_rows
from velfield.sources.telemetry.placement import affine_of_pixels

WGS84 = 4326
_MIN_POINTS = 3
_AFFINE_POINTS = 6
"""An affine transform is only tried with so many points: with fewer it follows their errors."""
_MAX_COORDINATE = 1e8
"""No reference system has larger ones; with those PROJ computes without end."""
_LONGITUDE, _LATITUDE = ("longitude", "lon", "longitude_deg"), ("latitude", "lat", "latitude_deg")
Model = Literal["similarity", "affine"]


def read_control_points(path: Path | str, epsg: int | None = None) -> tuple[tuple[ControlPoint, ...], int]:
    """Control points of a CSV, and the EPSG code of their coordinates.

    It has the columns ``x_px, y_px`` (pixels of the base image) and ``longitude, latitude`` or ``x, y``; optional are
    ``name`` and ``epsg``, the code of ``x, y``, which may be given.

    Raises
    ------
    InputError
        Not such a table, or the reference system of ``x, y`` is not known.
    """
    file = local_path(path, "control points")
    names = ("x", "y", "name", "epsg", *_LONGITUDE, *_LATITUDE)
    rows = list(read_csv_rows(file, required=("x_px", "y_px"), optional=names, what="control points"))
    if not rows:
        raise InputError(f"{file.name}: found no control points, expected {_MIN_POINTS} or more")
    first = rows[0][1]
    longitude = next((name for name in _LONGITUDE if first.get(name)), None)
    latitude = next((name for name in _LATITUDE if first.get(name)), None)
    columns = (longitude, latitude) if longitude and latitude else ("x", "y")
    if columns == ("x", "y"):
        epsg = epsg if epsg is not None else _epsg_column(file, [row for _, row in rows])
    elif epsg not in (None, WGS84):
        raise InputError(f"--epsg {epsg}: found columns {longitude} and {latitude}, which are degrees; omit it")
    points = [
        ControlPoint(
            x_px=number_cell(file, line, row, "x_px"),
            y_px=number_cell(file, line, row, "y_px"),
            x=number_cell(file, line, row, columns[0]),
            y=number_cell(file, line, row, columns[1]),
            name=row.get("name", ""),
        )
        for line, row in rows
    ]
    return tuple(points), WGS84 if epsg is None or columns != ("x", "y") else epsg


def _epsg_column(file: Path, rows: Sequence[dict[str, str]]) -> int:
    codes = {row.get("epsg", "") for row in rows}
    code = codes.pop() if len(codes) == 1 else ""
    if not code.isdecimal():
        raise InputError(
            f"{file.name}: found coordinates x, y without one reference system, expected an EPSG code; give --epsg, "
            "or columns longitude and latitude"
        )
    return int(code)


@dataclass(frozen=True)
class _Fit:
    """``linear @ xy + offset`` of base pixels in the map's reference system, and errors at the points in its units."""

    linear: FloatArray
    offset: FloatArray
    residual: FloatArray
    left_out: FloatArray


def fit_control_points(
    points: Sequence[ControlPoint], epsg: int, *, shape: tuple[int, int], base_digest: str, model: Model | None = None
) -> ControlPointsRecord:
    """Fit the map of a base image (h, w) to three control points or more; degrees are projected to their UTM zone.

    Without a model it is a similarity, or with six points or more an affine transform where that is closer at points
    left out.

    Raises
    ------
    InputError
        Too few points, on one line, outside the image, of no reference system, or the map would be distorted.
    """
    _check(points, shape)
    pixels = np.array([[point.x_px, point.y_px] for point in points])
    crs, ground = _project(points, epsg)
    if np.linalg.det(_solve(pixels, ground, "affine")[0]) >= 0:
        raise InputError("found control points that mirror the map, expected y_px downwards; exchange the coordinates")
    models: tuple[Model, ...] = (
        (model,) if model else ("similarity", "affine") if len(points) >= _AFFINE_POINTS else ("similarity",)
    )
    fits = {name: _fit(pixels, ground, name) for name in models}
    chosen = min(fits, key=lambda name: float(np.nanmean(fits[name].left_out ** 2)) if len(fits) > 1 else 0.0)
    return _record(points, epsg, crs, chosen, fits[chosen], shape, base_digest)


def _check(points: Sequence[ControlPoint], shape: tuple[int, int]) -> None:
    if len(points) < _MIN_POINTS:
        raise InputError(f"found {len(points)} control points, expected {_MIN_POINTS} or more, far apart; add some")
    height, width = shape
    for number, point in enumerate(points, start=1):
        if not (-0.5 <= point.x_px <= width - 0.5 and -0.5 <= point.y_px <= height - 0.5):
            raise InputError(
                f"control point {point.name or number}: found the pixel ({point.x_px:g}, {point.y_px:g}), expected one "
                f"of the map of {width} x {height} px"
            )
        if not max(abs(point.x), abs(point.y)) < _MAX_COORDINATE:
            raise InputError(
                f"control point {point.name or number}: found coordinates ({point.x:g}, {point.y:g}), too large in "
                "metres and in feet; correct them"
            )
    pixels = np.array([[point.x_px, point.y_px] for point in points])
    spread = np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)
    if spread[1] < 0.02 * max(spread[0], 1.0):
        raise InputError(
            "found all control points on one line, expected them spread over the map; add one off that line"
        )


def _project(points: Sequence[ControlPoint], epsg: int) -> tuple[CRS, Points]:
    """The map's reference system and the points (n, 2) in it."""
    try:
        crs = CRS.from_epsg(epsg)
    except CRSError:
        raise InputError(
            f"--epsg {epsg}: found no such reference system, expected an EPSG code such as 32633"
        ) from None
    xs, ys = [point.x for point in points], [point.y for point in points]
    if not crs.is_geographic:
        return crs, np.column_stack([xs, ys])
    if max(map(abs, ys)) > 84 or max(map(abs, xs)) > 180:
        raise InputError(
            f"found a control point at longitude {xs[0]:g}, latitude {ys[0]:g}, expected degrees, longitude first; "
            "check the columns, or give --epsg"
        )
    utm = utm_crs(float(np.mean(xs)), float(np.mean(ys)))
    east, north = transform(crs, utm, xs, ys)
    return utm, np.column_stack([east, north])


def _fit(pixels: Points, ground: Points, model: Model) -> _Fit:
    linear, offset = _solve(pixels, ground, model)
    residual = np.linalg.norm(pixels @ linear.T + offset - ground, axis=1)
    left_out = np.full(len(pixels), np.nan)
    for k in range(len(pixels) if len(pixels) > (2 if model == "similarity" else 3) else 0):
        kept = np.arange(len(pixels)) != k
        part, shift = _solve(pixels[kept], ground[kept], model)
        left_out[k] = np.linalg.norm(part @ pixels[k] + shift - ground[k])
    return _Fit(linear, offset, residual, left_out)


def _solve(pixels: Points, ground: Points, model: Model) -> tuple[FloatArray, FloatArray]:
    """Least squares; y of pixels points down and of coordinates up, so that a similarity mirrors."""
    middle, target = pixels.mean(axis=0), ground.mean(axis=0)
    p, q = pixels - middle, ground - target
    if model == "affine":
        linear = np.linalg.lstsq(p, q, rcond=None)[0].T
    else:
        rows = np.concatenate([np.column_stack([p[:, 0], p[:, 1]]), np.column_stack([-p[:, 1], p[:, 0]])])
        (a, b), *_ = np.linalg.lstsq(rows, np.concatenate([q[:, 0], q[:, 1]]), rcond=None)
        linear = np.array([[a, b], [b, -a]])
    return linear, target - linear @ middle


def _record(
    points: Sequence[ControlPoint],
    epsg: int,
    crs: CRS,
    model: Model,
    fit: _Fit,
    shape: tuple[int, int],
    base_digest: str,
) -> ControlPointsRecord:
    affine = affine_of_pixels(fit.linear, fit.offset)
    gsd_m = ground_sample_distance_m(crs, Affine(*affine), shape, name=f"the map by control points in EPSG:{epsg}")
    metres = gsd_m / float(np.sqrt(abs(np.linalg.det(fit.linear))))  # a unit of the reference system, on the ground
    pixels = np.array([[point.x_px, point.y_px] for point in points])
    freedom = 2 * len(points) - (4 if model == "similarity" else 6)
    sigma_m = float(np.sqrt(np.sum((fit.residual * metres) ** 2) / max(freedom, 1)))
    reach_px = float(np.sqrt(np.sum((pixels - pixels.mean(axis=0)) ** 2)))
    known = np.isfinite(fit.left_out)
    residuals = [
        PointResidual(residual_m=float(residual), left_out_m=float(left_out) if np.isfinite(left_out) else None)
        for residual, left_out in zip(fit.residual * metres, fit.left_out * metres, strict=True)
    ]
    return ControlPointsRecord(
        points=tuple(points),
        epsg=epsg,
        model=model,
        crs_wkt=crs.to_wkt(),
        affine=affine,
        gsd_m=gsd_m,
        gsd_sd_m=sigma_m / reach_px,
        north_sd_deg=float(np.degrees(sigma_m / (gsd_m * reach_px))),
        residuals=tuple(residuals),
        rms_m=float(np.sqrt(np.mean((fit.residual * metres) ** 2))),
        left_out_rms_m=float(np.sqrt(np.mean((fit.left_out[known] * metres) ** 2))) if known.any() else None,
        base_digest=base_digest,
        degrees_of_freedom=max(freedom, 0),
    )


def residual_table(record: ControlPointsRecord) -> str:
    """The fit, one line a point: residual, and error where the point is left out of the fit, m."""
    lines = [f"{'point':<16} {'residual, m':>12} {'left out, m':>12}"]
    for number, (point, error) in enumerate(zip(record.points, record.residuals, strict=True), start=1):
        left_out = "" if error.left_out_m is None else f"{error.left_out_m:12.2f}"
        lines.append(f"{point.name or number!s:<16} {error.residual_m:12.2f} {left_out:>12}".rstrip())
    return "\n".join([*lines, f"{record.text()}; {scale_text(record)}"])


def scale_text(record: ControlPointsRecord) -> str:
    """The map's scale by the points, and how sure scale and north are."""
    return f"{record.gsd_m:.4g} m a pixel ± {record.gsd_sd_m:.2g}, north to {record.north_sd_deg:.2f}°"
