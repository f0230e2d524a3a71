"""Where numba keeps the machine code of our kernels, and when that code is out of date.

numba compares the file of a kernel alone with the one that was compiled: where ``b.outer`` calls ``a.inner`` and a.py
changes, it would run ``outer`` with the old ``inner``. Here the code of a file lies in a folder named by a digest of
that file and of all of ours that it imports, directly or not, so that a change of any of them compiles again.

``import velfield`` names `Locator` to numba, by an environment variable, so that workers and notebooks have it too.
"""

import os
import re
import shutil
import stat
import tempfile
import time
import warnings
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

from velfield.errors import CacheWarning, InputError

_SOURCES = Path(__file__).resolve().parents[1]
_IMPORT = re.compile(rb"^\s*from ((?:velfield|schemas)[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)
_UNUSED_S = 30 * 86400.0
"""A folder of code that nothing used for so long is removed when newer code of its file is compiled."""


class Locator:
    """Location of one function's cached code: numba's interface of cache locators."""

    def __init__(self, py_func: Any, source: Path) -> None:
        self._line = str(py_func.__code__.co_firstlineno)
        self._stamp = source_stamp(source)
        self._folder = _folder(source, self._stamp)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> "Locator | None":
        """The locator of a function of ours; None of any other, which numba's own locators then find."""
        source = Path(py_file).resolve()
        ours = source.is_file() and any(source.is_relative_to(_SOURCES / name) for name in ("velfield", "schemas"))
        return cls(py_func, source) if ours else None

    def ensure_cache_path(self) -> None:
        """Make the folder, which numba may find removed."""
        self._folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        """The folder."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Stamp of the source, which changes when the cached code is out of date."""
        return self._stamp

    def get_disambiguator(self) -> str:
        """Line number, which distinguishes functions of one name in a file."""
        return self._line


@cache
def _folder(source: Path, stamp: str) -> Path:
    """The folder of a file's code: made, and filled with what was compiled when velfield was installed."""
    name = ".".join(source.relative_to(_SOURCES).with_suffix("").parts)
    folder, installed = cache_root() / f"{name}-{stamp}", _beside_sources() / f"{name}-{stamp}"
    if folder.is_dir():
        os.utime(folder)
        return folder
    for old in folder.parent.glob(f"{name}-*"):
        if time.time() - old.stat().st_mtime > _UNUSED_S:
            shutil.rmtree(old, ignore_errors=True)
    if installed.is_dir():  # and cannot be written: numba would fail where it has one more signature to keep
        copied = Path(tempfile.mkdtemp(prefix=".new-", dir=folder.parent))
        shutil.copytree(installed, copied, dirs_exist_ok=True)
        try:
            copied.rename(folder)
        except OSError:  # another process was first
            shutil.rmtree(copied, ignore_errors=True)
    folder.mkdir(exist_ok=True)
    return folder


def source_stamp(source: Path) -> str:
    """Digest of a file and of all of ours that it imports, and of what compiles it.

    A file that changed since this process started may be imported as it was: the digest is this process's own then.
    """
    from importlib.metadata import version  # here, as psutil below: `velfield --help` would wait for them

    digest = blake2b(version("llvmlite").encode(), digest_size=10)
    files, left = set[Path](), [source]
    while left:
        file = left.pop()
        if file not in files:
            files.add(file)
            left += _imported(file)
    for file in sorted(files):
        digest.update(f"\0{file.relative_to(_SOURCES).as_posix()}\0".encode() + _read(file))
        if file.stat().st_mtime > _started_s():
            digest.update(f"{os.getpid()} {_started_s()}".encode())
    return digest.hexdigest()


@cache
def _started_s() -> float:
    import psutil

    return float(psutil.Process().create_time())


@cache
def _read(file: Path) -> bytes:
    return file.read_bytes()


@cache
def _imported(file: Path) -> list[Path]:
    """Our files that a file imports."""
    found = []
    for module, names in _IMPORT.findall(_read(file)):
        path = _SOURCES / module.decode().replace(".", "/")
        inside = [path / f"{name.decode()}.py" for name in re.findall(rb"\w+", names)]
        found += [one for one in (path.with_suffix(".py"), path / "__init__.py", *inside) if one.is_file()]
    return found


@cache
def cache_root() -> Path:
    """The folder of all compiled code: the user's, beside the sources, in the user's cache, or a temporary one.

    Raises
    ------
    InputError
        None of them can be written.
    """
    given, users = os.environ.get("NUMBA_CACHE_DIR"), user_cache()
    chosen = [] if given is None else [Path(given) / "velfield"]
    of_user = [] if users is None else [users / "kernels"]
    for folder in (*chosen, _beside_sources(), *of_user):
        if is_writable(folder):
            return folder
    folder = temporary_cache() / "kernels"
    folder.mkdir(exist_ok=True)
    warnings.warn(
        f"found neither the installation nor the user's cache folder writable: compiled code is kept in {folder}; "
        "set NUMBA_CACHE_DIR to a folder that lasts",
        CacheWarning,
        stacklevel=2,
    )
    return folder


def _beside_sources() -> Path:
    return Path(__file__).resolve().parent / "__pycache__" / "kernels"


def user_cache() -> Path | None:
    """The user's folder of our caches, which need not be writable; None for a user without a home."""
    home = user_home()
    given = os.environ.get("XDG_CACHE_HOME") or (None if home is None else home / ".cache")
    return None if given is None else Path(given) / "velfield"


def user_home() -> Path | None:
    """The user's home folder; None where it is not known, or not there."""
    home = Path(os.path.expanduser("~"))  # of Path it raises where neither HOME nor a name of the user is known
    return home if home.is_dir() else None


def is_writable(folder: Path) -> bool:
    """Whether files can be written into a folder, which is made where it is not there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


@cache
def temporary_cache() -> Path:
    """A folder for temporary files of this user alone; the same one next time, where the system allows.

    Raises
    ------
    InputError
        No temporary folder can be written.
    """
    try:
        user = os.getuid()
        folder = Path(tempfile.gettempdir()) / f"velfield-{user}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == user:
            return folder
        return Path(tempfile.mkdtemp(prefix="velfield-"))  # the name is taken: what lies there is not ours to run
    except OSError as error:
        raise InputError(f"found no folder for temporary files ({error}); set TMPDIR to one that is writable") from None
