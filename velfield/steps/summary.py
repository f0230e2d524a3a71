"""One line a stage: what a person wants to know when it is done."""

from collections.abc import Mapping, Sequence

from schemas.records import CommitRecord
from schemas.summary import StageSummary

_LINES: dict[str, str] = {
    "frames": "{usable:.0f} of {frames:.0f} frames read",
    "lens": "distortion of {corner_px:.1f} px at the corners, lines straight to {residual_px:.2f} px",
    "base": "base image {width:.0f} x {height:.0f} px from {frames:.0f} frames",
    "registration": "{registered:.0f} of {frames:.0f} frames registered, held-out residual {heldout_px:.2f} px",
    "detector": "{labels:.0f} cars to learn from, threshold {threshold:.3f}",
    "detections": "{cars:.0f} cars in {frames:.0f} frames",
    "links": "{tracklets:.0f} tracklets over three frames",
    "tracklets": "{passages:.0f} vehicles going by in {tracklets:.0f} tracklets",
    "field": "{pixels:.0f} pixels known, {pixels_5:.0f} of them by 5 or more vehicles",
    "maps": "{maps:.0f} maps",
}
_MEANS = frozenset({"heldout_px", "residual_px"})
"""Counts that are averaged over units, weighted by frames; all others are summed."""


def summarise_stage(
    name: str, records: Sequence[CommitRecord], *, units: int, done_before: int, lost: Sequence[str], seconds: float
) -> StageSummary:
    """Add up a stage's units."""
    counts = _total([record.counts for record in records])
    text = _LINES[name].format_map({key: counts.get(key, float("nan")) for key in _keys(_LINES[name])})
    if done_before:
        text += f" ({done_before} of {units} units were done before)" if done_before < units else " (done before)"
    if lost:
        text += f"; {len(lost)} of {units} units lost"
    return StageSummary(
        name=name,
        units=units,
        done_before=done_before,
        lost=tuple(lost),
        counts=counts,
        notes=tuple(note for record in records for note in record.notes),
        seconds=seconds,
        text=text,
    )


def _keys(line: str) -> list[str]:
    return [part.split(":")[0] for part in line.split("{")[1:]]


def _total(units: Sequence[Mapping[str, float]]) -> dict[str, float]:
    total: dict[str, float] = {}
    weights = [unit.get("frames", 1.0) for unit in units]
    for key in sorted({key for unit in units for key in unit}):
        values = [(unit[key], weight) for unit, weight in zip(units, weights, strict=True) if key in unit]
        if key in _MEANS:
            total[key] = sum(v * w for v, w in values) / max(sum(w for _, w in values), 1e-12)
        else:
            total[key] = sum(v for v, _ in values)
    return total
