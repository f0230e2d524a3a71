"""The base image and its georeference: read safely, reprojected from degrees, its ground sample distance measured."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio._err import CPLE_BaseError  # what PROJ refuses; rasterio's public errors have none for it
from rasterio.crs import CRS
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioError
from rasterio.transform import Affine
from rasterio.warp import Resampling, reproject, transform

from schemas.arrays import Float32Array, FloatArray, GreyImage, Mask
from schemas.flight import FramesConfig
from velfield.errors import InputError, one_line
from velfield.sources.frames import local_path
from velfield.sources.images import check_size, read_grey_image, read_magic

TIFF_DRIVERS = ((b"II*\0", "GTiff"), (b"MM\0*", "GTiff"), (b"II+\0", "GTiff"), (b"MM\0+", "GTiff"))
_PICTURE_DRIVERS = ((b"\x89PNG", "PNG"), (b"\xff\xd8\xff", "JPEG"), (b"BM", "BMP"))
WGS84_A_M, WGS84_E2 = 6378137.0, 0.00669437999014
_SQUARE = 0.02
"""Pixels whose two sides differ by more than this fraction are not square; speeds would depend on direction."""
MAX_GSD_DISAGREEMENT = 0.02


@dataclass(frozen=True)
class BaseRaster:
    """The base image's pixels and georeference."""

    grey: GreyImage
    """(h, w) uint8: the base image; its pixels are base pixels."""
    crs_wkt: str | None = None
    affine: tuple[float, float, float, float, float, float] | None = None
    gsd_m: float | None = None
    """Reference system; (a, b, c, d, e, f) from (column, row) of pixel corners to its coordinates, as rasterio's
    `Affine`; metres a pixel by the reference system's local scale at the centre. None without a reference system; of a
    local one, which has metres but no place on Earth, only ``gsd_m`` is known."""
    valid: Mask | None = None
    """(h, w) bool, False where there is no data; None where all pixels have some."""
    notes: tuple[str, ...] = ()
    """Notes on what was changed or is not used, one line each."""


def read_base_raster(path: Path | str, config: FramesConfig) -> BaseRaster:
    """Read the base image given as ``--base``.

    GeoTIFF; or PNG, JPEG, TIFF, BMP, with its reference system where there are a world file and a ``.prj`` or
    ``.aux.xml`` beside it. An image in degrees is reprojected to the UTM zone of its centre. A local reference system,
    as of a survey without GPS, gives the scale alone.

    Raises
    ------
    InputError
        An address, a VRT, another format, too large, truncated, pixels that are not square on the ground.
    """
    file = local_path(path, "base image")
    head = read_magic(file, "a base image; check it")
    driver = next((name for magic, name in TIFF_DRIVERS if head.startswith(magic)), None)
    if driver is not None:
        return _read_geotiff(file, config.max_pixels)
    grey = read_grey_image(file, config.max_pixels)  # refuses what it cannot read
    return _read_beside(file, grey, head, config.max_pixels)


def ground_sample_distance_m(crs: CRS, affine: Affine, shape: tuple[int, int], *, name: str) -> float:
    """Metres a pixel on the ground at the image's centre, by the reference system's local scale.

    Measured on the ellipsoid between pixels around the centre, which is right for Web Mercator (18 % too large at 32
    degrees north), feet and any other system.

    Raises
    ------
    InputError
        The pixels are not square on the ground.
    """
    rows, columns = shape
    step = max(min(rows, columns) / 8, 1.0)
    x0, y0 = columns / 2, rows / 2
    ends = [(x0 - step, y0), (x0 + step, y0), (x0, y0 - step), (x0, y0 + step)]
    xs, ys = zip(*(_apply_affine(affine, *end) for end in ends), strict=True)
    longitude, latitude = (np.radians(values) for values in _to_degrees(crs, xs, ys, name))
    across = _ground_distance(longitude[:2], latitude[:2]) / (2 * step)
    down = _ground_distance(longitude[2:], latitude[2:]) / (2 * step)
    return _square_side(across, down, name)


