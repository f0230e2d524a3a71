"""Names of format 1 and what they are called now. The old ones are read until version 0.3, and nowhere else."""

from collections.abc import Mapping
from typing import Any

from schemas.detector import DETECTOR_VERSION, METHODS, RECORDS, CascadeTraining

OLD_NAMES_UNTIL = "0.3"
"""The first version that reads no name of format 1."""

OLD_KEYS: dict[str, str] = {
    "detection.network_steps": "detection.fine_tune_steps",
    "registration.key_points": "registration.max_keypoints",
    "registration.key_point_scale": "registration.keypoint_scale",
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
    "detection.method": {"network": "cnn", "aligned": "cascade", "dense": "paper"},
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

DETECTOR_LAYERS = {
    "grain": "stem",
    "edges": "down1",
    "corners_0": "enc1_0",
    "corners_1": "enc1_1",
    "parts": "down2",
    "body_0": "res1_0",
    "body_1": "res1_1",
    "body_2": "res2_0",
    "body_3": "res2_1",
    "back": "up1",
    "middle": "dec1",
    "told": "head",
}
"""Old name of a layer of the network in a detector file -> name."""

DETECTOR_KEYS = {
    "network": "layers",
    "numbers": "weights_f16",
    "below": "leaf_low",
    "above": "leaf_high",
    "chosen": "operating_point",
    "evidence": "description",
    "least_score": "min_score",
    "least_first_score": "min_stage1_score",
    "still_grey": "bonus_ramp_start",
    "moving_grey": "bonus_ramp_end",
    "lift": "max_score_bonus",
}
"""Old key of a detector file, wherever in it -> key."""


def upgrade_detector(record: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a detector file of version 1 as version 2 has it."""
    found = _rename_keys(record, DETECTOR_KEYS)
    found["version"] = DETECTOR_VERSION
    found["method"] = _present_value("detection.method", found.get("method"))
    if isinstance(found.get("layers"), dict):
        found["layers"] = {DETECTOR_LAYERS.get(name, name): layer for name, layer in found["layers"].items()}
    of_others = {name for model in RECORDS for name in model.model_fields}
    for model in RECORDS:
        if model.model_fields["method"].default == found["method"]:
            of_others -= set(model.model_fields)
    return {name: value for name, value in found.items() if name not in of_others}


def _rename_keys(value: Any, names: Mapping[str, str]) -> Any:
    if isinstance(value, Mapping):
        return {names.get(name, name): _rename_keys(inner, names) for name, inner in value.items()}
    return [_rename_keys(inner, names) for inner in value] if isinstance(value, list) else value


OLD_FOLDERS: dict[str, str] = {"tracklets": "links", "tracks": "tracklets", "intervals": "slices"}
"""Folder of a run, and stage -> its old name."""

OLD_ARRAYS: dict[str, str] = {
    "n_matches_base": "count_base",
    "n_matches_previous": "count_previous",
    "n_inliers": "count_kept",
    "coverage": "spread",
    "velocity_histogram_time_weighted": "velocity_histogram_by_time",
    "occupancy_ms": "dwell_ms",
    "velocity_variance_sum": "velocity_noise",
    "mode_fraction": "mode_share",
    "stationary_fraction": "standing_share",
    "direction_ci90_half_width": "direction_half90",
    "speed_p50_ci90_lower": "speed_p50_low90",
    "speed_p50_ci90_upper": "speed_p50_high90",
}
"""Array of a Zarr store -> its old name."""

OLD_ATTRIBUTES: dict[str, str] = {"time_interval": "slice"}
"""Attribute of a field's store -> its old name."""

OLD_WEIGHTS: dict[str, str] = {"track": "passage"}
"""What a field is weighted by -> its old name."""

OLD_FIELDS: dict[str, dict[str, str]] = {
    "grid": {"how": "base_source", "frames_to": "registered_to"},
    "working": {
        "learnt_from": "training_source",
        "purity": "label_precision_estimate",
        "coherence": "axial_motion_fraction",
    },
    "report": {"few": "low_coverage_note"},
    "precision_recall": {"chosen": "operating_point", "evidence": "description"},
    "commit_counts": {"passages": "tracks"},
}
"""Record of a run folder -> its old field -> field."""

OLD_FIELD_VALUES: dict[str, dict[object, object]] = {
    "base_source": {"own": "flight"},
    "registered_to": {"own": "flight"},
}
"""Field of a record -> old value -> value."""


def upgrade_record(kind: str, record: Mapping[str, Any]) -> dict[str, Any]:
    """A record of format 1 by the present names of its fields; ``kind`` is one of `OLD_FIELDS`.

    Examples
    --------
    >>> upgrade_record("grid", {"how": "own", "width_px": 800})
    {'base_source': 'flight', 'width_px': 800}
    """
    present = {OLD_FIELDS[kind].get(name, name): value for name, value in record.items()}
    return {
        name: OLD_FIELD_VALUES.get(name, {}).get(value, value) if isinstance(value, str) else value
        for name, value in present.items()
    }


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
    upgraded = _copy_sections(tree)
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
    messages += _regroup_detection(upgraded.get("detection"))
    for key in OLD_VALUES:
        if not _has(upgraded, key):
            continue
        value = _take(upgraded, key)
        present = _present_value(key, value)
        _put(upgraded, key, present)
        if present is not value and key not in OLD_KEYS.values():
            messages.append(f"{key}={value} is now {key}={present}; the old value works until {OLD_NAMES_UNTIL}")
    return upgraded, messages


def _regroup_detection(section: Any) -> list[str]:
    """Take out of a section of format 1, which held the keys of all methods, those that its method never read."""
    method = _present_value("detection.method", section.get("method")) if isinstance(section, dict) else None
    if method is None or method == section["method"]:
        return []
    (model,) = (model for model in METHODS if model.model_fields["method"].default == method)
    messages = []
    for key in [
        key for key in section if key not in model.model_fields and any(key in m.model_fields for m in METHODS)
    ]:
        value = section.pop(key)
        if method == "cnn" and key in CascadeTraining.model_fields:
            section.setdefault("cascade", {})[key] = value
            messages.append(
                f"detection.{key} is now detection.cascade.{key}; the old name works until {OLD_NAMES_UNTIL}"
            )
        else:
            messages.append(f"detection.{key} is ignored: method {method} does not read it")
    return messages


def _copy_sections(tree: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _copy_sections(value) if isinstance(value, Mapping) else value for name, value in tree.items()}


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
