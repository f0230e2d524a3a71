"""The size of a car in the base image, by what the detector that ships takes for cars, whatever else is known."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from schemas.scale import CAR_LENGTH_M, ScaleEstimate
from velfield.detection.interface import Detector
from velfield.detection.registry import shipped_detector
from velfield.detection.scale_search import REFINE_PX, STEP, View, Views, find_scale, is_plausible_scale, spread_windows
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import advance
from velfield.pipeline.stages.rectified_frames import WorkingGrid
from velfield.pipeline.stages.registration import spread_usable_frames
from velfield.run.frame_transforms import read_own_grid
from velfield.run.stores import FrameStore

_FRAMES = 3
_GSD_RANGE_M = 0.02, 0.6
"""Metres a base pixel at which cars are looked for."""
_MAX_PX = 4e7
_MAX_RATIO = 1.5
"""Maximum ratio of two scales that agree: cars a quarter larger or smaller are found."""
_SEARCH_SD = 0.06
"""Relative error of the search: 0.05, RMS of 52 searches in images of KIT AIS, minsk, songdo, a clip and simulated
cities against the lengths of the cars in them, and 0.03 of these against those of other places."""


def search_scale(plan: Plan, detector: Detector) -> float | None:
    """Working px a base px, by the detector that ships; None where it finds cars at no scale, or at several."""
    grid = read_own_grid(plan.layout)
    gsd_m = _GSD_RANGE_M[0] * STEP ** np.arange(np.log(_GSD_RANGE_M[1] / _GSD_RANGE_M[0]) / np.log(STEP))
    scales = detector.record.working_car_length_px / (CAR_LENGTH_M / gsd_m)
    scales = scales[scales**2 * grid.width_px * grid.height_px < _MAX_PX]
    return find_scale(_views(plan), detector, scales)


def contradict_metadata(plan: Plan, metadata: ScaleEstimate) -> ScaleEstimate | None:
    """The scale by what looks like a car, where the metadata's can not be; else None.

    Cars are looked for at the scale of the metadata first, and at all others only where few are found there: what the
    detector finds at one scale can not confirm another.
    """
    detector, grid = in_light_of_flight(plan, shipped_detector()), read_own_grid(plan.layout)
    car_px = float(detector.record.working_car_length_px)
    scale = car_px * metadata.gsd_m / CAR_LENGTH_M
    if scale**2 * grid.width_px * grid.height_px < _MAX_PX and is_plausible_scale(
        _views(plan)(scale, REFINE_PX), detector
    ):
        return None
    found = search_scale(plan, detector)
    if found is None or abs(np.log(found / scale)) <= np.log(_MAX_RATIO):
        return None
    gsd_m, factor = found * CAR_LENGTH_M / car_px, float(np.exp(1.645 * _SEARCH_SD))
    return ScaleEstimate(
        gsd_m=gsd_m,
        low_m=gsd_m / factor,
        high_m=gsd_m * factor,
        source="vehicles",
        note="at the scale of the metadata nothing looks like a car",
    )


def in_light_of_flight(plan: Plan, detector: Detector) -> Detector:
    """The detector, adjusted to how bright the flight's frames are."""
    store = FrameStore(plan.layout.frames)
    return detector.in_light_of([store.read(frame) for frame in spread_usable_frames(plan, _FRAMES)])


def _views(plan: Plan) -> Views:
    """Windows that are spread over the base image, in turn of some frames."""
    chosen = spread_usable_frames(plan, _FRAMES)
    opened = WorkingGrid.open(plan, 1.0)

    def views(scale: float, area_px: int) -> Iterator[View]:
        working, grid = replace(opened, scale=scale), opened.grid
        windows = spread_windows(grid.width_px, grid.height_px, area_px / scale**2)
        frames = int(np.clip(area_px // (grid.width_px * grid.height_px * scale**2), 1, _FRAMES))
        count = len(windows) if len(windows) > 1 else frames
        for k in range(count if len(chosen) else 0):
            rectified = working.frame(chosen[k % len(chosen)], windows[k % len(windows)])
            if rectified is not None:
                yield rectified.image, rectified.valid
        advance("detector", 0)

    return views
