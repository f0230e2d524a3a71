"""Open a video, read its packets past corrupt ones, and time stamps of its frames by demuxing alone."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import av
import numpy as np

from schemas.arrays import IntArray, Mask
from velfield.errors import InputError
from velfield.sources.frames import IMAGE_SUFFIXES, FootageLoss
from velfield.sources.video.corruption import capture_errors

# Demuxers that read this one file: playlists (HLS, ffconcat, SDP, image patterns) could name other files or hosts.
_FORMATS = "mov,mp4,avi,matroska,webm,mpegts,mpeg,h264,hevc,m4v,mpegvideo,flv,mxf,asf,ogg,nut,ivf,av1,obu,dv,gif"
_OPTIONS = {"protocol_whitelist": "file", "format_whitelist": _FORMATS}
_MAX_ERRORS = 100
_METADATA = {"metadata_errors": "replace"} if int(av.__version__.partition(".")[0]) < 19 else {}
"""A container's texts need not be UTF-8. PyAV 19 never raises at them, and has no such argument."""


def open_video(path: Path) -> Any:
    """Open for reading; only local files, only demuxers that read this one file."""
    try:
        with capture_errors():
            return av.open(str(path), mode="r", options=_OPTIONS, **_METADATA)
    except (av.error.FFmpegError, OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        if path.suffix.lower() in IMAGE_SUFFIXES:
            raise InputError(
                f"{path.name}: found one image, expected a video or a folder of images; --base takes a base image"
            ) from None
        raise InputError(
            f"{path.name}: could not be opened as video ({why}), expected an intact MP4, MOV, AVI, MKV, TS or "
            "similar file; give a video or a folder of images"
        ) from None


def video_stream(container: Any, path: Path) -> Any:
    """The first video stream that is no cover image or thumbnail (DJI files hold both)."""
    streams = list(container.streams.video)
    videos = [stream for stream in streams if not int(stream.disposition) & int(av.stream.Disposition.attached_pic)]
    if not videos:
        raise InputError(f"{path.name}: found no video stream, expected one; give a video or a folder of images")
    if videos[0].codec_context is None:
        raise InputError(
            f"{path.name}: found a video stream without a decoder, expected H.264, HEVC or similar; convert it"
        )
    return videos[0]


def iter_packets(container: Any, stream: Any) -> Iterator[tuple[Any, list[str]]]:
    """Packets of a stream, each with the demuxer's errors; continues after corrupt data."""
    packets, failures = iter(container.demux(stream)), 0
    while failures < _MAX_ERRORS:
        errors: list[str] = []
        try:
            with capture_errors() as errors:
                packet = next(packets, None)
        except (av.error.FFmpegError, OSError, IndexError):  # IndexError: PyAV, where corruption makes up a stream
            packets, failures = iter(container.demux(stream)), failures + 1
            continue
        if packet is None:
            return
        yield packet, errors


@dataclass(frozen=True)
class Packets:
    """Time stamps of the packets, in the file's order.

    ``pts`` (n,) are presentation time stamps, which identify frames, where ``stamps`` is "pts"; decoding time stamps
    where it is "dts": frames get them by order of presentation; 0, 1, 2, ... where "none".
    """

    pts: IntArray
    key: Mask
    stamps: Literal["pts", "dts", "none"]
    notes: tuple[str, ...]


def demux(container: Any, stream: Any, path: Path) -> Packets:
    """Read all packets, decode none. A packet to be decoded but not presented (edit list) is no frame."""
    rows: list[tuple[int | None, int | None, bool]] = []
    notes: tuple[str, ...] = ()
    for packet, _ in iter_packets(container, stream):
        if packet.size and not packet.is_discard:
            rows.append((packet.pts, packet.dts, bool(packet.is_keyframe)))
    timed = [(row[0], row[2]) for row in rows if row[0] is not None]
    if len(timed) > 0.8 * len(rows) and stream.time_base is not None and _stamps_ascend(path):
        if len(timed) < len(rows):
            notes += (f"{len(rows) - len(timed)} frames have no time stamp (corrupt): dropped",)
        return Packets(
            np.array([p for p, _ in timed], np.int64), np.array([k for _, k in timed], np.bool_), "pts", notes
        )
    dts = [row[1] for row in rows if row[1] is not None]
    key = np.array([row[2] for row in rows], np.bool_)
    if len(dts) == len(rows) and stream.time_base is not None:
        return Packets(np.array(sorted(dts), np.int64), key, "dts", notes)
    return Packets(np.arange(len(rows), dtype=np.int64), key, "none", notes)


def _stamps_ascend(path: Path) -> bool:
    """Whether frames are decoded in the order of their stamps. AVI has those of decoding; libav guesses others."""
    with capture_errors(), open_video(path) as container:
        if container.format.name != "avi":
            return True
        stream = video_stream(container, path)
        stream.codec_context.thread_count = 1
        try:
            presented = [frame.pts for frame in itertools.islice(container.decode(stream), 48)]
        except av.error.FFmpegError:
            return True
    return None not in presented and all(first < second for first, second in itertools.pairwise(presented))


def drop_timestamp_outliers(
    path: Path, packets: Packets, time_base: Fraction | None
) -> tuple[Packets, tuple[str, ...]]:
    """Drop frames whose time stamp is an outlier: far from those of the neighbouring frames in the file.

    Raises
    ------
    InputError
        Time runs back and stays back: two recordings in one file.
    """
    if packets.stamps != "pts" or time_base is None or packets.pts.size < 3:
        return packets, ()
    pts = packets.pts
    max_deviation = max(2.0 / float(time_base), 20 * float(np.median(np.abs(np.diff(pts)))))  # more than any reordering
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(pts, 8, mode="reflect" if pts.size > 8 else "edge"), 17)
    # Beside a true gap a frame agrees with its own side, the larger half of its window.
    outlier = np.abs(pts - np.median(windows, axis=1)) > max_deviation
    notes: tuple[str, ...] = ()
    if outlier.any():
        notes = (
            FootageLoss(f"{np.count_nonzero(outlier)} frames have times far from their neighbours' (corrupt): dropped"),
        )
        packets = Packets(pts[~outlier], packets.key[~outlier], packets.stamps, packets.notes)
    back = np.maximum.accumulate(packets.pts) - packets.pts
    if back.size and back.max() > max_deviation:
        index = int(np.argmax(back > max_deviation))
        raise InputError(
            f"{path.name}: timestamps jump back {float(back[index] * time_base):.1f} s at frame {index}, expected "
            "one recording per file; split it there, or give --timestamps"
        )
    return packets, notes


def closed_key_frames(packets: Packets) -> Mask:
    """Key frames that all later packets are presented after (closed groups): decoding can start there."""
    later_min = np.minimum.accumulate(packets.pts[::-1])[::-1]
    return np.asarray(packets.key & (later_min == packets.pts), np.bool_)
