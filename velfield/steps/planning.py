"""What a run would do, said before it is done: units, task runs, bytes, what is finished already."""

import shutil

from velfield.layout import STAGES
from velfield.plan import Plan
from velfield.steps.field_writing import GROUP_TILES
from velfield.steps.outcome import committed, unit_name

_PER_FRAME = ("frames", "registration", "detections", "links")
_FRAME_COMPRESSION = 0.8
"""Zstandard leaves about this much of a noisy grey frame."""
_BYTES_A_DETECTION_FRAME = 150_000
_BYTES_A_TILE = 200_000
_TOUCHED = 0.1
"""Share of the map that traffic touches: a few per cent, with a margin."""


def planned_units(plan: Plan) -> dict[str, list[str]]:
    """Names of every stage's units; the field's are an estimate until the base image's size is known."""
    units = {stage: ["all"] for stage in STAGES}
    for stage in _PER_FRAME:
        units[stage] = [unit_name(frames) for frames in plan.units]
    side = plan.config.field.tile_size_px * GROUP_TILES
    rows, columns = -(-plan.info.height // side), -(-plan.info.width // side)
    units["field"] = [f"group-{row:03d}-{column:03d}" for row in range(rows) for column in range(columns)]
    return units


def estimated_bytes(plan: Plan) -> int:
    """Bytes that the run folder will take."""
    pixels = plan.info.width * plan.info.height
    frames = plan.frame_count * (pixels * _FRAME_COMPRESSION + _BYTES_A_DETECTION_FRAME)
    tiles = pixels / plan.config.field.tile_size_px**2 * _TOUCHED * _BYTES_A_TILE
    return int(frames + tiles + 8 * pixels)


def describe_plan(plan: Plan) -> str:
    """The plan as text: a line a stage, then bytes needed and free."""
    lines = [f"{plan.job.inputs.source}: {plan.info.frame_count} frames of {plan.info.width} x {plan.info.height} px, "]
    lines[0] += f"{plan.frame_count} of them to work on, {plan.unit_frames} a unit"
    total = 0
    for stage, units in planned_units(plan).items():
        done = sum(committed(plan, stage, unit) is not None for unit in units)
        total += len(units)
        lines.append(f"  {stage:<13} {len(units):>5} units, {done:>5} done")
    root = plan.layout.root
    existing = next(path for path in (root, *root.resolve().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    lines.append(
        f"{total} task runs; about {estimated_bytes(plan) / 1e9:.2f} GB needed in {root}, {free / 1e9:.1f} GB free"
    )
    return "\n".join(lines)
