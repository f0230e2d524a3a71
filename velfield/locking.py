"""One run at a time on a run folder."""

import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

from velfield.errors import InputError
from velfield.layout import RunLayout


@contextmanager
def locked(layout: RunLayout) -> Iterator[None]:
    """Hold the run folder's lock; the kernel frees it when the process ends, however it ends.

    Raises
    ------
    InputError
        Another process holds it: says which, where and since when.
    """
    layout.root.mkdir(parents=True, exist_ok=True)
    with layout.lock.open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            raise InputError(f"{layout.root} is locked {_holder(file.read())}; wait for it, or stop it") from None
        file.truncate(0)
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        file.write(json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "since": since}))
        file.flush()
        yield


def _holder(text: str) -> str:
    try:
        record = json.loads(text)
        return f"by pid {record['pid']} on {record['host']} since {record['since']}"
    except (ValueError, KeyError):
        return "by another process"
