"""``velfield bench overhead``: the overhead of flow and Dask over the bare functions, start-up excluded.

The peer runs the same stage functions in the same order on a pool of as many processes, in a plain loop. Both are
measured from the first unit to the last commit, in wall time, and in the processor time of all processes together,
which is meaningful on a shared machine too.
"""

import shutil
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from schemas.job import Job


@dataclass(frozen=True)
class Cost:
    """Cost of one run: wall and processor time, and start-up time, which they exclude."""

    wall_s: float
    processor_s: float
    start_s: float


def overhead(flight: Path, /, *, work: Path, workers: int = 2) -> int:
    """Compare flow and Dask with the bare functions, on a simulated flight; with Prefect where a server is set.

    Parameters
    ----------
    flight
        Folder that `velfield simulate` wrote.
    work
        Folder for the two runs; earlier ones there are removed.
    workers
        Processes of each.
    """
    from flows.launch import prepare_process
    from schemas.job import Inputs, Job
    from velfield.pipeline.configuration import resolve_config

    prepare_process(verbose=False)
    inputs = Inputs.from_simulated_flight(flight)
    config = resolve_config(overrides={"gsd_m": 0.23})
    costs = {}
    for name, way in (("bare", _bare), ("flow", _flow)):
        shutil.rmtree(work / name, ignore_errors=True)
        costs[name] = way(Job(root=str(work / name), inputs=inputs, config=config).anywhere(), workers)
        cost = costs[name]
        print(f"{name}  {cost.wall_s:7.1f} s, {cost.processor_s:7.1f} s of processor, start-up {cost.start_s:.1f} s")
    for what in ("wall_s", "processor_s"):
        ratio = getattr(costs["flow"], what) / getattr(costs["bare"], what)
        print(f"overhead in {what.removesuffix('_s')} time: {100 * (ratio - 1):+.1f} %")
    return 0


def _processor_s() -> float:
    """User and system time of this process and all that it started, so far."""
    import psutil

    own = psutil.Process()
    return float(sum(sum(process.cpu_times()[:2]) for process in (own, *own.children(recursive=True))))


def _flow(job: "Job", workers: int) -> Cost:
    from flows.console import Console
    from flows.process_flight import run_flight
    from flows.runners import RunnerConfig

    marks: list[tuple[float, float]] = []

    class Marking(Console):
        """Notes the time when the cluster is up, and when a stage is done."""

        def event(self, kind: str, text: str, **fields: Any) -> None:
            marks.append((time.monotonic(), _processor_s()))

    begun = time.monotonic()
    run_flight(job, RunnerConfig(workers=workers), Marking("quiet"))
    (start, used_before), (end, used) = marks[0], marks[-1]
    return Cost(end - start, used - used_before, start - begun)


def _bare(job: "Job", workers: int) -> Cost:
    import multiprocessing

    from velfield.bench.workers import compute_bare
    from velfield.pipeline.plan import make_plan, write_flight_record

    begun = time.monotonic()
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        list(pool.map(abs, range(workers)))
        plan = make_plan(job)
        write_flight_record(plan)
        start, used_before = time.monotonic(), _processor_s()
        compute_bare(plan, pool)
        return Cost(time.monotonic() - start, _processor_s() - used_before, start - begun)
