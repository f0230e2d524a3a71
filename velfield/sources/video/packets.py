"""The time stamps of a video's frames, by demuxing alone, and which of them can be trusted."""

import itertools
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import av
import numpy as np
from numpy.typing import NDArray

from velfield.errors import InputError
from velfield.sources.video.container import demuxed, open_video, video_stream
from velfield.sources.video.corruption import captured_errors


@dataclass(frozen=True)
class Packets:
    """What demuxing alone tells, in the file's order.

    ``pts`` (n,) are the presentation time stamps that identify frames where ``stamps`` is "pts"; decoding time stamps
    where it is "dts": times are known, but which frame has which only by the order of coming out; 0, 1, 2, ... where
    "none".
    """

    pts: NDArray[np.int64]
    key: NDArray[np.bool_]
    stamps: Literal["pts", "dts", "none"]
    notes: tuple[str, ...]


def demux(container: Any, stream: Any, path: Path) -> Packets:
    """Read all packets, decode none. A packet that is to be decoded but not shown (an edit list) is no frame."""
    rows: list[tuple[int | None, int | None, bool]] = []
    notes: tuple[str, ...] = ()
    for packet, _ in demuxed(container, stream):
        if packet.size and not packet.is_discard:
            rows.append((packet.pts, packet.dts, bool(packet.is_keyframe)))
    timed = [(row[0], row[2]) for row in rows if row[0] is not None]
    if len(timed) > 0.8 * len(rows) and stream.time_base is not None and _stamps_ascend(path):
        if len(timed) < len(rows):
            notes += (f"{len(rows) - len(timed)} frames have lost their time (damaged) and are left out",)
        return Packets(
            np.array([p for p, _ in timed], np.int64), np.array([k for _, k in timed], np.bool_), "pts", notes
        )
    dts = [row[1] for row in rows if row[1] is not None]
    key = np.array([row[2] for row in rows], np.bool_)
    if len(dts) == len(rows) and stream.time_base is not None:
        return Packets(np.array(sorted(dts), np.int64), key, "dts", notes)
    return Packets(np.arange(len(rows), dtype=np.int64), key, "none", notes)


def _stamps_ascend(path: Path, *, look: int = 48) -> bool:
    """Whether pictures come out in the order of their stamps. AVI has those of decoding alone; others are guessed."""
    with captured_errors(), open_video(path) as container:
        if container.format.name != "avi":
            return True
        stream = video_stream(container, path)
        stream.codec_context.thread_count = 1
        try:
            shown = [frame.pts for frame in itertools.islice(container.decode(stream), look)]
        except av.error.FFmpegError:
            return True
    return None not in shown and all(first < second for first, second in itertools.pairwise(shown))


def without_strays(path: Path, packets: Packets, time_base: Fraction | None) -> tuple[Packets, tuple[str, ...]]:
    """Leave out frames whose time cannot be: a damaged stamp, far from those of the frames about it in the file.

    Raises
    ------
    InputError
        Time runs back for good: two recordings in one file.
    """
    if packets.stamps != "pts" or time_base is None or packets.pts.size < 3:
        return packets, ()
    pts = packets.pts
    reach = max(2.0 / float(time_base), 20 * float(np.median(np.abs(np.diff(pts)))))  # more than any reordering
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(pts, 8, mode="reflect" if pts.size > 8 else "edge"), 17)
    # On either side of a true gap a frame agrees with its own side, which is the larger half of its window.
    stray = np.abs(pts - np.median(windows, axis=1)) > reach
    notes: tuple[str, ...] = ()
    if stray.any():
        notes = (f"{np.count_nonzero(stray)} frames have times far from their neighbours' (damaged) and are left out",)
        packets = Packets(pts[~stray], packets.key[~stray], packets.stamps, packets.notes)
    back = np.maximum.accumulate(packets.pts) - packets.pts
    if back.size and back.max() > reach:
        place = int(np.argmax(back > reach))
        raise InputError(
            f"{path.name}: found that time runs back by {float(back[place] * time_base):.1f} s at frame {place}, "
            "expected one "
            "recording in a file; cut it there, or give --timestamps"
        )
    return packets, notes


def closed_keys(packets: Packets) -> NDArray[np.bool_]:
    """Key frames whose followers in the file are shown after them, so that decoding can begin there."""
    later_least = np.minimum.accumulate(packets.pts[::-1])[::-1]
    return np.asarray(packets.key & (later_least == packets.pts), np.bool_)
