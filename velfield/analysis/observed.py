"""Slices of the times that are seen: counts in them give flows and how much these vary."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from schemas.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class ObservedSlices:
    """Begins and ends (n,) of slices of about equal length, s, in time order; none holds a time that is not seen."""

    begin_s: FloatArray
    end_s: FloatArray

    @classmethod
    def of(cls, observed_s: FloatArray, slice_s: float) -> Self:
        """Slices of times (k, 2) that are seen; one shorter than half a slice is left out, unless all are.

        Examples
        --------
        >>> ObservedSlices.of(np.array([[0.0, 130.0], [500.0, 520.0], [600.0, 655.0]]), 60.0).begin_s.tolist()
        [0.0, 65.0, 600.0]
        """
        length = observed_s[:, 1] - observed_s[:, 0]
        used = observed_s[length >= min(slice_s / 2, float(length.max(initial=0.0)))]
        edges = [np.linspace(begin, end, max(round((end - begin) / slice_s), 1) + 1) for begin, end in used]
        none = np.empty(0)
        return cls(np.concatenate([none, *(e[:-1] for e in edges)]), np.concatenate([none, *(e[1:] for e in edges)]))

    def __len__(self) -> int:
        return len(self.begin_s)

    @property
    def hours(self) -> float:
        """Length of all of them, h."""
        return float((self.end_s - self.begin_s).sum()) / 3600

    def number(self, time_s: FloatArray) -> IntArray:
        """Number (m,) of the slice that each time lies in, -1 in none."""
        if not len(self):
            return np.full(len(time_s), -1)
        number = np.searchsorted(self.begin_s, time_s, side="right") - 1
        return np.where((number >= 0) & (time_s <= self.end_s[number]), number, -1)

    def sums(self, time_s: FloatArray, weights: FloatArray | None = None) -> FloatArray:
        """Sum (n,) in each slice of the weights, 1 by default, of what happens at times (m,)."""
        number = self.number(time_s)
        inside = number >= 0
        return np.bincount(number[inside], None if weights is None else weights[inside], len(self)).astype(np.float64)
