"""The Zarr stores of a run folder: create, open, check. The only module that imports zarr.

Three rules, each after a fault seen in zarr or in its use:

- every chunk has a checksum: the default codec returns wrong pixels for one bit in seven, silently;
- a chunk has one writer: two writers on parts of one chunk lose each other's work, so the chunks of per-frame columns
  are exactly the units of work;
- a missing chunk reads as the fill value: whoever reads asks the commit records which chunks must exist.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec, ZstdCodec

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray
from schemas.records import FORMAT_VERSION
from velfield.errors import InputError, StoreError
from velfield.run.commits import write_atomically
from velfield.run.layout import is_remote
from velfield.run.shards import block_side, decode_tile, encode_chunk, encode_tile

_ZSTANDARD = ZstdCodec(level=1, checksum=True)
_STATUS_BYTES = 160
_FORMAT_KEY = "format_version"
"""Attribute of a store that names its format."""
HISTOGRAM = "velocity_histogram"
HISTOGRAM_TIME_WEIGHTED = "velocity_histogram_time_weighted"
GROUP_TILES = 8
"""Side of a group in tiles, 512 px: a chunk of the layers."""
FIELD_BLOCK = 2
"""Side of a unit of work in groups: each reads the tables of tracks once, and costs a task of its own."""


def _create(
    group: zarr.Group,
    name: str,
    shape: Sequence[int],
    chunks: Sequence[int],
    dtype: str,
    *,
    codec: ZstdCodec | Crc32cCodec = _ZSTANDARD,
    **kw: Any,
) -> zarr.Array[Any]:
    return group.create_array(name, shape=tuple(shape), chunks=tuple(chunks), dtype=dtype, compressors=codec, **kw)


def fill_value(dtype: str) -> float:
    """The value of what is not known: NaN, of integers 0."""
    return np.nan if dtype.startswith("float") else 0


def _location(path: Path) -> dict[str, Any]:
    """Zarr's arguments for the store at a path."""
    if is_remote(path):
        return {"store": str(path), "storage_options": dict(path.storage_options)}
    return {"store": path}


class _Group:
    """A group, opened, whose arrays are opened once: on S3 each opening is a request or two."""

    def __init__(self, group: zarr.Group) -> None:
        self._group = group
        self._arrays: dict[str, zarr.Array[Any]] = {}

    @property
    def attrs(self) -> Mapping[str, Any]:
        return dict(self._group.attrs)

    def __getitem__(self, name: str) -> zarr.Array[Any]:
        if name not in self._arrays:
            self._arrays[name] = cast("zarr.Array[Any]", self._group[name])
        return self._arrays[name]

    @cached_property
    def by_axes(self) -> dict[int, list[str]]:
        """Names of the arrays by their number of axes, sorted."""
        self._arrays |= dict(self._group.arrays())
        names: dict[int, list[str]] = {}
        for name in sorted(self._arrays):
            names.setdefault(self._arrays[name].ndim, []).append(name)
        return names


def _open(path: Path, mode: str) -> _Group:
    try:
        return _Group(zarr.open_group(**_location(path), mode=cast(Any, mode), zarr_format=3, use_consolidated=False))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist: run `velfield run` on this folder first") from None


def _read(path: Path, group: _Group, name: str, selection: Any) -> NDArray[Any]:
    try:
        return np.asarray(group[name][selection])
    except Exception as error:
        raise StoreError(
            f"{path / name}: a chunk is damaged ({error}); `velfield verify {path.parent}` finds which"
        ) from error


def _check_column(path: Path, name: str, known: Iterable[str]) -> None:
    """Refuse an unknown name, which would look like a damaged column."""
    if name not in known:
        raise InputError(f"{path}: found no column {name!r}; it has {', '.join(known)}")


def _check_frame(path: Path, frame: int, count: int) -> None:
    """Refuse an unknown frame, whose chunk would look missing or damaged."""
    if not 0 <= frame < count:
        raise InputError(f"{path}: frame {frame} is not in the run: its frames go from 0 to {count - 1}")


def _metadata(path: Path) -> list[Path]:
    """The metadata files of a store and its arrays."""
    return [path / "zarr.json", *sorted(path.glob("*/zarr.json"))]


