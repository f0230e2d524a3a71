"""Stage ``scale``: the scale once more, with the lengths of the vehicles that were tracked; the times, with how they
set off and stop.

Stages before this one work with what `velfield.pipeline.stages.georeference` found, or, where nothing gives the scale,
with the size of the cars that the detector was trained on. Here the measured lengths of all vehicles give an estimate
with an interval. It is used where there is no other, and else compared with the one that is used.
"""

import numpy as np
import pandas as pd

from schemas.georeference import GeoreferenceRecord
from schemas.scale import ScaleEstimate
from schemas.tables import DIMENSION_COLUMNS, TRACK_COLUMNS
from velfield.analysis.speed_changes import MIN_VEHICLES, PLAUSIBLE_M_PER_S2, check_times
from velfield.analysis.trajectories import from_tracklets, moving
from velfield.analysis.vehicle_scale import MIN_VEHICLES as MIN_LENGTHS
from velfield.analysis.vehicle_scale import estimate_track_scale
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.pipeline.stages.georeference import (
    compare_sources,
    describe,
    georeference_counts,
    georeference_warnings,
    write_georeference,
)
from velfield.run.frame_transforms import read_first_georeference, read_own_grid, read_tracking_gsd
from velfield.run.layout import RunLayout
from velfield.run.tables import read_tables

_OTHER_LIMITS = 0.25
"""Where the limits of tracking were for a scale that differs by more than this fraction, vehicles may be missed."""
_CHECKED_BYTES = 20_000_000
"""Size of the tracks' files by which the times are checked: minutes of dense traffic."""


def scale_run(plan: Plan) -> StageResult:
    """Write ``base/scale.json``; and the base image as GeoTIFF where its place became known here."""
    layout, before = plan.layout, read_first_georeference(plan.layout) or GeoreferenceRecord()
    measured, vehicles = scale_of_tracks(layout)
    if measured is None and before.scale.used is not None and before.scale.used.source == "vehicles":
        measured = before.scale.used  # too few were tracked, but the metadata are contradicted all the same
    record, _ = compare_sources(plan, read_own_grid(layout), measured)
    outputs = write_georeference(layout, layout.scale, record, plan.config.frames)
    advance("scale")
    counts = {**georeference_counts(record), "vehicles": float(vehicles)}
    if measured is not None:
        counts["vehicle_gsd_m"] = measured.gsd_m
    known = [*describe(before), *georeference_warnings(before)]
    notes = [line for line in describe(record) if line not in known]
    warnings = [line for line in georeference_warnings(record) if line not in known]
    more_notes, more_warnings = _check_times(plan, record)
    return StageResult(
        outputs, counts, [*notes, *more_notes], [*warnings, *_other_limits(plan, record), *more_warnings]
    )


def scale_of_tracks(layout: RunLayout) -> tuple[ScaleEstimate | None, int]:
    """The scale by the measured lengths of a run's vehicles, None of too few; and their number.

    Of those that moved by their length where there are enough: among things that stand are some that are no vehicles.
    """
    if not layout.dimensions.exists():
        return None, 0
    table = read_tables([layout.dimensions], DIMENSION_COLUMNS, only=["track_id", "length_px", "length_sd_px"])
    table = table[np.isfinite(table["length_px"])]
    moved = table[_path_extent_px(layout).reindex(table["track_id"]).to_numpy() > table["length_px"].to_numpy()]
    used = moved if len(moved) >= MIN_LENGTHS else table
    length, sd = (used[name].to_numpy(np.float64) for name in ("length_px", "length_sd_px"))
    return estimate_track_scale(length, sd), len(used)


def _path_extent_px(layout: RunLayout) -> pd.Series:
    """Diagonal of the box about each track's positions, base px, by ``track_id``."""
    names = ["track_id", "x_1_px", "y_1_px"]
    boxes = [
        read_tables([path], TRACK_COLUMNS, only=names).groupby("track_id").agg(["min", "max"])
        for path in layout.unit_files(layout.tracks)
    ]
    if not boxes:
        return pd.Series(dtype=np.float64)
    both = pd.concat(boxes).groupby(level=0)
    span = both.max().xs("max", axis=1, level=1) - both.min().xs("min", axis=1, level=1)
    return pd.Series(np.hypot(span["x_1_px"], span["y_1_px"]))


def _other_limits(plan: Plan, record: GeoreferenceRecord) -> list[str]:
    """A warning where the scale that vehicles were tracked with was far from the one that is used."""
    tracked, used = read_tracking_gsd(plan.layout), record.scale.used
    if used is None or tracked is None or abs(np.log(used.gsd_m / tracked)) <= np.log1p(_OTHER_LIMITS):
        return []
    return [
        f"vehicles were tracked with limits for {tracked:.3g} m a pixel, as {used.gsd_m:.3g} was not known yet; run "
        f"the flight again with --gsd-m {used.gsd_m:.3g}"
    ]


def _check_times(plan: Plan, record: GeoreferenceRecord) -> tuple[list[str], list[str]]:
    """Notes and warnings about the times of the frames, by the accelerations of vehicles."""
    fps, used = plan.config.frames.fps, record.scale.used
    if used is None:
        return [], []
    paths, size = [], 0
    for path in plan.layout.unit_files(plan.layout.tracks):
        paths.append(path)
        size += path.stat().st_size
        if size > _CHECKED_BYTES:
            break
    check = check_times(moving(from_tracklets(read_tables(paths, TRACK_COLUMNS), used.gsd_m)))
    given = f"--fps {fps:g}" if fps else "--timestamps" if plan.job.inputs.timestamps else None
    if not check.known:
        short = f"found {check.vehicles} of the {MIN_VEHICLES} vehicles that must set off or stop to check them"
        return ([f"the times are those of {given}: {short}"] if given else []), []
    if check.plausible:
        return [], []
    advice = (
        f"give --fps {fps / check.factor:.2g} if that is the true rate" if fps else "give true times by --timestamps"
    )
    return [], [
        f"vehicles set off and stop with {check.median_m_per_s2:.2g} m/s2 (median of {check.vehicles}), where "
        f"{PLAUSIBLE_M_PER_S2[0]:g} to {PLAUSIBLE_M_PER_S2[1]:g} is expected: by "
        f"{given or 'the times of the video'} all speeds "
        f"are about {check.factor:.2g} times the true ones, unless the scale is wrong; {advice}"
    ]
