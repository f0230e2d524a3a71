"""Add and subtract the fields of run folders, tile by tile: exact, with one tile of each in memory."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

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
    for name in (*_SAME, *_SAME_GEOREFERENCE):
        if a.attributes.get(name) != b.attributes.get(name):
            raise InputError(_mismatch(first, other, name, a.attributes.get(name), b.attributes.get(name)))
    if not a.attributes.get("crs_wkt") and _base_digest(first) != _base_digest(other):
        raise InputError(
            f"{first} and {other} have different base images, and no coordinates to relate their pixels: "
            "run both with the same --base"
        )


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
