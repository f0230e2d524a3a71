"""SIGTERM and Ctrl-C: either ends a run within seconds, whatever is under way. What was committed stays."""

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
"""For Prefect to be told that the run ended; the frames under way, half a minute of work perhaps, are given up."""
_END_S = 3.0
_resumes = threading.Event()
_MARK = "VELFIELD_STARTED_BY"
"""Environment: by which process, of which moment, all of its children were started."""
_WATCH = """if True:
    import sys
    mark = sys.argv[1]
    sys.stdin.read()  # until the process that watches over its children is gone
    import psutil
    for process in psutil.process_iter():
        try:
            if process.environ().get("VELFIELD_STARTED_BY") == mark and process.pid != psutil.Process().pid:
                process.terminate()
        except psutil.Error:
            pass
"""


def stop_on_signals() -> None:
    """From now on SIGTERM is as Ctrl-C, and neither waits for the work under way, which the same command resumes.

    Call in the main thread.
    """
    _resumes.set()
    as_ctrl_c()
    # Prefect puts a handler of its own in the place of ours, then waits for the threads: this hears of it all the same.
    told, tell = socket.socketpair()
    tell.setblocking(False)
    signal.set_wakeup_fd(tell.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_end_late, args=(told, tell), name="end", daemon=True).start()
    end_children_when_killed()


def end_children_when_killed() -> None:
    """From now on what this process starts ends with it even where it is killed: Prefect's server would stay for ever.

    Nobody can mind SIGKILL, so another process waits for the end of this one, and finds those it left by a mark in
    their environment.
    """
    os.environ[_MARK] = mark = f"{os.getpid()}-{time.time_ns()}"
    watcher = subprocess.Popen(
        [sys.executable, "-c", _WATCH, mark],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # a terminal's Ctrl-C is for us, and not its end
    )
    atexit.register(_release, watcher)


def _release(watcher: "subprocess.Popen[bytes]") -> None:
    assert watcher.stdin is not None
    watcher.stdin.close()
    watcher.wait()


def as_ctrl_c() -> None:
    """SIGTERM is as Ctrl-C, and Ctrl-C is heard even where a shell started us in the background, with it ignored."""
    for number in _ENDING:
        signal.signal(number, _stop)


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _end_late(told: socket.socket, _tell: socket.socket) -> None:
    while told.recv(1)[0] not in _ENDING:
        pass
    logging.disable(logging.CRITICAL)  # what fails now fails because we end: it would only alarm
    threading.Event().wait(_GRACE_S)
    leave(STOPPED)


def leave(status: int) -> None:
    """Say so and end at once, with all that this process has started."""
    shown = "\x1b[?25h" if sys.stderr.isatty() else ""  # the cursor, which a progress bar hides
    told = "stopped; the same command resumes" if _resumes.is_set() else "stopped"
    print(f"{shown}\nvelfield: {told}", file=sys.stderr, flush=True)
    end_children(_END_S)
    os._exit(status)


def end_children(patience_s: float) -> None:
    """End what this process started and is still there; kill what does not end in time."""
    import psutil

    children = psutil.Process().children(recursive=True)
    for child in children:
        with contextlib.suppress(psutil.NoSuchProcess):
            child.terminate()
    _, alive = psutil.wait_procs(children, timeout=patience_s)
    for child in alive:
        with contextlib.suppress(psutil.NoSuchProcess):
            child.kill()
