"""A trained boosted classifier as arrays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Float32Array
from schemas.detector import Round

Int32s = NDArray[np.int32]


@dataclass(frozen=True)
class BoostedStumps:
    """A boosted classifier as arrays, for the kernels."""

    rectangles: Int32s
    """(r, 5) int32: sign, x0, y0, x1, y1 from the centre."""
    starts: Int32s
    """(rounds + 1,) int32: the rectangles of round k are ``starts[k]:starts[k + 1]``."""
    thresholds: Float32Array
    """(rounds,)"""
    leaves: Float32Array
    """(rounds, 2) what a round adds to the score at or below its threshold, and above."""

    @classmethod
    def from_rounds(cls, rounds: Sequence[Round]) -> "BoostedStumps":
        """The stumps of the rounds in a detector's record."""
        table = [(r.sign, r.x0, r.y0, r.x1, r.y1) for one in rounds for r in one.rectangles]
        starts = np.cumsum([0, *(len(one.rectangles) for one in rounds)])
        return cls(
            rectangles=np.array(table, np.int32).reshape(-1, 5),
            starts=starts.astype(np.int32),
            thresholds=np.array([one.threshold for one in rounds], np.float32),
            leaves=np.array([(one.leaf_low, one.leaf_high) for one in rounds], np.float32),
        )

    def __len__(self) -> int:
        return len(self.thresholds)
