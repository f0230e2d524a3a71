"""Choice among several estimates of the ground sample distance, and contradictions between them."""

from collections.abc import Iterable

from schemas.scale import ScaleChoice, ScaleEstimate, ScaleSource

PRECEDENCE: tuple[ScaleSource, ...] = ("control_points", "base", "given", "metadata", "vehicles")
"""Sources from the most trusted on: measured on the ground, then on a map, then typed in by a person, who may know
better than a barometer that counts from the place of take-off; the lengths of vehicles are there for every flight."""
MAX_METADATA_RATIO = 1.25
_MIN_HALF_WIDTH = 0.02
"""Intervals are taken as at least this fraction to either side: below it, nobody would call it a contradiction."""


def choose_scale(estimates: Iterable[ScaleEstimate]) -> ScaleChoice:
    """Choose by `PRECEDENCE`; of two estimates of one source, the first.

    The lengths of vehicles come before metadata that contradict them by more than `MAX_METADATA_RATIO`: a start from a
    roof, a zoom or a unit that was misread change the metadata by any factor, and cars have one length.

    Examples
    --------
    >>> given = ScaleEstimate(gsd_m=0.06, low_m=0.06, high_m=0.06, source="given")
    >>> metadata = ScaleEstimate(gsd_m=0.05, low_m=0.048, high_m=0.052, source="metadata")
    >>> choice = choose_scale([metadata, given])
    >>> choice.used.source, choice.disagreements
    ('given', ('0.06 m a pixel by --gsd-m is used, but it is 0.05 m a pixel (90 % interval 0.048 to 0.052) by the \
metadata: speeds would be 0.833 times as high',))
    """
    ranked = sorted(estimates, key=lambda estimate: PRECEDENCE.index(estimate.source))
    if not ranked:
        return ScaleChoice()
    vehicles = next((one for one in ranked if one.source == "vehicles"), ranked[0])
    if ranked[0].source == "metadata" and not _agree(ranked[0], vehicles):
        ratio = max(vehicles.gsd_m / ranked[0].gsd_m, ranked[0].gsd_m / vehicles.gsd_m)
        ranked.sort(key=lambda one: ratio > MAX_METADATA_RATIO and one is not vehicles)
    used, *others = ranked
    disagreements = tuple(_disagreement(used, other) for other in others if not _agree(used, other))
    return ScaleChoice(used=used, others=tuple(others), disagreements=disagreements)


def _agree(one: ScaleEstimate, other: ScaleEstimate) -> bool:
    (low, high), (other_low, other_high) = _interval(one), _interval(other)
    return low <= other_high and other_low <= high


def _interval(estimate: ScaleEstimate) -> tuple[float, float]:
    return (
        min(estimate.low_m, estimate.gsd_m * (1 - _MIN_HALF_WIDTH)),
        max(estimate.high_m, estimate.gsd_m * (1 + _MIN_HALF_WIDTH)),
    )


def _disagreement(used: ScaleEstimate, other: ScaleEstimate) -> str:
    times = f"{other.gsd_m / used.gsd_m:.3g}"
    return f"{used.text()} is used, but it is {other.text()}: speeds would be {times} times as high"
