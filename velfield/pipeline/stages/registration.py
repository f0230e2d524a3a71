"""Stage ``registration``: every frame of a unit to the base image and to the frame before it, in chains."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from functools import lru_cache, partial
from math import sqrt
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage, Mask
from velfield.camera.tilt import FOCAL_HALF_DIAGONALS, MIN_TURN
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.registration.alignment import Templates
from velfield.registration.frame_fit import BaseReference, FrameRegistration
from velfield.registration.intrasensor import register_chain
from velfield.registration.keypoints import Keypoints, detect_keypoints
from velfield.registration.transforms import FrameTransform, vector_length
from velfield.run.frame_transforms import read_grid, read_lens
from velfield.run.stores import (
    ERROR_CELLS,
    POSITION_SD_CELLS,
    REGISTRATION_COLUMNS,
    FrameStore,
    RegistrationStore,
    create_registration,
    fill_value,
    is_cut_as,
)
from velfield.run.tables import read_arrays, write_arrays
from velfield.sources.geo import BaseRaster, read_base_raster
from velfield.sources.labels.labels import read_detections
from velfield.sources.quality import UNUSABLE, describe_flags

MAP_PARAMETERS = 65
"""Approximate number of parameters of a frame's map: its standard error is residual * sqrt(parameters / points)."""
MAX_SCALE_CHANGE = 1.15
"""Change of a frame's scale that is reported; a drone that holds its height changes by 2 %."""
_LARGE_PX = 5e6
"""A larger image is reduced to this before SIFT, which takes 240 bytes a pixel that it sees: 0.5 GB of half of 4K."""
_FEATURES: dict[str, Any] = {"keypoints": Keypoints, "templates": Templates, "dense_templates": Templates}
_REFERENCE_LOCK = Lock()
_references: dict[tuple[str, str], BaseReference] = {}
_BOXES: dict[str, pd.DataFrame] = {}


def create_registration_store(plan: Plan) -> None:
    """Create ``registration.zarr`` unless there is one of this plan's key, cut into its units."""
    path = plan.layout.registration
    if is_cut_as(path, plan.keys["registration"], plan.unit_frames):
        return
    height, width = plan.frame_shape
    length = vector_length(width, height, plan.config.registration)
    create_registration(
        path,
        key=plan.keys["registration"],
        count=plan.frame_count,
        vector_length=length,
        unit_frames=plan.unit_frames,
    )


def register_unit(plan: Plan, frames: range) -> StageResult:
    """Chain a unit's frames in chains of ``chain_length_frames``, each started from the base image."""
    store = FrameStore(plan.layout.frames)
    flags = store.column("flags")
    reference, lens, config = base_reference(plan), read_lens(plan.layout), plan.config.registration
    results: dict[int, FrameRegistration] = {}
    for start in range(frames.start, frames.stop, config.chain_length_frames):
        chain = range(start, min(start + config.chain_length_frames, frames.stop))
        usable = [frame for frame in chain if not flags[frame] & int(UNUSABLE)]
        found = register_chain(_read(plan, store, usable), reference, lens, config)
        results.update(zip(usable, found, strict=True))
        advance("registration", len(chain))
    return _write(plan, frames, flags, results)


def _read(
    plan: Plan, store: FrameStore, frames: Sequence[int]
) -> Iterator[tuple[int, NDArray[np.uint8], Callable[[], Keypoints]]]:
    for frame in frames:
        grey = store.read(frame)
        yield frame, grey, lru_cache(maxsize=1)(partial(_detect_keypoints, plan, frame, grey))


def _detect_keypoints(plan: Plan, frame: int, grey: GreyImage) -> Keypoints:
    config = plan.config.registration
    scale = config.keypoint_scale * min(1.0, sqrt(_LARGE_PX / grey.size))
    config = config.model_copy(update={"keypoint_scale": scale})
    return detect_keypoints(grey, config, vehicle_free_mask(plan, frame, grey.shape))