def true_north_rad(crs_wkt: str, affine: Sequence[float], shape: tuple[int, int], *, name: str) -> float:
    """Direction of true north in the middle of an image, from +x towards +y (down): a reference system's own north is
    off by up to some degrees, 2.3 in a UTM zone at 50 degrees. ``affine`` (6,), row by row, is from pixels to the
    coordinates of the system, ``shape`` (height, width) px.
    """
    crs, matrix = CRS.from_wkt(crs_wkt), np.reshape(affine, (2, 3))
    x, y = matrix @ (shape[1] / 2, shape[0] / 2, 1.0)
    longitude, latitude = _to_degrees(crs, [x], [y], name)
    xs, ys = transform(CRS.from_epsg(4326), crs, [longitude[0]] * 2, [latitude[0], latitude[0] + 1e-4])
    step = np.linalg.solve(matrix[:, :2], [xs[1] - xs[0], ys[1] - ys[0]])
    return float(np.arctan2(step[1], step[0]))


def _square_side(across: float, down: float, name: str) -> float:
    if not abs(across - down) <= _SQUARE * max(across, down):
        raise InputError(
            f"{name}: found pixels of {across:.4g} m by {down:.4g} m on the ground, expected square ones; "
            "resample it, such as with gdalwarp -tr"
        )
    return float(np.sqrt(across * down))


def _to_degrees(crs: CRS, xs: Sequence[float], ys: Sequence[float], name: str) -> tuple[FloatArray, FloatArray]:
    """Longitude and latitude (n,) of coordinates of a reference system, degrees."""
    try:
        longitude, latitude = (np.asarray(values) for values in transform(crs, CRS.from_epsg(4326), xs, ys))
        reason = "" if np.isfinite([longitude, latitude]).all() else "coordinates beyond its area"
    except (CPLE_BaseError, RasterioError) as error:
        reason = one_line(error)
    if reason:
        raise InputError(
            f"{name}: found a reference system that does not cover the image ({reason}), expected one that does; fix it"
        )
    return longitude, latitude


