"""What a source of frames is: the facts of the whole (`SourceInfo`) and one decoded frame (`SourceFrame`)."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

SourceKind = Literal["video", "folder"]


@dataclass(frozen=True)
class SourceFrame:
    """One frame as it came.

    Attributes
    ----------
    source_index
        Its place in `SourceInfo`, that is, in order of time.
    name
        A picture's file name, or a video's 0-based frame index, as text: what labels call it.
    time_s
        True time, s: the container's, the side file's, or index / fps where the user asked for that.
    grey
        (h, w) uint8, raw pixels as stored (no EXIF rotation); zeros where it is unreadable.
    flags
        Bits of `velfield.sources.flags.FrameFlag`.
    reason
        What was wrong, one line; empty where nothing was.
    """

    source_index: int
    name: str
    time_s: float
    grey: NDArray[np.uint8]
    flags: int
    reason: str = ""


@dataclass(frozen=True)
class SourceInfo:
    """What is known of a video or a picture folder before any frame is decoded.

    Attributes
    ----------
    kind
        ``video`` or ``folder``.
    width, height
        Size of every frame, px.
    frame_count
        Number of frames that can be asked for.
    times_s
        (n,) float64, ascending, s; equal times may stand in it, `select_frames` takes the first of them.
    names
        (n,) what labels call each frame: file names, or indices as text.
    warnings
        One line each, for people: what is missing, out of order, or cut short.
    declared_count
        Frames that the container says it has, where it says so.
    pts
        (n,) int64 presentation time stamps of a video's frames in `time_base` units; empty for a folder and for a
        video without times. With the file, a frame's identity.
    key_frames
        (n,) bool, where a damaged stretch ends; empty as `pts`.
    entries
        (n,) bool, the key frames that nothing leans across (closed groups): where a video can be entered.
    fps
        Rate that made the times, where the user gave one and the source had none.
    max_pixels
        Limit on the size of a picture, refused before memory is taken.
    """

    kind: SourceKind
    width: int
    height: int
    frame_count: int
    times_s: NDArray[np.float64]
    names: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    declared_count: int | None = None
    pts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    key_frames: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    entries: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    fps: float | None = None
    max_pixels: int = 400_000_000

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of a frame, (h, w)."""
        return self.height, self.width


def unreadable_frame(path: Path, info: SourceInfo, index: int, flags: int, reason: str) -> SourceFrame:
    """Stand-in for a frame that could not be read: zeros, with the reason and where it happened."""
    time_s = float(info.times_s[index])
    where = f"{path.name}: frame {info.names[index]} at {time_s:.3f} s"
    return SourceFrame(index, info.names[index], time_s, np.zeros(info.shape, np.uint8), flags, f"{where}: {reason}")
