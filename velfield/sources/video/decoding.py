"""Decoding a video in sequence: each frame by its time stamp, each damaged one told."""

import itertools
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from velfield.errors import InputError
from velfield.sources.flags import FrameFlag
from velfield.sources.frames import SourceFrame, SourceInfo, unreadable_frame
from velfield.sources.video.block_artifacts import PictureBreaks
from velfield.sources.video.container import demuxed, open_video, video_stream
from velfield.sources.video.corruption import DamageLog, captured_errors, libav_log

_LUMA_FIRST = {"gray", "yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "nv21"}
_FULL_RANGE = 2  # AVCOL_RANGE_JPEG
_INTRA = 1  # AV_PICTURE_TYPE_I
_HELD_FRAMES = 75
"""A frame is held back, until the end of its group has been seen, for no more frames than this, ..."""
_HELD_BYTES = 256 * 1024 * 1024
"""... and all together for no more memory than this."""

_Decoded = tuple[int, NDArray[np.uint8] | None, bool]
"""A frame's index, its picture (None: none came out), whether it is known to be suspect."""
_LIMITED_TO_FULL = np.clip(np.round((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(np.uint8)


def iter_video(path: Path, info: SourceInfo, indices: NDArray[np.int64]) -> Iterator[SourceFrame]:
    """Decode the frames `indices` in sequence; one that does not come out is yielded unreadable, in its place."""
    with libav_log():
        for entry in _entries(info, int(indices[0])):
            damage = DamageLog(lasting=not info.pts.size, midway=entry > 0)
            decoded = _decode(path, info, entry, damage)
            first = next(decoded, None)
            if entry == 0 or (first is not None and first[0] <= indices[0] and not first[2]):
                break
            decoded.close()
        frames = itertools.chain([] if first is None else [first], decoded)
        yield from _in_place(path, info, indices, frames, damage)
        decoded.close()


def _in_place(
    path: Path, info: SourceInfo, indices: NDArray[np.int64], frames: Iterable[_Decoded], damage: DamageLog
) -> Iterator[SourceFrame]:
    """Pick the frames `indices`; each is held back until the next key frame has shown whether its group was whole."""
    held: deque[_Decoded] = deque()
    place, room = 0, max(_HELD_BYTES // (info.width * info.height), 1)
    for index, grey, suspect in frames:
        while place < indices.size and indices[place] < index:
            damage.mark_lost(index)
            held.append((int(indices[place]), None, True))
            place += 1
        group_over = not info.key_frames.size or info.key_frames[index]
        while held and (group_over or len(held) > room or index - held[0][0] > _HELD_FRAMES):
            yield _source_frame(path, info, held.popleft(), damage)
        if place == indices.size and not held:
            return
        if place < indices.size and indices[place] == index:
            held.append((index, grey, suspect))
            place += 1
    held.extend((int(index), None, True) for index in indices[place:])
    for waiting in held:
        yield _source_frame(path, info, waiting, damage)


def _decode(path: Path, info: SourceInfo, entry: int, damage: DamageLog) -> Generator[_Decoded, None, None]:
    """Yield (index, grey, whether suspect) of every frame that comes out, entering at the key frame `entry`."""
    with ExitStack() as stack:
        container = stack.enter_context(open_video(path))
        stream = video_stream(container, path)
        counted = container.format.name == "avi" and info.frame_count < (info.declared_count or 0)
        damage.lasting |= counted  # AVI numbers frames as it finds them: a lost one shifts the times of all that follow
        stream.codec_context.thread_count = 1  # damage is logged by the thread that decodes: see bitstream.py
        stream.codec_context.options = {"max_pixels": str(info.max_pixels)}
        if entry:
            with captured_errors():
                container.seek(int(info.pts[entry]), stream=stream, backward=True, any_frame=False)
        identity, breaks = _Identity(info), PictureBreaks()
        for packet, demux_errors in demuxed(container, stream):
            damage.feed(packet, identity.of_packet(packet))
            out = _pictures_of(stream, packet, demux_errors, damage)
            for frame in out:
                index = identity.of_frame(frame)
                if index is None:
                    damage.mark("a frame of unknown time")
                    continue
                if info.key_frames.size and info.key_frames[index]:
                    damage.note_key_picture(is_intra=int(frame.pict_type) == _INTRA)
                if frame.is_corrupt:
                    damage.mark_frame(index)
                grey = _grey(frame)
                if breaks.feed(grey):
                    damage.mark_break(index)
                yield index, grey, damage.is_suspect(index)


def _pictures_of(stream: Any, packet: Any, demux_errors: list[str], damage: DamageLog) -> list[Any]:
    """Decode one packet, and put what is said of it down as damage."""
    out: list[Any] = []
    try:
        with captured_errors() as errors:
            out = stream.codec_context.decode(packet if packet.size else None)
    except (av.error.FFmpegError, ValueError) as error:
        damage.mark(str(error))
    for message in (*demux_errors, *errors):
        damage.mark(message)
    if packet.is_corrupt:
        damage.mark("packet damaged")
    return out


class _Identity:
    """From time stamp to index; among equal stamps by order of coming, and by that alone where there are no stamps."""

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


def _entries(info: SourceInfo, first: int) -> list[int]:
    """Frames to enter at so as to reach frame `first`, the best first, the start of the file last.

    One group more is decoded than must be, so that a group that is damaged from its key frame on is seen to break with
    the one before, and an open group has what it leans on. Some key frames are none (gradual refresh): no frame comes
    out at them, and the next entry is tried.
    """
    keys = np.flatnonzero(info.key_frames[: first + 1])[::-1].tolist()
    near = [key for place, key in enumerate(keys[1:4], 1) if info.entries[key] or place > 1]
    return [*(key for key in near[:2] if key > 0), 0]


def _source_frame(path: Path, info: SourceInfo, decoded: _Decoded, damage: DamageLog) -> SourceFrame:
    index, grey, suspect = decoded
    if grey is None:
        return unreadable_frame(path, info, index, int(FrameFlag.UNREADABLE), "no picture came out of the decoder")
    suspect = suspect or damage.is_suspect(index)
    time_s = float(info.times_s[index])
    if grey.shape != info.shape:
        found = f"{grey.shape[1]}x{grey.shape[0]}"
        if suspect:
            flags = int(FrameFlag.UNREADABLE | FrameFlag.SUSPECT)
            return unreadable_frame(path, info, index, flags, f"damaged: its size comes out as {found}")
        raise InputError(
            f"{path.name}: found frame {index} at {time_s:.3f} s of {found}, expected {info.width}x{info.height} "
            "as the frames before; use --stop-s, or cut the video there"
        )
    reason = f"{path.name}: frame {index} at {time_s:.3f} s: bitstream damaged ({damage.last_error})" if suspect else ""
    return SourceFrame(index, info.names[index], time_s, grey, int(FrameFlag.SUSPECT) if suspect else 0, reason)


def _grey(frame: Any) -> NDArray[np.uint8]:
    """Luma as (h, w) uint8 of full range. The plane is taken as it is; converting colours would cost ten times that."""
    if frame.format.name not in _LUMA_FIRST:
        return np.ascontiguousarray(frame.to_ndarray(format="gray"), np.uint8)
    plane = frame.planes[0]
    luma = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: frame.height, : frame.width]
    full = frame.format.name.startswith(("yuvj", "gray")) or int(frame.color_range) == _FULL_RANGE
    return luma.copy() if full else np.asarray(cv2.LUT(np.ascontiguousarray(luma), _LIMITED_TO_FULL), np.uint8)
