"""Dask graphs of a unit of each stage. Within velfield the only module that imports dask.

A unit of frames becomes a graph of blocks (some eight frames each: one-frame blocks cost more than they save) and one
last node that writes what must have a single writer and then the commit record. Images never travel: blocks read their
frames from the store, and only key points, tables and patches go from node to node. Every function in a graph lives in
``velfield``, so that a worker needs neither ``flows`` nor Prefect.
"""

import time
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from dask import delayed
from dask.local import get_sync

from velfield.pipeline.plan import Plan
from velfield.pipeline.result import commit
from velfield.pipeline.stage import Stage, resolve
from velfield.pipeline.units import Unit, unit_blocks

if TYPE_CHECKING:
    from velfield.pipeline.stages.rebase import Rebase

Graph = Any
"""A ``dask.delayed.Delayed`` whose value is a ``CommitRecord``."""


def _node(function: Any, *arguments: Any, **options: Any) -> Any:
    # pure=False: what is done already is known from commit records, not from Dask.
    return delayed(function, pure=False)(*arguments, **options)


def _constant(value: Any) -> Any:
    return delayed(value, pure=False, traverse=False)


def unit_graph(plan: Plan, stage: Stage, unit: Unit, rebase: "Rebase | None" = None) -> Graph:
    """A unit of a stage: its blocks where it has any, then its result, then its commit record.

    Of given tracks, and of a run that is mapped onto a new base image (``rebase``), the stage's own function for them
    where it has one.
    """
    constant = _constant(plan)
    function, arguments = stage.unit, list(unit.part)
    if rebase is not None and stage.remap is not None:
        function, arguments = stage.remap, [*arguments, _constant(rebase)]
    elif plan.inputs.source.of_tracks and stage.from_tracks is not None:
        function = stage.from_tracks
    elif stage.block is not None:
        block, parts = resolve(stage.block), unit_blocks(plan, unit)
        # Dask computes what is alike in the order of its keys, which it would draw at random: the last block, a short
        # one, may so come first, and a long one be left over for one thread alone.
        keys = [f"{stage.name}-{unit.name}-{k:06d}-{uuid4().hex}" for k in range(len(parts))]
        blocks = [_node(block, constant, frames, dask_key_name=key) for frames, key in zip(parts, keys, strict=True)]
        arguments.append(blocks)
    result = _node(resolve(function), constant, *arguments)
    return _node(commit, constant, stage.name, unit.name, result, started=time.time())


def compute_here(graph: Graph) -> Any:
    """The value of a graph, computed on this thread."""
    return graph.compute(scheduler=get_sync)
