"""The units of a stage: what is computed, committed and, should it fail, tried again as one."""

from dataclasses import dataclass
from typing import Any

from velfield.pipeline.plan import Plan
from velfield.pipeline.stage import Cut, Stage, resolve
from velfield.run.commits import WHOLE, commit_path, read_commit


@dataclass(frozen=True)
class Unit:
    """One unit of a stage."""

    name: str
    """Of its commit record."""
    part: tuple[Any, ...] = ()
    """Its frames (a range) or its group of tiles (row, column), as the one argument of the stage's function; empty
    where the stage is not cut."""

    @property
    def frames(self) -> range:
        """Its frames; none where the stage is not cut by frames."""
        return self.part[0] if self.part and isinstance(self.part[0], range) else range(0)

    @property
    def steps(self) -> int:
        """Steps of the progress bar that it is: a step a frame, else one."""
        return max(1, len(self.frames))


def unit_name(frames: range) -> str:
    """Name of a unit of frames: its range, so that a record says which frames it is about.

    Examples
    --------
    >>> unit_name(range(64, 128))
    '000064-000127'
    """
    return f"{frames.start:06d}-{frames.stop - 1:06d}"


def group_name(group: tuple[int, int]) -> str:
    """Name of a unit of tiles, (row, column).

    Examples
    --------
    >>> group_name((0, 3))
    'group-000-003'
    """
    return f"group-{group[0]:03d}-{group[1]:03d}"


def prepare_stage(plan: Plan, stage: Stage) -> None:
    """Create what the units of a stage write into, and remove what units of an earlier plan left there."""
    if stage.prepare is not None:
        resolve(stage.prepare)(plan)
    _remove_stale_units(plan, stage)


def discard_unit(plan: Plan, stage: Stage, unit: str) -> None:
    """Remove the record of a unit, and the files that it vouches for outside the stage's store: no stage reads them."""
    record = read_commit(plan.layout, stage.name, unit)
    commit_path(plan.layout, stage.name, unit).unlink(missing_ok=True)
    if record is not None and stage.store is None:
        for output in record.outputs:
            (plan.layout.root / output).unlink(missing_ok=True)


def _remove_stale_units(plan: Plan, stage: Stage) -> None:
    """Remove the records of units that this plan does not have, and their files: fewer frames, or other units."""
    current = {unit.name for unit in stage_units(plan, stage)}
    for path in (plan.layout.commits / stage.name).glob("*.json"):
        if path.stem not in current:
            discard_unit(plan, stage, path.stem)


def stage_units(plan: Plan, stage: Stage) -> list[Unit]:
    """The units of a stage, in their order; those by tiles are known once the base image is."""
    if stage.cut is Cut.BY_FRAMES:
        return [Unit(unit_name(frames), (frames,)) for frames in plan.units]
    if stage.tiles is not None:
        return [Unit(group_name(group), (group,)) for group in resolve(stage.tiles)(plan)]
    return [Unit(WHOLE)]


def unit_blocks(plan: Plan, unit: Unit) -> list[range]:
    """The blocks of frames that a unit is computed by, where its stage has such.

    Blocks of a unit of frames end at multiples of their length in the flight, where frames that are searched whole lie.
    """
    step = plan.config.work.block_frames
    first, last = unit.frames.start, unit.frames.stop
    ends = [*range((first // step + 1) * step, last, step), last]
    return [range(start, end) for start, end in zip([first, *ends[:-1]], ends, strict=True)]
