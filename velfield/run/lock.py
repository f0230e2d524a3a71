"""One run at a time on a run folder: the kernel's lock on a disk, a lease on S3.

The lease is an object that is never removed. Every change of it is one conditional write, "only if there is none" or
"only if its content still is what I read", so that of several processes that find it expired one gets it.
"""

import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

from velfield.errors import InputError, parse_json
from velfield.run.file_lock import try_lock
from velfield.run.layout import RunLayout, is_remote

if TYPE_CHECKING:
    from velfield.run.s3 import S3ObjectPath

_LEASE_S = 60.0
"""How long a lock on S3 outlives a process that was killed on another machine."""


@contextmanager
def locked(layout: RunLayout) -> Iterator[None]:
    """Hold the run folder's lock; the kernel frees it when the process ends, however it ends.

    Raises
    ------
    InputError
        Another process holds it: with its pid, host and since when. A symbolic link leads out of the folder. Or, on
        S3, this process stood still for longer than the lease, and another took the lock over meanwhile.
    """
    if is_remote(layout.lock):
        with _leased(layout.lock, str(layout.root)):
            yield
        return
    layout.root.mkdir(parents=True, exist_ok=True)
    _refuse_links(layout.root)
    with layout.lock.open("a+") as file:
        if not try_lock(file):
            file.seek(0)
            raise InputError(_refusal(str(layout.root), file.read()))
        file.truncate(0)
        file.write(_record())
        file.flush()
        yield


def _refuse_links(root: Path) -> None:
    """Refuse a run folder in which a symbolic link leads out of it: what is written stays inside.

    The folder itself may be reached by a link.
    """
    inside = root.resolve()
    folders = [str(root)]
    while folders:
        with os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_symlink():
                    target = Path(entry.path).resolve()
                    if not target.is_relative_to(inside):
                        raise InputError(
                            f"{entry.path}: found a symbolic link to {target}, expected that all of a run folder lies "
                            "in it; remove the link, and move or link the run folder as a whole"
                        )
                elif entry.is_dir():
                    folders.append(entry.path)


def _record(lease_s: float = 0.0, lease: str = "") -> str:
    """JSON of this process; no two are equal, for S3 compares contents."""
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    owner = {"pid": os.getpid(), "host": socket.gethostname(), "since": since, "lease": lease}
    return json.dumps(owner | {"until_s": time.time() + lease_s, "write": uuid.uuid4().hex})


class _Lease:
    """The lock object of a run folder on S3, held by this process from `acquire` to `release`."""

    def __init__(self, path: "S3ObjectPath", name: str) -> None:
        self._path = path
        self._name = name
        self._id = uuid.uuid4().hex
        self._version: str | None = None

    def acquire(self) -> None:
        while self._version is None:
            self._version = self._path.create(self._data()) or self._take_over()

    def renew(self, lease_s: float = _LEASE_S) -> bool:
        """Extend the lease; whether it was still ours."""
        if self._version is not None:
            self._version = self._path.replace_version(self._version, self._data(lease_s)) or self._own_version()
        return self._version is not None

    def release(self) -> bool:
        """Let it expire; whether it was still ours."""
        return self.renew(lease_s=0.0)

    def _data(self, lease_s: float = _LEASE_S) -> bytes:
        return _record(lease_s, self._id).encode()

    def _read(self) -> tuple[str, str]:
        """Version and content, the version first: should another write come between, the version is the older one."""
        return self._path.version(), self._path.read_bytes().decode()

    def _take_over(self) -> str | None:
        """Version of the lock once it is ours; None where another process changed it meanwhile."""
        try:
            version, text = self._read()
        except FileNotFoundError:  # removed by hand
            return None
        if self._id in text:  # a write whose answer was lost
            return version
        if not _is_expired(text):
            raise InputError(_refusal(self._name, text))
        return self._path.replace_version(version, self._data())

    def _own_version(self) -> str | None:
        """Version of the lock where it is ours though a write was refused: it was a repetition, its answer lost."""
        try:
            version, text = self._read()
        except FileNotFoundError:
            return None
        return version if self._id in text else None


@contextmanager
def _leased(path: "S3ObjectPath", name: str) -> Iterator[None]:
    lease = _Lease(path, name)
    lease.acquire()
    ended = threading.Event()

    def keep() -> None:
        while not ended.wait(_LEASE_S / 3):
            with suppress(OSError):  # the next attempt comes before the lease expires
                lease.renew()

    thread = threading.Thread(target=keep, name="lease", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        kept = lease.release()
    if not kept:
        raise InputError(
            f"{name}: found the lock taken over by another process, expected it renewed every {_LEASE_S / 3:.0f} s; "
            "this process stood still: check the folder with `velfield verify`"
        )


def holder_is_gone(layout: RunLayout) -> bool:
    """Whether the process that last held the lock has ended, perhaps killed: one of this machine; on S3 any whose lease
    has expired."""
    try:
        text = layout.lock.read_text(encoding="utf-8")
        if is_remote(layout.lock):
            return _is_expired(text)
        record = parse_json(text)
        return bool(record["host"] == socket.gethostname()) and not _is_running(int(record["pid"]))
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _is_expired(text: str) -> bool:
    """Whether the writer of the record is gone: it was not renewed in time, or its process on this machine ended."""
    try:
        record = parse_json(text)
        gone = record["host"] == socket.gethostname() and not _is_running(int(record["pid"]))
        return gone or time.time() > float(record["until_s"])
    except (ValueError, KeyError):
        return True


def _is_running(pid: int) -> bool:
    return bool(psutil.pid_exists(pid))  # on Windows os.kill(pid, 0) is Ctrl-C


def _refusal(name: str, text: str) -> str:
    try:
        record = parse_json(text)
        holder = f"pid {record['pid']} on {record['host']} since {record['since']}"
    except (ValueError, KeyError):
        holder = "another process"
    return f"{name} is locked by {holder}; wait for it, or stop it"
