"""Decode a video in sequence: each frame by its time stamp, corrupt ones flagged.

A sound H.264 stream is decoded by libav's own threads, and frames that are neither asked for nor referred to are not
decoded. At the first sign of damage (an error in libav's log, a frame marked as corrupt, one that is lost) the frames
that are not delivered yet are decoded again, one packet at a time on one thread: so each error is known to belong to a
packet, and the frames that it may affect are flagged. Streams of other codecs are all decoded in this way, and searched
for block artefacts: libav decodes damaged HEVC without an error.
"""

import itertools
import re
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from schemas.arrays import GreyImage, IntArray
from velfield.errors import InputError
from velfield.parallel import usable_processors
from velfield.sources.frames import SourceFrame, SourceInfo
from velfield.sources.images import Levels, stretch, stretch_levels
from velfield.sources.quality import FrameFlag
from velfield.sources.video.corruption import (
    MARGIN,
    BlockArtifactDetector,
    CorruptionTracker,
    capture_errors,
    count_errors,
    libav_log,
)
from velfield.sources.video.packets import iter_packets, open_video, video_stream
from velfield.sources.video.pauses import Pause, Pauses, file_state

_GREY_16, _SAMPLED = "gray16le", 16
_LUMA_FIRST = {"gray", "yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "nv21"}
_DEEP = re.compile(r"yuv4\d\dp(\d\d)le")
_MOST_THREADS = 4
_LOGS_DAMAGE = "h264"
"""The codec of which libav logs every error that changes a picture, or marks the frame."""
_FULL_RANGE = 2  # AVCOL_RANGE_JPEG
_INTRA = 1  # AV_PICTURE_TYPE_I
_HELD_FRAMES = 4 * MARGIN
"""A frame is delivered once so many later ones, more than any reordering and the margin of an error, are decoded."""
_FAR = 0.25
"""Frames decoded for nothing, as a fraction of a part's own, from which on parts share a decoder."""
_NONE: IntArray = np.empty(0, np.int64)
_pauses = Pauses()
_Decoded = tuple[int, GreyImage | None, bool]
"""A frame's index, its image (None: not decoded), whether it is known to be suspect."""
_LIMITED_TO_FULL = np.clip(np.round((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(np.uint8)


def iter_video(
    path: Path, info: SourceInfo, indices: IntArray, then: IntArray = _NONE
) -> Generator[SourceFrame, None, None]:
    """Decode the frames `indices` in sequence; one that is not decoded is yielded with the flag UNREADABLE.

    ``then``: the frames that other calls will ask for; the next one, which begins with the last of these, goes on with
    the decoder where that saves much.
    """
    delivered = 0
    if info.pts.size and info.key_frames.size:
        with closing(_read_on(path, info, indices, then)) as frames:
            for frame in frames:
                yield frame
                delivered += 1
    if delivered < indices.size:
        with libav_log():
            yield from _read_with_care(path, info, indices[delivered:])


def _read_on(path: Path, info: SourceInfo, indices: IntArray, then: IntArray) -> Generator[SourceFrame, None, None]:
    """`_read_sound` by a decoder that waits at the first frame, if there is one; it waits at the last, if that pays."""
    first, last, asked = int(indices[0]), int(indices[-1]), np.concatenate([indices, then])
    file = file_state(path) if usable_processors() <= _MOST_THREADS else None
    if file is None:  # more processors decode several parts at once
        yield from _read_sound(path, info, indices)
        return
    frames, pause = _read_sound(path, info, asked), None
    waits = then.size > 0 and last > first and _is_far(info, last, 2 * last - first)
    if waits:
        _pauses.announce(file, last)
    try:
        taken = _pauses.take(file, asked) if _is_far(info, first, last) else None
        frames = frames if taken is None else taken.frames
        for frame in itertools.chain([] if taken is None else [taken.last], frames):
            yield frame
            if frame.source_index == last:
                pause = Pause(file, frame, then, frames) if waits else None
                break
    finally:
        if waits:
            _pauses.end(file, last, pause)
        if pause is None:
            frames.close()


def _is_far(info: SourceInfo, first: int, last: int) -> bool:
    """Whether a decoder that begins at the key frame before a part decodes much for nothing, beside the part itself."""
    key = int(np.flatnonzero(info.key_frames[: first + 1])[-1:].sum())
    return first - key > _FAR * (last - first)


def _read_sound(path: Path, info: SourceInfo, indices: IntArray) -> Generator[SourceFrame, None, None]:
    """The frames `indices` until the first sign of damage; all of them in a sound stream."""
    with libav_log():
        yield from _read_logged(path, info, indices)


def _read_logged(path: Path, info: SourceInfo, indices: IntArray) -> Iterator[SourceFrame]:
    for entry in _entry_points(info, int(indices[0])):
        errors, waiting, position, held = count_errors(), 0, 0, deque[tuple[int, GreyImage]]()
        for index, frame in _decode_on_threads(path, info, entry, indices):
            if count_errors() != errors or frame.is_corrupt or index is None:
                return
            if position < indices.size and index > indices[position]:
                break
            if position < indices.size and index == indices[position]:
                grey = _grey(frame, info.levels)
                if grey.shape != info.shape:
                    return
                held.append((index, grey))
                position += 1
            while held and (info.key_frames[index] or index - held[0][0] >= _HELD_FRAMES):
                if held[0][0] == index:
                    break
                yield info.frame(*held.popleft())
                waiting += 1
            if position == indices.size and not held:
                return
        else:
            if position and position == indices.size and count_errors() == errors:
                yield from (info.frame(*one) for one in held)
            return
        if position or waiting:
            return  # a frame is lost; else this entry point is none for the decoder, which began later


def _decode_on_threads(
    path: Path, info: SourceInfo, entry: int, indices: IntArray
) -> Generator[tuple[int | None, Any], None, None]:
    """Yield (index, frame) in order of presentation; not those that nobody asks for and no other frame refers to."""
    wanted = np.zeros(info.frame_count, np.bool_)
    wanted[indices] = True
    with _opened(path, info, entry) as (container, stream):
        if stream.codec_context.name != _LOGS_DAMAGE:
            return
        stream.codec_context.thread_type = "AUTO"
        stream.codec_context.thread_count = min(usable_processors(), _MOST_THREADS)
        of_packets, of_frames = _TimestampIndex(info), _TimestampIndex(info)
        packets = container.demux(stream)
        while True:
            try:
                packet = next(packets, None)
                if packet is None:
                    return
                index = of_packets.of_packet(packet)
                asked = index is None or bool(wanted[index])
                stream.codec_context.skip_frame = "DEFAULT" if asked else "NONREF"
                for frame in stream.codec_context.decode(packet if packet.size else None):
                    yield of_frames.of_frame(frame), frame
                if packet.is_corrupt:
                    return
            except (av.error.FFmpegError, OSError, ValueError, IndexError):  # as in `iter_packets`
                return


@contextmanager
def _opened(path: Path, info: SourceInfo, entry: int) -> Iterator[tuple[Any, Any]]:
    """The container and its video stream, at the key frame `entry`."""
    with open_video(path) as container:
        stream = video_stream(container, path)
        stream.codec_context.options = {"max_pixels": str(info.max_pixels)}
        if entry:
            with capture_errors():
                container.seek(int(info.pts[entry]), stream=stream, backward=True, any_frame=False)
        try:
            yield container, stream
        finally:
            _drain(stream.codec_context)


def _drain(decoder: Any) -> None:
    """Wait for the decoder's threads: closing it holds Python's lock, for which a thread that logs would wait."""
    try:
        with capture_errors():
            decoder.decode(None)
    except (av.error.FFmpegError, ValueError):  # at its end already, or damaged to the end
        return


def _read_with_care(path: Path, info: SourceInfo, indices: IntArray) -> Iterator[SourceFrame]:
    """The frames `indices`, those that damage may affect flagged."""
    for entry in _entry_points(info, int(indices[0]), groups_before=1):
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
    """Pick the frames `indices`; each is buffered until later ones show whether an error may affect it."""
    held: deque[_Decoded] = deque()
    position = 0
    for index, grey, suspect in frames:
        while position < indices.size and indices[position] < index:
            corruption.mark_lost(index)
            held.append((int(indices[position]), None, True))
            position += 1
        group_over = not info.key_frames.size or info.key_frames[index]
        while held and (group_over or index - held[0][0] >= _HELD_FRAMES):
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
    with _opened(path, info, entry) as (container, stream):
        counted = container.format.name == "avi" and info.frame_count < (info.declared_count or 0)
        corruption.lasting |= counted  # AVI numbers frames by order: a lost one shifts the times of all that follow
        stream.codec_context.thread_count = 1  # errors are logged by the thread that decodes: see corruption.py
        timestamp_index = _TimestampIndex(info)
        artifacts = None if stream.codec_context.name == _LOGS_DAMAGE else BlockArtifactDetector()
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
                for ago in () if artifacts is None else artifacts.feed(grey):
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


def _entry_points(info: SourceInfo, first: int, *, groups_before: int = 0) -> list[int]:
    """Frames to start decoding at to reach frame `first`, the best first, the start of the file last.

    With ``groups_before`` artefacts show in a group that is corrupt from its key frame on. An open group is decoded
    from the group before, which it refers to. Some key frames are none (gradual refresh): no frame is decoded there
    until the picture is refreshed, and the next entry point is tried.
    """
    keys = np.flatnonzero(info.key_frames[: first + 1])[::-1].tolist()
    near = [
        key
        for rank, key in enumerate(keys[:4])
        if rank >= groups_before and (info.entries[key] or rank > groups_before)
    ]
    return [*(key for key in near[:3] if key > 0), 0]


def _source_frame(path: Path, info: SourceInfo, decoded: _Decoded, corruption: CorruptionTracker) -> SourceFrame:
    index, grey, suspect = decoded
    if grey is None:
        return info.frame(index, None, int(FrameFlag.UNREADABLE), "the decoder returned no image")
    suspect = suspect or corruption.is_suspect(index)
    if grey.shape != info.shape:
        found = f"{grey.shape[1]}x{grey.shape[0]}"
        if suspect:
            flags = int(FrameFlag.UNREADABLE | FrameFlag.SUSPECT)
            return info.frame(index, None, flags, f"corrupt: decoded as {found}")
        raise InputError(
            f"{path.name}: found frame {index} at {info.times_s[index]:.3f} s of {found}, expected "
            f"{info.width}x{info.height} as the frames before; use --stop-s, or cut the video there"
        )
    if not suspect:
        return info.frame(index, grey)
    return info.frame(index, grey, int(FrameFlag.SUSPECT), f"bitstream corrupt ({corruption.last_error})")


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
            found += [frame.to_ndarray(format=_GREY_16) for frame in itertools.islice(container.decode(stream), 1)]
    return stretch_levels(found) if found else None


def _grey(frame: Any, levels: Levels | None = None) -> GreyImage:
    """Luma as (h, w) uint8 of full range, straight from the plane: converting colours would cost ten times as much."""
    if levels is not None:
        return stretch(np.asarray(frame.to_ndarray(format=_GREY_16), np.float64), levels)
    name, full = frame.format.name, int(frame.color_range) == _FULL_RANGE
    deep = _DEEP.fullmatch(name)
    if name not in _LUMA_FIRST and deep is None:
        return np.ascontiguousarray(frame.to_ndarray(format="gray"), np.uint8)
    plane = frame.planes[0]
    dtype = np.uint8 if deep is None else np.uint16
    luma = np.frombuffer(plane, dtype).reshape(plane.height, -1)[: frame.height, : frame.width]
    if deep is not None:
        unit = 1 << (int(deep[1]) - 8)  # black is 16 units and white 235, or 0 and 255 of full range
        above = luma if full else cv2.subtract(luma, np.full(1, 16.0 * unit))
        return np.asarray(cv2.convertScaleAbs(above, alpha=(1.0 if full else 255 / 219) / unit), np.uint8)
    full |= name.startswith(("yuvj", "gray"))
    return (
        np.array(luma, np.uint8)
        if full
        else np.asarray(cv2.LUT(np.ascontiguousarray(luma), _LIMITED_TO_FULL), np.uint8)
    )