def _write(plan: Plan, frames: range, flags: NDArray[np.uint16], results: dict[int, FrameRegistration]) -> StageResult:
    config = plan.config.registration
    height, width = plan.frame_shape
    length = vector_length(width, height, config)
    vectors = np.full((len(frames), length), np.nan)
    columns = {name: np.full(len(frames), fill_value(dtype), dtype) for name, dtype in REGISTRATION_COLUMNS.items()}
    cells = {"error_px": ERROR_CELLS, "position_sd_px": POSITION_SD_CELLS}
    by_cell = {name: np.full((len(frames), *shape), np.nan, np.float32) for name, shape in cells.items()}
    statuses = []
    for k, frame in enumerate(frames):
        result = results.get(frame)
        if result is None:
            statuses.append(f"skipped:{describe_flags(int(flags[frame]))}")
            continue
        statuses.append(result.status)
        if result.transform is not None:
            vectors[k] = result.transform.to_vector(config)
        for name in columns:
            columns[name][k] = getattr(result, name)
        for name, values in (("error_px", result.error_map), ("position_sd_px", result.position_sd_px)):
            if values is not None:
                by_cell[name][k] = values
    store = RegistrationStore(plan.layout.registration, "r+")
    store.write(frames.start, vectors, statuses, {**columns, **by_cell})
    registered = statuses.count("ok")
    counts = {"frames": float(len(frames)), "registered": float(registered)}
    if registered:
        counts["heldout_px"] = float(np.nanmean(columns["heldout_px"]))
    return StageResult(store.files(frames.start), counts, warnings=_view_warnings(plan, results))


def _view_warnings(plan: Plan, results: dict[int, FrameRegistration]) -> list[str]:
    """Whether within a unit the camera zoomed, climbed by much, or turned towards the horizon."""
    transforms = {frame: result.transform for frame, result in results.items() if result.transform is not None}
    if not transforms:
        return []
    scales = np.array([transform.scale_and_rotation()[0] for transform in transforms.values()])
    convergences = np.array([ground_convergence(transform) for transform in transforms.values()])
    usual, straight = 1.0, np.zeros(2)  # the flight's own base image is as the camera looked
    if read_grid(plan.layout).registered_to == "given":
        usual, straight = float(np.median(scales)), np.median(convergences, axis=0)
    frames = list(transforms)
    return [*_scale_warnings(frames, scales / usual), *_turn_warnings(frames, convergences - straight)]


def _scale_warnings(frames: list[int], scales: FloatArray) -> list[str]:
    """Frames (n,) by their scale (n,) relative to the usual one: the lens was calibrated at one focal length."""
    odd = np.flatnonzero(np.abs(np.log(scales)) > np.log(MAX_SCALE_CHANGE))
    if not len(odd):
        return []
    most = odd[np.argmax(np.abs(np.log(scales[odd])))]
    return [
        f"frames {frames[odd[0]]} to {frames[odd[-1]]} show the ground at up to {1 / scales[most]:.2f} times the usual "
        "scale: the camera zoomed or changed its height, and the lens, calibrated for the whole flight, may not fit "
        "there"
    ]


def _turn_warnings(frames: list[int], convergences: FloatArray) -> list[str]:
    """Frames (n,) by the convergence (n, 2) of the ground in them, relative to the usual one."""
    size = np.hypot(*convergences.T)
    odd = np.flatnonzero(size > MIN_TURN)
    if not len(odd):
        return []
    degrees = float(np.degrees(np.arctan(FOCAL_HALF_DIAGONALS * size.max())))
    return [
        f"frames {frames[odd[0]]} to {frames[odd[-1]]} look at the ground at up to {degrees:.0f} degrees from the "
        "base image's view, 20 at most expected: the camera turned to or from the horizon in mid-flight; leave the "
        "part that looks far away out, with --start-s and --stop-s"
    ]


def ground_convergence(transform: FrameTransform) -> FloatArray:
    """Convergence (2,) of a frame's view of the base image, 1 / half-diagonal: its horizon is at convergence @ x = -1.

    Under a homography the area that a pixel covers grows as the third power of a linear function's inverse.
    """
    width, height = transform.width, transform.height
    x, y = np.meshgrid(np.linspace(0.1, 0.9, 9) * (width - 1), np.linspace(0.1, 0.9, 7) * (height - 1))
    raw = np.column_stack([x.ravel(), y.ravel()])
    with np.errstate(invalid="ignore", divide="ignore"):
        linear = 1.0 / np.cbrt(np.abs(np.linalg.det(transform.jacobian(raw))))
    good = np.isfinite(linear)
    offset = (raw - transform.centre) / (0.5 * np.hypot(width, height))
    level, *slope = np.linalg.lstsq(np.column_stack([np.ones(len(raw)), offset])[good], linear[good], rcond=None)[0]
    return np.asarray(np.array(slope) / level, np.float64)


