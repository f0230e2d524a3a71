"""The Zarr stores of a run folder: create, open, check. The only module that imports zarr.

Three rules, each after a fault seen in zarr or in its use:

- every chunk has a checksum: the default codec returns wrong pixels for one bit in seven, silently;
- a chunk has one writer: two writers on parts of one chunk lose each other's work, so the chunks of per-frame columns
  are exactly the units of work;
- a missing chunk reads as the fill value: whoever reads asks the commit records which chunks must exist.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, cast

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
HISTOGRAM = "velocity_histogram"
HISTOGRAM_TIME_WEIGHTED = "velocity_histogram_time_weighted"
GROUP_TILES = 8
"""Side of a group in tiles, 512 px: a chunk of the layers."""
FIELD_BLOCK = 2
"""Side of a unit of work in groups: each reads the tables of tracks once, and costs a task of its own."""


def _create(group: zarr.Group, name: str, shape: Sequence[int], chunks: Sequence[int], dtype: str, **kw: Any) -> Any:
    about = {"compressors": _ZSTANDARD, **kw}
    return group.create_array(name, shape=tuple(shape), chunks=tuple(chunks), dtype=dtype, **about)


def fill_value(dtype: str) -> float:
    """The value of what is not known: NaN, of integers 0."""
    return np.nan if dtype.startswith("float") else 0


def _location(path: Path) -> dict[str, Any]:
    """Zarr's arguments for the store at a path."""
    if is_remote(path):
        return {"store": str(path), "storage_options": dict(path.storage_options)}
    return {"store": path}


def _new_group(path: Path, attributes: Mapping[str, Any]) -> zarr.Group:
    about = {"format_version": FORMAT_VERSION, **attributes}
    return zarr.create_group(**_location(path), overwrite=True, attributes=about)


def _open_group(path: Path, mode: Any = "r") -> zarr.Group:
    return zarr.open_group(**_location(path), mode=mode, zarr_format=3, use_consolidated=False)


class _Store:
    """A store, opened, whose arrays are opened once: on S3 each opening is a request or two.

    Raises
    ------
    InputError
        There is none at the path.
    """

    def __init__(self, path: Path, mode: str = "r") -> None:
        self.path = path
        self._arrays: dict[str, zarr.Array[Any]] = {}
        try:
            self._group = _open_group(path, mode)
        except FileNotFoundError:
            raise InputError(f"{path} does not exist: run `velfield run` on this folder first") from None

    def __getitem__(self, name: str) -> zarr.Array[Any]:
        if name not in self._arrays:
            self._arrays[name] = cast("zarr.Array[Any]", self._group[name])
        return self._arrays[name]

    def _read(self, name: str, selection: Any) -> NDArray[Any]:
        try:
            return np.asarray(self[name][selection])
        except Exception as error:
            raise StoreError(
                f"{self.path / name}: a chunk is damaged ({error}); `velfield verify {self.path.parent}` finds which"
            ) from error

    def _file(self, name: str, *place: int) -> Path:
        """File of a chunk, or of a shard."""
        return (self.path / name / "c").joinpath(*map(str, place))

    def _files(self, chunks: Iterable[Path]) -> list[Path]:
        """The metadata files of the store and its arrays, and of its chunks those that exist: zarr writes none that
        hold only the fill value."""
        metadata = [self.path / "zarr.json", *sorted(self.path.glob("*/zarr.json"))]
        return [*metadata, *(path for path in chunks if path.exists())]


class _ByFrame(_Store):
    """A store of frames; ``_main`` is the array of which each frame has a part."""

    _main: ClassVar[str]

    @property
    def count(self) -> int:
        return int(self[self._main].shape[0])

    def check_frame(self, frame: int) -> int:
        """The frame itself; InputError where there is none of this number, whose chunk would look missing."""
        if not 0 <= frame < self.count:
            raise InputError(f"{self.path}: frame {frame} is not in the run: its frames go from 0 to {self.count - 1}")
        return frame

    def write_columns(self, start: int, columns: Mapping[str, NDArray[Any]]) -> None:
        """Write a whole unit of columns from frame ``start`` on."""
        for name, values in columns.items():
            self[name][start : start + len(values)] = values

    def _column(self, name: str, known: Iterable[str], rows: slice) -> NDArray[Any]:
        """Rows of a column; an unknown name, which would look like a damaged column, is refused."""
        if name not in known:
            raise InputError(f"{self.path}: found no column {name!r}; it has {', '.join(known)}")
        return self._read(name, rows)


