"""Stage ``scale``: the scale once more, with the lengths of the vehicles that were tracked.

Stages before this one work with what `velfield.pipeline.stages.georeference` found, or, where nothing gives the scale,
with the size of the cars that the detector was trained on. Here the measured lengths of all vehicles give an estimate
with an interval. It is used where there is no other, and else compared with the one that is used.
"""

import numpy as np

from schemas.georeference import GeoreferenceRecord
from schemas.scale import ScaleEstimate
from schemas.tables import DIMENSION_COLUMNS
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


def scale_run(plan: Plan) -> StageResult:
    """Write ``base/scale.json``; and the base image as GeoTIFF where its place became known here."""
    layout, before = plan.layout, read_first_georeference(plan.layout) or GeoreferenceRecord()
    measured, vehicles = scale_of_tracks(layout)
    record, _ = compare_sources(plan, read_own_grid(layout), measured)
    outputs = write_georeference(layout, layout.scale, record, plan.config.frames)
    advance("scale")
    counts = {**georeference_counts(record), "vehicles": float(vehicles)}
    if measured is not None:
        counts["vehicle_gsd_m"] = measured.gsd_m
    known = [*describe(before), *georeference_warnings(before)]
    notes = [line for line in describe(record) if line not in known]
    warnings = [line for line in georeference_warnings(record) if line not in known]
    return StageResult(outputs, counts, notes, [*warnings, *_other_limits(plan, record)])


def scale_of_tracks(layout: RunLayout) -> tuple[ScaleEstimate | None, int]:
    """The scale by the measured lengths of a run's vehicles, None of too few; and their number."""
    if not layout.dimensions.exists():
        return None, 0
    lengths = read_tables([layout.dimensions], DIMENSION_COLUMNS, only=["length_px", "length_sd_px"])
    length, sd = (lengths[name].to_numpy(np.float64) for name in lengths)
    return estimate_track_scale(length, sd), int(np.isfinite(length).sum())


def _other_limits(plan: Plan, record: GeoreferenceRecord) -> list[str]:
    """A warning where the scale that vehicles were tracked with was far from the one that is used."""
    tracked, used = read_tracking_gsd(plan.layout), record.scale.used
    if used is None or tracked is None or abs(np.log(used.gsd_m / tracked)) <= np.log1p(_OTHER_LIMITS):
        return []
    return [
        f"vehicles were tracked with limits for {tracked:.3g} m a pixel, as {used.gsd_m:.3g} was not known yet; run "
        f"the flight again with --gsd-m {used.gsd_m:.3g}"
    ]