def _existing(paths: Iterable[Path]) -> list[Path]:
    """Chunks that exist: zarr writes none that hold only the fill value."""
    return [path for path in paths if path.exists()]


# ------------------------------------------------------------------------------------------------------------- frames


def store_key(path: Path) -> str | None:
    """Content key that a store was created under; None where it does not exist or is incomplete."""
    try:
        return str(zarr.open_group(**_location(path), mode="r", zarr_format=3, use_consolidated=False).attrs["key"])
    except (FileNotFoundError, KeyError, ValueError):
        return None


def is_cut_as(path: Path, key: str, unit_frames: int) -> bool:
    """Whether a store was created under a key, for units of so many frames.

    Units that share a chunk would overwrite each other's rows.
    """
    if store_key(path) != key:
        return False
    group = zarr.open_group(**_location(path), mode="r", zarr_format=3, use_consolidated=False)
    column: Any = group["vector" if "vector" in group else "time_s"]
    return bool(column.chunks[0] == min(unit_frames, max(column.shape[0], 1)))


FRAME_COLUMNS: dict[str, tuple[str, float]] = {
    "time_s": ("float64", np.nan),
    "source_index": ("int64", -1),
    "decoding_flags": ("uint16", 2),
    "sharpness": ("float32", np.nan),
    "brightness": ("float32", np.nan),
}
"""Column that units write -> type, and fill value."""
FLAGS = "flags"
"""The column of all defects, written once all frames are there."""
THUMBNAIL_SHAPE = (16, 16)


def create_frames(
    path: Path, *, key: str, count: int, height: int, width: int, unit_frames: int, source: Mapping[str, Any]
) -> None:
    """Create ``frames.zarr``: one frame a chunk; a unit of a column a chunk. Frames are unreadable until written."""
    group = zarr.create_group(
        **_location(path), overwrite=True, attributes={_FORMAT_KEY: FORMAT_VERSION, "source": dict(source)}
    )
    chunk = min(unit_frames, max(count, 1))
    # Zstandard takes off a tenth of a frame, for 13 ms a frame of 5 Mpx to write and 4 ms to read.
    raw, axes = (count, height, width), ("frame", "y", "x")
    _create(group, "raw", raw, (1, height, width), "uint8", codec=Crc32cCodec(), dimension_names=axes)
    for name, (dtype, fill) in FRAME_COLUMNS.items():
        _create(group, name, (count,), (chunk,), dtype, fill_value=fill, dimension_names=("frame",))
    shape, chunks = (count, *THUMBNAIL_SHAPE), (chunk, *THUMBNAIL_SHAPE)
    _create(group, "thumbnail", shape, chunks, "float32", fill_value=0, dimension_names=("frame", "row", "column"))
    _create(group, FLAGS, (count,), (max(count, 1),), "uint16", fill_value=2, dimension_names=("frame",))
    group.attrs["key"] = key  # last: a store without it is incomplete


