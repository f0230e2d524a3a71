"""One run at a time on a run folder."""

import fcntl
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from velfield.errors import InputError
from velfield.run.layout import RunLayout
from velfield.run.paths import RemotePath

_LEASE_S = 60.0
"""How long a lock on S3 outlives a process that was killed on another machine."""


@contextmanager
def locked(layout: RunLayout) -> Iterator[None]:
    """Hold the run folder's lock; the kernel frees it when the process ends, however it ends.

    Raises
    ------
    InputError
        Another process holds it: says which, where and since when.
    """
    if isinstance(layout.lock, RemotePath):
        with _leased(layout.lock, str(layout.root)):
            yield
        return
    layout.root.mkdir(parents=True, exist_ok=True)
    with layout.lock.open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            raise InputError(f"{layout.root} is locked {_holder(file.read())}; wait for it, or stop it") from None
        file.truncate(0)
        file.write(_own_record())
        file.flush()
        yield


def _own_record() -> str:
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    until_s = time.time() + _LEASE_S
    return json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "since": since, "until_s": until_s})


@contextmanager
def _leased(lock: RemotePath, name: str) -> Iterator[None]:
    """No kernel watches over an object: written where none is, renewed while we live, taken over when it is not."""
    if not lock.write_new(_own_record().encode()):
        record = lock.read_text()
        if not _is_over(record):
            raise InputError(f"{name} is locked {_holder(record)}; wait for it, or stop it")
        lock.write_bytes(_own_record().encode())
    ended = threading.Event()

    def renew() -> None:
        while not ended.wait(_LEASE_S / 3):
            lock.write_bytes(_own_record().encode())

    thread = threading.Thread(target=renew, name="lease", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        lock.unlink(missing_ok=True)


def _is_over(text: str) -> bool:
    """Whether whoever wrote it is gone: it was not renewed in time, or its process on this machine ended."""
    try:
        record = json.loads(text)
        gone = record["host"] == socket.gethostname() and not _lives(int(record["pid"]))
        return gone or time.time() > float(record["until_s"])
    except (ValueError, KeyError):
        return True


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _holder(text: str) -> str:
    try:
        record = json.loads(text)
        return f"by pid {record['pid']} on {record['host']} since {record['since']}"
    except (ValueError, KeyError):
        return "by another process"
