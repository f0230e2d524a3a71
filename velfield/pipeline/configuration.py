"""The configuration from its four sources, each stronger than the one before: preset, file, ``--set``, options."""

import difflib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast, get_args

import yaml
from pydantic import BaseModel, ValidationError

from schemas.flight import PRESETS, FlightConfig, Preset
from schemas.renames import upgrade_config
from velfield.errors import InputError, OldNameWarning

Tree = dict[str, Any]


def resolve_config(
    *,
    preset: str | None = None,
    file: Path | None = None,
    settings: Sequence[str] = (),
    overrides: Mapping[str, object] | None = None,
) -> FlightConfig:
    """The configuration of a run.

    Parameters
    ----------
    preset
        ``best``, ``fast`` or ``paper``; none: the file's, else ``best``.
    file
        YAML of ``FlightConfig``'s fields.
    settings
        ``section.key=value`` each, the value in YAML.
    overrides
        ``section.key`` -> value; a value of ``None`` is left out.

    Raises
    ------
    InputError
        An unknown key (with what was meant, perhaps), or a value out of range.

    Examples
    --------
    >>> resolve_config(settings=["tracking.max_speed_m_per_s=20"]).tracking.max_speed_m_per_s
    20.0
    """
    given = _present_names(_read(file), str(file)) if file else {}
    asked: Tree = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals:
            raise InputError(f"--set {setting}: found no '='; expected section.key=value")
        _put(asked, key.strip(), _yaml(value, f"--set {setting}"))
    given = _merge(given, _present_names(asked, "--set"))
    for dotted, override in (overrides or {}).items():
        if override is not None:
            _put(given, dotted, override)
    name = preset or given.get("preset") or "best"
    if name not in get_args(Preset):
        raise InputError(f"preset {name!r} is not known; expected one of {', '.join(get_args(Preset))}")
    chosen = cast(Preset, name)
    tree = _merge(PRESETS[chosen], given)
    tree["preset"] = chosen
    return _validate(tree, str(file) if file else "configuration")


def _read(file: Path) -> Tree:
    if not file.exists():
        raise InputError(f"--config: {file} is not there; give a YAML file, see examples/flight.yaml")
    tree = _yaml(file.read_text(), str(file)) or {}
    if not isinstance(tree, dict):
        raise InputError(
            f"{file}: found a {type(tree).__name__}; expected sections with keys, see examples/flight.yaml"
        )
    # A section all of whose keys are commented out, as `velfield init` writes it, says nothing.
    return {key: value for key, value in tree.items() if value is not None or not _is_section(key)}


def _present_names(tree: Tree, what: str) -> Tree:
    """The tree by the present names; a warning for each old one."""
    try:
        tree, messages = upgrade_config(tree)
    except ValueError as error:
        raise InputError(f"{what}: {error}") from None
    for message in messages:
        warnings.warn(f"{what}: {message}", OldNameWarning, stacklevel=3)
    return tree


def _is_section(key: str) -> bool:
    info = FlightConfig.model_fields.get(key)
    return info is not None and isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel)


def _yaml(text: str, what: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None or "\n" not in text.strip() else f"line {mark.line + 1}: "
        problem = getattr(error, "problem", None) or "it cannot be read"
        raise InputError(
            f"{what}: {where}this is not YAML ({problem}); expected `section:` on a line of its own and its keys, "
            "indented alike, below it"
        ) from None


def _put(tree: Tree, dotted: str, value: object) -> None:
    *sections, key = dotted.split(".")
    for section in sections:
        tree = tree.setdefault(section, {})
        if not isinstance(tree, dict):
            raise InputError(f"{dotted}: {section} is a value, not a section")
    tree[key] = value


def _merge(below: Mapping[str, Any], above: Mapping[str, Any]) -> Tree:
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        merged[key] = _merge(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return merged


def _validate(tree: Tree, what: str) -> FlightConfig:
    try:
        return FlightConfig.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise InputError(f"{what}: unknown key {where!r}{_did_you_mean(where)}") from None
        raise InputError(f"{what}: {where} = {first['input']!r}: {first['msg'].lower()}") from None


def _did_you_mean(key: str) -> str:
    close = difflib.get_close_matches(key, list(_keys(FlightConfig)), n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else "; `velfield schema` lists the keys"


def _keys(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for name, info in model.model_fields.items():
        yield prefix + name
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            yield from _keys(info.annotation, f"{prefix}{name}.")
