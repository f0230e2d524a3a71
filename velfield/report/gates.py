"""Counts of tracking's gates as tables for the report: candidates and tracklets, and the rejected ones by gate."""

from collections.abc import Mapping

_TOTALS = {
    "windows": "Windows of three frames",
    "links_tried": "Links tried, from a car to one in the next frame",
    "pairs_tried": "Pairs of links tried, over three frames",
    "tracklets": "Pairs accepted: tracklets",
    "moving_candidates": "Tracklets of candidates that the detector was not sure of, by their motion",
    "links_refined": "Links of tracklets refined in the images",
    "links_not_refined": "Links of tracklets not refined",
}
_REJECTIONS = {
    "frames_not_registered": ("frames", "not registered to the map", None),
    "gaps_too_long": ("frames", "the next one comes too late", None),
    "speed": ("links", "faster than a vehicle", "links_tried"),
    "axis": ("links", "not along the car's axis", "links_tried"),
    "appearance": ("links", "another car has the more similar appearance", "links_tried"),
    "turn": ("pairs", "change direction too fast", "pairs_tried"),
    "acceleration": ("pairs", "change speed too fast", "pairs_tried"),
    "not_best": ("pairs", "another pair with the same car is more likely", "pairs_tried"),
    "confidence": ("pairs", "most likely, but ambiguous", "pairs_tried"),
}
"""Gate -> what it rejects, why, and the total it is a fraction of."""

Rows = list[tuple[str, ...]]


def totals_table(gates: Mapping[str, int]) -> Rows:
    """Candidates and accepted ones: description and count. A count without a description has its own name."""
    known = [(words, f"{gates[name]:,}") for name, words in _TOTALS.items() if name in gates]
    others = [name for name in gates if name not in _TOTALS and name not in _REJECTIONS]
    return [*known, *((name.replace("_", " "), f"{gates[name]:,}") for name in others)]


def rejection_table(gates: Mapping[str, int]) -> Rows:
    """Rejected candidates by gate: kind, reason, count, and fraction of those tried."""
    return [
        (kind, why, f"{gates[name]:,}", _fraction(gates[name], gates.get(total or "", 0)))
        for name, (kind, why, total) in _REJECTIONS.items()
        if name in gates
    ]


def _fraction(count: int, tried: int) -> str:
    return f"{100 * count / tried:.0f} %" if tried else ""
