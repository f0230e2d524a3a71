"""One interface to videos and image folders: `probe` it, choose frames (`selection`), read them (`iter_frames`)."""

from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from schemas.arrays import IntArray
from schemas.flight import FramesConfig
from velfield.errors import InputError
from velfield.sources.capture_times import describe_rate
from velfield.sources.clips import CLIPS_SUFFIX, iter_clips, probe_clips, read_clip_list
from velfield.sources.folder import iter_folder, list_images, probe_folder
from velfield.sources.frames import SourceFrame, SourceInfo, local_path
from velfield.sources.images import describe_levels
from velfield.sources.quality import FrameFlag, is_black, is_duplicate
from velfield.sources.video.corruption import libav_log
from velfield.sources.video.decoding import iter_video, video_levels
from velfield.sources.video.packets import open_video, video_stream
from velfield.sources.video.probe import probe_video


def probe(path: Path | str, *, frames: FramesConfig, timestamps: Path | None = None) -> SourceInfo:
    """Facts of a video or an image folder: size, true times, names, defects. No frame is decoded.

    A source without times of its own needs ``frames.fps`` or ``timestamps``, a CSV ``frame,time_s`` of an image's file
    name or a video's 0-based frame index, and its time in s.

    Raises
    ------
    InputError
        The source cannot be read; no times, times that disagree, frames of several sizes, an image too large.
    """
    source = local_path(path, "video or image folder")
    if timestamps is not None:
        timestamps = local_path(timestamps, "time stamps file")
        if frames.fps is not None:
            raise InputError("--timestamps and --fps exclude each other; omit --fps")
    if source.is_dir():
        info = probe_folder(source, frames=frames, timestamps=timestamps)
        if frames.fps is None:
            return info
        return replace(info, warnings=info.warnings + describe_rate(source, info.names, frames.fps))
    if source.suffix == CLIPS_SUFFIX:
        return probe_clips(source, frames=frames, timestamps=timestamps)
    info = probe_video(source, frames=frames, timestamps=timestamps)
    levels = video_levels(source, info)
    note = () if levels is None else (describe_levels(levels),)
    return replace(info, levels=levels, warnings=info.warnings + note)


def check_source(path: Path | str) -> None:
    """Check quickly that a source exists, is of a known kind and not empty; `probe` checks more and takes longer.

    Raises
    ------
    InputError
        The source cannot be read.
    """
    source = local_path(path, "video or image folder")
    if source.is_dir():
        list_images(source)
        return
    for clip in read_clip_list(source) if source.suffix == CLIPS_SUFFIX else [source]:
        with libav_log(), open_video(clip) as container:
            video_stream(container, clip)


def iter_frames(
    path: Path | str,
    info: SourceInfo,
    indices: Sequence[int] | IntArray,
    *,
    after: int | None = None,
    then: Sequence[int] | IntArray = (),
) -> Generator[SourceFrame, None, None]:
    """Read frames, in order; one frame for each index, defective ones with flags.

    A video is decoded in sequence from the key frame before the first index (seeking to a frame number lands
    elsewhere); of a folder only the requested images are read. Indices into `info` ascend.

    Parameters
    ----------
    after
        The frame processed just before the first of `indices`, if any: it is read for comparison only, so
        that a flight cut into units flags the same frames as an uncut one.
    then
        Ascending indices behind them that later calls ask for: a decoder goes on from one call to the next. Then a
        call is read to its end, or closed, before the same thread begins the next one.

    Raises
    ------
    InputError
        The source is gone or was changed since `probe`, or its frames change size.
    """
    source = local_path(path, "video or image folder")
    requested = np.asarray(indices, np.int64)
    if requested.size == 0:
        return
    if requested[0] < 0 or requested[-1] >= info.frame_count or np.any(np.diff(requested) <= 0):
        raise ValueError(f"indices must ascend within 0 to {info.frame_count - 1}")
    read = requested if after is None else np.r_[np.int64(after), requested]
    previous: SourceFrame | None = None
    with closing(_read(source, info, read, np.asarray(then, np.int64))) as frames:
        for frame in frames:
            checked = _with_content_flags(frame, previous)
            if not checked.flags & FrameFlag.UNREADABLE:
                previous = checked
            if checked.source_index != after:
                yield checked


def _read(source: Path, info: SourceInfo, indices: IntArray, then: IntArray) -> Generator[SourceFrame, None, None]:
    if info.parts:
        return iter_clips(info, indices, then)
    return iter_video(source, info, indices, then) if info.kind == "video" else iter_folder(source, info, indices)


def _with_content_flags(frame: SourceFrame, previous: SourceFrame | None) -> SourceFrame:
    """Add the flags that follow from the pixels: black, or the same as the last readable frame."""
    if frame.flags & FrameFlag.UNREADABLE:
        return frame
    flags, reasons = frame.flags, [frame.reason] if frame.reason else []
    if is_black(frame.grey):
        flags |= FrameFlag.BLACK
        reasons.append("black, or without detail")
    if previous is not None and (frame.time_s <= previous.time_s or is_duplicate(frame.grey, previous.grey)):
        flags |= FrameFlag.DUPLICATE
        reasons.append("the same image as the frame before")
    return replace(frame, flags=int(flags), reason="; ".join(reasons))
