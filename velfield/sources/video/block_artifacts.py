"""Damage that no log tells, seen in the pictures themselves: blocks that come out of nowhere.

Many decoders (HEVC always, MPEG-4 often) decode flipped bytes without a word. What they make of them is blocks that
were not there a frame ago, in a stream whose frames otherwise follow from each other.
"""

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

BLOCK_PX = 16
"""Macroblocks of most codecs."""
_WORK_WIDTH = 480
_LEVELS = 8.0  # a block whose mean lies this far outside what stood about it a frame ago is new
_FEW_BLOCKS = 3
_USUAL_FACTOR = 3.0
_MEMORY = 15
_ENOUGH = 3  # frames that tell what is usual; before them, the most that a film was seen to have:
_UNKNOWN = 10.0


class PictureBreaks:
    """Fed with every frame as it is shown, tells where blocks appear that nothing led up to.

    A block counts as new where it lies outside the range of the frame before within one pixel (at a width of some 480
    px), after the shift and the change of brightness of the whole. Traffic and parallax make some such blocks in every
    frame: only several times as many as usual are a break.
    """

    def __init__(self) -> None:
        self._previous: NDArray[np.float32] | None = None
        self._counts: deque[int] = deque(maxlen=_MEMORY)
        self._window: NDArray[np.float32] | None = None

    def feed(self, grey: NDArray[np.uint8]) -> bool:
        """Whether blocks of this frame, (h, w) uint8, were not led up to by the frame before."""
        factor = 1 << max(round(np.log2(grey.shape[1] / _WORK_WIDTH)), 0)
        size = (max(grey.shape[1] // factor, 1), max(grey.shape[0] // factor, 1))
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        previous, self._previous = self._previous, small
        if previous is None or previous.shape != small.shape:
            self._counts.clear()
            return False
        count = self._new_blocks(previous, small, max(BLOCK_PX // factor, 1))
        usual = float(np.median(self._counts)) if len(self._counts) >= _ENOUGH else _UNKNOWN
        self._counts.append(count)
        return count > _FEW_BLOCKS + _USUAL_FACTOR * usual

    def _new_blocks(self, previous: NDArray[np.float32], current: NDArray[np.float32], block: int) -> int:
        if self._window is None or self._window.shape != current.shape:
            self._window = cv2.createHanningWindow(current.shape[::-1], cv2.CV_32F)
        # With its window argument OpenCV 5 writes into the pictures it is given.
        (dx, dy), _ = cv2.phaseCorrelate(previous * self._window, current * self._window)
        shift = np.array([[1, 0, dx], [0, 1, dy]])
        moved = cv2.warpAffine(previous, shift, current.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
        moved += np.float32(np.median(current[::4, ::4] - moved[::4, ::4]))
        kernel = np.ones((3, 3), np.uint8)
        outside = np.maximum(current - cv2.dilate(moved, kernel), cv2.erode(moved, kernel) - current)
        rows, columns = current.shape[0] // block, current.shape[1] // block
        if not rows or not columns:
            return 0
        inner = np.maximum(outside[: rows * block, : columns * block], 0)
        means = cv2.resize(inner, (columns, rows), interpolation=cv2.INTER_AREA)
        border = max(int(np.ceil(max(abs(dx), abs(dy)) / block)), 0)  # what the shift brings in was not there before
        return int(np.count_nonzero(means[border : rows - border, border : columns - border] > _LEVELS))
