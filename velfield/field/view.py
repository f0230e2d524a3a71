"""`VelocityField`: queries on a velocity field over tiles from any source, few of them in memory at a time."""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from threading import Lock
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Float32Array, FloatArray
from velfield.errors import InputError
from velfield.field.accumulate import FieldTile, accumulate_tile
from velfield.field.gate import COVERAGE, VelocityGate, make_gate
from velfield.field.modes import modal_velocity
from velfield.field.pixel import PixelDistribution, describe_pixel
from velfield.field.prior import densities_at_pixel, log_density_in_window
from velfield.field.segments import Segments, VelocityBins, segments_by_tile
from velfield.field.statistics import TileStatistics, direction_rad, speed_px_per_s, tile_statistics

TileSource = Callable[[int, int], FieldTile | None]
"""Returns tile (ty, tx), or None where no vehicle passed; tiles at the map's edge may be cut or padded."""
LayerSource = Callable[[str], NDArray[Any]]
"""Returns a whole (y, x) layer by its name."""

T = TypeVar("T")
_Window = tuple[slice, slice]
_CACHED_TILES = 12
"""The nine that places in one tile can need, and the three more of the tile beside it: with fewer, places all over the
map read each tile several times."""
_MAP_SAMPLE_TILES = 64
_NEIGHBOURHOOD_M = 1.5
_NEIGHBOURHOOD_PX = 6
"""Radius of a pixel's neighbourhood in the prior, where the ground sample distance is known and where it is not."""


