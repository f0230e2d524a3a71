"""Content keys and commit records: which units of work are finished.

A unit is finished when its record is under ``commits/`` with the key of the present inputs, parameters and code, and
the outputs it names exist. The record is written last, atomically; a run killed before that repeats the unit.
"""

import hashlib
import io
import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO

from pydantic import BaseModel, ValidationError

from schemas.records import FORMAT_VERSION, CommitRecord, SealedRecord
from velfield.errors import parse_json
from velfield.run.layout import RunLayout, is_remote, remove_tree

_WHOLE_FILE_BYTES = 256 * 2**20
_SAMPLE_BYTES = 2**20
_SAMPLES = 64
_SYNCED_AT_ONCE = 8
"""Files: 650 of a short clip's field take 0.13 s, one after another 1.3 s."""
_DIGEST = "digest"
"""Key of a record of which the digest of all others is the value."""
PAGE, ANALYSIS, WHOLE = "page", "analysis", "all"
"""Names of the commit records of the page and of the analysis, which are no stages, and of their one unit."""
POSITION_SD_M = "position_sd_m"
"""Count of the stage of given tracks: the standard deviation of a smoothed position along one axis, m."""


def code_version() -> str:
    """The installed version of velfield."""
    return version("velfield")


def digest_bytes(data: bytes) -> str:
    """BLAKE2b of ``data``, 128 bits, hexadecimal."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def digest_input(path: Path) -> str:
    """Digest of a file's content; of a file above 256 MiB, of its size and 64 blocks of 1 MiB spread over it.

    Hashing all of a flight of hours would take longer than decoding its first minutes.
    """
    return digest_file(path, whole_bytes=_WHOLE_FILE_BYTES)


def digest_file(path: Path, *, whole_bytes: int = sys.maxsize) -> str:
    """Digest of a file's content; of a file above ``whole_bytes``, of blocks of it."""
    if is_remote(path):
        data = path.read_bytes()  # one request; its size and its blocks would be more
        return _digest_stream(io.BytesIO(data), len(data), whole_bytes)
    size = path.stat().st_size
    with path.open("rb") as file:
        return _digest_stream(file, size, whole_bytes)