@dataclass(frozen=True)
class FrameStore:
    """``frames.zarr``, opened."""

    path: Path
    group: _Group

    @property
    def count(self) -> int:
        return int(self.group["raw"].shape[0])

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of a frame, px."""
        _, height, width = self.group["raw"].shape
        return int(height), int(width)

    def read(self, frame: int) -> GreyImage:
        """One grey frame, (h, w) uint8.

        Raises
        ------
        InputError
            There is no such frame.
        StoreError
            The chunk is damaged or gone.
        """
        _check_frame(self.path, frame, self.count)
        if not (self.path / "raw" / "c" / str(frame) / "0" / "0").exists():
            raise StoreError(f"{self.path}: the chunk of frame {frame} is missing; `velfield run` writes it again")
        try:
            return np.asarray(self.group["raw"][frame], dtype=np.uint8)
        except Exception as error:
            raise StoreError(f"{self.path}: the chunk of frame {frame} is damaged ({error})") from error

    def write(self, frame: int, grey: GreyImage) -> None:
        """Write one frame: one chunk, also of a black frame, which else would look missing."""
        self.group["raw"].with_config({"write_empty_chunks": True})[frame] = grey

    def column(self, name: str) -> NDArray[Any]:
        """One column: ``flags``, or one of ``FRAME_COLUMNS``, (frames,)."""
        _check_column(self.path, name, (*FRAME_COLUMNS, FLAGS))
        return _read(self.path, self.group, name, slice(None))

    def write_columns(self, start: int, columns: Mapping[str, NDArray[Any]]) -> None:
        """Write a whole unit of columns, ``thumbnail`` too, from frame ``start`` on."""
        for name, values in columns.items():
            self.group[name][start : start + len(values)] = values

    def files(self, start: int, stop: int) -> list[Path]:
        """Files that hold the frames ``[start, stop)``, a unit, and their columns; and the store's metadata."""
        raw = [self.path / "raw" / "c" / str(frame) / "0" / "0" for frame in range(start, stop)]
        unit = start // int(self.group["time_s"].chunks[0])
        columns = [self.path / name / "c" / str(unit) for name in FRAME_COLUMNS]
        thumbnails = self.path / "thumbnail" / "c" / str(unit) / "0" / "0"
        return [*_metadata(self.path), *_existing([*raw, *columns, thumbnails])]

    def thumbnails(self, start: int, stop: int) -> Float32Array:
        """Thumbnails of the frames ``[start, stop)``, (frames, 16, 16), each with its mean removed."""
        return _read(self.path, self.group, "thumbnail", slice(start, stop))

    def write_flags(self, flags: IntArray) -> Path:
        """Write the column ``flags`` whole, as one chunk; returns its file."""
        self.group[FLAGS].with_config({"write_empty_chunks": True})[:] = flags
        return self.path / FLAGS / "c" / "0"


def open_frames(path: Path, mode: str = "r") -> FrameStore:
    """Open ``frames.zarr``."""
    return FrameStore(path, _open(path, mode))


# ------------------------------------------------------------------------------------------------------- registration

REGISTRATION_COLUMNS: dict[str, str] = {
    "n_matches_base": "int32",  # matches with the base image
    "n_matches_previous": "int32",  # matches with the previous registered frame
    "n_inliers": "int32",  # inliers of the robust fit
    "residual_px": "float32",  # RMS of the fit's control points
    "heldout_px": "float32",  # RMS of the control points held out of the fit
    "coverage": "float32",  # fraction of the frame's cells that hold inliers
}


ERROR_CELLS = (6, 8)
"""Rows and columns of a frame's cells, in which hold-out errors are stored."""


POSITION_SD_CELLS = (24, 32)
"""Rows and columns of a frame's cells, in which the standard deviation of its map is stored."""
_CELL_ARRAYS = ("error_px", "position_sd_px")


def create_registration(path: Path, *, key: str, count: int, vector_length: int, unit_frames: int) -> None:
    """Create ``registration.zarr``: chunks are units, so that a unit has one writer."""
    group = zarr.create_group(**_location(path), overwrite=True, attributes={_FORMAT_KEY: FORMAT_VERSION})
    chunk = min(unit_frames, max(count, 1))
    _create(group, "vector", (count, vector_length), (chunk, vector_length), "float64", fill_value=np.nan)
    _create(group, "status", (count, _STATUS_BYTES), (chunk, _STATUS_BYTES), "uint8", fill_value=0)
    for name, dtype in REGISTRATION_COLUMNS.items():
        _create(group, name, (count,), (chunk,), dtype, fill_value=fill_value(dtype), dimension_names=("frame",))
    axes = ("frame", "row", "column")
    for name, cells in zip(_CELL_ARRAYS, (ERROR_CELLS, POSITION_SD_CELLS), strict=True):
        shape, chunks = (count, *cells), (chunk, *cells)
        _create(group, name, shape, chunks, "float32", fill_value=np.nan, dimension_names=axes)
    group.attrs["key"] = key