def usable_frames(plan: Plan) -> Mask:
    """Frames (frames,) that are registered and have no fault."""
    flags = FrameStore(plan.layout.frames).column("flags")
    statuses = RegistrationStore(plan.layout.registration).statuses()
    registered = np.array([status == "ok" for status in statuses], np.bool_)
    return np.asarray(registered & ((flags & int(UNUSABLE)) == 0), np.bool_)


def spread_usable_frames(plan: Plan, count: int) -> list[int]:
    """At most ``count`` of them, spread over the flight."""
    usable = np.flatnonzero(usable_frames(plan))
    return usable[np.unique(np.linspace(0, max(len(usable) - 1, 0), count).astype(int))].tolist() if len(usable) else []


def detect_frame_keypoints(plan: Plan, frame: int) -> Keypoints:
    """Detect the keypoints of a frame, raw px, outside the vehicles of the given boxes."""
    return _detect_keypoints(plan, frame, FrameStore(plan.layout.frames).read(frame))


def external_boxes(plan: Plan) -> pd.DataFrame:
    """The boxes of the whole flight, read once a process."""
    key = f"{plan.job.inputs.source} {plan.inputs.detections}"
    if key not in _BOXES:
        _BOXES.clear()
        _BOXES[key] = read_detections(Path(str(plan.job.inputs.detections)), plan.info)
    return _BOXES[key]


def vehicle_free_mask(plan: Plan, frame: int, shape: tuple[int, int]) -> Mask | None:
    """Mask of a raw frame (h, w), true outside the given vehicle boxes: key points are detected there only.

    None without given boxes. Boxes without a size mask nothing; key points on these vehicles are outliers of the fit.
    """
    if plan.job.inputs.detections is None:
        return None
    table = external_boxes(plan)
    sized = table[table["source_index"] == plan.indices[frame]].dropna(subset=["length_px", "width_px"])
    degrees = np.degrees(sized["orientation_rad"].fillna(sized["abs_box_angle_rad"]).fillna(0.0))
    boxes = np.column_stack([sized[["x_px", "y_px", "length_px", "width_px"]], degrees])
    mirrored = boxes[sized["orientation_rad"].isna()] * [1, 1, 1, 1, -1]  # an upright box leaves the sign open
    free = np.ones(shape, np.uint8)
    for x, y, length, width, angle in np.concatenate([boxes, mirrored]):
        corners = cv2.boxPoints(((x, y), (length, width), angle))
        cv2.fillPoly(free, [np.rint(corners).astype(np.int32)], (0,))
    return free.astype(np.bool_)


def base_reference(plan: Plan) -> BaseReference:
    """The features of the base image; the last ones are cached, because all units of a run use the same."""
    with _REFERENCE_LOCK:
        key = (str(plan.layout.root), plan.keys["base"])
        if key not in _references:
            _references.clear()
            _references[key] = _read_reference(plan)
        return _references[key]


def write_reference(plan: Plan, reference: BaseReference) -> Path:
    """Write the features of the base image; returns the file."""
    arrays: dict[str, NDArray[np.generic]] = {"shape": np.array(reference.shape)}
    for name in _FEATURES:
        arrays |= {f"{name}.{key}": array for key, array in vars(getattr(reference, name)).items()}
    write_arrays(plan.layout.base_features, arrays)
    return plan.layout.base_features


def _read_reference(plan: Plan) -> BaseReference:
    arrays = read_arrays(plan.layout.base_features)
    features = {
        name: kind(**{one.name: arrays[f"{name}.{one.name}"] for one in fields(kind)})
        for name, kind in _FEATURES.items()
    }
    height, width = arrays["shape"].tolist()
    keypoints = features.pop("keypoints")
    return BaseReference((height, width), **features, detect=lambda: keypoints)


def read_given_base(plan: Plan) -> BaseRaster | None:
    path = plan.job.inputs.base
    return read_base_raster(Path(path), plan.config.frames) if path else None
