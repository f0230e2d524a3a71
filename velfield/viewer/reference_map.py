"""A map of the user's own, to take coordinates from: a GeoTIFF or MBTiles file, or a tile server.

GDAL reads both files and reprojects to Web Mercator, tile by tile, so that a page can show either as it shows tiles of
a server. Nothing but the file is read: formats that name other files or addresses (VRT, WMS) are not opened.
"""

import math
import re
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError  # what PROJ refuses; rasterio's public errors have none for it
from rasterio.crs import CRS
from rasterio.enums import ColorInterp
from rasterio.errors import CRSError, RasterioError
from rasterio.vrt import WarpedVRT
from rasterio.warp import Resampling, transform, transform_bounds
from rasterio.windows import Window

from schemas.arrays import FloatArray, GreyImage
from velfield.errors import InputError, one_line
from velfield.sources.control_points import WGS84
from velfield.sources.frames import local_path
from velfield.sources.geo import TIFF_DRIVERS, ignore_missing_georeference

TILE_PX = 256
MAX_ZOOM = 24
_HALF_WORLD_M = math.pi * 6378137.0
_WEB_MERCATOR, _DEGREES = CRS.from_epsg(3857), CRS.from_epsg(4326)
_MAX_LATITUDE = 85.05
_NO_TRANSFORM = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
_DRIVERS = (*TIFF_DRIVERS, (b"SQLite format 3\0", "MBTiles"))
_MAX_PX_WITHOUT_OVERVIEWS = 1e8
"""All of them are read for the first view: some seconds."""
_SAMPLE_PX = 512
_PERCENTILES = 0.5, 99.5
_EXPECTED = "expected a GeoTIFF, or an MBTiles file of images"

_TEMPLATE_EXPECTED = "expected an address as https://HOST/{z}/{x}/{y}.png"
_HOST = re.compile(r"[A-Za-z0-9.-]+|\[[0-9A-Fa-f:.]+\]")

RGBAImage = NDArray[np.uint8]
"""(h, w, 4); alpha 0 where the map has no data."""


@dataclass(frozen=True)
class TileServer:
    """A tile server that the user named."""

    template: str
    """Address of a tile, with ``{z}``, ``{x}`` and ``{y}``, or ``{-y}`` where rows are counted from the south."""
    origin: str
    """Scheme, host and port: what the page may load images from."""


@dataclass(frozen=True)
class _Levels:
    """How bands become colours: a palette (n, 4) uint8, or grey levels from ``low`` to ``high``."""

    palette: NDArray[np.uint8] | None = None
    low: float = 0.0
    high: float = 255.0


