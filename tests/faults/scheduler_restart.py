"""A cluster's scheduler killed in mid-run and started again, workers later: the run waits, and ends with the same bits.

python -m tests.faults.scheduler_restart [--after detector] [--workers-after 90]
"""

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from tests.small_flight import digests

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
_LIMIT_S = 1800


def _start(*command: str | Path) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True, cwd=ROOT
    )


def _kill(processes: Sequence["subprocess.Popen[bytes]"]) -> None:
    for process in processes:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def main() -> int:
    """One run without a cluster, one whose scheduler is killed; whether they are equal."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--after", default="detector", help="kill it at the first commit of this stage")
    parser.add_argument("--workers-after", type=float, default=90.0, help="start workers so many seconds later")
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="velfield-scheduler-"))
    flight, whole, root = folder / "flight", folder / "whole", folder / "run"
    subprocess.run([BIN / "velfield", "simulate", flight, "--frames", "24", "--size", "640x480", "--quiet"], check=True)
    beside = [f"--{name}={flight / file}" for name, file in _INPUTS.items()]
    run = [BIN / "velfield", "run", flight / "frames", *beside, "--gsd-m", "0.23", "--preset", "fast"]
    subprocess.run([*run, "--out", whole, "--quiet"], check=True, stdout=subprocess.DEVNULL)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    address = f"tcp://127.0.0.1:{port}"
    scheduler = (BIN / "dask", "scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
    worker = (BIN / "dask", "worker", address, "--nworkers", "2", "--nthreads", "1", "--no-dashboard")
    started = [_start(*scheduler), _start(*worker)]
    try:
        time.sleep(10)
        with subprocess.Popen([*run, "--out", root, "--scheduler", address], stdout=subprocess.DEVNULL) as process:
            while process.poll() is None and not list(root.glob(f"commits/{given.after}/*.json")):
                time.sleep(0.05)
            assert process.poll() is None, "the run ended before the scheduler was killed"
            _kill(started)
            started.append(_start(*scheduler))
            time.sleep(given.workers_after)
            started.append(_start(*worker))
            status = process.wait(_LIMIT_S)
    finally:
        _kill(started)
    found, expected = digests(root), digests(whole)
    differ = [name for name in found.keys() | expected.keys() if found.get(name) != expected.get(name)]
    print(
        f"exit status {status}; {len(differ)} of {len(expected)} files differ {' '.join(sorted(differ)[:5])}; {folder}"
    )
    return int(status != 0 or bool(differ))


_INPUTS = {"timestamps": "timestamps.csv", "base": "base.png", "labels": "labels.csv"}

if __name__ == "__main__":
    sys.exit(main())
