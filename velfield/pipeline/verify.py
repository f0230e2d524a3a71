"""Whether a run folder is whole: every file and chunk that a commit record names is there and is what was written."""

import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from schemas.records import CommitRecord, FlightRecord
from velfield.run.commits import commit_path, digest_file, read_commits
from velfield.run.layout import STAGES, RunLayout
from velfield.run.paths import remove_tree

_BY_FRAMES = ("registration", "detections", "tracklets")
"""Stages that are cut as the frames are."""
_STORES = {"frames": "frames.zarr", "registration": "registration.zarr", "field": "field.zarr"}
_THREADS = min(4, os.cpu_count() or 1)


NOT_FINISHED = "not finished"


@dataclass(frozen=True)
class Damage:
    """One thing that is not as its commit record says, or a unit that has none."""

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
    """Read all that is committed and compare it with its digests; a unit that was never finished is told too."""
    by_stage = {stage: read_commits(layout, stage) for stage in STAGES}
    found = list(_unfinished(by_stage)) + list(_other_keys(by_stage, record))
    with ThreadPoolExecutor(_THREADS) as pool:
        checked = pool.map(lambda unit: _check(layout, unit), chain.from_iterable(by_stage.values()))
        found += chain.from_iterable(checked)
    return found


def _check(layout: RunLayout, record: CommitRecord) -> list[Damage]:
    found = []
    for name, digest in record.outputs.items():
        try:
            whole = digest_file(layout.root / name) == digest
        except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
            found.append(Damage(record.stage, record.unit, name, "gone"))
        else:
            found += [] if whole else [Damage(record.stage, record.unit, name, "damaged")]
    return found


def _unfinished(by_stage: dict[str, list[CommitRecord]]) -> Iterator[Damage]:
    cut = {unit.unit for unit in by_stage["frames"]}
    for stage, records in by_stage.items():
        there = {record.unit for record in records}
        wanted = cut if stage in _BY_FRAMES else set() if there else {"all"}
        yield from (Damage(stage, unit, None, NOT_FINISHED) for unit in sorted(wanted - there))


def _other_keys(by_stage: dict[str, list[CommitRecord]], flight: FlightRecord) -> Iterator[Damage]:
    for stage, records in by_stage.items():
        key = flight.keys.get(stage)
        for record in records:
            if key is not None and record.key != key:
                yield Damage(stage, record.unit, None, "made without units that were lost, or of other inputs")


def forget(layout: RunLayout, damages: Iterable[Damage]) -> list[str]:
    """Take back the records of damaged units, so that the next run does them again; returns ``stage unit`` names.

    A store whose description is damaged is of no use to anybody: all of its units are taken back.
    """
    units = {(damage.stage, damage.unit) for damage in damages}
    for stage in {damage.stage for damage in damages if (damage.path or "").endswith("zarr.json")}:
        units |= {(stage, record.unit) for record in read_commits(layout, stage)}
        remove_tree(layout.root / _STORES[stage])
    for stage, unit in units:
        commit_path(layout, stage, unit).unlink(missing_ok=True)
    return sorted(f"{stage} {unit}" for stage, unit in units)


def describe_damage(root: Path, damages: Sequence[Damage]) -> str:
    """All damage, for people."""
    if not damages:
        return f"{root}: whole"
    units = len({(damage.stage, damage.unit) for damage in damages})
    told = [damage.text() for damage in damages]
    if not has_damage(damages):
        return "\n".join([*told, f"{root}: what is there is whole; {units} units were never finished"])
    return "\n".join([*told, f"{root}: {len(damages)} faults in {units} units"])


def has_damage(damages: Sequence[Damage]) -> bool:
    """Whether anything is amiss beyond units that a run which stopped, or was refused, never came to."""
    return any(damage.what != NOT_FINISHED for damage in damages)
