"""One run at a time on a run folder: the kernel's lock on a disk, a lease on S3.

The lease is an object that is never removed. Every change of it is one conditional write, "only if there is none" or
"only if its content still is what I read", so that of several processes that find it expired one gets it.
"""

import _thread
import errno
import fcntl
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import psutil

from velfield.errors import InputError, parse_json
from velfield.run.layout import RunLayout, is_remote

if TYPE_CHECKING:
    from velfield.run.s3 import S3ObjectPath

_LEASE_S = 60.0
"""How long a lock on S3 outlives a process that was killed on another machine."""
Lost = Callable[[str], object]
"""Called from another thread, with a line for people, when the lock is lost: has to stop all writing at once."""


def _interrupt(_message: str) -> None:
    _thread.interrupt_main()  # the line is that of the InputError with which the context ends


@contextmanager
def locked(layout: RunLayout, lost: Lost = _interrupt) -> Iterator[None]:
    """Hold the run folder's lock; the kernel frees it when the process ends, however it ends.

    A lock on S3 can be lost while it is held, where this process stands still, or has no network, for longer than the
    lease. ``lost`` is called then; the default interrupts the main thread, as Ctrl-C does.

    Raises
    ------
    InputError
        Another process holds it: with its pid, host and since when. There can be no such folder. A symbolic link leads
        out of it. Or, on S3, the lock was lost.
    """
    if is_remote(layout.lock):
        with _leased(layout.lock, str(layout.root), lost):
            yield
        return
    try:
        layout.root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        found = f"found that no folder can be made there ({error.strerror})"
        raise InputError(f"{layout.root}: {found}, expected one or a place for it; give another --out") from None
    _refuse_links(layout.root)
    while True:
        with layout.lock.open("a+") as file:
            if not try_lock(file):
                file.seek(0)
                raise InputError(_refusal(str(layout.root), file.read()))
            if not _is_at(layout.lock, file.fileno()):
                continue  # its holder has removed it meanwhile, and others lock the next one
            file.truncate(0)
            file.write(_record())
            file.flush()
            yield
            return


def try_lock(file: IO[str]) -> bool:
    """Lock an open file until it is closed or this process ends; whether it was free.

    Raises
    ------
    OSError
        The file system has no locks.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.EAGAIN, errno.EACCES):
            raise
        return False
    return True


def _is_at(path: Path, descriptor: int) -> bool:
    """Whether an open file still is the one at a path."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        path.parent.mkdir(parents=True, exist_ok=True)
        return False


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
    owner = {"pid": os.getpid(), "host": socket.gethostname(), "machine": machine_id(), "since": since, "lease": lease}
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
def _leased(path: "S3ObjectPath", name: str, lost: Lost) -> Iterator[None]:
    lease = _Lease(path, name)
    lease.acquire()
    ended, gone = threading.Event(), threading.Event()
    message = (
        f"{name}: found the lock taken over by another process, or no answer of the store for {_LEASE_S:.0f} s; "
        "this process stopped writing: check the folder with `velfield verify`, and the same command resumes"
    )

    def keep() -> None:
        kept_s = time.time()  # the clock that others compare the lease with; it runs on while this machine sleeps
        while not ended.wait(_LEASE_S / 3):
            try:
                kept = lease.renew()
            except Exception:  # a refused connection is no OSError to botocore; the next attempt comes in time
                kept = time.time() - kept_s < _LEASE_S
            else:
                kept_s = time.time() if kept else kept_s
            if not kept:
                gone.set()
                lost(message)
                return

    thread = threading.Thread(target=keep, name="lease", daemon=True)
    thread.start()
    kept = False
    try:
        try:
            yield
        finally:
            ended.set()
            thread.join()
            if not gone.is_set():
                with suppress(Exception):  # it expires by itself
                    kept = lease.release()
    except KeyboardInterrupt:
        if not gone.is_set():
            raise
    if gone.is_set() or not kept:
        raise InputError(message)


def holder_is_gone(layout: RunLayout) -> bool:
    """Whether the process that last held the lock has ended, perhaps killed: one of this machine; on S3 any whose lease
    has expired."""
    try:
        text = layout.lock.read_text(encoding="utf-8")
        return _is_expired(text) if is_remote(layout.lock) else _has_ended(parse_json(text))
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _is_expired(text: str) -> bool:
    """Whether the writer of the record is gone: it was not renewed in time, or its process on this machine ended."""
    try:
        record = parse_json(text)
        return _has_ended(record) or time.time() > float(record["until_s"])
    except (ValueError, KeyError, TypeError):
        return True


def _has_ended(record: dict[str, Any]) -> bool:
    """Whether the writer of a record is a process of this machine that does not run any more."""
    return machine_id() != "" and record.get("machine") == machine_id() and not psutil.pid_exists(int(record["pid"]))


@cache
def machine_id() -> str:
    """Name the process number space, different for containers of one host name too; empty: not known."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _refusal(name: str, text: str) -> str:
    try:
        record = parse_json(text)
        holder = f"pid {record['pid']} on {record['host']} since {record['since']}"
    except (ValueError, KeyError):
        holder = "another process"
    return f"{name} is locked by {holder}; wait for it, or stop it"
