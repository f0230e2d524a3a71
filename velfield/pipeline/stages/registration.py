"""Stage ``registration``: every frame of a unit to the base image and to the frame before it, in chains."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Mask
from velfield.pipeline.plan import Plan
from velfield.pipeline.progress import advance
from velfield.pipeline.result import StageResult
from velfield.pipeline.stages.base_image import FrameKeypoints, base_reference
from velfield.registration.intrasensor import FrameRegistration, register_chain
from velfield.registration.keypoints import Keypoints
from velfield.registration.transforms import vector_length
from velfield.run.frame_transforms import read_lens
from velfield.run.stores import (
    ERROR_CELLS,
    REGISTRATION_COLUMNS,
    FrameStore,
    create_registration,
    open_frames,
    open_registration,
    store_key,
)
from velfield.sources.flags import UNUSABLE, describe_flags

MAP_PARAMETERS = 65
"""Approximate number of parameters of a frame's map: its standard error is residual * sqrt(parameters / points)."""


def create_registration_store(plan: Plan) -> None:
    """Create ``registration.zarr`` unless there is one of this plan's key."""
    path = plan.layout.registration
    if store_key(path) == plan.keys["registration"]:
        return
    length = vector_length(plan.info.width, plan.info.height, plan.config.registration)
    create_registration(
        path,
        key=plan.keys["registration"],
        count=plan.frame_count,
        vector_length=length,
        unit_frames=plan.unit_frames,
    )


def register_unit(plan: Plan, frames: range, blocks: Sequence[Sequence[FrameKeypoints]]) -> StageResult:
    """Chain a unit's frames in chains of ``chain_length_frames``, each started from the base image."""
    keypoints = {found.frame: found.keypoints for block in blocks for found in block}
    store = open_frames(plan.layout.frames)
    flags = store.column("flags")
    reference, lens, config = base_reference(plan), read_lens(plan.layout), plan.config.registration
    results: dict[int, FrameRegistration] = {}
    for start in range(frames.start, frames.stop, config.chain_length_frames):
        chain = range(start, min(start + config.chain_length_frames, frames.stop))
        usable = [frame for frame in chain if not flags[frame] & int(UNUSABLE)]
        found = register_chain(_read(store, usable, keypoints), reference, lens, config)
        results.update(zip(usable, found, strict=True))
        advance("registration", len(chain))
    return _write(plan, frames, flags, results)


def _read(
    store: FrameStore, frames: Sequence[int], keypoints: dict[int, Keypoints]
) -> Iterator[tuple[int, NDArray[np.uint8], Keypoints]]:
    for frame in frames:
        yield frame, store.read(frame), keypoints[frame]


def _write(plan: Plan, frames: range, flags: NDArray[np.uint16], results: dict[int, FrameRegistration]) -> StageResult:
    config = plan.config.registration
    length = vector_length(plan.info.width, plan.info.height, config)
    vectors = np.full((len(frames), length), np.nan)
    columns = {
        name: np.full(len(frames), np.nan if dtype.startswith("float") else 0, dtype)
        for name, dtype in REGISTRATION_COLUMNS.items()
    }
    errors = np.full((len(frames), *ERROR_CELLS), np.nan, np.float32)
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
        if result.error_map is not None:
            errors[k] = result.error_map
    store = open_registration(plan.layout.registration, "r+")
    store.write(frames.start, vectors, statuses, {**columns, "error_px": errors})
    registered = statuses.count("ok")
    counts = {"frames": float(len(frames)), "registered": float(registered)}
    if registered:
        counts["heldout_px"] = float(np.nanmean(columns["heldout_px"]))
    return StageResult(store.files(frames.start), counts)


def usable_frames(plan: Plan) -> Mask:
    """Frames (frames,) that are registered and have no fault."""
    flags = open_frames(plan.layout.frames).column("flags")
    statuses = open_registration(plan.layout.registration).statuses()
    registered = np.array([status == "ok" for status in statuses], np.bool_)
    return np.asarray(registered & ((flags & int(UNUSABLE)) == 0), np.bool_)


def lost_frames(plan: Plan) -> tuple[str, ...]:
    """Frames that are not registered, with the reason, one line each."""
    times_s = open_frames(plan.layout.frames).column("time_s")
    statuses = open_registration(plan.layout.registration).statuses()
    return tuple(
        f"frame {frame} ({times_s[frame]:.3f} s): {status or 'not processed'}"
        for frame, status in enumerate(statuses)
        if status != "ok"
    )
