"""A source of frames: its facts (`SourceInfo`) and one decoded frame (`SourceFrame`).

Inputs are local files: addresses and protocols are refused before any library sees them.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from schemas.arrays import FloatArray, GreyImage, IntArray, Mask
from velfield.errors import InputError

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".ts", ".m4v", ".mpg", ".webm")
"""Files of a folder that are videos."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Files of a folder that are images."""
# Two letters or more before the colon: "C:\flight.mp4" is a path. A Path keeps one slash of "http://".
_PROTOCOL = re.compile(r"^([A-Za-z][A-Za-z0-9+.\-]+):")


def local_path(path: Path | str, what: str) -> Path:
    """Resolve a user's path to an existing file or folder of this machine; messages name it ``what``.

    It is absolute: no library can take it for a protocol (``concat:``, ``http:``) or an option.

    Raises
    ------
    InputError
        It is an address, or nothing is there.
    """
    text = str(path)
    if "\0" in text:
        raise InputError(f"found a {what} path with a NUL in it, expected a path; fix the path")
    protocol = _PROTOCOL.match(text)
    if protocol and not Path(text).exists():
        raise InputError(
            f"found {text!r} as {what}: the protocol {protocol[1]!r} is not supported, expected a local path; "
            "download it first"
        )
    try:
        return Path(text).resolve(strict=True)
    except (OSError, RuntimeError) as error:
        raise InputError(f"found no {what} at {text!r} ({_why(error)}), expected an existing path; check it") from None


def _why(error: Exception) -> str:
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)


SourceKind = Literal["video", "folder"]


@dataclass(frozen=True)
class SourceFrame:
    """One decoded frame."""

    source_index: int
    """Its index in `SourceInfo`, in order of time."""
    name: str
    """An image's file name, or a video's 0-based frame index, as text: its name in labels."""
    time_s: float
    """True time, s: the container's, the CSV's, or index / fps with --fps."""
    grey: GreyImage
    """(h, w) uint8, raw pixels as stored (no EXIF rotation); zeros where it is unreadable."""
    flags: int
    """Bits of `velfield.sources.quality.FrameFlag`."""
    reason: str = ""
    """The fault, in one line, without the frame's name; empty if there was none."""


class FootageLoss(str):
    """A warning that part of the recording is not there: a run of it ends as not complete."""

    __slots__ = ()


@dataclass(frozen=True)
class SourceInfo:
    """Properties of a video or an image folder that are known before any frame is decoded."""

    kind: SourceKind
    """``video`` or ``folder``."""
    width: int
    height: int
    """Size of every frame, px."""
    frame_count: int
    """Number of frames that can be read."""
    times_s: FloatArray
    """(n,) float64, ascending, s; it may hold equal times, of which `select_frames` takes the first."""
    names: tuple[str, ...]
    """(n,) name of each frame in labels: file names, or indices as text."""
    warnings: tuple[str, ...] = ()
    """One line each, for the user: frames missing, out of order, or truncated; what is lost is a `FootageLoss`."""
    declared_count: int | None = None
    """Number of frames that the container declares, if it does."""
    pts: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    """(n,) int64 presentation time stamps of a video's frames in `time_base` units; empty for a folder and for a video
    without times. With the file, a frame's identity."""
    key_frames: Mask = field(default_factory=lambda: np.zeros(0, np.bool_))
    """(n,) bool, key frames, where corruption ends; empty as `pts`."""
    entries: Mask = field(default_factory=lambda: np.zeros(0, np.bool_))
    """(n,) bool, key frames of closed groups of pictures, where decoding can start."""
    fps: float | None = None
    """Frame rate behind the times, where the user gave one and the source had none."""
    max_pixels: int = 400_000_000
    """Limit on the size of an image, refused before memory is taken."""
    levels: tuple[float, float] | None = None
    """Levels of frames of more than 8 bits that become 0 and 255 in every frame."""
    parts: tuple[tuple[str, "SourceInfo", float], ...] = ()
    """Parts of several clips (`velfield.sources.clips`), in order of time: path, facts, and start in s from the start
    of the first."""

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of a frame, (h, w)."""
        return self.height, self.width

    def frame(self, index: int, grey: GreyImage | None, flags: int = 0, reason: str = "") -> SourceFrame:
        """The frame of an index; zeros, with flags and the reason, where it could not be read."""
        grey = np.zeros(self.shape, np.uint8) if grey is None else grey
        return SourceFrame(index, self.names[index], float(self.times_s[index]), grey, flags, reason)
