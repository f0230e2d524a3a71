"""``velfield bench overhead``: what Prefect and Dask add to the bare functions, start-up told apart and left out.

The peer is the same stage functions in the same order on a pool of as many processes, from a plain loop. Both are
measured from the first unit to the last commit, in wall time, and in the processor time of all processes together:
that is what can be told on a machine that others use as well.
"""

import shutil
import time
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from schemas.job import Job
    from velfield.pipeline.plan import Plan


@dataclass(frozen=True)
class Cost:
    """What one way took: seconds of wall and of processor, start-up left out and told apart."""

    wall_s: float
    processor_s: float
    start_s: float


def overhead(flight: Path, /, *, work: Path, workers: int = 2) -> int:
    """Prefect and Dask beside the bare functions, on a simulated flight.

    Parameters
    ----------
    flight
        Folder that `velfield simulate` wrote.
    work
        Folder for the two runs; what stands there is removed.
    workers
        Processes of either.
    """
    from flows.launch import prepare_process
    from schemas.job import Inputs, Job
    from velfield.pipeline.configuration import resolve_config

    prepare_process(verbose=False)
    inputs = Inputs(
        source=str(flight / "frames"),
        timestamps=str(flight / "timestamps.csv"),
        base=str(flight / "base.png"),
        labels=str(flight / "labels.csv"),
    )
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

    from velfield.pipeline.plan import make_plan, write_flight_record

    begun = time.monotonic()
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        list(pool.map(abs, range(workers)))
        plan = make_plan(job)
        write_flight_record(plan)
        start, used_before = time.monotonic(), _processor_s()
        _stages(plan, pool)
        return Cost(time.monotonic() - start, _processor_s() - used_before, start - begun)


def _stages(plan: "Plan", pool: Executor) -> None:
    """The stages in the order of `flows.process_flight`, each on the pool."""
    from velfield.pipeline.stages import base_image as base
    from velfield.pipeline.stages import (
        detections,
        detector,
        field,
        frames,
        lens,
        maps,
        registration,
        tracklets,
        tracks,
    )

    frames.lay_out_frames(plan)
    _by_unit(plan, pool, "frames", frames.read_unit)
    _whole(plan, pool, "lens", lens.calibrate_flight)
    spread, step = base.spread_frames(plan), plan.config.work.block_frames
    blocks = [spread[k : k + step] for k in range(0, len(spread), step)]
    found = list(pool.map(base.detect_unit_keypoints, [plan] * len(blocks), blocks))
    _whole(plan, pool, "base", base.build_base, found)
    registration.lay_out_registration(plan)
    _by_blocks(plan, pool, "registration", base.detect_unit_keypoints, registration.register_unit)
    _whole(plan, pool, "detector", detector.make_detector)
    _by_blocks(plan, pool, "detections", detections.detect_block, detections.write_detections)
    _by_unit(plan, pool, "tracklets", tracklets.link_unit)
    _whole(plan, pool, "tracks", tracks.chain_tracks, plan.units)
    field.lay_out_field(plan)
    groups = field.field_groups(plan)
    names = [field.group_name(group) for group in groups]
    for done in [
        pool.submit(_one, plan, "field", n, field.accumulate_group, g) for n, g in zip(names, groups, strict=True)
    ]:
        done.result()
    _whole(plan, pool, "maps", maps.make_maps)


def _one(plan: "Plan", stage: str, unit: str, function: Callable[..., Any], *arguments: Any) -> None:
    from velfield.pipeline.result import commit

    started = time.time()
    commit(plan, stage, unit, function(plan, *arguments), started=started)


def _whole(plan: "Plan", pool: Executor, stage: str, function: Callable[..., Any], *arguments: Any) -> None:
    pool.submit(_one, plan, stage, "all", function, *arguments).result()


def _by_unit(plan: "Plan", pool: Executor, stage: str, function: Callable[..., Any]) -> None:
    from velfield.pipeline.result import unit_name

    for done in [pool.submit(_one, plan, stage, unit_name(unit), function, unit) for unit in plan.units]:
        done.result()


def _by_blocks(
    plan: "Plan", pool: Executor, stage: str, of_block: Callable[..., Any], of_unit: Callable[..., Any]
) -> None:
    """Blocks of all units at once, then what puts a unit's together, as soon as they are there."""
    from velfield.pipeline.result import unit_name

    under_way = {unit: [pool.submit(of_block, plan, block) for block in plan.blocks(unit)] for unit in plan.units}
    ends = []
    for unit, blocks in under_way.items():
        found = [block.result() for block in blocks]
        ends.append(pool.submit(_one, plan, stage, unit_name(unit), of_unit, unit, found))
    for end in ends:
        end.result()
