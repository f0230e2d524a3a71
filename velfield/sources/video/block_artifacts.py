"""Block artefacts of a corrupt bitstream, detected in the decoded frames.

Many decoders (HEVC always, MPEG-4 often) decode flipped bits without logging an error. The result is blocks that the
frame before does not have, in a stream whose frames otherwise follow from each other.
"""

from collections import deque

import cv2
import numpy as np

from schemas.arrays import Float32Array, GreyImage

BLOCK_PX = 16
"""Side of a macroblock in most codecs."""
_WORK_WIDTH = 480
_MIN_DIFFERENCE = 8.0
"""Grey levels: a block is new where its mean lies this far outside the range of its surroundings a frame ago."""
_MIN_BLOCKS = 3
_TYPICAL_FACTOR = 3.0
_HISTORY_FRAMES = 15
_MIN_HISTORY_FRAMES = 3
_DEFAULT_COUNT = 10.0
"""New blocks a frame, the most seen in sound videos: assumed typical until there is a history."""


class BlockArtifactDetector:
    """Fed with every frame in order of presentation, detects those with many new blocks.

    A block is new where it lies outside the range of the frame before within one pixel (at a width of some 480 px),
    after global translation and change of brightness are compensated. Traffic and parallax make some new blocks in
    every frame, so the threshold is a multiple of the typical number.
    """

    def __init__(self) -> None:
        self._previous: Float32Array | None = None
        self._counts: deque[int] = deque(maxlen=_HISTORY_FRAMES)
        self._window: Float32Array | None = None

    def feed(self, grey: GreyImage) -> bool:
        """Whether this frame, (h, w) uint8, has block artefacts."""
        factor = 1 << max(round(np.log2(grey.shape[1] / _WORK_WIDTH)), 0)
        size = (max(grey.shape[1] // factor, 1), max(grey.shape[0] // factor, 1))
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        previous, self._previous = self._previous, small
        if previous is None or previous.shape != small.shape:
            self._counts.clear()
            return False
        count = self._new_blocks(previous, small, max(BLOCK_PX // factor, 1))
        typical = float(np.median(self._counts)) if len(self._counts) >= _MIN_HISTORY_FRAMES else _DEFAULT_COUNT
        self._counts.append(count)
        return count > _MIN_BLOCKS + _TYPICAL_FACTOR * typical

    def _new_blocks(self, previous: Float32Array, current: Float32Array, block: int) -> int:
        if self._window is None or self._window.shape != current.shape:
            self._window = cv2.createHanningWindow(current.shape[::-1], cv2.CV_32F)
        # With its window argument OpenCV 5 writes into its arguments.
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
        border = max(int(np.ceil(max(abs(dx), abs(dy)) / block)), 0)  # pixels that the shift brings in are new
        return int(np.count_nonzero(means[border : rows - border, border : columns - border] > _MIN_DIFFERENCE))
