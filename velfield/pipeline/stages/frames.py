"""Frames of the source, decoded into ``frames.zarr``, with their timestamps and defects.

Frames unlike their neighbours: blurred ones, and ones that do not belong to the flight.

Both are defined by the frames around them, so they are detected over the whole flight at once: the result is the same
however the flight is cut into units. Frames with another defect are neither tested nor anybody's neighbours.
"""

from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import GreyImage, IntArray
from velfield.errors import InputError
from velfield.parallel import for_each_behind
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.run.stores import THUMBNAIL_SHAPE, FrameStore, create_frames, is_cut_as
from velfield.sources.frame_measures import frame_quality
from velfield.sources.frames import SourceFrame
from velfield.sources.quality import (
    UNUSABLE,
    FrameFlag,
    describe_flags,
    describe_light,
    find_cuts,
    flag_blurred,
    flag_outlier_frames,
)
from velfield.sources.source import iter_frames

_OVERLAP = 5
_CHUNK = 4096
"""Thumbnails in memory at a time."""

_FEWEST_USABLE = 3
"""Frames of a tracklet."""


def flag_frames(plan: Plan) -> StageResult:
    """Write the column ``flags`` of ``frames.zarr``: defects from decoding, and frames unlike their neighbours.

    Raises
    ------
    InputError
        Fewer than three frames are without a fault.
    """
    store = FrameStore(plan.layout.frames, "r+")
    flags = store.column("decoding_flags")
    tested = np.flatnonzero((flags & int(UNUSABLE)) == 0)
    blurred = tested[flag_blurred(store.column("sharpness")[tested])]
    outliers = tested[_find_outliers(store, tested)]
    flags[blurred] |= int(FrameFlag.BLURRED)
    flags[outliers] |= int(FrameFlag.OUTLIER)
    times_s = store.column("time_s")
    warnings = [f"frame {k} ({times_s[k]:.3f} s) is blurred: it is left out" for k in blurred]
    warnings += [f"frame {k} ({times_s[k]:.3f} s) is unlike the frames around it: it is left out" for k in outliers]
    warnings += _describe_footage(store, np.flatnonzero((flags & int(UNUSABLE)) == 0))
    usable = int(np.sum((flags & int(UNUSABLE)) == 0))
    if usable < _FEWEST_USABLE:
        kinds = {flag: int(np.sum((flags & int(flag)) > 0)) for flag in UNUSABLE}
        listed = ", ".join(f"{count} {describe_flags(int(flag))}" for flag, count in kinds.items() if count)
        raise InputError(
            f"{plan.job.inputs.source}: found {usable} frames without a fault of {len(flags)} "
            f"({listed}), expected {_FEWEST_USABLE} or more; "
            "copy the recording from the camera again, or give another part of it with --start-s and --stop-s"
        )
    advance("quality")
    counts = {"usable": usable, "flagged": len(flags) - usable, "blurred": len(blurred), "outliers": len(outliers)}
    return StageResult([store.write_flags(flags)], {name: float(count) for name, count in counts.items()}, [], warnings)


def _describe_footage(store: FrameStore, usable: IntArray) -> list[str]:
    """Cuts, and what the light makes uncertain, one line each."""
    times_s, contrast, found = store.column("time_s"), [], []
    for start in range(0, len(usable), _CHUNK):
        frames = usable[max(start - _OVERLAP, 0) : start + _CHUNK]
        thumbnails = store.thumbnails(int(frames[0]), int(frames[-1]) + 1)[frames - frames[0]]
        contrast.append(thumbnails.reshape(len(frames), -1).std(axis=1))
        for k in find_cuts(thumbnails):
            found.append(
                f"the picture changes completely at frame {frames[k]} ({times_s[frames[k]]:.3f} s), as at a cut "
                "to another place: only frames of one place are registered; run each place separately, with "
                "--start-s and --stop-s"
            )
    light = describe_light(
        store.column("brightness")[usable],
        np.concatenate(contrast) if contrast else np.empty(0),
        store.column("sharpness")[usable],
    )
    return list(dict.fromkeys(found)) + light


def _find_outliers(store: FrameStore, tested: IntArray) -> IntArray:
    """Indices, among the tested frames, of those that are unlike the one before and the one after."""
    found = [np.empty(0, np.int64)]
    for start in range(0, len(tested), _CHUNK):
        first = max(start - 1, 0)
        frames = tested[first : start + _CHUNK + 1]
        thumbnails = store.thumbnails(int(frames[0]), int(frames[-1]) + 1)[frames - frames[0]]
        outliers = first + np.flatnonzero(flag_outlier_frames(thumbnails))
        found.append(outliers[(outliers >= start) & (outliers < start + _CHUNK)])
    return np.concatenate(found)


def create_frame_store(plan: Plan) -> None:
    """Create ``frames.zarr`` unless it exists under this plan's key and cut into its units."""
    path = plan.layout.frames
    if is_cut_as(path, plan.keys["frames"], plan.unit_frames):
        return
    height, width = plan.frame_shape
    create_frames(
        path,
        key=plan.keys["frames"],
        count=plan.frame_count,
        height=height,
        width=width,
        unit_frames=plan.unit_frames,
        source=plan.inputs.source.model_dump(),
    )


def read_unit(plan: Plan, frames: range) -> StageResult:
    """Decode a unit of frames and write them, one chunk each; an unreadable frame is black and flagged.

    A unit of which no frame is readable is written like any other: `flag_frames` judges the recording as a whole.
    """
    store = FrameStore(plan.layout.frames, "r+")
    indices = plan.indices[frames.start : frames.stop]
    before = int(plan.indices[frames.start - 1]) if frames.start else None
    flags = np.zeros(len(frames), np.uint16)
    sharpness, brightness = np.full(len(frames), np.nan, np.float32), np.full(len(frames), np.nan, np.float32)
    thumbnails = np.zeros((len(frames), *THUMBNAIL_SHAPE), np.float32)
    warnings = []

    def keep(numbered: tuple[int, SourceFrame]) -> None:
        k, found = numbered
        grey = found.grey if plan.reduction == 1 else _reduce(found.grey, plan.frame_shape)
        store.write(frames[k], grey)
        flags[k] = found.flags
        if found.reason:
            warnings.append(f"frame {frames[k]} ({found.time_s:.3f} s, source frame {found.name}): {found.reason}")
        if not found.flags & FrameFlag.UNREADABLE:
            quality = frame_quality(grey)
            sharpness[k], brightness[k], thumbnails[k] = quality.sharpness, quality.brightness, quality.thumbnail
        advance("frames")

    source, then = Path(plan.job.inputs.source), plan.indices[frames.stop :]
    with closing(iter_frames(source, plan.info, indices, after=before, then=then)) as read:
        for_each_behind(keep, enumerate(read))
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


def _reduce(grey: GreyImage, shape: tuple[int, int]) -> GreyImage:
    return np.asarray(cv2.resize(grey, shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)
