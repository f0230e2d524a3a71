"""Run folders that are not on a disk: ``s3://bucket/run``, with the few operations of a path that a run folder needs.

An object is written whole or not at all, so nothing partial is ever seen there. Where the store is and who asks for it
stands in the environment, as for every program that speaks S3: ``AWS_ENDPOINT_URL``, ``AWS_ACCESS_KEY_ID``, ...
"""

import io
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import IO, Any, NamedTuple, cast

from velfield.errors import InputError

SCHEME = "s3:/"
"""How such a path begins once it is a path: two slashes in a row mean the same as one."""
S3_OPTIONS: dict[str, Any] = {
    "use_listings_cache": False,  # other processes write what this one looks for
    "max_concurrency": 1,  # more would ask for an object's size before each reading; ours are small
}


class Stat(NamedTuple):
    """What is known of an object."""

    st_size: int
    st_mtime: float


class RemotePath(PurePosixPath):
    """An object, or a prefix of objects. Not a `Path`, yet with the same names: stores and tables need not know.

    Examples
    --------
    >>> path = RemotePath("s3://bucket/run") / "commits" / "lens"
    >>> path.url, path.name
    ('s3://bucket/run/commits/lens', 'lens')
    """

    @property
    def url(self) -> str:
        """The address, for zarr and for people."""
        return "s3://" + "/".join(self.parts[1:])

    @property
    def _key(self) -> str:
        return "/".join(self.parts[1:])

    def exists(self) -> bool:
        """Whether it is there, an object or a prefix of some."""
        return bool(_files().exists(self._key))

    def is_file(self) -> bool:
        """Whether it is an object."""
        return bool(_files().isfile(self._key))

    def is_dir(self) -> bool:
        """Whether it is a prefix of objects."""
        return bool(_files().isdir(self._key))

    def mkdir(self, **_options: bool) -> None:
        """Nothing to do: prefixes are there when objects are."""

    def read_bytes(self) -> bytes:
        """All of it."""
        return bytes(_files().cat_file(self._key))

    def read_text(self) -> str:
        """All of it, UTF-8."""
        return self.read_bytes().decode()

    def write_bytes(self, data: bytes) -> None:
        """All of it at once."""
        _files().pipe_file(self._key, data)

    def write_new(self, data: bytes) -> bool:
        """All of it at once, and only if nothing is there: whether that was so."""
        try:
            _files().pipe_file(self._key, data, mode="create")
        except FileExistsError:
            return False
        return True

    def open(self, mode: str = "rb") -> IO[bytes]:
        """Its bytes, to be read."""
        assert mode == "rb", "objects are written whole"
        return io.BytesIO(self.read_bytes())

    def unlink(self, missing_ok: bool = False) -> None:
        """Remove the object."""
        try:
            _files().rm_file(self._key)
        except FileNotFoundError:
            if not missing_ok:
                raise

    def stat(self) -> Stat:
        """Size and time of the last change."""
        info = _files().info(self._key)
        return Stat(int(info["size"]), info["LastModified"].timestamp() if "LastModified" in info else 0.0)

    def glob(self, pattern: str) -> Iterator["RemotePath"]:
        """Objects below that match."""
        return (RemotePath("s3:/", found) for found in _files().glob(f"{self._key}/{pattern}"))

    def rglob(self, pattern: str) -> Iterator["RemotePath"]:
        """Objects anywhere below that match."""
        return self.glob(f"**/{pattern}")

    def remove_below(self) -> None:
        """Remove all objects with this prefix."""
        if self.exists():
            _files().rm(self._key, recursive=True)


@lru_cache(maxsize=1)
def _files() -> Any:
    try:
        import s3fs
    except ImportError:
        raise InputError("a run folder on s3:// needs the extra: pip install 'velfield[s3]'") from None
    return s3fs.S3FileSystem(**S3_OPTIONS)


def place(path: str | Path) -> Path:
    """The path as one that can be worked with, wherever it is; a `RemotePath` is typed as a `Path` for that reason."""
    text = str(path)
    return cast(Path, RemotePath(text)) if text.startswith(SCHEME) else Path(path)


def is_remote(path: object) -> bool:
    """Whether a path is not on this machine."""
    return isinstance(path, RemotePath)


def remove_tree(path: Path) -> None:
    """Remove a folder and all in it, if it is there."""
    if isinstance(path, RemotePath):
        path.remove_below()
    else:
        shutil.rmtree(path, ignore_errors=True)


def copy_objects(pairs: Sequence[tuple[Path, Path]]) -> None:
    """Objects under further names, many at once, within the store: no byte of them comes here."""
    if pairs:
        sources, targets = zip(*((source._key, target._key) for source, target in pairs), strict=True)  # type: ignore[attr-defined]
        _files().copy(list(sources), list(targets))


def rename_tree(source: Path, target: Path, *, last: str) -> None:
    """Give a folder another name: on a disk in one step, on S3 object by object.

    There ``last``, a file of the folder, is copied after all others: who sees it sees a whole folder.
    """
    if not isinstance(source, RemotePath):
        source.rename(target)
        return
    objects = [RemotePath(SCHEME, key) for key in _files().find(source._key)]
    pairs = [(cast(Path, path), target / os.fspath(path.relative_to(source))) for path in objects]
    final = (cast(Path, source / last), target / last)
    copy_objects([pair for pair in pairs if pair != final])
    copy_objects([final])
    source.remove_below()


@contextmanager
def local_copy(path: Path) -> Iterator[Path]:
    """A file that libraries can open by name: the path itself, or a copy of the object for the time of the context."""
    if not is_remote(path):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder) / path.name
        here.write_bytes(path.read_bytes())
        yield here


@contextmanager
def written_locally(path: Path) -> Iterator[Path]:
    """A file that libraries can write by name; an object is then written from it, whole."""
    if not is_remote(path):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder) / path.name
        yield here
        path.write_bytes(here.read_bytes())
