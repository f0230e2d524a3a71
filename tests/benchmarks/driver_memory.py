"""The driver's memory over a flight: all units of 5,000 and of 72,000 frames as tasks, their work left out.

python -m tests.benchmarks.driver_memory
"""

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from flows.launch import prepare_process


def main() -> None:
    """Print the resident memory of this process before and after each flight."""
    prepare_process(verbose=False)
    from flows.orchestration import Threads

    with tempfile.TemporaryDirectory() as folder:
        print(f"{'frames':>8} {'unit':>5} {'tasks':>6} {'MB before':>10} {'MB after':>9}")
        for frames, unit in ((256, 8), (5000, 8), (5000, "auto"), (72_000, "auto")):
            by = Threads()
            root = Path(folder) / f"{frames}-{unit}"
            before = _resident_mb()
            stages = partial(_stages, root, frames, unit, by)
            tasks = by.run(stages, name="driver-memory", run_name=root.name, threads=4, parameters=None)
            print(f"{frames:>8} {unit:>5} {tasks:>6} {before:>10.0f} {_resident_mb():>9.0f}", flush=True)


def _stages(root: Path, frames: int, unit: Any, by: Any) -> int:
    from dask import delayed

    from flows.console import Console
    from flows.runners import ThreadsRunner
    from flows.work import Work
    from tests.pipeline.test_estimate import planned
    from velfield.pipeline.stage import STAGES, Cut

    plan = planned(frames, root, unit_frames=unit)
    work = Work(plan, ThreadsRunner(2), Console("quiet"), by, at_once=4)
    by_frames = [replace(stage, prepare=None) for stage in STAGES if stage.cut is Cut.BY_FRAMES]
    work.run(by_frames, lambda plan, stage, part: delayed(_commit, pure=False)(plan, stage.name, part))
    return len(by_frames) * len(plan.units)


def _commit(plan: Any, stage: str, part: Any) -> Any:
    """A record as large as a true one's, written as a true one is."""
    from schemas.records import CommitRecord
    from velfield.run.commits import write_commit

    counts = dict.fromkeys(("frames", "usable", "registered", "heldout_px", "cars", "tracklets"), 1.0)
    outputs = {f"frames.zarr/raw/c/{frame}/0/0": "0" * 32 for frame in part.frames}
    key = plan.keys[stage]
    record = CommitRecord(stage=stage, unit=part.name, key=key, outputs=outputs, counts=counts, code_version="0")
    write_commit(plan.layout, record)
    return record


def _resident_mb() -> float:
    import psutil

    return psutil.Process().memory_info().rss / 1e6


if __name__ == "__main__":
    main()