class ReferenceMap:
    """A georeferenced raster file, read by web map tiles from any thread.

    Attributes
    ----------
    bounds
        West, south, east, north, degrees.
    native_zoom
        Zoom at which a tile's pixels are as fine as the file's; finer tiles show nothing more.

    Raises
    ------
    InputError
        Not there, another format, without a reference system, beyond 85 degrees north or south, or so large without
        overviews that it cannot be shown.
    """

    def __init__(self, path: Path | str) -> None:
        file = local_path(path, "map")
        self.name = file.name
        self._alone = threading.Lock()
        driver = _driver(file)
        try:
            with ignore_missing_georeference():
                self._source = rasterio.open(file, driver=driver)
        except RasterioError as error:
            raise InputError(f"--map {file.name}: could not be read ({one_line(error)}), {_EXPECTED}") from None
        try:
            self.bounds = self._check()
            self._bands, self._levels = self._read_levels()
            self._warped = self._warp()
        except (RasterioError, CPLE_BaseError) as error:
            self.close()
            raise InputError(f"--map {file.name}: could not be read ({one_line(error)}), {_EXPECTED}") from None
        except InputError:
            self.close()
            raise
        resolution_m = abs(self._warped.transform.a)
        zoom = math.ceil(math.log2(2 * _HALF_WORLD_M / TILE_PX / resolution_m) - 0.01)
        self.native_zoom = min(max(zoom, 0), MAX_ZOOM)

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def tile(self, zoom: int, column: int, row: int) -> RGBAImage | None:
        """A tile of the web map's scheme, north at the top.

        Returns
        -------
        (256, 256, 4) uint8, transparent where the file has no data; None where there is no such tile.

        Raises
        ------
        InputError
            The file is damaged there.
        """
        if not (0 <= zoom <= MAX_ZOOM and 0 <= column < 2**zoom and 0 <= row < 2**zoom):
            return None
        side_m = 2 * _HALF_WORLD_M / 2**zoom
        west, north = column * side_m - _HALF_WORLD_M, _HALF_WORLD_M - row * side_m
        grid = self._warped.transform
        scale = TILE_PX / side_m  # tile px a metre
        left, top = (grid.c - west) * scale, (north - grid.f) * scale
        across, down = grid.a * scale, -grid.e * scale  # tile px a map px
        columns, rows = _cut(left, across, self._warped.width), _cut(top, down, self._warped.height)
        tile = np.zeros((TILE_PX, TILE_PX, 4), np.uint8)
        if columns is None or rows is None:
            return tile
        window = Window(columns[2], rows[2], columns[3], rows[3])
        shape = rows[1] - rows[0], columns[1] - columns[0]
        try:
            colours = self._read(window, shape)
        except RasterioError as error:
            raise InputError(
                f"--map {self.name}: the tile {zoom}/{column}/{row} could not be read ({one_line(error)}), expected a "
                "whole file; copy it again"
            ) from None
        tile[rows[0] : rows[1], columns[0] : columns[1]] = colours
        return tile

    def _check(self) -> tuple[float, float, float, float]:
        """Refuse what cannot be shown; west, south, east, north in degrees."""
        source, name = self._source, self.name
        if source.crs is None or tuple(source.transform)[:6] == _NO_TRANSFORM:
            raise InputError(
                f"--map {name}: found no reference system, expected a map with coordinates; add one, such as with "
                "gdal_translate -a_srs -a_ullr"
            )
        if any(kind.startswith("complex") for kind in source.dtypes):
            raise InputError(f"--map {name}: found complex pixels, expected grey or colour levels; convert it")
        pixels = source.width * source.height
        if pixels > _MAX_PX_WITHOUT_OVERVIEWS and not source.overviews(1):
            raise InputError(
                f"--map {name}: found {source.width}x{source.height} px without overviews, expected some above "
                f"{_MAX_PX_WITHOUT_OVERVIEWS:.0e} px; make them: gdaladdo {name} 2 4 8 16 32 64"
            )
        west, south, east, north = transform_bounds(source.crs, _DEGREES, *source.bounds)
        if not (np.isfinite([west, south, east, north]).all() and -_MAX_LATITUDE <= south < north <= _MAX_LATITUDE):
            raise InputError(
                f"--map {name}: found latitudes from {south:g} to {north:g}, expected them within {_MAX_LATITUDE:g} "
                "degrees; cut it"
            )
        return west, south, east, north

    def _read_levels(self) -> tuple[list[int], _Levels]:
        """The bands that are shown, and how they become colours."""
        source = self._source
        colours = [k for k, kind in enumerate(source.colorinterp, 1) if kind != ColorInterp.alpha]
        bands = colours[:3] if len(colours) >= 3 else colours[:1]
        if ColorInterp.palette in source.colorinterp:
            table = np.zeros((256, 4), np.uint8)
            for value, rgba in source.colormap(1).items():
                if value < len(table):
                    table[value] = rgba
            return [1], _Levels(palette=table)
        if source.dtypes[bands[0] - 1] == "uint8":
            return bands, _Levels()
        reduced = max(source.width, source.height) / _SAMPLE_PX
        shape = tuple(max(int(side / max(reduced, 1)), 1) for side in (source.height, source.width))
        sample: Any = source.read(bands, out_shape=(len(bands), *shape), masked=True)
        values = np.ma.masked_invalid(sample).compressed()
        if not len(values):
            raise InputError(f"--map {self.name}: found no pixel with data, expected a map; check its nodata value")
        low, high = np.percentile(values, _PERCENTILES)
        return bands, _Levels(low=float(low), high=max(float(high), float(low) + 1e-12))

    def _warp(self) -> WarpedVRT:
        palette = self._levels.palette is not None
        return WarpedVRT(
            self._source,
            crs=_WEB_MERCATOR,
            resampling=Resampling.nearest if palette else Resampling.bilinear,
            add_alpha=ColorInterp.alpha not in self._source.colorinterp,
        )

    def _read(self, window: Window, shape: tuple[int, int]) -> RGBAImage:
        """Colours of a part of the map, reduced or enlarged to ``shape``: (h, w, 4) uint8."""
        kind = self._warped.colorinterp
        alpha = next(k for k, one in enumerate(kind, 1) if one == ColorInterp.alpha)
        bands = [*self._bands, alpha]
        resampling = Resampling.nearest if self._levels.palette is not None else Resampling.bilinear
        with self._alone:  # a data set of GDAL is for one thread at a time
            read = self._warped.read(bands, window=window, out_shape=(len(bands), *shape), resampling=resampling)
        data, opaque = read[:-1], np.where(read[-1] > 0, 255, 0).astype(np.uint8)
        if self._levels.palette is not None:
            colours = self._levels.palette[np.clip(data[0], 0, 255).astype(np.intp)]
            return np.dstack([colours[..., :3], np.minimum(colours[..., 3], opaque)])
        levels = _to_bytes(data.astype(np.float64), self._levels)
        rgb = levels if len(levels) == 3 else np.repeat(levels, 3, axis=0)
        return np.dstack([*rgb, opaque])


