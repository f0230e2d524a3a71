"""A store that fails, is torn or fills up at its n-th call, on a disk and on S3; and a small flight to try it on.

Every file and chunk of a run folder is written by one of two calls on a disk, the writing of a new file and its
renaming, and by one on S3: these are counted and fail. Files that GDAL writes by itself (``maps/*.tif``) are not.
"""

import errno
import io
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from schemas.job import Inputs, Job
from schemas.simulation import SimulationConfig
from schemas.summary import RunSummary
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.graphs import unit_graph
from velfield.pipeline.plan import Plan, make_plan, write_flight_record
from velfield.pipeline.result import committed
from velfield.pipeline.stage import STAGES
from velfield.pipeline.stages.report import write_report
from velfield.pipeline.summary import summarise_stage
from velfield.pipeline.units import prepare_stage, stage_units
from velfield.run.commits import PAGE, sweep_partial

Mode = Literal["fails", "tears", "fills up"]
MODES: tuple[Mode, ...] = ("fails", "tears", "fills up")
"""``fails``: that call, with an input/output error; ``tears``: that call leaves half of the data under the final name,
and the process writes nothing after it; ``fills up``: no space from that call on."""
TINY = SimulationConfig(frames=6, width=320, height=240, seed=21)
_SETTINGS = (
    "detection.fine_tune_steps=2",
    "lens.calibrate=never",
    "registration.max_keypoints=600",
    "registration.min_control_points=20",
    "work.unit_frames=3",
    "field.tile_size_px=128",
    "field.bin_width_m_per_s=4",
    "field.time_weighted=false",
)


def tiny_job(flight: Path, root: Path | str, *settings: str) -> Job:
    """A job on `TINY`: some seconds. Another detector is taken with its own settings."""
    another = any(setting.startswith("detection.method=") for setting in settings)
    usual = [setting for setting in _SETTINGS if not (another and setting.startswith("detection."))]
    config = resolve_config(settings=[*usual, *settings], overrides={"gsd_m": 0.23})
    return Job(root=str(root), inputs=Inputs.from_simulated_flight(flight), config=config)


def run_again(job: Job, *, until: str = PAGE) -> Plan:
    """The job on this thread, without Prefect, up to a stage or to the page; what is finished is not computed again."""
    plan = make_plan(job)
    sweep_partial(plan.layout.root)
    write_flight_record(plan)
    summaries = []
    for stage in STAGES:
        prepare_stage(plan, stage)
        units = stage_units(plan, stage)
        records = [
            committed(plan, stage.name, unit.name) or unit_graph(plan, stage, unit).compute(scheduler="synchronous")
            for unit in units
        ]
        summaries.append(summarise_stage(stage.name, records, units=len(units), before=records, seconds=0.0))
        if stage.name == until:
            return plan
    write_report(plan, RunSummary(root=job.root, stages=tuple(summaries), frames_lost=()))
    return plan


@dataclass
class Fault:
    """Counts the calls of a store, and fails at one of them."""

    mode: Mode = "fails"
    at: int | None = None
    """Number of the call, from 0; none: only counts."""
    calls: int = 0
    names: list[str] = field(default_factory=list)
    """What each call wrote, by the last parts of its path."""
    lock: threading.Lock = field(default_factory=threading.Lock)

    def meet(self, name: str, tear: Callable[[], None]) -> None:
        """One call; raises where it is to fail."""
        with self.lock:
            number, self.calls = self.calls, self.calls + 1
            self.names.append(name)
        if self.at is None or number < self.at or (self.mode == "fails" and number > self.at):
            return
        if self.mode == "fills up":
            raise OSError(errno.ENOSPC, "No space left on device", name)
        if self.mode == "tears" and number == self.at:
            tear()
        raise OSError(errno.EIO, "Input/output error", name)


_NO_FILE = -1


class _File(io.BytesIO):
    """A file that is being written: what it holds is written when it is closed, or the fault met."""

    def __init__(self, path: Path, fault: Fault, write: Callable[[Path, bytes], None]) -> None:
        super().__init__()
        self._path, self._fault, self._write = path, fault, write

    def fileno(self) -> int:
        return _NO_FILE  # of which nothing is synchronised

    def close(self) -> None:
        if not self.closed:
            data = self.getvalue()
            super().close()
            self._fault.meet(str(self._path), lambda: self._write(_final(self._path), data[: len(data) // 2]))
            self._write(self._path, data)


def _final(path: Path) -> Path:
    """The name that a file under a temporary one will have."""
    return path.with_name(path.name.split(".partial")[0].rsplit(".", 1)[0]) if ".partial" in path.name else path


@contextmanager
def failing_disk(root: Path, fault: Fault) -> Iterator[None]:
    """Let every writing and renaming of a file below ``root`` meet the fault."""
    true_open, true_replace, true_sync = Path.open, Path.replace, os.fsync

    def write(path: Path, data: bytes) -> None:
        with true_open(path, "wb") as file:
            file.write(data)

    def opened(self: Path, mode: str = "r", *arguments: Any, **named: Any) -> Any:
        if mode not in ("wb", "xb", "w") or not self.is_relative_to(root):
            return true_open(self, mode, *arguments, **named)
        return _File(self, fault, write)

    def replaced(self: Path, target: Path) -> Path:
        if Path(target).is_relative_to(root):
            data = self.read_bytes()
            fault.meet(f"{target} (renamed)", lambda: write(Path(target), data[: len(data) // 2]))
        return true_replace(self, target)

    def synced(descriptor: int) -> None:
        if descriptor != _NO_FILE:
            true_sync(descriptor)

    Path.open, Path.replace, os.fsync = opened, replaced, synced
    try:
        yield
    finally:
        Path.open, Path.replace, os.fsync = true_open, true_replace, true_sync


_S3_WRITES = {
    *("put_object", "copy_object", "delete_object", "delete_objects"),
    *("create_multipart_upload", "upload_part", "upload_part_copy", "complete_multipart_upload"),
}


@contextmanager
def failing_s3(root: Path, fault: Fault) -> Iterator[None]:
    """Let every writing of an object below ``root`` meet the fault."""
    import s3fs

    below = str(root).removeprefix("s3://")
    true = s3fs.S3FileSystem._call_s3

    async def call(self: Any, method: str, *arguments: Any, **named: Any) -> Any:
        names = [named.get("Key"), *(one["Key"] for one in named.get("Delete", {}).get("Objects", []))]
        path = f"{named.get('Bucket')}/{next((name for name in names if name), None)}"
        if method not in _S3_WRITES or not path.startswith(below) or path.endswith(".lock"):
            return await true(self, method, *arguments, **named)
        torn: list[dict[str, Any]] = []
        body = bytes(named.get("Body", b""))
        try:
            # half of an object; of a call that has no body all is done, and only its answer is lost
            fault.meet(f"{path} ({method})", lambda: torn.append({"Body": body[: len(body) // 2]} if body else {}))
        except OSError:
            for instead in torn:
                await true(self, method, *arguments, **(named | instead))
            raise
        return await true(self, method, *arguments, **named)

    s3fs.S3FileSystem._call_s3 = call
    try:
        yield
    finally:
        s3fs.S3FileSystem._call_s3 = true
