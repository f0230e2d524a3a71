"""The configuration from its four sources, each overriding the ones before: preset, file, ``--set``, options."""

import difflib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar, cast, get_args

import yaml
from pydantic import BaseModel, ValidationError

from schemas.flight import PRESETS, READ_WITH, FlightConfig, Preset
from schemas.model import load_yaml
from velfield.errors import IneffectiveSettingWarning, InputError
from velfield.sources.table import read_text

Tree = dict[str, Any]
ModelT = TypeVar("ModelT", bound=BaseModel)
_SIMILAR = 0.6
"""Similarity from which an unknown key is taken for a misspelt one."""


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
        An unknown key (with the nearest known one), or a value out of range.

    Examples
    --------
    >>> resolve_config(settings=["tracking.max_speed_m_per_s=20"]).tracking.max_speed_m_per_s
    20.0
    """
    given = _read(file) if file else {}
    asked: Tree = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals:
            raise InputError(f"--set {setting}: found no '='; expected section.key=value")
        _put(asked, key.strip(), _yaml(value, f"--set {setting}"))
    given = _merge(given, asked)
    for dotted, override in (overrides or {}).items():
        if override is not None:
            _put(given, dotted, override)
    name = preset or given.get("preset") or "best"
    if name not in get_args(Preset):
        raise InputError(f"preset {name!r} is not known; expected one of {', '.join(get_args(Preset))}")
    chosen = cast(Preset, name)
    tree = _merge(_of_methods(PRESETS[chosen], given), given)
    tree["preset"] = chosen
    config = _validate(tree, str(file) if file else "configuration")
    for message in _ineffective(config, given):
        warnings.warn(message, IneffectiveSettingWarning, stacklevel=2)
    return config


def from_options(model: type[ModelT], options: Mapping[str, tuple[str, object]]) -> ModelT:
    """A model from options of the command line.

    Parameters
    ----------
    options
        Field -> the option as it was given, for the message, and the field's value.

    Raises
    ------
    InputError
        A value out of range; the message names the option.

    Examples
    --------
    >>> from schemas.simulation import SimulationConfig
    >>> from_options(SimulationConfig, {"frames": ("--frames 9", 9)}).frames
    9
    """
    try:
        return model.model_validate({name: value for name, (_, value) in options.items()})
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0])
        raise InputError(f"{options[name][0]}: {_problem(first['msg'])}{_what_is(model, name)}") from None


def _of_methods(preset: Mapping[str, Any], given: Mapping[str, Any]) -> Tree:
    """A preset for the methods that are given: a section's keys belong to its own method, or to one that it names."""

    def of_method(name: str) -> Any:
        section = given.get(name)
        method = section.get("method") if isinstance(section, Mapping) else None
        if method is None or method == preset[name].get("method", method):
            return preset[name]
        return preset[name].get(method)

    return {name: section for name in preset if (section := of_method(name)) is not None}


def _read(file: Path) -> Tree:
    if not file.exists():
        raise InputError(f"--config {file}: no such file; `velfield init VIDEO` writes one")
    tree = _yaml(read_text(file, "configuration"), str(file)) or {}
    if not isinstance(tree, dict):
        raise InputError(
            f"--config {file}: found no keys; expected sections with keys, as `velfield init VIDEO` writes them"
        )
    # A section all of whose keys are commented out, as `velfield init` writes it, is null.
    return {key: value for key, value in tree.items() if value is not None or not section_models(key)}


def section_models(section: str) -> list[type[BaseModel]]:
    """The models that a section may have: one, or one for each method, the default first; none where it is no section.

    Examples
    --------
    >>> [model.__name__ for model in section_models("detection")]
    ['CnnConfig', 'PaperConfig']
    """
    info = FlightConfig.model_fields.get(section)
    return [] if info is None else _models(info.annotation)


def _models(annotation: object) -> list[type[BaseModel]]:
    """The models that a key may hold: none, one, or in a tagged union one for each method."""
    if isinstance(annotation, type):
        return [annotation] if issubclass(annotation, BaseModel) else []
    return [model for inner in get_args(annotation) for model in _models(inner)]