def _driver(file: Path) -> str:
    """GDAL's driver by the first bytes: its own choice would open what names other files."""
    if not file.is_file():
        raise InputError(f"--map {file.name}: found a folder, {_EXPECTED}; give a file in it")
    try:
        with file.open("rb") as opened:
            head = opened.read(16)
    except OSError as error:
        raise InputError(f"--map {file.name}: could not be read ({error.strerror}), {_EXPECTED}; check it") from None
    driver = next((name for magic, name in _DRIVERS if head.startswith(magic)), None)
    if driver is None:
        raise InputError(f"--map {file.name}: found neither a TIFF nor an SQLite file, {_EXPECTED}; convert it")
    return driver


def _to_bytes(values: FloatArray, levels: _Levels) -> GreyImage:
    spread = np.nan_to_num((values - levels.low) * (255 / (levels.high - levels.low)))
    return np.asarray(np.clip(np.round(spread), 0, 255), np.uint8)


def _cut(start: float, step: float, count: int) -> tuple[int, int, float, float] | None:
    """The part of a tile's side that ``count`` map pixels of ``step`` tile px from ``start`` on cover.

    First and last + 1 tile px; offset and length of the same in map pixels. None where they do not meet.
    """
    low, high = max(math.floor(start), 0), min(math.ceil(start + step * count), TILE_PX)
    first, last = max((low - start) / step, 0.0), min((high - start) / step, float(count))
    return None if low >= high or last <= first else (low, high, first, last - first)


def open_map(given: str) -> ReferenceMap | TileServer:
    """Open the map that the user gives: the address of tiles, else a file.

    Raises
    ------
    InputError
        Neither.

    Examples
    --------
    >>> open_map("https://tiles.example:8080/z{z}/{x}/{-y}.png").origin
    'https://tiles.example:8080'
    """
    if not re.match(r"https?://", given, re.IGNORECASE):
        return ReferenceMap(given)
    try:
        parts = urlsplit(given)
        host, port = parts.netloc.removesuffix(f":{parts.port}"), parts.port
    except ValueError as error:
        raise InputError(f"--map {given}: {error}, {_TEMPLATE_EXPECTED}; fix it") from None
    path = given[given.index(parts.netloc) + len(parts.netloc) :]
    missing = [name for name in ("{z}", "{x}", "{y}") if name not in path.replace("{-y}", "{y}")]
    if missing:
        raise InputError(f"--map {given}: found no {' and no '.join(missing)}, {_TEMPLATE_EXPECTED}; add it")
    if not _HOST.fullmatch(host) or re.search(r"[\s\"'<>\\]", path):
        raise InputError(
            f"--map {given}: found a host or a character that no address has, {_TEMPLATE_EXPECTED}; fix it"
        )
    others = re.findall(r"{[^}]*}?", re.sub(r"{(z|x|-?y)}", "", path))
    if others:
        raise InputError(f"--map {given}: found {others[0]}, {_TEMPLATE_EXPECTED}; write its value")
    scheme = parts.scheme.lower()
    origin = f"{scheme}://{host.lower()}" + ("" if port is None else f":{port}")
    return TileServer(origin + path, origin)


def change_coordinates(x: float, y: float, epsg: int, to_epsg: int) -> tuple[float, float]:
    """A place's coordinates in another reference system; of each first the one that points to the east.

    One of the two codes is `WGS84`'s: longitude and latitude.

    Raises
    ------
    InputError
        There is no such system, or it does not cover the place.
    """
    source, to = _crs(epsg), _crs(to_epsg)
    try:
        (x_to,), (y_to,) = transform(source, to, [x], [y])
    except CPLE_BaseError:
        x_to = y_to = math.nan
    if not (math.isfinite(x_to) and math.isfinite(y_to)):
        other = to_epsg if epsg == WGS84 else epsg
        raise InputError(f"found ({x:.9g}, {y:.9g}), expected a place in the area of EPSG:{other}; check the code")
    return float(x_to), float(y_to)


def _crs(epsg: int) -> CRS:
    try:
        return CRS.from_epsg(epsg)
    except CRSError:
        raise InputError(f"EPSG code {epsg}: found no such reference system, expected one such as 32633") from None
