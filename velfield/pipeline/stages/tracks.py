"""The tracks of vehicles: tracklets of the whole flight that share detections, chained."""

from pathlib import Path

import numpy as np

from schemas.tables import TRACKLET_COLUMNS
from velfield.pipeline.plan import Plan, widen_interval
from velfield.pipeline.progress import advance
from velfield.pipeline.result import StageResult
from velfield.pipeline.stages.registration import usable_frames
from velfield.run.grid import read_grid
from velfield.run.stores import open_frames
from velfield.run.tables import read_tables, write_tracks
from velfield.tracking.gap_closing import END_COLUMNS, GapLimits, reconnect_tracks
from velfield.tracking.tracks import assign_tracks


def tracklet_files(plan: Plan) -> list[Path]:
    """Tables of tracklets of the units that are finished, in order."""
    layout = plan.layout
    paths = [layout.unit_file(layout.tracklets, unit, ".parquet") for unit in range(len(plan.units))]
    return [path for path in paths if path.exists()]


def chain_tracks(plan: Plan) -> StageResult:
    """Give every tracklet the track that it belongs to: reads a few columns of all units, writes unit by unit."""
    ids = [f"detection_id_{k}" for k in range(3)]
    sources = tracklet_files(plan)
    tracklets = read_tables(sources, TRACKLET_COLUMNS, only=[*ids, *END_COLUMNS])
    tracks = assign_tracks(tracklets[ids].to_numpy(np.int64))
    config = plan.config.tracking
    gaps = GapLimits(config.max_gap_s, config.max_stationary_gap_s, config.stationary_speed_m_per_s)
    tracks = reconnect_tracks(tracklets, tracks, gaps, gsd_m=read_grid(plan.layout).gsd_m)
    written, start = [], 0
    for path in sources:
        table = read_tables([path], TRACKLET_COLUMNS)
        table["track_id"] = tracks[start : start + len(table)]
        start += len(table)
        target = plan.layout.tracks / path.name
        write_tracks(target, table)
        written.append(target)
    for stale in set(plan.layout.tracks.glob("unit-*.parquet")) - set(written):
        stale.unlink()  # of an earlier plan with more units
    advance("tracks")
    warnings = [] if len(tracks) else [explain_no_tracklets(plan)]
    return StageResult(written, {"tracklets": len(tracks), "tracks": len(np.unique(tracks))}, warnings=warnings)


def explain_no_tracklets(plan: Plan) -> str:
    """The reason why there are no tracklets, so that the maps are empty, and the remedy."""
    effect, near_s = "no tracklets, so the maps are empty", plan.config.tracking.max_interval_s
    times_s = open_frames(plan.layout.frames).column("time_s")[usable_frames(plan)]
    if len(times_s) < 3:
        return f"{effect}: {len(times_s)} frames are registered well enough, 3 or more needed; see registration's notes"
    gaps = np.diff(times_s)
    near = gaps <= near_s
    if (near[1:] & near[:-1]).any():
        return (
            f"{effect}: no detection can be linked over three frames as a vehicle; check on the page whether "
            "detections are vehicles, and if not label one frame and give it with --labels"
        )
    return (
        f"{effect}: no three registered frames are within tracking.max_interval_s = {near_s:g} s of one another "
        f"(median {np.median(gaps):.2f} s); {widen_interval(gaps)}"
    )
