"""Dask graphs of a unit of each stage. Within velfield the only module that imports dask.

A unit of frames becomes a graph of blocks (some eight frames each: one-frame blocks cost more than they give) and one
last
node that writes what must have a single writer and then the commit record. Pictures never travel: blocks read their
frames from the store, and only key points, tables and patches go from node to node. Every function in a graph lives in
``velfield``, so that a worker needs neither ``flows`` nor Prefect.

    frames         decode, write                                                   ->  commit
    lens           edge points of spread frames                                    ->  commit
    base           key points of spread frames, two passes to their median         ->  commit
    registration   key points of each block  ->  the chain over the unit's frames  ->  commit
    detector       spread windows of three frames: labels, training                ->  commit
    detections     cars of each block        ->  one table, its patches            ->  commit
    tracklets      three-frame windows over the unit's frames and the halo after   ->  commit
    tracks         the tracks of vehicles over all units                           ->  commit
    field          the tiles of one group, from the segment table                  ->  commit
    maps           figures, GIS layers, the report                                 ->  commit
"""

import time
from typing import TYPE_CHECKING, Any

from dask import delayed

from velfield.pipeline.plan import Plan
from velfield.pipeline.result import commit, unit_name

if TYPE_CHECKING:
    from velfield.pipeline.stages.rebase import Rebase

Graph = Any
"""A ``dask.delayed.Delayed`` whose value is a ``CommitRecord``."""

WHOLE = "all"
"""Name of the one unit of a stage that is not cut."""


def _node(function: Any, *arguments: Any) -> Any:
    # pure=False: what is done already is known from commit records, not from Dask.
    return delayed(function, pure=False)(*arguments)


def _constant(value: Any) -> Any:
    return delayed(value, pure=False, traverse=False)


def _plan_node(plan: Plan) -> Any:
    return _constant(plan)


def _committed(plan: Any, stage: str, unit: str, outcome: Any) -> Graph:
    return delayed(commit, pure=False)(plan, stage, unit, outcome, started=time.time())


def frames_graph(plan: Plan, frames: range) -> Graph:
    """Decode a unit of frames into the frame store."""
    from velfield.pipeline.stages.frames import read_unit

    node = _plan_node(plan)
    return _committed(node, "frames", unit_name(frames), _node(read_unit, node, frames))


def lens_graph(plan: Plan) -> Graph:
    """Calibrate the lens from frames spread over the flight."""
    from velfield.pipeline.stages.lens import calibrate_flight

    node = _plan_node(plan)
    return _committed(node, "lens", WHOLE, _node(calibrate_flight, node))


def base_graph(plan: Plan) -> Graph:
    """Build the base image, or register the flight to the given one."""
    from velfield.pipeline.stages.base_image import build_base, detect_unit_keypoints, spread_frames

    node = _plan_node(plan)
    spread = spread_frames(plan)
    step = plan.config.work.block_frames
    blocks = [_node(detect_unit_keypoints, node, spread[k : k + step]) for k in range(0, len(spread), step)]
    return _committed(node, "base", WHOLE, _node(build_base, node, blocks))


def registration_graph(plan: Plan, frames: range) -> Graph:
    """Key points by block, then the light chain over the unit's frames."""
    from velfield.pipeline.stages.base_image import detect_unit_keypoints
    from velfield.pipeline.stages.registration import register_unit

    node = _plan_node(plan)
    blocks = [_node(detect_unit_keypoints, node, list(block)) for block in plan.blocks(frames)]
    return _committed(node, "registration", unit_name(frames), _node(register_unit, node, frames, blocks))


def detector_graph(plan: Plan) -> Graph:
    """Background, labels, training; or the detector that was given."""
    from velfield.pipeline.stages.detector import make_detector

    node = _plan_node(plan)
    return _committed(node, "detector", WHOLE, _node(make_detector, node))


def detections_graph(plan: Plan, frames: range) -> Graph:
    """Cars of each block, then one table a unit."""
    from velfield.pipeline.stages.detections import detect_block, write_detections

    node = _plan_node(plan)
    blocks = [_node(detect_block, node, block) for block in plan.blocks(frames)]
    return _committed(node, "detections", unit_name(frames), _node(write_detections, node, frames, blocks))


def tracklets_graph(plan: Plan, frames: range) -> Graph:
    """Windows of three frames that start in this unit."""
    from velfield.pipeline.stages.tracklets import link_unit

    node = _plan_node(plan)
    return _committed(node, "tracklets", unit_name(frames), _node(link_unit, node, frames))


def tracks_graph(plan: Plan, units: list[range]) -> Graph:
    """Chain tracklets that share detections into tracks."""
    from velfield.pipeline.stages.tracks import chain_tracks

    node = _plan_node(plan)
    return _committed(node, "tracks", WHOLE, _node(chain_tracks, node, units))


def field_graph(plan: Plan, group: tuple[int, int]) -> Graph:
    """The tiles of one group of the field."""
    from velfield.pipeline.stages.field import accumulate_group, group_name

    node = _plan_node(plan)
    return _committed(node, "field", group_name(group), _node(accumulate_group, node, group))


def maps_graph(plan: Plan) -> Graph:
    """Figures, GIS layers and the report."""
    from velfield.pipeline.stages.maps import make_maps

    node = _plan_node(plan)
    return _committed(node, "maps", WHOLE, _node(make_maps, node))


def rebase_graph(plan: Plan, rebase: "Rebase") -> Graph:
    """A new base image under a finished run: its grid, and the map onto it."""
    from velfield.pipeline.stages.rebase import rebase_image

    node = _plan_node(plan)
    return _committed(node, "base", WHOLE, _node(rebase_image, node, _constant(rebase)))


def rebase_detections_graph(plan: Plan, frames: range, rebase: "Rebase") -> Graph:
    """The cars of a unit, mapped onto the new base image."""
    from velfield.pipeline.stages.rebase import rebase_detections

    node = _plan_node(plan)
    return _committed(node, "detections", unit_name(frames), _node(rebase_detections, node, frames, _constant(rebase)))


def rebase_tracks_graph(plan: Plan, rebase: "Rebase") -> Graph:
    """All tracklets, mapped onto the new base image."""
    from velfield.pipeline.stages.rebase import rebase_tracks

    node = _plan_node(plan)
    return _committed(node, "tracks", WHOLE, _node(rebase_tracks, node, _constant(rebase)))
