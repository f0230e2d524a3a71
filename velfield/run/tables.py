"""Tables of a run folder: Parquet parts of one unit each; arrays in one file, as image patches of the detections."""

import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.tables import TRACK_COLUMNS
from velfield.errors import StoreError, one_line
from velfield.run.commits import open_atomically, write_atomically
from velfield.run.layout import copy_objects, is_remote

Arrays = dict[str, NDArray[Any]]


def conform(table: pd.DataFrame, columns: Mapping[str, str]) -> pd.DataFrame:
    """The table with exactly these columns, in this order and of these types.

    Raises
    ------
    KeyError
        A column is missing.
    """
    return table[list(columns)].astype(dict(columns))


def empty_table(columns: Mapping[str, str]) -> pd.DataFrame:
    """A table of no rows.

    Examples
    --------
    >>> len(empty_table({"frame": "int32"}))
    0
    """
    return pd.DataFrame({name: np.empty(0, dtype) for name, dtype in columns.items()})


def write_table(path: Path, table: pd.DataFrame, columns: Mapping[str, str]) -> None:
    """Write one part, whole or not at all."""
    buffer = io.BytesIO()
    # By default no reader would notice a flipped bit.
    conform(table, columns).to_parquet(buffer, index=False, compression="zstd", write_page_checksum=True)
    write_atomically(path, buffer.getvalue())


def write_tracks(path: Path, tracklets: pd.DataFrame) -> None:
    """Write one part of the tracks: tracklets with their ``track_id``, ``recovered`` where the table says so."""
    write_table(path, tracklets.assign(recovered=tracklets.get("recovered", False)), TRACK_COLUMNS)


def link_file(source: Path, target: Path) -> Path:
    """Give one file a second name, as `link_files` does; returns it."""
    link_files([(source, target)])
    return target


def link_files(pairs: Sequence[tuple[Path, Path]]) -> None:
    """Give files a second name each, whole or not at all; no bytes are copied where the disk can do without.

    Files of a run folder are replaced, never changed in place: a change under one name does not show under the other.

    Parameters
    ----------
    pairs
        A file and its second name, each.
    """
    if all(is_remote(path) for pair in pairs for path in pair):
        copy_objects(pairs)
        return
    for source, target in pairs:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)
        try:
            os.link(source, target)
        except (OSError, TypeError):  # another disk, or an object
            write_atomically(target, source.read_bytes())


def read_tables(
    paths: Sequence[Path], columns: Mapping[str, str], *, only: Sequence[str] | None = None
) -> pd.DataFrame:
    """Parts concatenated in order; ``only`` selects columns.

    Raises
    ------
    StoreError
        A part is damaged: with its name.
    """
    selected = {name: columns[name] for name in (only or columns)}
    parts = [_read_part(path, list(selected)) for path in paths]
    parts = [part for part in parts if len(part)]
    return conform(pd.concat(parts, ignore_index=True), selected) if parts else empty_table(selected)


def _read_part(path: Path, columns: list[str]) -> pd.DataFrame:
    data = path.read_bytes()
    try:
        return pd.read_parquet(io.BytesIO(data), columns=columns, page_checksum_verification=True)
    except Exception as error:
        raise _damage_error(path, error) from error


def _damage_error(path: Path, error: Exception) -> StoreError:
    return StoreError(f"{path} is damaged ({one_line(error)}); `velfield verify` finds its unit")


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any] | Sequence[NDArray[Any]]]) -> None:
    """Write arrays by name: image patches of the detections, (n, h, w) uint8 each in the table's order, features of the
    base image.

    The bytes are those of `numpy.savez`, which copies them three times. Not compressed: that would save a quarter of
    the space, and cost as much time as all else but the network.

    Parameters
    ----------
    arrays
        Each whole, or in parts, one or more, which follow one another along the first axis.
    """
    with open_atomically(path) as file, ZipFile(file, "w") as archive:
        for name, given in arrays.items():
            parts = [given] if isinstance(given, np.ndarray) else given
            kind = parts[0]
            shape = (sum(map(len, parts)), *kind.shape[1:]) if kind.ndim else ()
            header = {"descr": np.lib.format.dtype_to_descr(kind.dtype), "fortran_order": False, "shape": shape}
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_1_0(member, header)
                for part in parts:
                    if (part.dtype, part.shape[1:]) != (kind.dtype, kind.shape[1:]):
                        raise ValueError(f"{path}: the parts of {name} are of different types or sizes")
                    member.write(np.ascontiguousarray(part).reshape(-1).view(np.uint8).data)


def read_arrays(path: Path, *, only: Sequence[str] | None = None) -> Arrays:
    """Arrays by name; ``only`` selects some, and of a file on a disk no others are read.

    Raises
    ------
    StoreError
        The file is damaged or gone.
    """
    try:
        with (
            io.BytesIO(path.read_bytes()) if is_remote(path) else path.open("rb") as opened,
            np.load(opened, allow_pickle=False) as file,
        ):
            return {name: file[name] for name in (only or file.files)}
    except Exception as error:
        raise _damage_error(path, error) from error