def _create_columns(
    group: zarr.Group, count: int, unit_frames: int, columns: Mapping[str, tuple[str, float, tuple[int, ...]]]
) -> None:
    """Create columns of frames, of a type, a fill value and a shape each, whose chunks are units of work."""
    chunk = min(unit_frames, max(count, 1))
    for name, (dtype, fill, shape) in columns.items():
        axes = None if len(shape) == 1 else ("frame", "row", "column")[: 1 + len(shape)]
        _create(group, name, (count, *shape), (chunk, *shape), dtype, fill_value=fill, dimension_names=axes)


def store_key(path: Path) -> str | None:
    """Content key that a store was created under; None where it does not exist or is incomplete."""
    try:
        return str(_open_group(path).attrs["key"])
    except (FileNotFoundError, KeyError, ValueError):
        return None


def is_cut_as(path: Path, key: str, unit_frames: int) -> bool:
    """Whether a store was created under a key, for units of so many frames.

    Units that share a chunk would overwrite each other's rows.
    """
    if store_key(path) != key:
        return False
    group = _open_group(path)
    column: Any = group["vector" if "vector" in group else "time_s"]
    return bool(column.chunks[0] == min(unit_frames, max(column.shape[0], 1)))


# ------------------------------------------------------------------------------------------------------------- frames

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
    group = _new_group(path, {"source": dict(source)})
    # Zstandard takes off a tenth of a frame, for 13 ms a frame of 5 Mpx to write and 4 ms to read.
    raw, axes = (count, height, width), ("frame", "y", "x")
    _create(group, "raw", raw, (1, height, width), "uint8", compressors=Crc32cCodec(), dimension_names=axes)
    columns = {name: (*column, ()) for name, column in FRAME_COLUMNS.items()}
    _create_columns(group, count, unit_frames, {**columns, "thumbnail": ("float32", 0, THUMBNAIL_SHAPE)})
    _create_columns(group, count, max(count, 1), {FLAGS: ("uint16", 2, ())})
    group.attrs["key"] = key  # last: a store without it is incomplete


class FrameStore(_ByFrame):
    """``frames.zarr``, opened."""

    _main = "raw"

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of a frame, px."""
        _, height, width = self["raw"].shape
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
        self.check_frame(frame)
        if not self._file("raw", frame, 0, 0).exists():
            raise StoreError(f"{self.path}: the chunk of frame {frame} is missing; `velfield run` writes it again")
        try:
            return np.asarray(self["raw"][frame], dtype=np.uint8)
        except Exception as error:
            raise StoreError(f"{self.path}: the chunk of frame {frame} is damaged ({error})") from error

    def write(self, frame: int, grey: GreyImage) -> None:
        """Write one frame: one chunk, also of a black frame, which else would look missing."""
        self["raw"].with_config({"write_empty_chunks": True})[frame] = grey

    def column(self, name: str) -> NDArray[Any]:
        """One column: ``flags``, or one of ``FRAME_COLUMNS``, (frames,)."""
        return self._column(name, (*FRAME_COLUMNS, FLAGS), slice(None))

    def files(self, start: int, stop: int) -> list[Path]:
        """Files that hold the frames ``[start, stop)``, a unit, and their columns; and the store's metadata."""
        raw = (self._file("raw", frame, 0, 0) for frame in range(start, stop))
        unit = start // int(self["time_s"].chunks[0])
        columns = (self._file(name, unit) for name in FRAME_COLUMNS)
        return self._files([*raw, *columns, self._file("thumbnail", unit, 0, 0)])

    def thumbnails(self, start: int, stop: int) -> Float32Array:
        """Thumbnails of the frames ``[start, stop)``, (frames, 16, 16), each with its mean removed."""
        return self._read("thumbnail", slice(start, stop))

    def write_flags(self, flags: IntArray) -> Path:
        """Write the column ``flags`` whole, as one chunk; returns its file."""
        self[FLAGS].with_config({"write_empty_chunks": True})[:] = flags
        return self._file(FLAGS, 0)


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
_CELL_ARRAYS = {"error_px": ERROR_CELLS, "position_sd_px": POSITION_SD_CELLS}


def create_registration(path: Path, *, key: str, count: int, vector_length: int, unit_frames: int) -> None:
    """Create ``registration.zarr``: chunks are units, so that a unit has one writer."""
    group = _new_group(path, {})
    columns = {
        "vector": ("float64", np.nan, (vector_length,)),
        "status": ("uint8", 0, (_STATUS_BYTES,)),
        **{name: (dtype, fill_value(dtype), ()) for name, dtype in REGISTRATION_COLUMNS.items()},
        **{name: ("float32", np.nan, cells) for name, cells in _CELL_ARRAYS.items()},
    }
    _create_columns(group, count, unit_frames, columns)
    group.attrs["key"] = key


