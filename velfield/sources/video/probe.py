"""Probe a video: its frames and the container's own times, without decoding.

A frame's identity is (file, presentation time stamp). Frame numbers and frame / fps are never used to find a frame:
that loses start offsets, and is wrong in files of variable frame rate.
"""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import av
import numpy as np

from schemas.arrays import FloatArray, IntArray
from schemas.flight import FramesConfig
from velfield.errors import InputError, count_text
from velfield.sources.frames import FootageLoss, SourceInfo
from velfield.sources.images import check_size
from velfield.sources.timestamps import check_against_container, read_timestamps
from velfield.sources.video.corruption import libav_log
from velfield.sources.video.packets import closed_key_frames, demux, drop_timestamp_outliers, open_video, video_stream


def probe_video(path: Path, *, frames: FramesConfig, timestamps: Path | None) -> SourceInfo:
    """Facts of a video (`velfield.sources.source.probe`). Reads the file once without decoding."""
    with libav_log(), ExitStack() as stack:
        container = stack.enter_context(open_video(path))
        stream = video_stream(container, path)
        width, height = int(stream.codec_context.width), int(stream.codec_context.height)
        if width <= 0 or height <= 0:
            raise InputError(
                f"{path.name}: found no frame size in the video stream, expected one; the file is damaged or truncated"
            )
        check_size(path, width, height, frames.max_pixels)
        declared = int(stream.frames) or None
        declared_s = _declared_seconds(container, stream)
        time_base = stream.time_base
        repeats = container.format.name == "avi"
        warnings = _stream_warnings(stream)
        packets = demux(container, stream, path)
    warnings += _picture_warnings(path, frames.max_pixels)
    if packets.pts.size == 0:
        raise InputError(
            f"{path.name}: found no frames in the video stream, expected at least one; the file is damaged or truncated"
        )
    packets, dropped = drop_timestamp_outliers(path, packets, time_base)
    order = np.argsort(packets.pts, kind="stable")
    trusted = packets.stamps == "pts"
    container_s = None
    if packets.stamps != "none":
        container_s = packets.pts[order] * time_base.numerator / time_base.denominator
    times_s, time_notes = _times(path, container_s, packets.pts.size, frames, timestamps)
    warnings += packets.notes + dropped + time_notes
    if repeats and packets.stamps != "none" and _counts_as_declared(packets.pts[order], declared):
        declared = times_s.size
    warnings += _truncation_warning(times_s, declared, declared_s if container_s is not None else None)
    return SourceInfo(
        kind="video",
        width=width,
        height=height,
        frame_count=times_s.size,
        times_s=times_s,
        names=tuple(str(index) for index in range(times_s.size)),
        warnings=warnings,
        declared_count=declared,
        pts=packets.pts[order] if trusted else np.zeros(0, np.int64),
        key_frames=packets.key[order] if trusted else np.zeros(0, np.bool_),
        entries=closed_key_frames(packets)[order] if trusted else np.zeros(0, np.bool_),
        fps=frames.fps if container_s is None and timestamps is None else None,
        max_pixels=frames.max_pixels,
    )


def _times(
    path: Path, container_s: FloatArray | None, count: int, frames: FramesConfig, timestamps: Path | None
) -> tuple[FloatArray, tuple[str, ...]]:
    """The frame times: the CSV's where it agrees, else the container's, else index / fps if --fps is given."""
    if timestamps is not None:
        return _times_from_csv(path, container_s, count, timestamps)
    if container_s is not None:
        notes: tuple[str, ...] = ("--fps is not used: the video has times of its own",) if frames.fps else ()
        equal = int(np.count_nonzero(np.diff(container_s) == 0))
        if equal:
            notes += (FootageLoss(f"{equal} frames have the time of the frame before and are dropped"),)
        return container_s, notes
    if frames.fps is None:
        raise InputError(
            f"{path.name}: found a video without times, expected them in the container; give --timestamps or --fps"
        )
    return np.arange(count) / frames.fps, ()


