"""Corruption of a bitstream, from libav's log: decoders conceal errors and return an image for every frame.

A corrupt packet affects every frame decoded after it until the next key frame, in decoding order, which is not the
order of presentation. So errors are recorded in decoding order, and a frame is classified when the decoder returns it.
Many decoders (HEVC always, MPEG-4 often) decode flipped bits without logging an error: then there are blocks that the
frame before does not have, in a stream whose frames otherwise follow from each other.
"""

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import av.logging
import cv2
import numpy as np

from schemas.arrays import Float32Array, GreyImage

BLOCK_PX = 16
"""Side of a macroblock in most codecs."""
_WORK_WIDTH = 480
_MIN_DIFFERENCE = 8.0
"""Grey levels: a block is new where its mean lies this far outside the range of its surroundings a frame ago."""
_REACH_PX = 3
_MIN_BLOCKS = 8
_TYPICAL_FACTOR = 3.0
_HISTORY_FRAMES = 15
_MIN_HISTORY_FRAMES = 5
"""Before there are so many none is judged: a busy city at 5 frames a second has 50 new blocks a frame, a quiet road at
25 none."""


class BlockArtifactDetector:
    """Fed with every frame in order of presentation, detects those with many new blocks.

    A block is new where it lies outside the range of the frame before within three pixels, after global translation and
    change of brightness are compensated: a camera that vibrates moves its rows by as much. Traffic and parallax make
    some new blocks in every frame, so the threshold is a multiple of the typical number.
    """

    LONGEST_AGO = _MIN_HISTORY_FRAMES - 1
    """Largest age, in frames, of a frame that `feed` returns."""

    def __init__(self) -> None:
        self._previous: Float32Array | None = None
        self._counts: deque[int] = deque(maxlen=_HISTORY_FRAMES)
        self._window: Float32Array | None = None

    def feed(self, grey: GreyImage) -> tuple[int, ...]:
        """The frames found to have block artefacts, by how many frames ago they were fed: 0 is this one, (h, w) uint8.

        The first frames are judged together, once there are enough to know what is typical.
        """
        factor = 1 << max(round(np.log2(grey.shape[1] / _WORK_WIDTH)), 0)
        size = (max(grey.shape[1] // factor, 1), max(grey.shape[0] // factor, 1))
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        previous, self._previous = self._previous, small
        if previous is None or previous.shape != small.shape:
            self._counts.clear()
            return ()
        count = self._new_blocks(previous, small, max(BLOCK_PX // factor, 1), -(-_REACH_PX // factor))
        if len(self._counts) >= _MIN_HISTORY_FRAMES:
            found = (0,) if count > self._limit() else ()
            self._counts.append(count)
            return found
        self._counts.append(count)
        if len(self._counts) < _MIN_HISTORY_FRAMES:
            return ()
        return tuple(ago for ago, one in enumerate(reversed(self._counts)) if one > self._limit())

    def _limit(self) -> float:
        return _MIN_BLOCKS + _TYPICAL_FACTOR * float(np.median(self._counts))

    def _new_blocks(self, previous: Float32Array, current: Float32Array, block: int, reach: int) -> int:
        if self._window is None or self._window.shape != current.shape:
            self._window = cv2.createHanningWindow(current.shape[::-1], cv2.CV_32F)
        # With its window argument OpenCV 5 writes into its arguments.
        (dx, dy), _ = cv2.phaseCorrelate(previous * self._window, current * self._window)
        shift = np.array([[1, 0, dx], [0, 1, dy]])
        moved = cv2.warpAffine(previous, shift, current.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
        moved += np.float32(np.median(current[::4, ::4] - moved[::4, ::4]))
        kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        outside = np.maximum(current - cv2.dilate(moved, kernel), cv2.erode(moved, kernel) - current)
        rows, columns = current.shape[0] // block, current.shape[1] // block
        if not rows or not columns:
            return 0
        inner = np.maximum(outside[: rows * block, : columns * block], 0)
        means = cv2.resize(inner, (columns, rows), interpolation=cv2.INTER_AREA)
        border = max(int(np.ceil(max(abs(dx), abs(dy)) / block)), 0)  # pixels that the shift brings in are new
        return int(np.count_nonzero(means[border : rows - border, border : columns - border] > _MIN_DIFFERENCE))


# At this level h264 and mpeg4 log "concealing ... errors" for truncated slices, which they log as no error.
_LEVEL = av.logging.DEBUG
_CONCEALED = "concealing"
_HARMLESS = "SEI", "skipping unregistered", "Could not find codec parameters", "timescale not set", "unsupported color"
"""Logged for sound files too: side data of cameras, not frames."""

MARGIN = 4
"""The first bytes of a burst often decode without an error: so many frames before the first one are suspect, too."""

_lock = threading.Lock()
_users = 0
_before: tuple[int | None, bool] = (None, True)
_capture = av.logging.Capture(local=False)
_errors = 0


@contextmanager
def libav_log() -> Iterator[None]:
    """Enable libav's log while frames are read. Its level is the whole process's, so users are counted."""
    global _users, _before
    with _lock:
        if _users == 0:
            _capture.__enter__()
            _before = (av.logging.get_level(), av.logging.get_skip_repeated())
            av.logging.set_level(_LEVEL)
            av.logging.set_skip_repeated(False)  # a repeated error is an error each time
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0:
                _capture.__exit__(None, None, None)
                _capture.logs.clear()
                av.logging.set_level(_before[0])
                av.logging.set_skip_repeated(_before[1])


def count_errors() -> int:
    """Number of errors that libav's own threads have logged so far, of all decoders of this process."""
    global _errors
    with _lock:
        count = len(_capture.logs)
        _errors += sum(_is_error(level, message) for level, _, message in _capture.logs[:count])
        del _capture.logs[:count]
        return _errors


@contextmanager
def capture_errors() -> Iterator[list[str]]:
    """Collect the errors that libav logs on this thread; the list is filled when the context ends."""
    errors: list[str] = []
    with av.logging.Capture(local=True) as lines:
        try:
            yield errors
        finally:
            errors += [message.strip() for level, _, message in lines if _is_error(level, message)]


def _is_error(level: int, message: str) -> bool:
    if message.startswith(_CONCEALED):
        return True
    return level <= av.logging.ERROR and not any(words in message for words in _HARMLESS)


class CorruptionTracker:
    """Finds suspect frames, given the packets in decoding order and the errors as they are logged.

    Attributes
    ----------
    last_error : libav's last message.
    """

    def __init__(self, *, lasting: bool = False, midway: bool = False) -> None:
        self.last_error = ""
        self.lasting = lasting  # frames identified by order alone: after a loss, all that follow are suspect
        self._midway = (
            midway  # decoding started at a later key frame, which may release reference images that were never decoded
        )
        self._count = 0
        self._group = 0  # groups are counted by key frames; group 0 precedes the first one and cannot be decoded
        self._key_index = -1
        self._first_error: dict[int, int] = {}
        self._position: dict[int, tuple[int, int, bool]] = {}
        self._key_of: dict[int, int] = {}
        self._gradual = False

    def feed(self, packet: Any, index: int | None) -> None:
        """Register the packet of frame `index`, before it is decoded."""
        self._count += 1
        if packet.is_keyframe and packet.size:
            self._group += 1
            self._key_index = -1 if index is None else index
            self._key_of[self._group] = self._key_index
        elif self._group == 0 and packet.size and not self._first_error:
            self._first_error[0] = 0  # a frame before the first key frame lacks what it refers to
            self.last_error = "no key frame before it"
        if index is not None:
            # Presented before the key frame it follows in the file: it may refer to the group before, too.
            self._position[index] = (self._count, self._group, index < self._key_index)

    def mark(self, message: str) -> None:
        """Register an error logged while the last packet was decoded."""
        if self._midway and self._group == 1 and message.startswith("mmco"):
            return
        self.last_error = message
        self._first_error.setdefault(self._group, self._count - MARGIN)

    def mark_frame(self, index: int) -> None:
        """Register that the decoder marked frame `index` as corrupt."""
        self._mark_at(index, "marked as corrupt by the decoder")

    def mark_artifacts(self, index: int) -> None:
        """Register block artefacts in frame `index`. On a key frame after corruption they are the repair."""
        group = self._position.get(index, (0, self._group, False))[1]
        at_key = index == self._key_of.get(group)
        if at_key and group > 1:
            if group - 1 in self._first_error:
                return
            self._first_error[group - 1] = 0  # either of the two groups may be the corrupt one
        self.mark_frame(index)
        self.last_error = "block artefacts"

    def mark_lost(self, index: int) -> None:
        """Register that a frame before frame `index` was lost: later frames may refer to it."""
        self._mark_at(index, "a frame was lost")

    def _mark_at(self, index: int, message: str) -> None:
        position = self._position.get(index)
        self.last_error = self.last_error or message
        if position is not None:
            count, group, _ = position
            self._first_error[group] = min(count - MARGIN, self._first_error.get(group, count))

    def is_suspect(self, index: int) -> bool:
        """Whether frame `index` may be corrupt, by the errors so far."""
        # Where packets carry no time stamp (AVI), the frame's position is unknown: then any error since the key frame
        # before the last one counts.
        count, group, leading = self._position.get(index, (self._count, self._group, True))
        if self.lasting and self._first_error:
            return True
        own = group in self._first_error and count >= self._first_error[group]
        return own or ((leading or self._gradual) and group - 1 in self._first_error)

    def note_key_frame(self, is_intra: bool) -> None:
        """Register a decoded key frame. One that is no intra frame starts a gradual refresh, until the next one."""
        self._gradual = self._gradual or not is_intra
