"""SIGTERM and Ctrl-C: either ends a run within seconds. Committed units stay."""

import atexit
import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from types import FrameType

STOPPED = 130
_ENDING = (signal.SIGTERM, signal.SIGINT)
_GRACE_S = 5.0
"""Time for Prefect to record the end of the run; units under way, half a minute of work perhaps, are abandoned."""
_END_S = 3.0
_resumes = threading.Event()
_leaves = threading.Lock()
_MARK = "VELFIELD_STARTED_BY"
"""Environment variable that marks the children of this process: its id and start time."""
_WATCH = """if True:
    import sys
    mark = sys.argv[1]
    sys.stdin.read()  # until the parent is gone: killed, for one that ends by itself ends this one too
    import psutil
    for process in psutil.process_iter():
        try:
            if process.environ().get("VELFIELD_STARTED_BY") == mark and process.pid != psutil.Process().pid:
                process.terminate()
        except psutil.Error:
            pass
"""


def stop_on_signals(*, resumes: bool = True, grace_s: float = _GRACE_S) -> None:
    """Treat SIGTERM as Ctrl-C; neither waits for the work under way, which the same command resumes.

    Call in the main thread.

    Parameters
    ----------
    resumes
        Whether the same command resumes the work: the last line then states it.
    grace_s
        Time to end by itself.
    """
    if resumes:
        _resumes.set()
    as_ctrl_c()
    # Prefect replaces our handler by its own, then waits for the threads: the wake-up descriptor is notified anyway.
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_end_late, args=(receiver, sender, grace_s), name="end", daemon=True).start()
    end_children_when_killed()


def end_children_when_killed() -> None:
    """End child processes with this one even where it is killed: workers and the server of `velfield serve` would stay.

    SIGKILL cannot be handled, so another process waits for the end of this one, and identifies its children by a mark
    in their environment.
    """
    os.environ[_MARK] = mark = f"{os.getpid()}-{time.time_ns()}"
    watcher = subprocess.Popen(
        [sys.executable, "-c", _WATCH, mark],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # a terminal's Ctrl-C must not end it
    )
    atexit.register(_release, watcher)


def _release(watcher: "subprocess.Popen[bytes]") -> None:
    end_children(_END_S)  # whatever is left of them, and the watcher
    watcher.communicate()


def as_ctrl_c() -> None:
    """Treat SIGTERM as Ctrl-C, and handle Ctrl-C even where a shell started this process with it ignored."""
    for number in _ENDING:
        signal.signal(number, _stop)


class Stopped(KeyboardInterrupt):
    """A class of its own: after a plain one within `exec`, as dataclasses use, Python ends by SIGINT though caught."""


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise Stopped


def _end_late(receiver: socket.socket, _sender: socket.socket, grace_s: float) -> None:
    while receiver.recv(1)[0] not in _ENDING:
        pass
    logging.disable(logging.CRITICAL)  # errors from now on are consequences of the end
    threading.Event().wait(grace_s)
    leave(STOPPED)


def leave(status: int) -> None:
    """Print that it stopped and end at once, with all child processes; the first thread that comes does it."""
    _leaves.acquire()  # and keeps it
    cursor = "\x1b[?25h" if sys.stderr.isatty() else ""  # shown again: a progress bar hides it
    message = "stopped; the same command resumes" if _resumes.is_set() else "stopped"
    print(f"{cursor}\nvelfield: {message}", file=sys.stderr, flush=True)
    end_children(_END_S)
    os._exit(status)


def stop_lost(message: str) -> None:
    """End at once, with all child processes, as the lock of the run folder is lost: nothing more may be written."""
    _leaves.acquire()
    print(f"velfield: {message}", file=sys.stderr, flush=True)
    end_children(_END_S)
    os._exit(1)


def end_children(patience_s: float) -> None:
    """Terminate the children of this process; kill those that do not end in time."""
    import psutil

    children = psutil.Process().children(recursive=True)
    for child in children:
        with contextlib.suppress(psutil.NoSuchProcess):
            child.terminate()
    _, alive = psutil.wait_procs(children, timeout=patience_s)
    for child in alive:
        with contextlib.suppress(psutil.NoSuchProcess):
            child.kill()
