"""Names of format 1 and what they are called now. The old ones are read until version 0.3, and nowhere else."""

from collections.abc import Mapping
from typing import Any

OLD_NAMES_UNTIL = "0.3"
"""The first version that reads no name of format 1."""

OLD_KEYS: dict[str, str] = {
    "registration.window_px": "registration.match_search_px",
    "registration.segment_frames": "registration.chain_length_frames",
    "tracking.slow_m_per_s": "tracking.stationary_speed_m_per_s",
    "tracking.join_gap_s": "tracking.max_gap_s",
    "tracking.join_standing_gap_s": "tracking.max_stationary_gap_s",
    "field.one_pixel_wide": "field.path_width",
    "field.weigh_shared_segments": "field.shared_segment_weight",
    "field.standing_m_per_s": "field.stationary_speed_m_per_s",
    "field.by_time": "field.time_weighted",
    "field.slice": "field.time_intervals",
}
"""Old configuration key -> key."""

OLD_VALUES: dict[str, dict[object, object]] = {
    "tracking.linking": {"links": "pairwise"},
    "field.path_width": {True: "pixel", False: "lane"},
    "field.shared_segment_weight": {"once": 1, "twice": 2},
}
"""Configuration key -> old value -> value."""

REMOVED_KEYS: dict[str, str] = {
    "tracking.patch_width_px": "no stage read it; appearance is compared on patches of 8 x 16 working px",
    "tracking.patch_length_px": "no stage read it; appearance is compared on patches of 8 x 16 working px",
}
"""Old configuration key -> why it is gone: it is ignored."""


def upgrade_config(tree: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """A configuration of either format by the present names, and a line for each old name that was found.

    Raises
    ------
    ValueError
        A parameter is given by its old and by its present name.

    Examples
    --------
    >>> upgrade_config({"tracking": {"join_gap_s": 1.0}})
    ({'tracking': {'max_gap_s': 1.0}}, ['tracking.join_gap_s is now tracking.max_gap_s; the old name works until 0.3'])
    """
    upgraded = _copied(tree)
    messages = []
    for key, reason in REMOVED_KEYS.items():
        if _has(upgraded, key):
            _take(upgraded, key)
            messages.append(f"{key} is ignored: {reason}")
    for old, key in OLD_KEYS.items():
        if not _has(upgraded, old):
            continue
        if _has(upgraded, key):
            raise ValueError(f"found {old} and {key}, two names of one parameter; keep {key}")
        value = _take(upgraded, old)
        _put(upgraded, key, value)
        present = _present_value(key, value)
        also = "" if present is value else f": {_text(value)} is {_text(present)} there"
        messages.append(f"{old} is now {key}{also}; the old name works until {OLD_NAMES_UNTIL}")
    for key in OLD_VALUES:
        if not _has(upgraded, key):
            continue
        value = _take(upgraded, key)
        present = _present_value(key, value)
        _put(upgraded, key, present)
        if present is not value and key not in OLD_KEYS.values():
            messages.append(f"{key}={value} is now {key}={present}; the old value works until {OLD_NAMES_UNTIL}")
    return upgraded, messages


def _copied(tree: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _copied(value) if isinstance(value, Mapping) else value for name, value in tree.items()}


def _present_value(key: str, value: object) -> object:
    return next(
        (new for old, new in OLD_VALUES.get(key, {}).items() if type(old) is type(value) and old == value), value
    )


def _text(value: object) -> str:
    """A value as YAML writes it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _section(tree: dict[str, Any], key: str) -> tuple[dict[str, Any] | None, str]:
    *sections, name = key.split(".")
    for section in sections:
        inner = tree.get(section)
        if not isinstance(inner, dict):
            return None, name
        tree = inner
    return tree, name


def _has(tree: dict[str, Any], key: str) -> bool:
    section, name = _section(tree, key)
    return section is not None and name in section


def _take(tree: dict[str, Any], key: str) -> Any:
    section, name = _section(tree, key)
    assert section is not None
    return section.pop(name)


def _put(tree: dict[str, Any], key: str, value: object) -> None:
    *sections, name = key.split(".")
    for section in sections:
        tree = tree.setdefault(section, {})
    tree[name] = value
