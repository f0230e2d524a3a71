"""The estimate of a run before it starts: units, bytes, memory, what is finished already."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from velfield.errors import InputError, is_disk_full
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import committed
from velfield.pipeline.stage import STAGES, Cut
from velfield.pipeline.units import group_name, stage_units, unit_name
from velfield.run.layout import is_remote
from velfield.run.stores import FIELD_BLOCK, GROUP_TILES

_BYTES_A_DETECTION_FRAME = 150_000
_BYTES_A_TILE = 200_000
_TOUCHED = 0.1
"""Fraction of the map that traffic touches: a few per cent, with a margin."""


_PROCESS_BYTES = 500_000_000
_MEMORY_BYTES_A_PIXEL = 350
"""Memory of a process, and of each of its concurrent units a pixel: peaks of runs of 1280 x 960 and 1920 x 1080 px."""


def planned_units(plan: Plan) -> dict[str, list[str]]:
    """Names of every stage's units; those by tiles are an estimate until the base image's size is known."""
    side = plan.config.field.tile_size_px * GROUP_TILES * FIELD_BLOCK
    rows, columns = range(-(-plan.info.height // side)), range(-(-plan.info.width // side))
    tiles = [group_name((row, column)) for row in rows for column in columns]
    by_tiles = Cut.BY_TILES
    return {s.name: tiles if s.cut is by_tiles else [unit.name for unit in stage_units(plan, s)] for s in STAGES}


def estimated_bytes(plan: Plan) -> int:
    """Bytes that the run folder will take."""
    pixels = plan.info.width * plan.info.height
    frames = plan.frame_count * (pixels + _BYTES_A_DETECTION_FRAME)
    tiles = pixels / plan.config.field.tile_size_px**2 * _TOUCHED * _BYTES_A_TILE
    return int(frames + tiles + 8 * pixels)


def estimated_memory(plan: Plan, at_a_time: int) -> int:
    """Bytes of memory that ``at_a_time`` units take together, whatever the flight's length."""
    return _PROCESS_BYTES + at_a_time * plan.info.width * plan.info.height * _MEMORY_BYTES_A_PIXEL


def check_space(plan: Plan) -> None:
    """Refuse a run that the disk has no room for, before it starts.

    Raises
    ------
    InputError
        The disk has less free than what is still to be written.
    """
    if is_remote(plan.layout.root):
        return
    needed, free = _bytes_left(plan), _free_bytes(plan.layout.root)
    if needed > free:
        raise InputError(
            f"{plan.layout.root}: about {needed / 1e9:.2f} GB needed, {free / 1e9:.2f} GB free; "
            "free space, put --out on another disk, or take fewer frames with --every or --stop-s"
        )


def _bytes_left(plan: Plan) -> int:
    """Bytes that the units which are not finished will take."""
    names = [unit_name(frames) for frames in plan.units]
    undone = sum(committed(plan, "frames", name) is None for name in names)
    return int(estimated_bytes(plan) * undone / len(names))


@contextmanager
def disk_full_as_input_error(plan: Plan) -> Iterator[None]:
    """Turn "no space left", wherever it is met, into one line with the path, the bytes needed and those free."""
    try:
        yield
    except OSError as error:
        if not is_disk_full(error):
            raise
        root = plan.layout.root
        where = "" if error.filename is None else f" at {error.filename}"
        raise InputError(
            f"{root}: the disk is full{where} ({error.strerror}): about {_bytes_left(plan) / 1e9:.2f} GB more needed"
            f"{_free(root)}; free space and run the same command again: it resumes"
        ) from None


def describe_plan(plan: Plan, at_a_time: int = 2) -> str:
    """The plan as text: a line a stage, then bytes needed and free, and memory for so many units at a time."""
    lines = [f"{plan.job.inputs.source}: {plan.info.frame_count} frames of {plan.info.width} x {plan.info.height} px, "]
    lines[0] += f"{plan.frame_count} of them to process, {plan.unit_frames} a unit"
    if plan.job.inputs.base is not None:
        from velfield.sources.geo import read_base_raster

        base = read_base_raster(Path(plan.job.inputs.base), plan.config.frames)
        size = f"{base.grey.shape[1]} x {base.grey.shape[0]} px"
        scale = "of unknown scale" if base.gsd_m is None else f"of {base.gsd_m:.4g} m"
        place = "placed on Earth" if base.crs_wkt is not None else "without a place on Earth"
        lines += [f"{plan.job.inputs.base}: {size} {scale}, {place}", *(f"  {note}" for note in base.notes)]
    total = 0
    for stage, units in planned_units(plan).items():
        done = sum(committed(plan, stage, unit) is not None for unit in units)
        total += len(units)
        lines.append(f"  {stage:<13} units done: {done} of {len(units)}")
    root = plan.layout.root
    lines.append(f"{total} units; about {estimated_bytes(plan) / 1e9:.2f} GB needed in {root}{_free(root)}")
    memory = estimated_memory(plan, at_a_time) / 1e9
    lines.append(f"about {memory:.1f} GB of memory with {at_a_time} units at a time")
    return "\n".join(lines)


def _free(root: Path) -> str:
    return "" if is_remote(root) else f", {_free_bytes(root) / 1e9:.1f} GB free"


def _free_bytes(root: Path) -> int:
    existing = next(path for path in (root, *root.resolve().parents) if path.exists())
    return shutil.disk_usage(existing).free
