"""The whole job without Prefect, stage after stage: for benchmarks, and to have the kernels compiled.

    python -m velfield.pipeline.local

runs a tiny job and discards it: what numba compiles on the way is cached beside the modules, and a first real run that
is under way finds it there.
"""

import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from schemas.job import Inputs, Job
from schemas.simulation import SimulationConfig
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.graphs import Graph, compute_here, unit_graph
from velfield.pipeline.plan import Plan, make_plan, write_flight_record
from velfield.pipeline.stage import STAGE, STAGES
from velfield.pipeline.units import prepare_stage, stage_units

_TINY = SimulationConfig(frames=9, width=480, height=360, seed=3)
_QUICK = {"detection.fine_tune_steps": 2, "registration.max_keypoints": 800, "gsd_m": 0.23}


Compute = Callable[[Graph], Any]
"""Gives the value of a graph."""


def compute_stages(plan: Plan, stages: Iterable[str] = tuple(STAGE), compute: Compute = compute_here) -> None:
    """Compute stages one after another, by default on this thread; what is finished is computed again.

    Units whose detections are lost are left out.
    """
    chosen = set(stages)
    for stage in STAGES:
        if stage.name not in chosen:
            continue
        prepare_stage(plan, stage)
        for unit in stage_units(plan, stage):
            if f"detections {unit.name}" not in plan.lost:
                compute(unit_graph(plan, stage, unit))


def compile_kernels() -> None:
    """Run a tiny job on a simulated flight, from its first frame to its maps."""
    from velfield.synthetic.write import write_flight

    with tempfile.TemporaryDirectory(prefix="velfield-kernels-") as folder:
        flight = Path(folder) / "flight"
        write_flight(flight, _TINY)
        inputs = Inputs.from_simulated_flight(flight)
        config = resolve_config(preset="fast", overrides=_QUICK)
        plan = make_plan(Job(root=str(Path(folder) / "run"), inputs=inputs, config=config))
        write_flight_record(plan)
        compute_stages(plan)


if __name__ == "__main__":
    compile_kernels()
