"""The two kinds of source behind one door: `probe` it, choose frames (`select_frames`), read them (`iter_frames`)."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.flight import FramesConfig
from velfield.errors import InputError
from velfield.sources.flags import FrameFlag
from velfield.sources.folder import iter_folder, list_pictures, probe_folder
from velfield.sources.frames import SourceFrame, SourceInfo
from velfield.sources.paths import local_path
from velfield.sources.quality import is_black, is_duplicate
from velfield.sources.selection import select_frames
from velfield.sources.video.container import open_video, video_stream
from velfield.sources.video.corruption import libav_log
from velfield.sources.video.decoding import iter_video
from velfield.sources.video.probe import probe_video

__all__ = ["SourceFrame", "SourceInfo", "check_source", "iter_frames", "probe", "select_frames"]


def probe(path: Path | str, *, frames: FramesConfig, timestamps: Path | None = None) -> SourceInfo:
    """Look at a video or a picture folder: size, true times, names, what is wrong with it. No frame is decoded.

    Parameters
    ----------
    path
        A video, or a folder of pictures, on this machine.
    frames
        ``fps`` for a source without times of its own, ``max_pixels``.
    timestamps
        CSV ``frame,time_s``: a picture's file name or a video's 0-based frame index, and its time in s.

    Raises
    ------
    InputError
        Nothing that can be read, no times, times that disagree, frames of several sizes, a picture too large.
    """
    place = local_path(path, "video or picture folder")
    if timestamps is not None:
        timestamps = local_path(timestamps, "time stamps file")
        if frames.fps is not None:
            raise InputError("found both --timestamps and --fps, expected one of them; leave --fps out")
    if place.is_dir():
        return probe_folder(place, frames=frames, timestamps=timestamps)
    return probe_video(place, frames=frames, timestamps=timestamps)


def check_source(path: Path | str) -> None:
    """A glance at the source: there, of a kind that we read, not empty. What `probe` finds beyond that takes longer.

    Raises
    ------
    InputError
        Nothing that can be read.
    """
    place = local_path(path, "video or picture folder")
    if place.is_dir():
        list_pictures(place)
        return
    with libav_log(), open_video(place) as container:
        video_stream(container, place)


def iter_frames(
    path: Path | str, info: SourceInfo, indices: Sequence[int] | NDArray[np.int64], *, after: int | None = None
) -> Iterator[SourceFrame]:
    """Read frames, in order; one frame for each index, whatever is wrong with it (its flags say).

    A video is decoded in sequence from the key frame before the first index (seeking to a frame number lands
    elsewhere); of a folder only the pictures asked for are read.

    Parameters
    ----------
    path, info
        The source and what `probe` said of it.
    indices
        Ascending indices into `info`.
    after
        The index worked on just before the first of `indices`, where there is one: it is read for comparison only, so
        that a flight cut into units flags the same frames as an uncut one.

    Raises
    ------
    InputError
        The source is gone or no longer what `probe` saw, or its frames change size.
    """
    place = local_path(path, "video or picture folder")
    wanted = np.asarray(indices, np.int64)
    if wanted.size == 0:
        return
    if wanted[0] < 0 or wanted[-1] >= info.frame_count or np.any(np.diff(wanted) <= 0):
        raise ValueError(f"indices must ascend within 0 to {info.frame_count - 1}")
    read = wanted if after is None else np.r_[np.int64(after), wanted]
    reader = iter_video if info.kind == "video" else iter_folder
    previous: SourceFrame | None = None
    for frame in reader(place, info, read):
        checked = _checked(frame, previous)
        if not checked.flags & FrameFlag.UNREADABLE:
            previous = checked
        if checked.source_index != after:
            yield checked


def _checked(frame: SourceFrame, previous: SourceFrame | None) -> SourceFrame:
    """Add what the picture itself tells: black, or the same as the last readable one."""
    if frame.flags & FrameFlag.UNREADABLE:
        return frame
    flags, reasons = frame.flags, [frame.reason] if frame.reason else []
    if is_black(frame.grey):
        flags |= FrameFlag.BLACK
        reasons.append("black, or without detail")
    if previous is not None and (frame.time_s <= previous.time_s or is_duplicate(frame.grey, previous.grey)):
        flags |= FrameFlag.DUPLICATE
        reasons.append(f"the same as frame {previous.name}")
    return replace(frame, flags=int(flags), reason="; ".join(reasons))