def _digest_stream(file: io.BufferedReader | io.BytesIO, size: int, whole_bytes: int) -> str:
    digest = hashlib.blake2b(str(size).encode(), digest_size=16)
    if size <= whole_bytes:
        hashlib.file_digest(file, lambda: digest)  # in one buffer: a new one a block costs an eighth more
    else:
        for k in range(_SAMPLES):
            file.seek((size - _SAMPLE_BYTES) * k // (_SAMPLES - 1))
            digest.update(file.read(_SAMPLE_BYTES))
    return digest.hexdigest()


def digest_path(path: Path) -> str:
    """Digest of an input, a file, or of a folder's files by name and content."""
    if path.is_dir():
        files = sorted(p for p in path.rglob("*") if p.is_file())
        with ThreadPoolExecutor() as pool:  # hashing releases the GIL
            digests = list(pool.map(digest_input, files))
        lines = [f"{p.relative_to(path)}\0{digest}\n" for p, digest in zip(files, digests, strict=True)]
        return digest_bytes("".join(lines).encode())
    return digest_input(path)


def content_key(
    stage: str, stage_version: int, *, parameters: Iterable[object] = (), inputs: Iterable[str | None] = ()
) -> str:
    """Key of a stage: equal exactly when its inputs, its parameters, its code's version and the format are.

    Examples
    --------
    >>> content_key("lens", 1, inputs=["a"]) == content_key("lens", 1, inputs=["a"])
    True
    >>> content_key("lens", 1, inputs=["a"]) == content_key("lens", 2, inputs=["a"])
    False
    """
    plain = [p.model_dump(mode="json") if isinstance(p, BaseModel) else p for p in parameters]
    text = json.dumps([FORMAT_VERSION, stage, stage_version, plain, list(inputs)], sort_keys=True, allow_nan=False)
    return digest_bytes(text.encode())


def write_atomically(path: Path, data: bytes, *, sync: bool = True) -> None:
    """Write ``data`` so that ``path`` is either unchanged or complete."""
    with open_atomically(path, sync=sync) as file:
        file.write(data)


def write_record(path: Path, record: BaseModel, *, indent: int | None = 1) -> None:
    """Write a record as JSON, atomically."""
    write_atomically(path, record.model_dump_json(indent=indent).encode())


@contextmanager
def open_atomically(path: Path, *, sync: bool = True) -> Iterator[BinaryIO]:
    """A file to write, which takes the place of ``path`` once it is complete.

    ``sync``: and on the disk; of one of many outputs `digest_outputs` sees to it.
    """
    if is_remote(path):
        buffer = io.BytesIO()
        yield buffer
        path.write_bytes(buffer.getvalue())
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    with partial.open("wb") as file:
        yield file
        if sync:
            file.flush()
            os.fsync(file.fileno())
    partial.replace(path)


def sealed_json(record: SealedRecord) -> bytes:
    """A record as JSON with a digest of its own content, by which `read_sealed` knows a damaged one."""
    content = json.loads(record.model_dump_json())
    content[_DIGEST] = _digest_content(content)
    return json.dumps(content, indent=1).encode()


def read_sealed(data: bytes) -> dict[str, Any]:
    """The content of a record as `sealed_json` wrote it; of one without a digest, which earlier versions wrote, as is.

    Raises
    ------
    ValueError
        It is not JSON, not an object, or not what was written.

    Examples
    --------
    >>> read_sealed(b'{"stage": "lens"}')
    {'stage': 'lens'}
    """
    content = parse_json(data)
    if not isinstance(content, dict):
        raise ValueError("not an object")
    found = content.pop(_DIGEST, None)
    if found is not None and found != _digest_content(content):
        raise ValueError("it is not what was written")
    return content


def _digest_content(content: dict[str, Any]) -> str:
    kept = {key: value for key, value in content.items() if key != _DIGEST}
    return digest_bytes(json.dumps(kept, sort_keys=True).encode())


def sweep_partial(root: Path) -> int:
    """Remove ``.partial`` files of a killed run; returns how many. On S3 there are none."""
    if is_remote(root):
        return 0
    found = list(root.rglob("*.partial"))
    for path in found:
        path.unlink(missing_ok=True)
    return len(found)


def commit_path(layout: RunLayout, stage: str, unit: str) -> Path:
    """Path of the record of one unit."""
    return layout.commits / stage / f"{unit}.json"


def write_commit(layout: RunLayout, record: CommitRecord) -> None:
    """Record that a unit is finished, after its outputs are written."""
    write_atomically(commit_path(layout, record.stage, record.unit), sealed_json(record))


def record_page(layout: RunLayout) -> None:
    """Record the files of the page and of its report, so that `velfield verify` knows them; written by every run."""
    view = [path for path in layout.view.glob("*") if path.suffix in (".json", ".jpg", ".txt")]
    if layout.view_changes.exists():
        view += [path for path in layout.view_changes.rglob("*") if path.is_file()]
    _record_files(layout, PAGE, [layout.report, *view])


def record_analysis(layout: RunLayout, *, slice_s: float) -> None:
    """Record the files of the analysis, and with which slices of time it was made, likewise; and the content key of the
    results that were analysed, which may be older than the settings."""
    files = [path for path in layout.analysis.rglob("*") if path.is_file()]
    analysed = *read_commits(layout, "tracks"), *read_commits(layout, "scale")
    keys = {record.stage: record.key for record in analysed}
    _record_files(layout, ANALYSIS, files, key=_analysed(keys), slice_s=slice_s)


def _analysed(keys: Mapping[str, str]) -> str:
    """The key of what an analysis reads: the tracks, and their scale, which a run of given tracks has no stage for."""
    return keys.get("scale") or keys.get("tracks", "")


def remove_analysis(layout: RunLayout, *, unless: Mapping[str, str] | None = None) -> list[str]:
    """Remove the analysis, unless it is of the results with these keys; a line that says so.

    The page and the report would show it beside what was computed since.
    """
    record = read_commit(layout, ANALYSIS, WHOLE)
    if record is None or (unless is not None and record.key == _analysed(unless)):
        return []
    remove_tree(layout.analysis)
    commit_path(layout, ANALYSIS, WHOLE).unlink()
    return [f"the analysis was of the results before and is removed; `velfield analyse {layout.root}` makes it again"]


def _record_files(layout: RunLayout, name: str, files: Iterable[Path], *, key: str = "", **counts: float) -> None:
    outputs = digest_outputs(layout, sorted(files))
    record = CommitRecord(stage=name, unit=WHOLE, key=key, outputs=outputs, counts=counts, code_version=code_version())
    write_commit(layout, record)


def read_commit(layout: RunLayout, stage: str, unit: str) -> CommitRecord | None:
    """The record of a unit; None where there is none or it is damaged."""
    path = commit_path(layout, stage, unit)
    try:
        return CommitRecord.model_validate_json(json.dumps(read_sealed(path.read_bytes())))
    except (FileNotFoundError, ValidationError, ValueError):
        return None


def read_commits(layout: RunLayout, stage: str) -> list[CommitRecord]:
    """The records of all finished units of a stage, by name."""
    folder = layout.commits / stage
    found = (read_commit(layout, stage, path.stem) for path in sorted(folder.glob("*.json")))
    return [record for record in found if record is not None]


def valid_commit(layout: RunLayout, stage: str, unit: str, key: str) -> CommitRecord | None:
    """The record of a unit where it has this key and its outputs exist; else None."""
    record = read_commit(layout, stage, unit)
    if record is None or record.key != key:
        return None
    outputs = list(record.outputs)
    if is_remote(layout.root):
        # Hundreds a unit, a request each: S3 loses no objects, and `velfield verify` checks all of them.
        outputs = outputs[-1:]
    return record if all((layout.root / output).exists() for output in outputs) else None


def digest_outputs(layout: RunLayout, paths: Iterable[Path]) -> dict[str, str]:
    """Digests of a unit's output files, by path in the run folder; they are on the disk then, even if the power is cut.

    A record that vouches for them is written afterwards.
    """
    files = list(paths)
    # Side by side: a journalling disk writes what waits at the same time in one go.
    with ThreadPoolExecutor(_SYNCED_AT_ONCE) as pool:
        digests = list(pool.map(_digest_synced, files))
        if not is_remote(layout.root):  # of a new file the folder's entry too
            list(pool.map(_sync_folder, {path.parent for path in files}))
    return {path.relative_to(layout.root).as_posix(): digest for path, digest in zip(files, digests, strict=True)}


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _digest_synced(path: Path) -> str:
    if not is_remote(path):
        with path.open("rb") as file:
            os.fsync(file.fileno())
    return digest_file(path)
