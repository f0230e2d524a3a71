"""Stages without Prefect, one after another."""

from collections.abc import Callable, Iterable
from typing import Any

from velfield.pipeline.graphs import Graph, compute_here, unit_graph
from velfield.pipeline.plan import Plan
from velfield.pipeline.stage import STAGE, STAGES, Stage
from velfield.pipeline.units import Unit, prepare_stage, stage_units

Compute = Callable[[Graph], Any]
"""Gives the value of a graph."""


def compute_stages(
    plan: Plan,
    stages: Iterable[str] = tuple(STAGE),
    compute: Compute = compute_here,
    *,
    graph: Callable[[Plan, Stage, Unit], Graph] = unit_graph,
) -> None:
    """Compute stages one after another, by default on this thread; what is finished is computed again.

    ``graph`` makes the graph of a unit, such as `tracks_graph` of a run of given tracks. Units whose detections are
    lost are left out.
    """
    chosen = set(stages)
    for stage in STAGES:
        if stage.name not in chosen:
            continue
        prepare_stage(plan, stage)
        for unit in stage_units(plan, stage):
            if f"detections {unit.name}" not in plan.lost:
                compute(graph(plan, stage, unit))
