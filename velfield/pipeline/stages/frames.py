"""Frames of the source, decoded into ``frames.zarr``, with their timestamps and defects."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from velfield.errors import InputError
from velfield.pipeline.plan import Plan
from velfield.pipeline.progress import advance
from velfield.pipeline.result import StageResult
from velfield.run.stores import THUMBNAIL_SHAPE, create_frames, open_frames, store_key
from velfield.sources.flags import UNUSABLE, FrameFlag
from velfield.sources.quality import frame_quality
from velfield.sources.source import iter_frames


def create_frame_store(plan: Plan) -> None:
    """Create ``frames.zarr`` unless it exists under this plan's key."""
    path = plan.layout.frames
    if store_key(path) == plan.keys["frames"]:
        return
    create_frames(
        path,
        key=plan.keys["frames"],
        count=plan.frame_count,
        height=plan.info.height,
        width=plan.info.width,
        unit_frames=plan.unit_frames,
        source=plan.inputs.source.model_dump(),
    )


def read_unit(plan: Plan, frames: range) -> StageResult:
    """Decode a unit of frames and write them, one chunk each; an unreadable frame is black and flagged.

    Raises
    ------
    InputError
        None of the unit's frames could be read.
    """
    store = open_frames(plan.layout.frames, "r+")
    indices = plan.indices[frames.start : frames.stop]
    before = int(plan.indices[frames.start - 1]) if frames.start else None
    flags = np.zeros(len(frames), np.uint16)
    sharpness, brightness = np.full(len(frames), np.nan, np.float32), np.full(len(frames), np.nan, np.float32)
    thumbnails = np.zeros((len(frames), *THUMBNAIL_SHAPE), np.float32)
    warnings = []
    source = Path(plan.job.inputs.source)
    for k, found in enumerate(iter_frames(source, plan.info, indices, after=before)):
        store.write(frames[k], found.grey)
        flags[k] = found.flags
        if found.reason:
            warnings.append(f"frame {frames[k]}: {found.reason}")
        if not found.flags & FrameFlag.UNREADABLE:
            quality = frame_quality(found.grey)
            sharpness[k], brightness[k], thumbnails[k] = quality.sharpness, quality.brightness, quality.thumbnail
        advance("frames")
    if np.all(flags & FrameFlag.UNREADABLE):
        raise InputError(
            f"{source}: none of the frames {indices[0]} to {indices[-1]} could be read; is the file whole?"
        )
    times_s = plan.info.times_s[indices]
    columns: dict[str, NDArray[Any]] = {
        "time_s": times_s,
        "source_index": indices,
        "decoding_flags": flags,
        "sharpness": sharpness,
        "brightness": brightness,
        "thumbnail": thumbnails,
    }
    store.write_columns(frames.start, columns)
    usable = int(np.sum((flags & int(UNUSABLE)) == 0))
    return StageResult(
        store.files(frames.start, frames.stop), {"frames": len(frames), "usable": usable}, warnings=warnings
    )
