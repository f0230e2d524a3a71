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
    "tracklets": "{tracklets:.0f} tracklets over three frames",
    "tracks": "{tracks:.0f} vehicle tracks from {tracklets:.0f} tracklets",
    "field": "vehicles passed {pixels:.0f} pixels, 5 or more vehicles {pixels_5:.0f} of them",
    "maps": "{maps:.0f} maps",
}
_GIVEN_BASE = (
    "base image {width:.0f} x {height:.0f} px as given, points left out of the fit to it miss by "
    "{intersensor_error_px:.2f} px"
)
_LENS_BY_POINTS = "distortion of {corner_px:.1f} px at the corners"
_PIN_HOLE = "no distortion that the evidence bears out: taken for a pin-hole"
_LEARNT_ELSEWHERE = "learnt elsewhere, threshold {threshold:.3f}"
_NO_DETECTOR = "none: another program's boxes are taken"
_MEANS = frozenset({"heldout_px", "residual_px"})
"""Counts that are averaged over units, weighted by frames; all others are summed."""


def summarise_stage(
    name: str,
    records: Sequence[CommitRecord],
    *,
    units: int,
    before: Sequence[CommitRecord],
    lost: Sequence[str],
    seconds: float,
) -> StageSummary:
    """Add up a stage's units; ``before``: those that an earlier run had finished."""
    counts = _total([record.counts for record in records])
    line = _line(name, counts)
    text = line.format_map({key: counts.get(key, float("nan")) for key in _keys(line)})
    if before:
        text += f" ({len(before)} of {units} units were done before)" if len(before) < units else " (done before)"
    if lost:
        text += f"; {len(lost)} of {units} units lost"
    return StageSummary(
        name=name,
        units=units,
        done_before=len(before),
        lost=tuple(lost),
        counts=counts,
        notes=tuple(note for record in records for note in record.notes),
        warnings=tuple(warning for record in records for warning in record.warnings),
        seconds=seconds,
        seconds_before=sum(record.seconds for record in before),
        text=text,
    )


def _line(name: str, counts: Mapping[str, float]) -> str:
    if name == "lens" and not counts.get("corner_px"):
        return _PIN_HOLE
    if name == "lens" and "residual_px" not in counts:
        return _LENS_BY_POINTS
    if name == "base" and "intersensor_error_px" in counts:
        return _GIVEN_BASE
    if name == "detector" and counts and "threshold" not in counts:
        return _NO_DETECTOR
    if name == "detector" and counts.get("labels") == 0:
        return _LEARNT_ELSEWHERE
    return _LINES[name]


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