def utm_crs(longitude: float, latitude: float) -> CRS:
    """The reference system of the UTM zone of a place.

    Examples
    --------
    >>> utm_crs(36.2, 50.0).to_epsg()
    32637
    """
    zone = min(int((longitude + 180) // 6) + 1, 60)
    return CRS.from_epsg((32600 if latitude >= 0 else 32700) + zone)


def reconcile_gsd(from_crs_m: float | None, given_m: float | None) -> float | None:
    """The ground sample distance, m a pixel: the reference system's, else the one given, else None.

    Raises
    ------
    InputError
        The two differ by more than 2 %.

    Examples
    --------
    >>> reconcile_gsd(0.2301, 0.23), reconcile_gsd(None, 0.23), reconcile_gsd(None, None)
    (0.2301, 0.23, None)
    """
    if from_crs_m is None or given_m is None:
        return given_m if from_crs_m is None else from_crs_m
    if abs(given_m - from_crs_m) > MAX_GSD_DISAGREEMENT * from_crs_m:
        raise InputError(
            f"found --gsd-m {given_m:g}, expected {from_crs_m:.4g} m a pixel by the base image's reference "
            "system; omit --gsd-m, or fix the image's georeference"
        )
    return from_crs_m


def _place(path: Path, raster: BaseRaster, crs: CRS, affine: Affine) -> BaseRaster:
    """The image in a reference system with metres or feet."""
    rows, columns = raster.grey.shape
    gsd_m = ground_sample_distance_m(crs, affine, (rows, columns), name=path.name)
    return replace(raster, crs_wkt=crs.to_wkt(), affine=tuple(affine)[:6], gsd_m=gsd_m)


@contextmanager
def ignore_missing_georeference() -> Iterator[None]:
    """Without a warning that an image is not georeferenced, as many are not.

    Filters of warnings belong to the whole process: where one of several threads writes images, enter this
    before they start, or another that leaves `warnings.catch_warnings` meanwhile takes it back.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


def _read_geotiff(path: Path, max_pixels: int) -> BaseRaster:
    """Read with GDAL's GTiff driver alone: a VRT named .tif would read other files."""
    try:
        with ignore_missing_georeference():
            dataset = rasterio.open(path, driver="GTiff")
        with dataset:
            check_size(path, dataset.width, dataset.height, max_pixels)
            crs, affine, points = dataset.crs, dataset.transform, len(dataset.gcps[0])
            grey, valid = _grey_levels(path, dataset)
    except RasterioError as error:
        raise InputError(
            f"{path.name}: the TIFF is truncated or damaged ({one_line(error)}), expected a whole one"
        ) from None
    return _with_georeference(path, BaseRaster(grey, valid=valid), crs, affine, points, max_pixels)


def _with_georeference(
    path: Path, raster: BaseRaster, crs: CRS | None, affine: Affine, points: int, max_pixels: int
) -> BaseRaster:
    """The image with the georeference that is there, or with a note why it is not used."""
    crs = crs if crs is not None else _prj(path)
    if affine.is_identity:
        if points:
            return replace(raster, notes=(f"its {points} ground control points are not used: apply gdalwarp",))
        return raster if crs is None else replace(raster, notes=("a reference system without a place: it is not used",))
    if crs is None:
        note = "a place without a .prj, .aux.xml or tag that names its reference system: it is not used"
        return replace(raster, notes=(note,))
    if crs.is_geographic:
        return _to_utm(path, raster, crs, affine, max_pixels)
    if crs.is_projected:
        return _place(path, raster, crs, affine)
    return _with_local_scale(path, raster, crs, affine)


def _with_local_scale(path: Path, raster: BaseRaster, crs: CRS, affine: Affine) -> BaseRaster:
    """The image with the scale of a reference system that has no place on Earth, as surveys without GPS write it."""
    system = crs.to_dict(projjson=True)
    unit = system.get("coordinate_system", {}).get("axis", [{}])[0].get("unit")
    if isinstance(unit, dict) and unit.get("type") == "LinearUnit" and unit.get("name") != "unknown":
        metres = float(unit["conversion_factor"])
    else:
        metres = 1.0 if unit == "metre" else 0.0
    if system.get("type") != "EngineeringCRS" or not metres:
        note = f"its reference system {system.get('name', '')} is none of a map in metres or degrees: it is not used"
        return replace(raster, notes=(note,))
    a, b, _, d, e, _ = tuple(affine)[:6]
    gsd_m = _square_side(float(np.hypot(a, d)) * metres, float(np.hypot(b, e)) * metres, path.name)
    note = f"its reference system {system.get('name', '')} is a local one: {gsd_m:.4g} m a pixel, no place on Earth"
    return replace(raster, gsd_m=gsd_m, notes=(note,))


def _grey_levels(path: Path, dataset: Any) -> tuple[GreyImage, Mask | None]:
    """Bands to grey: luma of three or more, else the first; other depths by their 0.5 to 99.5 percentile."""
    if any(name.startswith("complex") for name in dataset.dtypes):
        raise InputError(f"{path.name}: found complex pixels, expected grey or colour levels; convert it")
    valid = dataset.dataset_mask() > 0
    if not valid.any():
        raise InputError(f"{path.name}: found no pixel with data, expected an image; check its nodata value")
    if dataset.count >= 3:
        red, green, blue = (dataset.read(band).astype(np.float32) for band in (1, 2, 3))
        levels = 0.299 * red + 0.587 * green + 0.114 * blue
    else:
        levels = _first_band(path, dataset)
    valid &= np.isfinite(levels)
    if dataset.dtypes[0] != "uint8":
        low, high = np.percentile(levels[valid], (0.5, 99.5))
        levels = (levels - low) * (255 / max(high - low, 1e-12))
    grey = np.clip(np.round(np.where(valid, levels, 0)), 0, 255).astype(np.uint8)
    return grey, None if valid.all() else valid


def _first_band(path: Path, dataset: Any) -> Float32Array:
    band = dataset.read(1)
    try:
        palette = dataset.colormap(1)
    except ValueError:
        return np.asarray(band, np.float32)
    table = np.zeros(max(256, int(band.max()) + 1), np.float32)
    for value, (red, green, blue, *_) in palette.items():
        if value < table.size:
            table[value] = 0.299 * red + 0.587 * green + 0.114 * blue
    return np.asarray(table[band], np.float32)


def _read_beside(path: Path, grey: GreyImage, head: bytes, max_pixels: int) -> BaseRaster:
    """A plain image with the georeference of the world file and ``.prj`` or ``.aux.xml`` beside it."""
    raster = BaseRaster(grey)
    driver = next((name for magic, name in _PICTURE_DRIVERS if head.startswith(magic)), None)
    if driver is None:
        return raster
    try:
        with ignore_missing_georeference(), rasterio.open(path, driver=driver) as dataset:
            crs, affine, points = dataset.crs, dataset.transform, len(dataset.gcps[0])
    except RasterioError as error:
        return replace(raster, notes=(f"its reference could not be read: {one_line(error)}",))
    return _with_georeference(path, raster, crs, affine, points, max_pixels)


def _prj(path: Path) -> CRS | None:
    beside = path.with_suffix(".prj")
    if not beside.is_file():
        return None
    try:
        return CRS.from_user_input(beside.read_text(encoding="utf-8", errors="replace").strip()[:100_000])
    except (CRSError, OSError) as error:
        raise InputError(
            f"{beside.name}: found no reference system ({one_line(error)}), expected WKT; fix or remove it"
        ) from None


def _to_utm(path: Path, raster: BaseRaster, crs: CRS, affine: Affine, max_pixels: int) -> BaseRaster:
    """Reproject from degrees, where a pixel has no length; bicubic, which keeps the image sharp for registration."""
    rows, columns = raster.grey.shape
    centre_x, centre_y = _apply_affine(affine, columns / 2, rows / 2)
    (longitude,), (latitude,) = _to_degrees(crs, [centre_x], [centre_y], path.name)
    if not (-180 <= longitude <= 180 and -80 <= latitude <= 84):
        raise InputError(
            f"{path.name}: found its centre at {longitude:g}, {latitude:g} degrees, expected it between 80 south and "
            "84 north; fix its georeference"
        )
    utm = utm_crs(longitude, latitude)
    zone = utm.to_epsg() % 100
    grid, width, height = _utm_grid((rows, columns), crs, affine, utm)
    check_size(path, width, height, max_pixels)
    shape = (height, width)
    grey, valid = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    source = np.ones(raster.grey.shape, np.uint8) if raster.valid is None else raster.valid.astype(np.uint8)
    transforms = {"src_crs": crs, "src_transform": affine, "dst_crs": utm, "dst_transform": grid}
    reproject(raster.grey, grey, resampling=Resampling.cubic, **transforms)
    reproject(source, valid, resampling=Resampling.nearest, **transforms)
    mask = valid > 0
    note = f"reprojected from degrees to UTM zone {zone}{'N' if latitude >= 0 else 'S'} ({width}x{height} px)"
    moved = BaseRaster(grey, valid=None if mask.all() else mask, notes=(*raster.notes, note))
    return _place(path, moved, utm, grid)


def _utm_grid(shape: tuple[int, int], crs: CRS, affine: Affine, utm: CRS) -> tuple[Affine, int, int]:
    """North-up grid of square pixels over the image, of the resolution along its diagonal (as GDAL's)."""
    rows, columns = shape
    fraction = np.linspace(0, 1, 21)
    border = np.r_[
        np.c_[fraction * columns, np.zeros(21)],
        np.c_[fraction * columns, np.full(21, rows)],
        np.c_[np.zeros(21), fraction * rows],
        np.c_[np.full(21, columns), fraction * rows],
    ]
    xs, ys = zip(*(_apply_affine(affine, column, row) for column, row in border), strict=True)
    east, north = (np.asarray(values) for values in transform(crs, utm, xs, ys))
    pixel = float(np.hypot(np.ptp(east), np.ptp(north)) / np.hypot(columns, rows))
    width, height = (max(int(np.ceil(np.ptp(values) / pixel - 1e-6)), 1) for values in (east, north))
    return Affine(pixel, 0, float(east.min()), 0, -pixel, float(north.max())), width, height


def _apply_affine(affine: Affine, column: float, row: float) -> tuple[float, float]:
    """Coordinates of a point of the image; written out, since `Affine` is changing its operator."""
    a, b, c, d, e, f = tuple(affine)[:6]
    return a * column + b * row + c, d * column + e * row + f


def _ground_distance(longitude: FloatArray, latitude: FloatArray) -> float:
    """Metres between two nearby points on the WGS 84 ellipsoid, by its radii of curvature at their midpoint."""
    middle = float(latitude.mean())
    flat = 1 - WGS84_E2 * np.sin(middle) ** 2
    north = WGS84_A_M * (1 - WGS84_E2) / flat**1.5 * (latitude[1] - latitude[0])
    difference = (longitude[1] - longitude[0] + np.pi) % (2 * np.pi) - np.pi
    east = WGS84_A_M / np.sqrt(flat) * np.cos(middle) * difference
    return float(np.hypot(north, east))
