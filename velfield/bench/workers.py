"""Stages as bare functions on a pool of processes: the peer of Prefect and Dask, and two workers against one."""

import multiprocessing
import time
from collections.abc import Iterable
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any

from velfield.pipeline.plan import Plan
from velfield.pipeline.result import commit
from velfield.pipeline.stage import STAGE, STAGES, resolve
from velfield.pipeline.units import Unit, prepare_stage, stage_units, unit_blocks


def compute_bare(plan: Plan, pool: Executor, stages: Iterable[str] = tuple(STAGE)) -> None:
    """Stages, one after another, each on the pool: blocks of all units at once, then what joins a unit's."""
    chosen = set(stages)
    for stage in (stage for stage in STAGES if stage.name in chosen):
        prepare_stage(plan, stage)
        under_way = []
        for unit in stage_units(plan, stage):
            frames = unit_blocks(plan, unit) if stage.block else []
            under_way.append((unit, [pool.submit(resolve(str(stage.block)), plan, part) for part in frames]))
        ends = []
        for unit, blocks in under_way:
            results = [[block.result() for block in blocks]] if stage.block else []
            ends.append(pool.submit(_one, plan, stage.name, unit, *results))
        for end in ends:
            end.result()


def _one(plan: Plan, stage: str, unit: Unit, *blocks: Any) -> None:
    started = time.time()
    commit(plan, stage, unit.name, resolve(STAGE[stage].unit)(plan, *unit.part, *blocks), started=started)


def time_workers(plan: Plan, stages: Iterable[str], workers: int) -> float:
    """Wall time of stages on so many processes, s, the second time: the first one imports and reads compiled
    kernels."""
    names = tuple(stages)
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_on_one_thread) as pool:
        compute_bare(plan, pool, names)
        start = time.perf_counter()
        compute_bare(plan, pool, names)
        return time.perf_counter() - start


def _on_one_thread() -> None:
    import cv2

    cv2.setNumThreads(1)