def _ineffective(config: FlightConfig, given: Tree) -> Iterator[str]:
    """A line for each key that was given another value than its default, and that the methods chosen do not read."""
    defaults = FlightConfig()
    for key, deciding in READ_WITH.items():
        section, _, name = key.partition(".")
        if name not in (given.get(section) or {}) or attrgetter(key)(config) == attrgetter(key)(defaults):
            continue
        for other, values in deciding.items():
            value = attrgetter(other)(config)
            if value not in values:
                yield f"{key} has no effect with {other}={yaml.safe_dump(value).split(chr(10))[0]}"


def _yaml(text: str, what: str) -> Any:
    try:
        return load_yaml(text)
    except (RecursionError, ValueError) as error:  # sections within sections without end; a date that is none
        problem = "sections lie too deep in each other" if isinstance(error, RecursionError) else str(error)
        raise InputError(
            f"{what}: this is not YAML that can be read ({problem}); `velfield init VIDEO` writes one that can"
        ) from None
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
        section, method, path = _parts(first["loc"])
        where = ".".join((section, *path))
        if first["type"] == "extra_forbidden":
            if method is not None and len(path) == 1 and (unread := _unread(section, method, path[0])):
                raise InputError(f"{what}: {unread}") from None
            raise InputError(f"{what}: unknown key {where!r}{_did_you_mean(where)}") from None
        if first["type"] == "union_tag_invalid":
            found, expected = first["ctx"]["tag"], first["ctx"]["expected_tags"]
            raise InputError(f"{what}: {where}.method = {found!r}: expected one of {expected}") from None
        problem = "expected keys with values" if first["type"] == "union_tag_not_found" else _problem(first["msg"])
        # What a section's keys are together has no one value: the problem names them.
        found = where if first["type"] == "value_error" and not path else f"{where} = {first['input']!r}"
        raise InputError(f"{what}: {found}: {problem}{_what_is(FlightConfig, where)}") from None


def _parts(location: Sequence[str | int]) -> tuple[str, str | None, tuple[str, ...]]:
    """Section, method where it has some, and path in it, of the place of an error."""
    section, *path = map(str, location)
    if len(section_models(section)) > 1 and path:
        return section, path[0], tuple(path[1:])
    return section, None, tuple(path)


def _unread(section: str, method: str, key: str) -> str:
    """Message that a key belongs to other methods of a section than the chosen one, and what to do; else empty."""
    models = {str(m.model_fields["method"].default): m for m in section_models(section)}
    readers = [name for name, model in models.items() if key in model.model_fields]
    if not readers:
        return ""
    nested = [
        f"{section}.{name}.{key}"
        for name, info in models[method].model_fields.items()
        if any(key in inner.model_fields for inner in _models(info.annotation))
    ]
    instead = "".join(f"set {name}, " for name in nested)
    return (
        f"{section}.{key} is read by {' and '.join(readers)}, not by {method}; {instead}choose {section}.method="
        f"{readers[0]} or leave it out"
    )


def _problem(message: str) -> str:
    """The message of an error without what stands before those of our own checks."""
    return message.removeprefix("Value error, ") if message.startswith("Value error, ") else message.lower()


def _what_is(model: type[BaseModel], key: str) -> str:
    """What a key outside the sections is, with its unit."""
    info = model.model_fields.get(key)
    return (
        ""
        if info is None or info.description is None
        else f" ({info.description.partition(';')[0].rstrip('.').lower()})"
    )


def _did_you_mean(key: str) -> str:
    """The known key or section most like one that is not: of its own section where there is one, else of any."""
    names = list(_keys(FlightConfig))
    section, _, last = key.rpartition(".")

    def similarity(name: str) -> tuple[float, float]:
        other = name.rpartition(".")[2]
        # Beginnings count, as `max_sped` of `max_speed_m_per_s`: people leave out the unit.
        begin = _ratio(last, other[: len(last)]) if last and other.startswith(last[:3]) else 0.0
        return max(begin, _ratio(last, other)), _ratio(key, name)

    for candidates in ([name for name in names if name.rpartition(".")[0] == section], names):
        best = max(candidates, key=similarity, default=key)
        if best != key and similarity(best)[0] >= _SIMILAR:
            return f"; did you mean {best!r}?"
    return "; `velfield schema` lists the keys"


def _ratio(one: str, other: str) -> float:
    return difflib.SequenceMatcher(None, one, other).ratio()


def _keys(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for name, info in model.model_fields.items():
        yield prefix + name
        for inner in _models(info.annotation):
            yield from _keys(inner, f"{prefix}{name}.")
