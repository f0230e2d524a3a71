"""The results of one flight on several base images: each a run folder, sharing the outputs that do not change.

``RUN`` is the first; others are in ``RUN/results/NAME`` and listed in ``RUN/results.json``. An unfinished one is in a
staging folder, whose name begins with a full stop, and is renamed in one step when it is complete.
"""

import datetime
import re
from collections.abc import Iterable
from pathlib import Path

from schemas.records import RebaseRecord, ResultRecord, ResultsRecord
from velfield.errors import InputError
from velfield.run.commits import (
    digest_path,
    read_commits,
    read_sealed,
    sealed_json,
    valid_commit,
    write_atomically,
    write_commit,
)
from velfield.run.flight_record import read_flight_record
from velfield.run.layout import RunLayout, remove_tree, rename_tree
from velfield.run.run import Run
from velfield.run.tables import link_files

FIRST = "first"
_LAST = "flight.json"
"""The file that marks a result as complete: where a folder is renamed file by file, it is the last one."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


def result_name(given: str | None, base: Path) -> str:
    """Name of a new result: the given one, else the base image's.

    Raises
    ------
    InputError
        It is no plain name; results stay inside the run folder.

    Examples
    --------
    >>> result_name(None, Path("maps/spring 2026.tif"))
    'spring-2026'
    """
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", base.stem).strip(".-") if given is None else given
    if not _NAME.fullmatch(name) or name == FIRST:
        raise InputError(f"--out {name!r}: expected a name of letters, digits, '.', '_' and '-', other than {FIRST!r}")
    return name


def staging_layout(layout: RunLayout, name: str) -> RunLayout:
    """Staging folder of an unfinished result."""
    return RunLayout(layout.results / f".{name}.unfinished")


def final_root(root: Path) -> Path:
    """Folder of a result once it is complete: another one only for a staging folder.

    Examples
    --------
    >>> final_root(Path("RUN/results/.spring.unfinished")).as_posix()
    'RUN/results/spring'
    """
    name = root.name
    return root.with_name(name[1:-11]) if name.startswith(".") and name.endswith(".unfinished") else root


def read_results(layout: RunLayout) -> tuple[ResultRecord, ...]:
    """All results, the first one first; empty where there is only one."""
    path = layout.results_index
    if not path.exists():
        return ()
    try:
        return ResultsRecord.model_validate(read_sealed(path.read_bytes())).results
    except ValueError:
        raise InputError(
            f"{path} is damaged, expected the list of results; remove it, and `velfield reprocess` writes it again"
        ) from None


def result_exists(layout: RunLayout, name: str, base: Path) -> bool:
    """Whether this result exists already.

    Raises
    ------
    InputError
        There is a result of that name, of another base image.
    """
    if not (layout.results / name / _LAST).exists():
        return False
    record = read_flight_record(layout.results / name)
    if record.inputs.base != digest_path(base):
        raise InputError(f"{layout.results / name} is the result of another base image; name this one with --out")
    return True


def link_shared_outputs(
    old: RunLayout, new: RunLayout, stages: Iterable[str], *, without: tuple[str, ...] = ()
) -> None:
    """Link the outputs of stages from an old result into a new one, then their commit records.

    Outputs whose path begins with one of ``without`` are not shared, and not in the new records.
    """
    for stage in stages:
        for record in read_commits(old, stage):
            if valid_commit(new, stage, record.unit, record.key):
                continue
            outputs = {name: digest for name, digest in record.outputs.items() if not name.startswith(without)}
            link_files([(old.root / name, new.root / name) for name in outputs])
            kept = record.model_copy(update={"outputs": outputs})
            write_commit(new, kept)


def publish_result(run: Run, name: str, base: Path) -> Path:
    """Rename a complete result to its name, and list both in ``results.json``."""
    layout = run.layout
    target = layout.results / name
    staged = staging_layout(layout, name).root
    if (target / _LAST).exists():
        remove_tree(staged)  # left by a process killed while renaming
    else:
        rename_tree(staged, target, last=_LAST)
    others = [result for result in read_results(layout) if result.name != name] or [_first(run)]
    records = ResultsRecord(results=(*others, _result(name, target, base)))
    write_atomically(layout.results_index, sealed_json(records))
    return target


def _first(run: Run) -> ResultRecord:
    given = run.record.given
    return ResultRecord(
        name=FIRST,
        path=".",
        base=given.base if given else None,
        base_digest=run.record.inputs.base,
        how="run",
        created=_modification_time(run.layout.flight),
    )


def _result(name: str, root: Path, base: Path) -> ResultRecord:
    path = RunLayout(root).rebased
    mapped = RebaseRecord.model_validate_json(path.read_bytes()) if path.exists() else None
    return ResultRecord(
        name=name,
        path=f"results/{name}",
        base=str(base),
        base_digest=digest_path(base),
        how="mapped" if mapped else "registered again",
        added_error_px=mapped.added_error_px if mapped else None,
        created=_modification_time(RunLayout(root).flight),
    )


def _modification_time(path: Path) -> str:
    return datetime.datetime.fromtimestamp(path.stat().st_mtime).astimezone().isoformat(timespec="seconds")
