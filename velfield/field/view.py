"""The velocity field to be asked: one object over tiles, wherever they come from, never more than a few in memory."""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from threading import Lock
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.errors import InputError
from velfield.field.accumulate import accumulate_tile
from velfield.field.bins import VelocityBins
from velfield.field.gate import SHARE, VelocityGate, make_gate
from velfield.field.modes import modal_velocity
from velfield.field.pixel import PixelDistribution, describe_pixel
from velfield.field.prior import densities_at_pixel, log_density_in_window
from velfield.field.segments import Segments, segments_by_tile
from velfield.field.statistics import TileStatistics, direction_rad, speed_px_per_s, tile_statistics

Tile = tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]
"""(ty, tx, nvy, nvx) histogram, (ty, tx) count of passages and their noise, as in `FieldTile`; tiles at the map's edge
may be cut or padded."""
TileSource = Callable[[int, int], Tile | None]
"""Gives tile (ty, tx); None where nothing was seen."""
LayerSource = Callable[[str], NDArray[Any]]
"""Gives a whole (y, x) layer by its name."""

T = TypeVar("T")
_Place = tuple[slice, slice]
Float32 = NDArray[np.float32]
_TILES_KEPT = 6
_TILES_OF_THE_MAP = 64
_NEIGHBOURHOOD_M = 1.5
_NEIGHBOURHOOD_PX = 6


