"""A command with all that it starts: time, and the memory of its driver and of its workers while it runs."""

import os
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import psutil

_EVERY_S = 0.5
_MB = 1e6


@dataclass
class Memory:
    """Resident memory of one kind of process, the largest of them, MB: its peak, and samples (s, MB)."""

    peak_mb: float = 0.0
    samples: list[tuple[float, float]] = field(default_factory=list)

    def add(self, at_s: float, resident_mb: float, peak_mb: float) -> None:
        """A sample of one process."""
        self.peak_mb = max(self.peak_mb, peak_mb, resident_mb)
        if self.samples and self.samples[-1][0] == at_s:
            resident_mb = max(resident_mb, self.samples.pop()[1])
        self.samples.append((at_s, resident_mb))

    def largest_in(self, first: float, last: float) -> float:
        """Largest sample between two fractions of the time; 0 where there is none."""
        end = self.samples[-1][0] if self.samples else 0.0
        return max((mb for at_s, mb in self.samples if first * end <= at_s <= last * end), default=0.0)


@dataclass(frozen=True)
class MeasuredRun:
    """Time and memory that a run took."""

    wall_s: float
    processor_s: float
    driver: Memory
    worker: Memory
    appeared_s: float | None = None
    """When the file that was watched for was there; None: never."""

    def text(self) -> str:
        """A line for people; the quarters show whether memory grows with the flight."""
        parts = []
        for name, memory in (("driver", self.driver), ("worker", self.worker)):
            if memory.samples:
                quarters = ", ".join(f"{memory.largest_in(k / 4, (k + 1) / 4) / 1000:.2f}" for k in range(4))
                parts.append(f"{name} {memory.peak_mb / 1000:.2f} GB at its peak (by quarters of the run {quarters})")
        return f"{self.wall_s:.1f} s, {self.processor_s:.1f} s of processor; memory: {'; '.join(parts)}"


def run_measured(command: Sequence[str], watch: Path | None = None) -> MeasuredRun:
    """Run a command to its end; ``watch``: a file that it writes, for the time when it is there.

    Raises
    ------
    RuntimeError
        It failed.
    """
    driver, worker = Memory(), Memory()
    appeared_s = None
    start, used_s = time.monotonic(), _processor_s()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        while process.poll() is None:
            _sample(process.pid, time.monotonic() - start, driver, worker)
            if appeared_s is None and watch is not None and watch.exists():
                appeared_s = time.monotonic() - start
            time.sleep(_EVERY_S)
        error = process.stderr.read().decode() if process.stderr else ""
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with status {process.returncode}: {error[-2000:]}")
    return MeasuredRun(time.monotonic() - start, _processor_s() - used_s, driver, worker, appeared_s)


def _processor_s() -> float:
    """Time of all processes that this one started and that ended."""
    used = os.times()
    return used.children_user + used.children_system


def _sample(pid: int, at_s: float, driver: Memory, worker: Memory) -> None:
    try:
        own = psutil.Process(pid)
        processes = [(own, driver), *((child, worker) for child in own.children(recursive=True) if _is_worker(child))]
    except psutil.Error:
        return
    for process, memory in processes:
        try:
            resident = process.memory_info().rss
            memory.add(at_s, resident / _MB, _peak_bytes(process.pid) / _MB)
        except (psutil.Error, OSError):
            continue  # it ended


def _is_worker(process: psutil.Process) -> bool:
    """Whether it is a worker of a local cluster: not Prefect's server, nor a helper of multiprocessing."""
    try:
        return any("spawn_main" in part for part in process.cmdline())
    except psutil.Error:
        return False


def _peak_bytes(pid: int) -> int:
    """Peak of the resident memory as the system counts it; 0 where it does not."""
    try:
        with open(f"/proc/{pid}/status") as file:
            return next((int(line.split()[1]) * 1024 for line in file if line.startswith("VmHWM")), 0)
    except FileNotFoundError:
        return 0