def _times_from_csv(
    path: Path, container_s: FloatArray | None, count: int, timestamps: Path
) -> tuple[FloatArray, tuple[str, ...]]:
    given = read_timestamps(timestamps)
    missing = [index for index in range(count) if str(index) not in given]
    if missing:
        raise InputError(
            f"{timestamps.name}: found no time for {len(missing)} of {count} frames of {path.name} (first: "
            f"{missing[0]}), expected the 0-based frame index as `frame`; add them"
        )
    times_s = np.array([given[str(index)] for index in range(count)])
    if container_s is not None:
        check_against_container(times_s, container_s, timestamps)
    if np.any(np.diff(times_s) < 0):
        index = int(np.argmax(np.diff(times_s) < 0)) + 1
        raise InputError(
            f"{timestamps.name}: found frame {index} before frame {index - 1}, expected ascending times; fix it"
        )
    extra = len(given) - count
    return times_s, (f"{timestamps.name} has {extra} times for frames that are not in the video",) if extra else ()


def _declared_seconds(container: Any, stream: Any) -> float | None:
    if stream.duration is not None and stream.time_base is not None:
        return float(stream.duration * stream.time_base)
    return None if container.duration is None else float(container.duration / av.time_base)


def _stream_warnings(stream: Any) -> tuple[str, ...]:
    aspect = stream.sample_aspect_ratio
    if aspect is not None and aspect not in (0, 1):
        return (f"pixels are {aspect} as wide as high: coordinates are pixels as stored",)
    return ()


_HDR = {16: "PQ", 18: "HLG"}
"""Transfer functions (ITU-T H.273) of high dynamic range."""


def _picture_warnings(path: Path, max_pixels: int) -> tuple[str, ...]:
    """Properties of the recording, by its first frame, that would make a wrong map, or a poor one."""
    found: list[str] = []
    with libav_log(), ExitStack() as stack:
        container = stack.enter_context(open_video(path))
        stream = video_stream(container, path)
        stream.codec_context.options = {"max_pixels": str(max_pixels)}
        try:
            picture = next(iter(container.decode(stream)), None)
        except (av.error.FFmpegError, ValueError):
            return ()  # a damaged start is told where frames are read
        if picture is None:
            return ()
        if picture.interlaced_frame:
            found.append(
                "the video is interlaced, and moving vehicles look like combs; "
                "deinterlace it first (`ffmpeg -i IN -vf bwdif OUT`)"
            )
        if int(picture.color_trc) in _HDR:
            found.append(
                f"the video is of high dynamic range ({_HDR[int(picture.color_trc)]}): its grey levels have "
                "less contrast than the detector expects; convert it to BT.709 first"
            )
        if picture.rotation % 360:
            found.append(
                f"the file's pictures are rotated by {picture.rotation % 360} degrees for display; velfield uses "
                "them as stored, and expects labels and detections in stored pixels"
            )
    return tuple(found)


def _counts_as_declared(pts: IntArray, declared: int | None) -> bool:
    """Whether an AVI's frames, of which its time stamps are the numbers, reach to the last that is declared.

    A chunk without an image repeats the one before, and counts.
    """
    steps = np.diff(pts)
    return declared is not None and int(pts[-1] - pts[0]) + int(steps.max(initial=1)) >= declared


def _truncation_warning(times_s: FloatArray, declared: int | None, declared_s: float | None) -> tuple[str, ...]:
    """Warn where the container declares more frames or time than the file holds."""
    if declared is not None and times_s.size < declared:
        return (
            FootageLoss(
                f"{count_text(times_s.size, 'frame')} read of {declared} declared: the file is truncated, copy it again"
            ),
        )
    if declared is None and declared_s is not None and times_s.size > 1:
        step = float(np.median(np.diff(times_s)))
        lasts = float(times_s[-1] - times_s[0]) + step
        if lasts < declared_s - max(2 * step, 0.02 * declared_s):
            return (
                FootageLoss(f"{lasts:.1f} s read of {declared_s:.1f} s declared: the file is truncated, copy it again"),
            )
    return ()
