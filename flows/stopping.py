"""SIGTERM and Ctrl-C: either ends a run within seconds, whatever is under way. What was committed stays."""

import contextlib
import logging
import os
import signal
import socket
import sys
import threading
from types import FrameType

STOPPED = 130
_ENDING = (signal.SIGTERM, signal.SIGINT)
_GRACE_S = 5.0
"""For Prefect to be told that the run ended; the frames under way, half a minute of work perhaps, are given up."""
_END_S = 3.0


def stop_when_told() -> None:
    """From now on SIGTERM is as Ctrl-C, and neither waits for the work under way. Call in the main thread."""
    as_ctrl_c()
    # Prefect puts a handler of its own in the place of ours, then waits for the threads: this hears of it all the same.
    told, tell = socket.socketpair()
    tell.setblocking(False)
    signal.set_wakeup_fd(tell.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_end_late, args=(told, tell), name="end", daemon=True).start()


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
    print(f"{shown}\nvelfield: stopped; the same command resumes", file=sys.stderr, flush=True)
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
