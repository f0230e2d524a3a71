"""Integrity of a run folder: every file and chunk that a commit record names exists and is what was written."""

import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from schemas.records import CommitRecord, FlightRecord
from velfield.errors import InputError
from velfield.pipeline.stage import STAGE, Cut
from velfield.run.commits import ANALYSIS, PAGE, WHOLE, commit_path, digest_file, read_commit, read_commits
from velfield.run.layout import RunLayout, remove_tree
from velfield.run.results import read_results
from velfield.run.stores import is_of_creation

_THREADS = min(4, os.cpu_count() or 1)
NOT_FINISHED = "not finished"
_BESIDES = (PAGE, ANALYSIS)
"""Names that have commit records but are not stages."""


@dataclass(frozen=True)
class Damage:
    """A file or unit that differs from its commit record, or a unit that has none."""

    stage: str
    unit: str
    path: str | None
    what: str
    """``gone``, ``damaged``, ``not finished`` or ``made without units that were lost``."""

    def text(self) -> str:
        """The damage in one line."""
        place = self.path or f"commits/{self.stage}/{self.unit}.json"
        return f"{self.stage} {self.unit}: {place} ({self.what})"


def verify_run(layout: RunLayout, record: FlightRecord) -> list[Damage]:
    """Read all that is committed and compare it with its digests; units that were never finished are listed too."""
    stages = [stage for stage in STAGE if not record.keys or stage in record.keys]  # a run of given tracks has fewer
    by_stage = {stage: read_commits(layout, stage) for stage in stages}
    besides = [record for name in _BESIDES for record in read_commits(layout, name)]
    found = [damage for stage in (*stages, *_BESIDES) for damage in _damaged_records(layout, stage)]
    damaged = {(damage.stage, damage.unit) for damage in found}
    found += [damage for damage in _unfinished(by_stage) if (damage.stage, damage.unit) not in damaged]
    found += _other_keys(by_stage, record)
    with ThreadPoolExecutor(_THREADS) as pool:
        checked = pool.map(lambda unit: _check(layout, unit), [*chain.from_iterable(by_stage.values()), *besides])
        found += chain.from_iterable(checked)
    return found + _damaged_index(layout)


def _damaged_records(layout: RunLayout, stage: str) -> Iterator[Damage]:
    """Commit records that are there and cannot be read."""
    for path in sorted((layout.commits / stage).glob("*.json")):
        if read_commit(layout, stage, path.stem) is None:
            yield Damage(stage, path.stem, path.relative_to(layout.root).as_posix(), "damaged")


def _damaged_index(layout: RunLayout) -> list[Damage]:
    try:
        read_results(layout)
    except InputError:
        return [Damage("results", layout.results_index.stem, layout.results_index.name, "damaged")]
    return []


def _check(layout: RunLayout, record: CommitRecord) -> list[Damage]:
    found = []
    for name, digest in record.outputs.items():
        try:
            path = layout.root / name
            whole = digest == digest_file(path)
        except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
            found.append(Damage(record.stage, record.unit, name, "gone"))
        else:
            found += [] if whole else [Damage(record.stage, record.unit, name, "damaged")]
    return found


def _unfinished(by_stage: dict[str, list[CommitRecord]]) -> Iterator[Damage]:
    by_frames = {record.unit for name, records in by_stage.items() for record in records if _is_by_frames(name)}
    for name, records in by_stage.items():
        finished = {record.unit for record in records}
        expected = by_frames if _is_by_frames(name) and by_frames else set() if finished else {WHOLE}
        yield from (Damage(name, unit, None, NOT_FINISHED) for unit in sorted(expected - finished))


def _is_by_frames(stage: str) -> bool:
    return STAGE[stage].cut is Cut.BY_FRAMES


def _other_keys(by_stage: dict[str, list[CommitRecord]], flight: FlightRecord) -> Iterator[Damage]:
    for stage, records in by_stage.items():
        key = flight.keys.get(stage)
        for record in records:
            if key is not None and record.key != key:
                yield Damage(stage, record.unit, None, "made without units that were lost, or of other inputs")


def invalidate(layout: RunLayout, damages: Iterable[Damage]) -> list[str]:
    """Remove the records of damaged units, so that the next run computes them again; returns ``stage unit`` names.

    A store whose metadata or coordinates are damaged is removed, with the records of all of its units: no unit writes
    those again. So are damaged files outside the stores, which a stage before theirs may read where they exist.
    """
    damages = list(damages)
    units = {(damage.stage, damage.unit) for damage in damages if damage.stage in (*STAGE, *_BESIDES)}
    if any((layout.root / (damage.path or "")).is_relative_to(layout.view_changes) for damage in damages):
        remove_tree(layout.view_changes)  # `velfield compare` writes it again
    of_creation = {damage.stage for damage in damages if damage.path and is_of_creation(damage.path)}
    for stage in of_creation & {name for name, stage in STAGE.items() if stage.store}:
        units |= {(stage, record.unit) for record in read_commits(layout, stage)}
        remove_tree(layout.root / str(STAGE[stage].store))
    for damage in damages:
        if damage.path and damage.stage in (*STAGE, *_BESIDES) and ".zarr/" not in damage.path:
            (layout.root / damage.path).unlink(missing_ok=True)
    for stage, unit in units:
        commit_path(layout, stage, unit).unlink(missing_ok=True)
    return sorted(f"{stage} {unit}" for stage, unit in units)


def describe_damage(root: Path, damages: Sequence[Damage]) -> str:
    """All damage, for people."""
    if not damages:
        return f"{root}: whole"
    n, units = len(damages), len({(damage.stage, damage.unit) for damage in damages})
    of_units = f"{units} unit{'s' if units > 1 else ''}"
    lines = [damage.text() for damage in damages]
    if not has_damage(damages):
        return "\n".join([*lines, f"{root}: what is there is whole; {of_units} never finished"])
    return "\n".join([*lines, f"{root}: {n} fault{'s' if n > 1 else ''} in {of_units}"])


def has_damage(damages: Sequence[Damage]) -> bool:
    """Whether there is damage, beyond units that a run which stopped, or was refused, did not reach."""
    return any(damage.what != NOT_FINISHED for damage in damages)
