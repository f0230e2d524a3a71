"""Paths of a run folder, on a disk or on S3: the operations that differ between the two.

By hand, as neither pathlib, fsspec nor universal-pathlib has them: renaming a tree of objects with a chosen one last,
copying many objects in one call, and files for libraries that open by name. The S3 paths are `velfield.run.s3`.
"""

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, TypeGuard, cast

from velfield.errors import InputError

if TYPE_CHECKING:
    from velfield.run.s3 import S3ObjectPath


def to_path(path: str | Path) -> Path:
    """The path to work with: of ``s3://``, a `velfield.run.s3.S3ObjectPath`, typed as the `Path` whose methods it has.

    Raises
    ------
    InputError
        It is on S3, and the extra is not installed.
    """
    text = str(path)
    if not text.startswith("s3:/"):
        return Path(path)
    if find_spec("s3fs") is None or find_spec("upath") is None:
        raise InputError(f"{text}: a run folder on s3:// needs the extra; pip install 'velfield[s3]'")
    from velfield.run.s3 import s3_path  # the extra

    return cast(Path, s3_path(text))


def is_remote(path: object) -> "TypeGuard[S3ObjectPath]":
    """Whether a path is not on this machine."""
    return not isinstance(path, Path)


def remove_tree(path: Path) -> None:
    """Remove a folder and all in it, if it exists."""
    if not is_remote(path):
        shutil.rmtree(path, ignore_errors=True)
    elif path.exists():
        path.fs.rm(path.path, recursive=True)


def copy_objects(pairs: Sequence[tuple[Path, Path]]) -> None:
    """Copy objects within the store, many at once: no byte of them comes to this machine."""
    remote = [(source, target) for source, target in pairs if is_remote(source) and is_remote(target)]
    if remote:
        sources, targets = zip(*((source.path, target.path) for source, target in remote), strict=True)
        remote[0][0].fs.copy(list(sources), list(targets))


def rename_tree(source: Path, target: Path, *, last: str) -> None:
    """Rename a folder: on a disk in one step, on S3 object by object.

    There ``last``, a file of the folder, is copied after all others: a folder that has it is whole.
    """
    if not is_remote(source):
        source.rename(target)
        return
    names = [key.removeprefix(f"{source.path}/") for key in source.fs.find(source.path)]
    pairs = {name: (cast(Path, source / name), target / name) for name in names}
    final = pairs.pop(last)
    copy_objects(list(pairs.values()))
    copy_objects([final])
    remove_tree(cast(Path, source))


@contextmanager
def local_copy(path: Path) -> Iterator[Path]:
    """A file that libraries can open by name: the path itself, or a copy of the object while the context lasts."""
    if not is_remote(path):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        local = Path(folder) / path.name
        local.write_bytes(path.read_bytes())
        yield local


@contextmanager
def local_output(path: Path) -> Iterator[Path]:
    """A file that libraries can write by name; at the end of the context the object is written from it, whole."""
    if not is_remote(path):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        local = Path(folder) / path.name
        yield local
        path.write_bytes(local.read_bytes())