@dataclass(frozen=True)
class RegistrationStore:
    """``registration.zarr``, opened."""

    path: Path
    group: _Group

    def write(
        self, start: int, vectors: FloatArray, statuses: Sequence[str], columns: Mapping[str, NDArray[Any]]
    ) -> None:
        """Write a whole unit from frame ``start`` on; ``columns`` are ``REGISTRATION_COLUMNS`` and those by cell."""
        stop = start + len(statuses)
        text = np.zeros((len(statuses), _STATUS_BYTES), np.uint8)
        for row, status in zip(text, statuses, strict=True):
            data = np.frombuffer(status.encode()[:_STATUS_BYTES], np.uint8)
            row[: len(data)] = data
        self.group["vector"][start:stop] = vectors
        self.group["status"][start:stop] = text
        for name, values in columns.items():
            self.group[name][start:stop] = values

    @property
    def unit_frames(self) -> int:
        """Frames of a chunk."""
        return int(self.group["vector"].chunks[0])

    def check_frame(self, frame: int) -> int:
        """The frame itself; InputError where there is none of this number."""
        _check_frame(self.path, frame, self.group["vector"].shape[0])
        return frame

    def statuses(self, start: int = 0, stop: int | None = None) -> list[str]:
        """``ok``, ``failed:<reason>`` or ``skipped:<reason>`` of each frame; empty where not processed yet."""
        rows = _read(self.path, self.group, "status", slice(start, stop))
        return [bytes(row).rstrip(b"\0").decode(errors="replace") for row in rows]

    def column(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """A column of the frames ``[start, stop)``.

        One of ``REGISTRATION_COLUMNS``, (frames,); ``vector``, (frames, n): parameters of the transforms, NaN where a
        frame is not registered; ``error_px``, (frames, 6, 8): hold-out error by cell; ``position_sd_px``, (frames,
        rows, columns): standard deviation of the maps by cell, NaN where there are no control points.
        """
        _check_column(self.path, name, (*REGISTRATION_COLUMNS, "vector", *_CELL_ARRAYS))
        return _read(self.path, self.group, name, slice(start, stop))

    def files(self, start: int) -> list[Path]:
        """Files that hold the unit from frame ``start`` on, and the store's metadata."""
        unit = start // int(self.group["vector"].chunks[0])
        tables = [self.path / name / "c" / str(unit) / "0" for name in ("vector", "status")]
        columns = [self.path / name / "c" / str(unit) for name in REGISTRATION_COLUMNS]
        cells = [self.path / name / "c" / str(unit) / "0" / "0" for name in _CELL_ARRAYS]
        return [*_metadata(self.path), *_existing([*tables, *columns, *cells])]


def open_registration(path: Path, mode: str = "r") -> RegistrationStore:
    """Open ``registration.zarr``."""
    return RegistrationStore(path, _open(path, mode))


# -------------------------------------------------------------------------------------------------------------- field


def create_field(
    path: Path,
    *,
    key: str,
    height: int,
    width: int,
    tile: int,
    group_tiles: int,
    velocities_px_per_s: FloatArray,
    attributes: Mapping[str, Any],
    histograms: Mapping[str, Mapping[str, Any]],
    layers: Mapping[str, tuple[str, Mapping[str, Any]]],
) -> None:
    """Create ``field.zarr``: the histogram in sparse tiles, whole layers in chunks of one tile group, labelled axes.

    Parameters
    ----------
    velocities_px_per_s : (n,) float64
        Bin centres of both velocity axes.
    histograms : name -> attributes
        (y, x, vy, vx) histograms; `HISTOGRAM` is one of them.
    layers : name -> type, attributes
        (y, x) layers beside the histogram.
    """
    group = zarr.create_group(**_location(path), overwrite=True, attributes={_FORMAT_KEY: FORMAT_VERSION, **attributes})
    n = len(velocities_px_per_s)
    grid_mapping = {"grid_mapping": "crs"} if attributes.get("crs_wkt") else {}
    for name, own_attributes in histograms.items():
        histogram = _create(
            group,
            name,
            (height, width, n, n),
            (block_side(tile), block_side(tile), n, n),
            "int32",
            shards=(tile, tile, n, n),
            fill_value=0,
            dimension_names=("y", "x", "vy", "vx"),
        )
        histogram.attrs.update({**own_attributes, **grid_mapping})
    side = tile * group_tiles
    for name, (dtype, attrs) in layers.items():
        layer = _create(
            group, name, (height, width), (side, side), dtype,
            fill_value=fill_value(dtype), dimension_names=("y", "x"),
        )  # fmt: skip
        layer.attrs.update({**attrs, **grid_mapping})
    _write_axes(group, height, width, velocities_px_per_s, attributes)
    group.attrs["key"] = key


_AXES, _METRIC = ("y", "x", "vy", "vx"), "_m_per_s"


def is_of_creation(name: str) -> bool:
    """Whether a file of a store, by its path in the run folder, is written when the store is created, and by no unit.

    That is the metadata, and the coordinates along the axes of the field.
    """
    return name.endswith("zarr.json") or Path(name).parts[1:2] in {
        (f"{axis}{unit}",) for axis in _AXES for unit in ("", _METRIC)
    }


def _write_axes(
    group: zarr.Group, height: int, width: int, velocities: FloatArray, attributes: Mapping[str, Any]
) -> None:
    axes: dict[str, tuple[FloatArray, str]] = {
        "y": (np.arange(height, dtype=np.float64), "px"),
        "x": (np.arange(width, dtype=np.float64), "px"),
        "vy": (velocities, "px s-1"),
        "vx": (velocities, "px s-1"),
    }
    for name, (values, units) in axes.items():
        axis = _create(group, name, values.shape, values.shape, "float64", dimension_names=(name,))
        axis[:] = values
        axis.attrs["units"] = units
    gsd_m = attributes.get("gsd_m")
    if gsd_m:
        for name in ("vy", "vx"):
            metric = _create(
                group, f"{name}{_METRIC}", velocities.shape, velocities.shape, "float64", dimension_names=(name,)
            )
            metric[:] = velocities * float(gsd_m)
            metric.attrs["units"] = "m s-1"
    if attributes.get("crs_wkt"):
        crs = _create(group, "crs", (), (), "int32", fill_value=0)
        crs.attrs.update({"crs_wkt": attributes["crs_wkt"], "GeoTransform": attributes.get("geotransform", "")})


@dataclass(frozen=True)
class FieldStore:
    """``field.zarr``, opened."""

    path: Path
    group: _Group

    @property
    def attributes(self) -> dict[str, Any]:
        return dict(self.group.attrs)

    @property
    def tile(self) -> int:
        return self.chunk_shape(HISTOGRAM)[0]

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the base image, px."""
        height, width = self.group[HISTOGRAM].shape[:2]
        return int(height), int(width)

    def velocities(self) -> FloatArray:
        """Bin centres, px/s."""
        return np.asarray(self.group["vx"][:])

    def histogram_names(self) -> list[str]:
        """Names of the (y, x, vy, vx) histograms."""
        return [name for name in (HISTOGRAM, HISTOGRAM_TIME_WEIGHTED) if name in self.group.by_axes.get(4, ())]

    def write_tile(
        self, row: int, column: int, histogram: NDArray[np.int32], count: NDArray[np.int32], name: str = HISTOGRAM
    ) -> None:
        """Write one tile of a histogram, (ty, tx, nvy, nvx), zero where ``count`` (ty, tx) is: one file."""
        write_atomically(self._tile_path(row, column, name), encode_tile(histogram, count, self.tile), sync=False)

    def _tile_path(self, row: int, column: int, name: str) -> Path:
        return self.path / name / "c" / str(row) / str(column) / "0" / "0"

    def has_tile(self, row: int, column: int, name: str = HISTOGRAM) -> bool:
        """Whether the tile's file exists."""
        return self._tile_path(row, column, name).exists()

    def read_tile(
        self, row: int, column: int, name: str = HISTOGRAM, *, into: NDArray[np.int32] | None = None
    ) -> NDArray[np.int32]:
        """One tile of a histogram, (ty, tx, nvy, nvx) int32; clipped at the border.

        ``into``: an earlier tile that nobody needs any more. Where it has the shape of this one it is returned, right
        where vehicles passed and with any values elsewhere: to clear 22 MB takes longer than to read the rest.

        Raises
        ------
        StoreError
            The tile is damaged or gone.
        """
        height, width, *bins = self.group[name].shape
        side = self.tile
        shape = (min(side, height - row * side), min(side, width - column * side), *bins)
        try:
            into = None if into is None or into.shape != shape else into
            return decode_tile(self._tile_path(row, column, name).read_bytes(), shape, side, into=into)
        except Exception as error:
            raise StoreError(f"{self.path}: the chunk of tile ({row}, {column}) is damaged ({error})") from error

    def write_layer(self, name: str, group: tuple[int, int], values: NDArray[Any]) -> None:
        """Write a layer of one group, (y, x), smaller than the others at the map's edge: one file, none if empty."""
        path, array = self._layer_path(name, group), self.group[name]
        chunk = encode_chunk(values, array.chunks, array.fill_value)
        if chunk is None:
            path.unlink(missing_ok=True)
        else:
            write_atomically(path, chunk, sync=False)

    def _layer_path(self, name: str, group: tuple[int, int]) -> Path:
        return self.path / name / "c" / str(group[0]) / str(group[1])

    def layer(self, name: str) -> NDArray[Any]:
        """A whole layer, (y, x)."""
        return _read(self.path, self.group, name, slice(None))

    def files(self, tiles: Iterable[tuple[int, int]], group: tuple[int, int]) -> list[Path]:
        """Files that hold the tiles (row, column) and the layers of one group; and the store's metadata."""
        places = list(tiles)
        histogram = [self._tile_path(*place, name) for name in self.histogram_names() for place in places]
        layers = [self._layer_path(name, group) for name in self.layer_names()]
        axes = [self.path / name / "c" / "0" for name in self.group.by_axes.get(1, ())]
        return [*_metadata(self.path), *_existing([*histogram, *layers, *axes])]

    def layer_names(self) -> list[str]:
        """Names of the (y, x) layers, sorted."""
        return self.group.by_axes.get(2, [])

    def layer_attributes(self, name: str) -> dict[str, Any]:
        """Units and long name of a layer."""
        return dict(self.group[name].attrs)

    def chunk_shape(self, name: str) -> tuple[int, int]:
        """(height, width) of what one file of an array holds, px."""
        array = self.group[name]
        height, width = (array.shards or array.chunks)[:2]
        return int(height), int(width)

    def stored_chunks(self, name: str) -> list[tuple[int, int]]:
        """(row, column) of the stored chunks of an array; those of only the fill value are not stored."""
        return sorted((int(path.parent.name), int(path.name)) for path in (self.path / name / "c").glob("*/*"))


def open_field(path: Path, mode: str = "r") -> FieldStore:
    """Open ``field.zarr``."""
    return FieldStore(path, _open(path, mode))


# ------------------------------------------------------------------------------------------------------------- viewer

_SEGMENTS_A_CHUNK = 65536
_LAYER_CHUNK_PX = 512


def write_segments(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write ``view/segments.zarr``: columns of one length, (segments,) each; every chunk is stored."""
    group = zarr.create_group(**_location(path), overwrite=True, attributes={_FORMAT_KEY: FORMAT_VERSION})
    for name, values in columns.items():
        chunk = (min(_SEGMENTS_A_CHUNK, max(len(values), 1)),)
        column = _create(group, name, values.shape, chunk, values.dtype.name, dimension_names=("segment",))
        column.with_config({"write_empty_chunks": True})[:] = values


def read_segment_tracks(path: Path) -> IntArray:
    """Column ``track`` of ``view/segments.zarr``, (segments,)."""
    group = zarr.open_group(**_location(path), mode="r")
    return np.asarray(cast("zarr.Array[Any]", group["track"])[:], np.int64)


def write_extra_layers(path: Path, layers: Mapping[str, tuple[NDArray[np.floating], Mapping[str, Any]]]) -> None:
    """Write float32 (y, x) layers with their attributes, shown beside the field's own; `open_field` reads them."""
    group = zarr.create_group(**_location(path), overwrite=True, attributes={_FORMAT_KEY: FORMAT_VERSION})
    for name, (values, attributes) in layers.items():
        chunk = (_LAYER_CHUNK_PX, _LAYER_CHUNK_PX)
        layer = _create(group, name, values.shape, chunk, "float32", fill_value=np.nan, dimension_names=("y", "x"))
        layer[:] = values
        layer.attrs.update(dict(attributes))
