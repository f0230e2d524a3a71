"""Add and subtract the fields of run folders, tile by tile: exact, with one tile of each in memory."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from rasterio.transform import Affine

from velfield.errors import InputError
from velfield.field.accumulate import FieldTile
from velfield.field.algebra import merge_tiles, subtract_tile
from velfield.field.segments import VelocityBins
from velfield.field.view import TileSource
from velfield.run.commits import content_key, digest_file, digest_outputs, write_record
from velfield.run.field_reader import tile_reader
from velfield.run.field_writer import GroupWriter, create_field_store, tile_groups
from velfield.run.flight_record import read_flight_record
from velfield.run.frame_transforms import read_grid, read_working
from velfield.run.layout import RunLayout
from velfield.run.stores import HISTOGRAM_TIME_WEIGHTED, FieldStore, store_key

Combine = Callable[[Sequence[FieldTile | None]], FieldTile | None]

_SAME = ("bin_width_px_per_s", "kernel_sigma_px_per_s", "band_radius_px", "velocity_span_s", "weighted_by", "gsd_m")
_WHOLE_PX = 0.01
"""Grids that lie farther than this from whole pixels of each other have none in common."""
_SAME_GEOREFERENCE = ("crs_wkt", "geotransform")


def merge_fields(roots: Sequence[Path], out: Path) -> None:
    """The sum of the fields of run folders, into a new folder that `open_run(out).field` reads.

    Raises
    ------
    InputError
        Fewer than two folders, fields on different grids, or ``out`` holds something.
    """
    if len(roots) < 2:
        raise InputError(f"merge needs two or more run folders, found {len(roots)}")

    def add(tiles: Sequence[FieldTile | None]) -> FieldTile | None:
        known = [tile for tile in tiles if tile is not None]
        return merge_tiles(known) if known else None

    stores = _open_compatible(roots)
    observed_s = sum(float(store.attributes.get("observed_s", 0.0)) for store in stores)
    _write(roots, stores, out, add, observed_s, {"merged_from": [str(root) for root in roots]})


def subtract_fields(whole: Path, part: Path, out: Path) -> None:
    """The field of ``whole`` less that of ``part``, into a new folder.

    Raises
    ------
    InputError
        The fields are on different grids, ``part`` is no part of ``whole``, or ``out`` holds something.
    """

    def subtract(tiles: Sequence[FieldTile | None]) -> FieldTile | None:
        large, small = tiles
        if small is None:
            return large
        if large is None:
            raise InputError(f"{part} has tracks where {whole} has none: it is no part of it")
        return subtract_tile(large, small)

    stores = _open_compatible([whole, part])
    seconds = [float(store.attributes.get("observed_s", 0.0)) for store in stores]
    made_from = {"subtracted_from": str(whole), "subtracted": str(part)}
    _write([whole, part], stores, out, subtract, max(seconds[0] - seconds[1], 0.0), made_from)


def check_same_grid(first: Path, other: Path) -> None:
    """Check that two fields have the same pixels and velocity bins.

    Raises
    ------
    InputError
        They differ: in what, and what to do.
    """
    a, b = (FieldStore(RunLayout(root).field) for root in (first, other))
    if a.shape != b.shape or a.tile != b.tile:
        raise InputError(_mismatch(first, other, "size", f"{a.shape[::-1]} px", f"{b.shape[::-1]} px"))
    _check_same(first, other, (*_SAME, *_SAME_GEOREFERENCE))
    known = a.attributes.get("crs_wkt") or find_offset(first, other) == (0, 0)
    if not known and _base_digest(first) != _base_digest(other):
        raise InputError(
            f"{first} and {other} have different base images, and no coordinates to relate their pixels: "
            "run both with the same --base"
        )


def common_offset(first: Path, other: Path) -> tuple[int, int]:
    """Column and row of the other field's grid at which pixel (0, 0) of the first one lies: (0, 0) on one grid.

    Raises
    ------
    InputError
        They have no pixels in common, other velocity bins, or nothing that relates their pixels.
    """
    offset = find_offset(first, other)
    if offset is None:
        check_same_grid(first, other)
        return 0, 0
    _check_same(first, other, (*_SAME, "crs_wkt"))
    a, b = (np.array(FieldStore(RunLayout(root).field).shape[::-1]) for root in (first, other))
    if (np.minimum(a + offset, b) <= np.maximum(offset, 0)).any():
        raise InputError(f"{first} and {other} have no place in common; give two runs of one place")
    return offset


def find_offset(first: Path, other: Path) -> tuple[int, int] | None:
    """As `common_offset`; None where neither coordinates nor metres of tracks relate the pixels, or not by whole
    pixels."""
    a, b = (read_grid(RunLayout(root)) for root in (first, other))
    if a.gsd_m != b.gsd_m:
        return None
    if a.affine and b.affine and a.crs_wkt == b.crs_wkt:
        first_map, other_map = Affine(*a.affine), Affine(*b.affine)
        if not np.allclose(first_map[:2] + first_map[3:5], other_map[:2] + other_map[3:5], rtol=1e-9, atol=0):
            return None
        at = np.array(~other_map * (first_map.c, first_map.f))
    elif a.base_source == b.base_source == "tracks" and not (a.crs_wkt or b.crs_wkt):
        at = np.array([a.origin_x_px - b.origin_x_px, a.origin_y_px - b.origin_y_px])
    else:
        return None
    return (round(at[0]), round(at[1])) if np.abs(at - at.round()).max() < _WHOLE_PX else None


def _check_same(first: Path, other: Path, names: Sequence[str]) -> None:
    a, b = (FieldStore(RunLayout(root).field).attributes for root in (first, other))
    for name in names:
        if a.get(name) != b.get(name):
            raise InputError(_mismatch(first, other, name, a.get(name), b.get(name)))


def _mismatch(first: Path, other: Path, what: str, a: object, b: object) -> str:
    return (
        f"the fields of {first} and {other} are on different grids: {what} is {_short(a)} and {_short(b)}; "
        "run both with the same --base, --gsd-m and field settings"
    )


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _base_digest(root: Path) -> str:
    layout = RunLayout(root)
    path = layout.base_image_tif if layout.base_image_tif.exists() else layout.base_image
    return digest_file(path)


def _open_compatible(roots: Sequence[Path]) -> list[FieldStore]:
    for other in roots[1:]:
        check_same_grid(roots[0], other)
    return [FieldStore(RunLayout(root).field) for root in roots]


def _write(
    roots: Sequence[Path],
    stores: Sequence[FieldStore],
    out: Path,
    combine: Combine,
    observed_s: float,
    made_from: Mapping[str, object],
) -> None:
    layout, first = RunLayout(out), RunLayout(roots[0])
    if out.exists() and any(out.iterdir()):
        raise InputError(f"--out {out} exists and holds files: give a new folder")
    record, grid = read_flight_record(roots[0]), read_grid(first)
    config = record.config.field
    out.mkdir(parents=True, exist_ok=True)
    shutil.copytree(first.base, layout.base, ignore=shutil.ignore_patterns(first.grid.name, first.working.name))
    write_record(layout.grid, grid)
    if first.working.exists():
        write_record(layout.working, read_working(first))
    key = content_key("algebra", 1, parameters=list(made_from), inputs=[store_key(store.path) for store in stores])
    create_field_store(
        layout.field,
        key=key,
        grid=grid,
        config=config,
        weighted_by=stores[0].attributes["weighted_by"],
        observed_s=observed_s,
        time_weighted=all(HISTOGRAM_TIME_WEIGHTED in store.histogram_names() for store in stores),
        more=made_from,
    )
    target = FieldStore(layout.field, "r+")
    kinds = [[tile_reader(store, name) for store in stores] for name in target.histogram_names()]
    bins = VelocityBins.from_config(config, grid.gsd_m)
    files = set[Path]()
    for group in tile_groups(grid, config):
        files |= _write_group(GroupWriter(target, group, grid=grid, config=config, bins=bins, zeros=[]), kinds, combine)
    digest_outputs(layout, files)  # which sees to it that they are on the disk
    write_record(layout.flight, record)  # last: without it nothing is whole


def _write_group(writer: GroupWriter, kinds: Sequence[Sequence[TileSource]], combine: Combine) -> set[Path]:
    for row, column in writer.tiles():
        tile, *timed = (combine([read(row, column) for read in readers]) for readers in kinds)
        if tile is not None:
            writer.put(row, column, tile, timed[0] if timed else None)
    writer.close()
    return set(writer.files())