class VelocityField:
    """A velocity field over a source of tiles.

    Parameters
    ----------
    source
        Returns the tile (ty, tx), or None; called from several threads if ``threads`` is more than one.
    tiles
        The tiles that are not empty: no other is read.
    shape
        (height, width) of the map, base px.
    tile_size
        Side of a tile, px.
    bins
        Velocity axes.
    stationary_speed_px_per_s
        A modal speed below this has no direction.
    threads
        Number of tiles that methods over the whole map process in parallel.
    layers
        Returns a (y, x) layer stored with the tiles (``modal_vx``, ``modal_vy``, ``count``), so that maps of these need
        no tile; None: they are computed from the tiles.
    """

    def __init__(
        self,
        source: TileSource,
        *,
        tiles: Sequence[tuple[int, int]],
        shape: tuple[int, int],
        tile_size: int,
        bins: VelocityBins,
        stationary_speed_px_per_s: float,
        threads: int = 1,
        layers: LayerSource | None = None,
    ) -> None:
        self.shape, self.tile_size, self.bins = shape, tile_size, bins
        self.stationary_speed_px_per_s = stationary_speed_px_per_s
        self.tiles = sorted(tiles)
        self._known = frozenset(self.tiles)
        self._source, self._threads, self._layers = source, threads, layers
        self._cache: OrderedDict[tuple[int, int], FieldTile | None] = OrderedDict()
        self._lock = Lock()
        self._modal: Float32Array | None = None
        self._map_weights: FloatArray | None = None

    @classmethod
    def from_segments(
        cls,
        segments: Segments,
        *,
        shape: tuple[int, int],
        tile_size: int,
        bins: VelocityBins,
        radius_px: float | None,
        stationary_speed_px_per_s: float,
    ) -> "VelocityField":
        """The field of a segment table; its tiles are accumulated when they are read."""
        rows = segments_by_tile(segments, shape=shape, tile_size=tile_size, radius_px=radius_px)

        def make(ty: int, tx: int) -> FieldTile:
            origin = (tx * tile_size, ty * tile_size)
            part = segments[rows[ty, tx]]
            size = (tile_size, tile_size)
            return accumulate_tile(part, origin_xy=origin, shape=size, bins=bins, radius_px=radius_px)

        return cls(
            make,
            tiles=list(rows),
            shape=shape,
            tile_size=tile_size,
            bins=bins,
            stationary_speed_px_per_s=stationary_speed_px_per_s,
        )

    # -- the map ------------------------------------------------------------------------------------------------------

    def modal_velocity(self) -> Float32Array:
        """(y, x, 2) float32 velocity of the highest mode as (vx, vy) px/s; NaN where no vehicle passed."""
        if self._modal is None:
            modal = np.full((*self.shape, 2), np.nan, np.float32)
            if self._layers is not None:
                modal[..., 0], modal[..., 1] = self._layers("modal_vx"), self._layers("modal_vy")
            else:
                self._fill(modal, lambda t: modal_velocity(t.histogram, t.count, bins=self.bins))
            self._modal = modal
        return self._modal.copy()

    def modal_direction_rad(self) -> FloatArray:
        """(y, x) direction of the highest mode in (-pi, pi], from +x to +y (down); NaN where empty or stationary."""
        limit = self.stationary_speed_px_per_s
        return direction_rad(self.modal_velocity().astype(np.float64), stationary_speed_px_per_s=limit)

    def modal_speed_px_per_s(self) -> FloatArray:
        """(y, x) speed of the highest mode, px/s; NaN where no vehicle passed."""
        return speed_px_per_s(self.modal_velocity().astype(np.float64))

    def modal_speed_km_per_h(self) -> FloatArray:
        """(y, x) speed of the highest mode, km/h; NaN where no vehicle passed.

        Raises
        ------
        InputError
            The ground sample distance is not known.
        """
        return self.modal_speed_px_per_s() * self.bins.km_per_h_per_px_per_s

    def count(self) -> NDArray[np.int32]:
        """(y, x) number of tracks; 0 where no vehicle passed."""
        if self._layers is not None:
            return np.array(self._layers("count"), np.int32)
        return self._fill(np.zeros(self.shape, np.int32), lambda t: t.count)

    def statistics(self) -> TileStatistics:
        """All statistics of every pixel, as whole maps in float32."""
        names = [field.name for field in fields(TileStatistics)]
        maps: dict[str, NDArray[np.generic]] = {}
        empty = self._tile_statistics(self._empty_pixel())
        for name in names:
            sample = getattr(empty, name)
            full = (*self.shape, *sample.shape[2:])
            maps[name] = np.zeros(full, np.int32) if name == "n" else np.full(full, np.nan, np.float32)
        for where, part in self._over_tiles(self._tile_statistics):
            for name in names:
                target = maps[name][where]
                target[...] = getattr(part, name)[: target.shape[0], : target.shape[1]]
        return TileStatistics(**maps)  # type: ignore[arg-type]  # float32 in place of float64: half the memory

    def _fill(self, out: NDArray[Any], work: Callable[[FieldTile], NDArray[Any]]) -> NDArray[Any]:
        for where, result in self._over_tiles(work):
            out[where] = result[: out[where].shape[0], : out[where].shape[1]]
        return out

    # -- a pixel ------------------------------------------------------------------------------------------------------

    def at(self, x: float, y: float) -> PixelDistribution:
        """The distribution at base pixel (x, y).

        Raises
        ------
        InputError
            The pixel is not on the map, or not one pixel.
        """
        if np.ndim(x) or np.ndim(y) or not np.isfinite([x, y]).all():
            raise InputError(
                f"at needs one finite pixel x, y, found {x} and {y}; call it for each pixel, or take `statistics` or "
                "`log_density` of many"
            )
        column, row = round(x), round(y)
        if not (0 <= column < self.shape[1] and 0 <= row < self.shape[0]):
            raise InputError(
                f"pixel ({column}, {row}) is not on the map: x goes from 0 to {self.shape[1] - 1}, "
                f"y from 0 to {self.shape[0] - 1}"
            )
        tile = self._tile(row // self.tile_size, column // self.tile_size)
        if tile is None:
            return self._distribution(column, row, self._empty_pixel())
        y0, x0 = row % self.tile_size, column % self.tile_size
        pixel = np.s_[y0 : y0 + 1, x0 : x0 + 1]
        return self._distribution(column, row, FieldTile(*(part[pixel] for part in tile)))

    def _empty_pixel(self) -> FieldTile:
        """An empty tile of one pixel."""
        return FieldTile(np.zeros((1, 1, self.bins.n, self.bins.n), np.int32), *np.zeros((3, 1, 1), np.int32))

    def _distribution(self, x: int, y: int, pixel: FieldTile) -> PixelDistribution:
        return describe_pixel(x, y, pixel, self.bins, self._tile_statistics(pixel))

    # -- a prior for another tracker ----------------------------------------------------------------------------------

    def log_density(self, xy: FloatArray, v: FloatArray) -> FloatArray:
        """Log predictive density p(v | x) of the next vehicle, per (px/s)^2: see `velfield.field.prior`.

        Parameters
        ----------
        xy
            (n, 2) base pixels; outside the map the density is the whole map's.
        v
            (n, 2) velocities, px/s.

        Returns
        -------
        ndarray
            (n,) float64, finite; NaN where ``xy`` or ``v`` is not finite.
        """
        xy, v = np.atleast_2d(np.asarray(xy, np.float64)), np.atleast_2d(np.asarray(v, np.float64))
        if xy.shape != v.shape or xy.shape[1] != 2:
            raise InputError(
                f"log_density needs positions and velocities of one shape (n, 2), found {xy.shape} and {v.shape}; "
                "repeat a position for each of its velocities (numpy.broadcast_to)"
            )
        out = np.full(len(xy), np.nan)
        good = np.flatnonzero(np.isfinite(xy).all(axis=1) & np.isfinite(v).all(axis=1))
        limit = float(max(self.shape)) * 2
        pixels = np.floor(xy[good].clip(-limit, limit) + 0.5).astype(np.int64)
        tiles = pixels[:, ::-1] // self.tile_size
        radius = self._neighbourhood_px()
        for tile in np.unique(tiles, axis=0):
            here = np.flatnonzero((tiles == tile).all(axis=1))
            # no more of the tile than is asked for: a tracker asks for few places, and a tile of the store is megabytes
            x0, y0 = pixels[here].min(axis=0) - radius
            width, height = np.ptp(pixels[here], axis=0) + 1 + 2 * radius
            histogram, count = self._cut(int(x0), int(y0), int(width), int(height))
            out[good[here]] = log_density_in_window(
                histogram,
                count,
                self._map_distribution(),
                pixels[here] - np.array([x0, y0], np.int64),
                self.bins.to_bins(v[good[here]]),
                radius,
                self.bins.blur_bins2,
            )
        out -= 2 * np.log(self.bins.width_px_per_s)
        return out

    def gate(self, xy: FloatArray, covariance: FloatArray | None = None, *, coverage: float = COVERAGE) -> VelocityGate:
        """The highest-density region of the velocity at a position, as a gate for another tracker
        (`velfield.field.gate`).

        Unlike `log_density` it is of the observed distribution, without a pseudocount of zero velocity.

        Parameters
        ----------
        xy
            (2,) base pixel.
        covariance
            (2, 2) px^2, of the position; None: zero.
        coverage
            Probability mass of the region, in (0, 1).
        """
        position = np.asarray(xy, np.float64)
        if position.shape != (2,) or not np.isfinite(position).all() or not 0 < coverage < 1:
            raise InputError(
                f"gate needs one finite position (2,) and a coverage between 0 and 1, found {xy} and {coverage}"
            )
        covariance = np.zeros((2, 2)) if covariance is None else covariance
        return make_gate(self._densities, position, covariance, self.bins, coverage)

    def anomaly(self, times_s: FloatArray, xy: FloatArray) -> float:
        """Anomaly score of a track, nats a step: the expected log density at its positions minus that of its
        velocities.

        About 0 for a track like those of the field; 3 and more for a wrong-way driver, or for a vehicle that stops
        where none does. Low for any track where the field is empty.

        Parameters
        ----------
        times_s, xy
            (n,) ascending times and (n, 2) base pixels, n >= 2.
        """
        time, position = np.asarray(times_s, np.float64), np.asarray(xy, np.float64)
        if time.ndim != 1 or len(time) < 2 or position.shape != (len(time), 2) or not (np.diff(time) > 0).all():
            raise InputError(
                f"anomaly needs ascending times (n,) and positions (n, 2), found {time.shape} and {position.shape}"
            )
        velocity = np.diff(position, axis=0) / np.diff(time)[:, None]
        midpoint = 0.5 * (position[1:] + position[:-1])
        score = [
            gate.expected_log_density - gate.log_density(v)[0]
            for gate, v in ((self.gate(where), v) for where, v in zip(midpoint, velocity, strict=True))
        ]
        return float(np.mean(score))

    def _densities(self, xy: FloatArray, v: FloatArray) -> FloatArray:
        """Observed density per (px/s)^2 at one position (2,) of velocities (n, 2)."""
        radius = self._neighbourhood_px()
        limit = float(max(self.shape)) * 2
        x, y = np.floor(np.clip(xy, -limit, limit) + 0.5).astype(np.int64)
        histogram, count = self._cut(int(x) - radius, int(y) - radius, 2 * radius + 1, 2 * radius + 1)
        map_weights = self._map_distribution()
        density = densities_at_pixel(
            histogram, count, map_weights, radius, radius, self.bins.to_bins(v), radius, self.bins.blur_bins2, 0.0
        )
        return np.asarray(density / self.bins.area_px2_per_s2, np.float64)

    def _neighbourhood_px(self) -> int:
        """Radius of a pixel's neighbourhood in the prior."""
        if self.bins.gsd_m is None:
            return _NEIGHBOURHOOD_PX
        return max(1, round(_NEIGHBOURHOOD_M / self.bins.gsd_m))

    def _map_distribution(self) -> FloatArray:
        """(nvy, nvx) the whole map's distribution, from a sample of its tiles; zero if it is empty."""
        if self._map_weights is None:
            total = np.zeros((self.bins.n, self.bins.n))
            step = max(1, len(self.tiles) // _MAP_SAMPLE_TILES)
            for ty, tx in self.tiles[::step]:
                tile = self._tile(ty, tx)
                if tile is not None:
                    total += tile.histogram.sum(axis=(0, 1), dtype=np.int64)
            self._map_weights = total / max(total.sum(), 1)
        return self._map_weights

    def _cut(self, x0: int, y0: int, width: int, height: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Histogram and count of a window of the map; zero where it is outside the map."""
        size = self.tile_size
        histogram = np.zeros((height, width, self.bins.n, self.bins.n), np.int32)
        count = np.zeros((height, width), np.int32)
        for row in range(y0 // size, (y0 + height - 1) // size + 1):
            for column in range(x0 // size, (x0 + width - 1) // size + 1):
                tile = self._tile(row, column)
                if tile is None:
                    continue
                tile_height, tile_width = tile.count.shape
                top, left = max(row * size, y0), max(column * size, x0)
                bottom = min(row * size + tile_height, y0 + height)
                right = min(column * size + tile_width, x0 + width)
                target = np.s_[top - y0 : bottom - y0, left - x0 : right - x0]
                origin = np.s_[top - row * size : bottom - row * size, left - column * size : right - column * size]
                histogram[target], count[target] = tile.histogram[origin], tile.count[origin]
        return histogram, count

    # -- tiles --------------------------------------------------------------------------------------------------------

    def _tile_statistics(self, tile: FieldTile) -> TileStatistics:
        limit = self.stationary_speed_px_per_s
        return tile_statistics(
            tile.histogram, tile.count, tile.variance_sum, bins=self.bins, stationary_speed_px_per_s=limit
        )

    def _tile(self, ty: int, tx: int) -> FieldTile | None:
        """A tile, from the cache if it is there."""
        key = (ty, tx)
        if key not in self._known:
            return None
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        found = self._source(ty, tx)
        with self._lock:
            self._cache[key] = found
            while len(self._cache) > _CACHED_TILES:
                self._cache.popitem(last=False)
        return found

    def _over_tiles(self, work: Callable[[FieldTile], T]) -> Iterator[tuple[_Window, T]]:
        """The result of ``work`` for every tile with its window in the map, in raster order. Tiles are not cached."""

        def one(key: tuple[int, int]) -> T | None:
            tile = self._source(*key)
            return None if tile is None else work(tile)

        size = self.tile_size
        with ThreadPoolExecutor(self._threads) as pool:
            for (ty, tx), result in zip(self.tiles, pool.map(one, self.tiles), strict=True):
                if result is not None:
                    yield np.s_[ty * size : (ty + 1) * size, tx * size : (tx + 1) * size], result