class VelocityField:
    """A velocity field over a source of tiles.

    Parameters
    ----------
    source
        Gives the tile (ty, tx), or None; called from several threads where ``threads`` is more than one.
    tiles
        The tiles that hold anything: no other is asked for.
    shape
        (height, width) of the map, base px.
    tile_size
        Side of a tile, px.
    bins
        Velocity axes.
    stationary_speed_px_per_s
        A modal speed below this has no direction.
    threads
        Tiles worked on at once by the methods that go over the whole map.
    layers
        Gives a (y, x) layer that was made with the tiles (``modal_vx``, ``modal_vy``, ``count``), so that whole maps
        need no tile; None: they are made from the tiles.
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
        self._kept: OrderedDict[tuple[int, int], Tile | None] = OrderedDict()
        self._lock = Lock()
        self._modal: Float32 | None = None
        self._everywhere: FloatArray | None = None

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
        """The field of a segment table, its tiles made as they are asked for."""
        rows = segments_by_tile(segments, shape=shape, tile_size=tile_size, radius_px=radius_px)

        def make(ty: int, tx: int) -> Tile:
            origin = (tx * tile_size, ty * tile_size)
            part = segments[rows[ty, tx]]
            size = (tile_size, tile_size)
            tile = accumulate_tile(part, origin_xy=origin, shape=size, bins=bins, radius_px=radius_px)
            return tile.histogram, tile.count, tile.noise

        return cls(
            make,
            tiles=list(rows),
            shape=shape,
            tile_size=tile_size,
            bins=bins,
            stationary_speed_px_per_s=stationary_speed_px_per_s,
        )

    # -- the map ------------------------------------------------------------------------------------------------------

    def modal_velocity(self) -> Float32:
        """(y, x, 2) float32 velocity of the largest mode as (vx, vy) px/s; NaN where no vehicle passed."""
        if self._modal is None:
            out = np.full((*self.shape, 2), np.nan, np.float32)
            if self._layers is not None:
                out[..., 0], out[..., 1] = self._layers("modal_vx"), self._layers("modal_vy")
                self._modal = out
                return out.copy()
            for where, velocity in self._over_tiles(lambda t: modal_velocity(t[0], t[1], bins=self.bins)):
                out[where] = velocity[: out[where].shape[0], : out[where].shape[1]]
            self._modal = out
        return self._modal.copy()

    def modal_direction_rad(self, *, stationary_speed_px_per_s: float | None = None) -> FloatArray:
        """(y, x) direction of the largest mode in (-pi, pi], from +x towards +y (down); NaN where empty or standing."""
        limit = self.stationary_speed_px_per_s if stationary_speed_px_per_s is None else stationary_speed_px_per_s
        return direction_rad(self.modal_velocity().astype(np.float64), stationary_speed_px_per_s=limit)

    def modal_speed_px_per_s(self) -> FloatArray:
        """(y, x) speed of the largest mode, px/s; NaN where no vehicle passed."""
        return speed_px_per_s(self.modal_velocity().astype(np.float64))

    def count(self) -> NDArray[np.int32]:
        """(y, x) distinct passages; 0 where no vehicle passed."""
        if self._layers is not None:
            return np.array(self._layers("count"), np.int32)
        out = np.zeros(self.shape, np.int32)
        for where, count in self._over_tiles(lambda t: t[1]):
            out[where] = count[: out[where].shape[0], : out[where].shape[1]]
        return out

    def statistics(self) -> TileStatistics:
        """All statistics of every pixel, as whole maps in float32."""
        names = [field.name for field in fields(TileStatistics)]
        maps: dict[str, NDArray[np.generic]] = {}
        empty = self._tile_statistics(self._nothing())
        for name in names:
            sample = getattr(empty, name)
            full = (*self.shape, *sample.shape[2:])
            maps[name] = np.zeros(full, np.int32) if name == "n" else np.full(full, np.nan, np.float32)
        for where, part in self._over_tiles(self._tile_statistics):
            for name in names:
                target = maps[name][where]
                target[...] = getattr(part, name)[: target.shape[0], : target.shape[1]]
        return TileStatistics(**maps)  # type: ignore[arg-type]  # float32 in place of float64: half the memory

    # -- a pixel ------------------------------------------------------------------------------------------------------

    def at(self, x: float, y: float) -> PixelDistribution:
        """The distribution at base pixel (x, y).

        Raises
        ------
        InputError
            Where the pixel is not on the map.
        """
        column, row = round(x), round(y)
        if not (0 <= column < self.shape[1] and 0 <= row < self.shape[0]):
            raise InputError(
                f"pixel ({column}, {row}) is not on the map: x goes from 0 to {self.shape[1] - 1}, "
                f"y from 0 to {self.shape[0] - 1}"
            )
        tile = self._tile(row // self.tile_size, column // self.tile_size)
        if tile is None:
            return self._distribution(column, row, self._nothing())
        y0, x0 = row % self.tile_size, column % self.tile_size
        pixel = np.s_[y0 : y0 + 1, x0 : x0 + 1]
        return self._distribution(column, row, (tile[0][pixel], tile[1][pixel], tile[2][pixel]))

    def _nothing(self) -> Tile:
        """A tile of one pixel that nobody passed."""
        return (np.zeros((1, 1, self.bins.n, self.bins.n), np.int32), *np.zeros((2, 1, 1), np.int32))

    def _distribution(self, x: int, y: int, pixel: Tile) -> PixelDistribution:
        return describe_pixel(x, y, pixel[0], pixel[1], self.bins, self._tile_statistics(pixel))

    # -- a prior for another tracker ----------------------------------------------------------------------------------

    def log_density(self, xy: FloatArray, v: FloatArray) -> FloatArray:
        """Log of p(v | x) of the next vehicle, density per (px/s)^2: see `velfield.field.prior`.

        Parameters
        ----------
        xy
            (n, 2) base pixels; outside of the map the density is the whole map's.
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
                f"log_density needs places and velocities of one shape (n, 2), found {xy.shape} and {v.shape}"
            )
        out = np.full(len(xy), np.nan)
        good = np.flatnonzero(np.isfinite(xy).all(axis=1) & np.isfinite(v).all(axis=1))
        limit = float(max(self.shape)) * 2
        pixels = np.floor(xy[good].clip(-limit, limit) + 0.5).astype(np.int64)
        tiles = pixels[:, ::-1] // self.tile_size
        radius = self._neighbourhood_px()
        for ty, tx in np.unique(tiles, axis=0):
            here = np.flatnonzero((tiles == (ty, tx)).all(axis=1))
            histogram, count, origin = self._window(int(ty), int(tx), radius)
            out[good[here]] = log_density_in_window(
                histogram,
                count,
                self._map_distribution(),
                pixels[here] - origin,
                self.bins.to_bins(v[good[here]]),
                radius,
                self._blur(),
            )
        out -= 2 * np.log(self.bins.width_px_per_s)
        return out

    def gate(self, xy: FloatArray, covariance: FloatArray | None = None, *, share: float = SHARE) -> VelocityGate:
        """What velocities are usual at a place: a gate for another tracker (`velfield.field.gate`).

        Unlike `log_density` it does not reckon with a queue where none has stood yet.

        Parameters
        ----------
        xy
            (2,) base pixel.
        covariance
            (2, 2) px^2, how well the place is known; None: to the pixel.
        share
            Share of vehicles that the gate lets pass.
        """
        place = np.asarray(xy, np.float64)
        if place.shape != (2,) or not np.isfinite(place).all() or not 0 < share < 1:
            raise InputError(f"gate needs one finite place (2,) and a share between 0 and 1, found {xy} and {share}")
        return make_gate(
            self._densities, place, np.zeros((2, 2)) if covariance is None else covariance, self.bins, share
        )

    def anomaly(self, times_s: FloatArray, xy: FloatArray) -> float:
        """How unusual a track is: by how many nats a step its velocities are less likely than what is usual there.

        About 0 for a track like those that the field was made of; 3 and more for a wrong-way driver, or for one who
        stands where nobody does. Where nothing is known, hardly anything is unusual.

        Parameters
        ----------
        times_s, xy
            (n,) rising times and (n, 2) base pixels, n of 2 or more.
        """
        time, place = np.asarray(times_s, np.float64), np.asarray(xy, np.float64)
        if time.ndim != 1 or len(time) < 2 or place.shape != (len(time), 2) or not (np.diff(time) > 0).all():
            raise InputError(f"anomaly needs rising times (n,) and places (n, 2), found {time.shape} and {place.shape}")
        velocity = np.diff(place, axis=0) / np.diff(time)[:, None]
        middle = 0.5 * (place[1:] + place[:-1])
        surprise = [
            gate.expected_log_density - gate.log_density(v)[0]
            for gate, v in ((self.gate(where), v) for where, v in zip(middle, velocity, strict=True))
        ]
        return float(np.mean(surprise))

    def _densities(self, xy: FloatArray, v: FloatArray) -> FloatArray:
        """Density per (px/s)^2 at one place (2,) of velocities (n, 2), by what was seen alone."""
        radius = self._neighbourhood_px()
        limit = float(max(self.shape)) * 2
        x, y = np.floor(np.clip(xy, -limit, limit) + 0.5).astype(np.int64)
        histogram, count = self._cut(int(x) - radius, int(y) - radius, 2 * radius + 1, 2 * radius + 1)
        everywhere = self._map_distribution()
        density = densities_at_pixel(
            histogram, count, everywhere, radius, radius, self.bins.to_bins(v), radius, self._blur(), 0.0
        )
        return np.asarray(density / self.bins.width_px_per_s**2, np.float64)

    def _blur(self) -> float:
        """What the kernel and the bins add to the variance of a velocity component, bins^2."""
        return (self.bins.kernel_sigma_px_per_s / self.bins.width_px_per_s) ** 2 + 1.0 / 12.0

    def _neighbourhood_px(self) -> int:
        """How far the pixels around reach."""
        if self.bins.gsd_m is None:
            return _NEIGHBOURHOOD_PX
        return max(1, round(_NEIGHBOURHOOD_M / self.bins.gsd_m))

    def _map_distribution(self) -> FloatArray:
        """(nvy, nvx) the whole map's distribution, from tiles spread over it; zero where it is empty."""
        if self._everywhere is None:
            total = np.zeros((self.bins.n, self.bins.n))
            step = max(1, len(self.tiles) // _TILES_OF_THE_MAP)
            for ty, tx in self.tiles[::step]:
                tile = self._tile(ty, tx)
                if tile is not None:
                    total += tile[0].sum(axis=(0, 1), dtype=np.int64)
            self._everywhere = total / max(total.sum(), 1)
        return self._everywhere

    def _window(self, ty: int, tx: int, margin: int) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
        """A tile with a margin from its neighbours: histogram, count, and the pixel (x, y) of its first corner."""
        x0, y0 = tx * self.tile_size - margin, ty * self.tile_size - margin
        extent = self.tile_size + 2 * margin
        return *self._cut(x0, y0, extent, extent), np.array([x0, y0], np.int64)

    def _cut(self, x0: int, y0: int, width: int, height: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Histogram and count of a window of the map that may reach beyond it."""
        size = self.tile_size
        histogram = np.zeros((height, width, self.bins.n, self.bins.n), np.int32)
        count = np.zeros((height, width), np.int32)
        for row in range(y0 // size, (y0 + height - 1) // size + 1):
            for column in range(x0 // size, (x0 + width - 1) // size + 1):
                tile = self._tile(row, column)
                if tile is None:
                    continue
                tile_height, tile_width = tile[1].shape
                top, left = max(row * size, y0), max(column * size, x0)
                bottom = min(row * size + tile_height, y0 + height)
                right = min(column * size + tile_width, x0 + width)
                target = np.s_[top - y0 : bottom - y0, left - x0 : right - x0]
                origin = np.s_[top - row * size : bottom - row * size, left - column * size : right - column * size]
                histogram[target], count[target] = tile[0][origin], tile[1][origin]
        return histogram, count

    # -- tiles --------------------------------------------------------------------------------------------------------

    def _tile_statistics(self, tile: Tile) -> TileStatistics:
        histogram, count, noise = tile
        return tile_statistics(
            histogram, count, noise, bins=self.bins, stationary_speed_px_per_s=self.stationary_speed_px_per_s
        )

    def _tile(self, ty: int, tx: int) -> Tile | None:
        """A tile, from the few kept in memory where it is one of them."""
        key = (ty, tx)
        if key not in self._known:
            return None
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        found = self._source(ty, tx)
        with self._lock:
            self._kept[key] = found
            while len(self._kept) > _TILES_KEPT:
                self._kept.popitem(last=False)
        return found

    def _over_tiles(self, work: Callable[[Tile], T]) -> Iterator[tuple[_Place, T]]:
        """Work on every tile, in raster order: where it stands in the map, and the result. Tiles are not kept."""

        def one(key: tuple[int, int]) -> T | None:
            tile = self._source(*key)
            return None if tile is None else work(tile)

        size = self.tile_size
        with ThreadPoolExecutor(self._threads) as pool:
            for (ty, tx), result in zip(self.tiles, pool.map(one, self.tiles), strict=True):
                if result is not None:
                    yield np.s_[ty * size : (ty + 1) * size, tx * size : (tx + 1) * size], result
