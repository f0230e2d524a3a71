"""Limits of the gates in base pixels and seconds, and the counts of candidates that each gate rejects."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from schemas.flight import PAPER_GSD_M, TrackingConfig


@dataclass(frozen=True)
class Limits:
    """The gates of a flight in base pixels, seconds and radians.

    Attributes
    ----------
    max_speed_px_per_s, stationary_speed_px_per_s, max_acceleration_px_per_s2
        Physical limits, base px.
    max_turn_rad, max_axis_offset_rad
        Angles between the two segments, and between motion and the car's axis.
    jitter_px, jitter_sigmas
        Standard deviation of a detection's position, base px, and by how many of them gates are widened.
    max_interval_s
        Longest interval between two frames of a window.
    """

    max_speed_px_per_s: float
    stationary_speed_px_per_s: float
    max_acceleration_px_per_s2: float
    max_turn_rad: float
    max_axis_offset_rad: float
    jitter_px: float
    jitter_sigmas: float
    max_interval_s: float

    @classmethod
    def from_config(cls, config: TrackingConfig, gsd_m: float | None) -> "Limits":
        """Limits in base pixels. Without a ground sample distance they are the paper's in pixels (150 px/s, 5 px/s,
        100 px/s^2).

        Examples
        --------
        >>> Limits.from_config(TrackingConfig(), None).max_speed_px_per_s
        150.0
        """
        metres = PAPER_GSD_M if gsd_m is None else gsd_m
        return cls(
            max_speed_px_per_s=config.max_speed_m_per_s / metres,
            stationary_speed_px_per_s=config.stationary_speed_m_per_s / metres,
            max_acceleration_px_per_s2=config.max_acceleration_m_per_s2 / metres,
            max_turn_rad=config.max_turn_rad,
            max_axis_offset_rad=config.max_axis_offset_rad,
            jitter_px=config.jitter_px,
            jitter_sigmas=config.jitter_sigmas,
            max_interval_s=config.max_interval_s,
        )

    def position_sd_px(self, residual_px: float) -> float:
        """Standard deviation of a detection's position along x or y: the detector's and registration's, base px."""
        return float(np.hypot(self.jitter_px, residual_px))


@dataclass
class GateLog(Mapping[str, int]):
    """Counts by gate; logs of disjoint sets of windows add up to the log of their union.

    Links of every pair of consecutive frames: ``links_tried`` (within twice the reach), of which rejected by
    ``speed``, ``axis``, and, with ``linking = pairwise``, ``appearance`` (not the mutual best in appearance). Pairs of
    links of every window: ``pairs_tried``, of which rejected by ``turn``, ``acceleration``, ``not_best`` (a pair
    through one of the same detections is cheaper) or ``confidence`` (the best, but ambiguous). Windows: ``windows``,
    ``frames_not_registered``, ``gaps_too_long``. Accepted: ``tracklets``; and of their links, two each,
    ``links_refined`` and ``links_not_refined`` (displacement not from the crops).
    """

    counts: dict[str, int] = field(default_factory=dict)

    def add(self, gate: str, count: int) -> None:
        """Add to the count of one gate."""
        self.counts[gate] = self.counts.get(gate, 0) + int(count)

    def __add__(self, other: "GateLog") -> "GateLog":
        total = GateLog(dict(self.counts))
        for gate, count in other.items():
            total.add(gate, count)
        return total

    def __getitem__(self, gate: str) -> int:
        return self.counts.get(gate, 0)

    def __iter__(self) -> Iterator[str]:
        return iter(self.counts)

    def __len__(self) -> int:
        return len(self.counts)
