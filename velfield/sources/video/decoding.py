"""Decode a video in sequence: each frame by its time stamp, corrupt ones flagged."""

import itertools
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from schemas.arrays import GreyImage, IntArray
from velfield.errors import InputError
from velfield.sources.frames import SourceFrame, SourceInfo, unreadable_frame
from velfield.sources.images import Levels, stretch, stretch_levels
from velfield.sources.quality import FrameFlag
from velfield.sources.video.corruption import BlockArtifactDetector, CorruptionTracker, capture_errors, libav_log
from velfield.sources.video.packets import iter_packets, open_video, video_stream

_DEEP, _SAMPLED = "gray16le", 16
_LUMA_FIRST = {"gray", "yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "nv21"}
_FULL_RANGE = 2  # AVCOL_RANGE_JPEG
_INTRA = 1  # AV_PICTURE_TYPE_I
_HELD_FRAMES = 75
"""A frame is buffered until the end of its group of pictures, for at most so many frames ..."""
_HELD_BYTES = 256 * 1024 * 1024
"""... and at most so much memory in all."""

_Decoded = tuple[int, GreyImage | None, bool]
"""A frame's index, its image (None: not decoded), whether it is known to be suspect."""
_LIMITED_TO_FULL = np.clip(np.round((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(np.uint8)


def iter_video(path: Path, info: SourceInfo, indices: IntArray) -> Iterator[SourceFrame]:
    """Decode the frames `indices` in sequence; one that is not decoded is yielded with the flag UNREADABLE."""
    with libav_log():
        for entry in _entry_points(info, int(indices[0])):
            corruption = CorruptionTracker(lasting=not info.pts.size, midway=entry > 0)
            decoded = _decode(path, info, entry, corruption)
            first = next(decoded, None)
            if entry == 0 or (first is not None and first[0] <= indices[0] and not first[2]):
                break
            decoded.close()
        frames = itertools.chain([] if first is None else [first], decoded)
        yield from _select(path, info, indices, frames, corruption)
        decoded.close()


def _select(
    path: Path, info: SourceInfo, indices: IntArray, frames: Iterable[_Decoded], corruption: CorruptionTracker
) -> Iterator[SourceFrame]:
    """Pick the frames `indices`; each is buffered until the next key frame shows whether its group was corrupt."""
    held: deque[_Decoded] = deque()
    position, room = 0, max(_HELD_BYTES // (info.width * info.height), 1)
    for index, grey, suspect in frames:
        while position < indices.size and indices[position] < index:
            corruption.mark_lost(index)
            held.append((int(indices[position]), None, True))
            position += 1
        group_over = not info.key_frames.size or info.key_frames[index]
        while held and (group_over or len(held) > room or index - held[0][0] > _HELD_FRAMES):
            yield _source_frame(path, info, held.popleft(), corruption)
        if position == indices.size and not held:
            return
        if position < indices.size and indices[position] == index:
            held.append((index, grey, suspect))
            position += 1
    held.extend((int(index), None, True) for index in indices[position:])
    for waiting in held:
        yield _source_frame(path, info, waiting, corruption)


def _decode(path: Path, info: SourceInfo, entry: int, corruption: CorruptionTracker) -> Generator[_Decoded, None, None]:
    """Yield (index, grey, whether suspect) of every decoded frame, starting at the key frame `entry`."""
    with ExitStack() as stack:
        container = stack.enter_context(open_video(path))
        stream = video_stream(container, path)
        counted = container.format.name == "avi" and info.frame_count < (info.declared_count or 0)
        corruption.lasting |= counted  # AVI numbers frames by order: a lost one shifts the times of all that follow
        stream.codec_context.thread_count = 1  # errors are logged by the thread that decodes: see corruption.py
        stream.codec_context.options = {"max_pixels": str(info.max_pixels)}
        if entry:
            with capture_errors():
                container.seek(int(info.pts[entry]), stream=stream, backward=True, any_frame=False)
        timestamp_index, artifacts = _TimestampIndex(info), BlockArtifactDetector()
        recent: deque[int] = deque(maxlen=BlockArtifactDetector.LONGEST_AGO + 1)
        for packet, demux_errors in iter_packets(container, stream):
            corruption.feed(packet, timestamp_index.of_packet(packet))
            out = _decode_packet(stream, packet, demux_errors, corruption)
            for frame in out:
                index = timestamp_index.of_frame(frame)
                if index is None:
                    corruption.mark("a frame of unknown time")
                    continue
                if info.key_frames.size and info.key_frames[index]:
                    corruption.note_key_frame(is_intra=int(frame.pict_type) == _INTRA)
                if frame.is_corrupt:
                    corruption.mark_frame(index)
                grey = _grey(frame, info.levels)
                recent.append(index)
                for ago in artifacts.feed(grey):
                    corruption.mark_artifacts(recent[-1 - ago])
                yield index, grey, corruption.is_suspect(index)


def _decode_packet(stream: Any, packet: Any, demux_errors: list[str], corruption: CorruptionTracker) -> list[Any]:
    """Decode one packet, and register the errors that are logged."""
    out: list[Any] = []
    try:
        with capture_errors() as errors:
            out = stream.codec_context.decode(packet if packet.size else None)
    except (av.error.FFmpegError, ValueError) as error:
        corruption.mark(str(error))
    for message in (*demux_errors, *errors):
        corruption.mark(message)
    if packet.is_corrupt:
        corruption.mark("packet damaged")
    return out


class _TimestampIndex:
    """From time stamp to frame index; equal stamps by order, and all by order where there are no stamps."""

    def __init__(self, info: SourceInfo) -> None:
        self._pts = info.pts
        self._count = info.frame_count
        self._seen = {"packet": 0, "frame": 0}
        self._last: dict[str, tuple[int, int]] = {}

    def of_packet(self, packet: Any) -> int | None:
        return self._index(packet.pts, "packet") if packet.size else None

    def of_frame(self, frame: Any) -> int | None:
        return self._index(frame.pts, "frame")

    def _index(self, pts: int | None, kind: str) -> int | None:
        if self._pts.size == 0:
            self._seen[kind] += 1
            return self._seen[kind] - 1 if self._seen[kind] <= self._count else None
        if pts is None:
            return None
        index = int(np.searchsorted(self._pts, pts))
        if index >= self._pts.size or self._pts[index] != pts:
            return None
        last_pts, last_index = self._last.get(kind, (-1, -1))
        if last_pts == pts and last_index + 1 < self._pts.size and self._pts[last_index + 1] == pts:
            index = last_index + 1
        self._last[kind] = (pts, index)
        return index


def _entry_points(info: SourceInfo, first: int) -> list[int]:
    """Frames to start decoding at to reach frame `first`, the best first, the start of the file last.

    One more group than necessary is decoded, so that artefacts show in a group that is corrupt from its key frame on,
    and an open group has its reference frames. Some key frames are none (gradual refresh): no frame is decoded there,
    and the next entry point is tried.
    """
    keys = np.flatnonzero(info.key_frames[: first + 1])[::-1].tolist()
    near = [key for rank, key in enumerate(keys[1:4], 1) if info.entries[key] or rank > 1]
    return [*(key for key in near[:2] if key > 0), 0]


def _source_frame(path: Path, info: SourceInfo, decoded: _Decoded, corruption: CorruptionTracker) -> SourceFrame:
    index, grey, suspect = decoded
    if grey is None:
        return unreadable_frame(path, info, index, int(FrameFlag.UNREADABLE), "the decoder returned no image")
    suspect = suspect or corruption.is_suspect(index)
    time_s = float(info.times_s[index])
    if grey.shape != info.shape:
        found = f"{grey.shape[1]}x{grey.shape[0]}"
        if suspect:
            flags = int(FrameFlag.UNREADABLE | FrameFlag.SUSPECT)
            return unreadable_frame(path, info, index, flags, f"corrupt: decoded as {found}")
        raise InputError(
            f"{path.name}: found frame {index} at {time_s:.3f} s of {found}, expected {info.width}x{info.height} "
            "as the frames before; use --stop-s, or cut the video there"
        )
    reason = (
        f"{path.name}: frame {index} at {time_s:.3f} s: bitstream corrupt ({corruption.last_error})" if suspect else ""
    )
    return SourceFrame(index, info.names[index], time_s, grey, int(FrameFlag.SUSPECT) if suspect else 0, reason)


def video_levels(path: Path, info: SourceInfo) -> Levels | None:
    """Levels of a grey video of more than 8 bits that become 0 and 255 in all frames; None of another."""
    with libav_log(), ExitStack() as stack:
        container = stack.enter_context(open_video(path))
        stream = video_stream(container, path)
        pixels = stream.codec_context.format
        if pixels is None or not pixels.name.startswith("gray") or pixels.components[0].bits <= 8:
            return None
        found = []
        for at in info.pts[np.unique(np.linspace(0, len(info.pts) - 1, _SAMPLED).astype(int))] if len(info.pts) else ():
            container.seek(int(at), stream=stream, backward=True, any_frame=False)
            found += [frame.to_ndarray(format=_DEEP) for frame in itertools.islice(container.decode(stream), 1)]
    return stretch_levels(found) if found else None


def _grey(frame: Any, levels: Levels | None = None) -> GreyImage:
    """Luma as (h, w) uint8 of full range, straight from the plane: converting colours would cost ten times as much."""
    if levels is not None:
        return stretch(np.asarray(frame.to_ndarray(format=_DEEP), np.float64), levels)
    if frame.format.name not in _LUMA_FIRST:
        return np.ascontiguousarray(frame.to_ndarray(format="gray"), np.uint8)
    plane = frame.planes[0]
    luma = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: frame.height, : frame.width]
    full = frame.format.name.startswith(("yuvj", "gray")) or int(frame.color_range) == _FULL_RANGE
    return luma.copy() if full else np.asarray(cv2.LUT(np.ascontiguousarray(luma), _LIMITED_TO_FULL), np.uint8)
