"""Stages without Prefect, one after another."""

from collections.abc import Callable, Iterable
from typing import Any

from velfield.pipeline.graphs import Graph, compute_here, unit_graph
from velfield.pipeline.plan import Plan
from velfield.pipeline.stage import STAGES
from velfield.pipeline.units import prepare_stage, stage_units

Compute = Callable[[Graph], Any]
"""Gives the value of a graph."""


def compute_stages(plan: Plan, stages: Iterable[str] | None = None, compute: Compute = compute_here) -> None:
    """Compute stages one after another, by default all of the plan on this thread; what is finished is computed again.

    Units whose detections are lost are left out.
    """
    chosen = set(plan.keys if stages is None else stages)
    for stage in STAGES:
        if stage.name not in chosen:
            continue
        prepare_stage(plan, stage)
        for unit in stage_units(plan, stage):
            if f"detections {unit.name}" not in plan.lost:
                compute(unit_graph(plan, stage, unit))