class RegistrationStore(_ByFrame):
    """``registration.zarr``, opened."""

    _main = "vector"

    def write(
        self, start: int, vectors: FloatArray, statuses: Sequence[str], columns: Mapping[str, NDArray[Any]]
    ) -> None:
        """Write a whole unit from frame ``start`` on; ``columns`` are ``REGISTRATION_COLUMNS`` and those by cell."""
        text = np.array([status.encode()[:_STATUS_BYTES] for status in statuses], f"S{_STATUS_BYTES}")
        rows = text.view(np.uint8).reshape(-1, _STATUS_BYTES)
        self.write_columns(start, {"vector": vectors, "status": rows, **columns})

    @property
    def unit_frames(self) -> int:
        """Frames of a chunk."""
        return int(self["vector"].chunks[0])

    def statuses(self, start: int = 0, stop: int | None = None) -> list[str]:
        """``ok``, ``failed:<reason>`` or ``skipped:<reason>`` of each frame; empty where not processed yet."""
        rows = self._read("status", slice(start, stop))
        return [bytes(row).rstrip(b"\0").decode(errors="replace") for row in rows]

    def column(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """A column of the frames ``[start, stop)``.

        One of ``REGISTRATION_COLUMNS``, (frames,); ``vector``, (frames, n): parameters of the transforms, NaN where a
        frame is not registered; ``error_px``, (frames, 6, 8): hold-out error by cell; ``position_sd_px``, (frames,
        rows, columns): standard deviation of the maps by cell, NaN where there are no control points.
        """
        return self._column(name, (*REGISTRATION_COLUMNS, "vector", *_CELL_ARRAYS), slice(start, stop))

    def files(self, start: int) -> list[Path]:
        """Files that hold the unit from frame ``start`` on, and the store's metadata."""
        unit = start // self.unit_frames
        tables = (self._file(name, unit, 0) for name in ("vector", "status"))
        columns = (self._file(name, unit) for name in REGISTRATION_COLUMNS)
        return self._files([*tables, *columns, *(self._file(name, unit, 0, 0) for name in _CELL_ARRAYS)])


# -------------------------------------------------------------------------------------------------------------- field

_AXES, _METRIC = ("y", "x", "vy", "vx"), "_m_per_s"


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
    group = _new_group(path, attributes)
    n = len(velocities_px_per_s)
    grid_mapping = {"grid_mapping": "crs"} if attributes.get("crs_wkt") else {}
    about: dict[str, Any]
    for name, own in histograms.items():
        shape, blocks = (height, width, n, n), (block_side(tile), block_side(tile), n, n)
        about = {"shards": (tile, tile, n, n), "dimension_names": _AXES, "attributes": {**own, **grid_mapping}}
        _create(group, name, shape, blocks, "int32", fill_value=0, **about)
    side = tile * group_tiles
    for name, (dtype, attrs) in layers.items():
        about = {"dimension_names": ("y", "x"), "attributes": {**attrs, **grid_mapping}}
        _create(group, name, (height, width), (side, side), dtype, fill_value=fill_value(dtype), **about)
    axes: list[tuple[str, str, FloatArray, str]] = [
        ("y", "", np.arange(height, dtype=np.float64), "px"),
        ("x", "", np.arange(width, dtype=np.float64), "px"),
        *((name, "", velocities_px_per_s, "px s-1") for name in ("vy", "vx")),
    ]
    if gsd_m := attributes.get("gsd_m"):
        axes += [(name, _METRIC, velocities_px_per_s * float(gsd_m), "m s-1") for name in ("vy", "vx")]
    for name, metric, values, units in axes:
        about = {"dimension_names": (name,), "attributes": {"units": units}}
        _create(group, name + metric, values.shape, values.shape, "float64", **about)[:] = values
    if attributes.get("crs_wkt"):
        about = {"crs_wkt": attributes["crs_wkt"], "GeoTransform": attributes.get("geotransform", "")}
        _create(group, "crs", (), (), "int32", fill_value=0, attributes=about)
    group.attrs["key"] = key


def is_of_creation(name: str) -> bool:
    """Whether a file of a store, by its path in the run folder, is written when the store is created, and by no unit.

    That is the metadata, and the coordinates along the axes of the field.
    """
    return name.endswith("zarr.json") or Path(name).parts[1:2] in {
        (f"{axis}{unit}",) for axis in _AXES for unit in ("", _METRIC)
    }


class FieldStore(_Store):
    """``field.zarr``, opened."""

    @property
    def attributes(self) -> dict[str, Any]:
        return dict(self._group.attrs)

    @cached_property
    def _by_axes(self) -> dict[int, list[str]]:
        """Names of the arrays by their number of axes, sorted."""
        self._arrays |= dict(self._group.arrays())
        names: dict[int, list[str]] = {}
        for name in sorted(self._arrays):
            names.setdefault(self._arrays[name].ndim, []).append(name)
        return names

    @property
    def tile(self) -> int:
        return self.chunk_shape(HISTOGRAM)[0]

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the base image, px."""
        height, width = self[HISTOGRAM].shape[:2]
        return int(height), int(width)

    def velocities(self) -> FloatArray:
        """Bin centres, px/s."""
        return np.asarray(self["vx"][:])

    def histogram_names(self) -> list[str]:
        """Names of the (y, x, vy, vx) histograms."""
        return [name for name in (HISTOGRAM, HISTOGRAM_TIME_WEIGHTED) if name in self._by_axes.get(4, ())]

    def write_tile(
        self, row: int, column: int, histogram: NDArray[np.int32], count: NDArray[np.int32], name: str = HISTOGRAM
    ) -> None:
        """Write one tile of a histogram, (ty, tx, nvy, nvx), zero where ``count`` (ty, tx) is: one file."""
        write_atomically(self._file(name, row, column, 0, 0), encode_tile(histogram, count, self.tile), sync=False)

    def has_tile(self, row: int, column: int, name: str = HISTOGRAM) -> bool:
        """Whether the tile's file exists."""
        return self._file(name, row, column, 0, 0).exists()

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
        height, width, *bins = self[name].shape
        side = self.tile
        shape = (min(side, height - row * side), min(side, width - column * side), *bins)
        try:
            into = None if into is None or into.shape != shape else into
            return decode_tile(self._file(name, row, column, 0, 0).read_bytes(), shape, side, into=into)
        except Exception as error:
            raise StoreError(f"{self.path}: the chunk of tile ({row}, {column}) is damaged ({error})") from error

    def write_layer(self, name: str, group: tuple[int, int], values: NDArray[Any]) -> None:
        """Write a layer of one group, (y, x), smaller than the others at the map's edge: one file, none if empty."""
        path, array = self._file(name, *group), self[name]
        chunk = encode_chunk(values, array.chunks, array.fill_value)
        if chunk is None:
            path.unlink(missing_ok=True)
        else:
            write_atomically(path, chunk, sync=False)

    def layer(self, name: str) -> NDArray[Any]:
        """A whole layer, (y, x)."""
        return self._read(name, slice(None))

    def files(self, tiles: Iterable[tuple[int, int]], group: tuple[int, int]) -> list[Path]:
        """Files that hold the tiles (row, column) and the layers of one group; and the store's metadata."""
        places = [*tiles]
        histogram = (self._file(name, *place, 0, 0) for name in self.histogram_names() for place in places)
        layers = (self._file(name, *group) for name in self.layer_names())
        return self._files([*histogram, *layers, *(self._file(name, 0) for name in self._by_axes.get(1, ()))])

    def layer_names(self) -> list[str]:
        """Names of the (y, x) layers, sorted."""
        return self._by_axes.get(2, [])

    def layer_attributes(self, name: str) -> dict[str, Any]:
        """Units and long name of a layer."""
        return dict(self[name].attrs)

    def chunk_shape(self, name: str) -> tuple[int, int]:
        """(height, width) of what one file of an array holds, px."""
        array = self[name]
        height, width = (array.shards or array.chunks)[:2]
        return int(height), int(width)

    def stored_chunks(self, name: str) -> list[tuple[int, int]]:
        """(row, column) of the stored chunks of an array; those of only the fill value are not stored."""
        return sorted((int(path.parent.name), int(path.name)) for path in (self.path / name / "c").glob("*/*"))


# ------------------------------------------------------------------------------------------------------------- viewer

_SEGMENTS_A_CHUNK = 65536
_LAYER_CHUNK_PX = 512


def write_segments(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write ``view/segments.zarr``: columns of one length, (segments,) each; every chunk is stored."""
    group = _new_group(path, {})
    for name, values in columns.items():
        chunk = (min(_SEGMENTS_A_CHUNK, max(len(values), 1)),)
        column = _create(group, name, values.shape, chunk, values.dtype.name, dimension_names=("segment",))
        column.with_config({"write_empty_chunks": True})[:] = values


def read_segment_tracks(path: Path) -> IntArray:
    """Column ``track`` of ``view/segments.zarr``, (segments,)."""
    return np.asarray(_Store(path)["track"][:], np.int64)


def write_extra_layers(path: Path, layers: Mapping[str, tuple[NDArray[np.floating], Mapping[str, Any]]]) -> None:
    """Write float32 (y, x) layers with their attributes, shown beside the field's own; `FieldStore` reads them."""
    group = _new_group(path, {})
    for name, (values, attributes) in layers.items():
        chunk = (_LAYER_CHUNK_PX, _LAYER_CHUNK_PX)
        about: dict[str, Any] = {"fill_value": np.nan, "dimension_names": ("y", "x"), "attributes": dict(attributes)}
        _create(group, name, values.shape, chunk, "float32", **about)[:] = values
