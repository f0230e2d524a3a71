"""A commented ``flight.yaml`` to start from: the properties of the source, and every key with its default."""

from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
import yaml
from pydantic import BaseModel

from schemas.flight import PRESETS, FlightConfig
from velfield.errors import Failure
from velfield.pipeline.configuration import resolve_config, section_models
from velfield.sources.frames import SourceInfo
from velfield.sources.selection import select_frames
from velfield.sources.telemetry.find import find_beside
from velfield.sources.telemetry.read import read_telemetry

_WIDTH = 116
_GSD = (
    "Metres a base pixel: the ground sample distance. Known from the height and the camera, from a car (4.5 m long) or "
    "a lane (3 to 3.7 m wide) in the image, or from a --base with coordinates. Without it the drone's metadata or the "
    "lengths of the vehicles give it."
)


def config_template(source: str, info: SourceInfo) -> str:
    """The default configuration as YAML: each key is commented out, below its description.

    Parameters
    ----------
    source
        The path as given, for the heading.
    info
        The source, from `velfield.sources.source.probe`.
    """
    config = resolve_config()
    lines = [
        "# The configuration of a flight. Every key is optional; those below are commented out at their defaults.",
        "# To set one, remove its `#`.",
        f"# Use it:  velfield run {source} --out RUN --config flight.yaml",
        "#",
        *(f"# {line}" for line in describe_source(info, config)),
        "",
        f"preset: {config.preset}  # one of: {', '.join(PRESETS)}",
        "",
        *_comment(_GSD, ""),
        "# gsd_m: 0.23",
    ]
    for name in type(config).model_fields:
        if isinstance(section := getattr(config, name), BaseModel):
            lines += [
                "",
                *_comment(type(section).__doc__ or "", ""),
                f"{name}:",
                *_keys(section),
                *_of_other_methods(name),
            ]
    return "\n".join(lines) + "\n"


_QUANTITY_NAMES = {
    "height_m": "height",
    "latitude_deg": "position",
    "yaw_deg": "heading",
    "pitch_deg": "tilt",
    "focal_px": "focal length",
    "focal_35mm": "focal length",
    "hfov_deg": "angle of view",
    "clock_s": "time of day",
}


def describe_telemetry(source: Path, info: SourceInfo) -> str:
    """Telemetry that gives scale and north of the source, in one line.

    Raises
    ------
    InputError
        There is a file of telemetry beside it that cannot be read.
    """
    found = read_telemetry(source, info, find_beside(source))
    if isinstance(found, Failure):
        return f"Telemetry: none ({found.reason}); the lengths of the vehicles give the scale, or gsd_m."
    known = dict.fromkeys(_QUANTITY_NAMES[name] for name in found.known_quantities() if name in _QUANTITY_NAMES)
    return f"Telemetry: {found.origin}: {', '.join(known)}."


def describe_source(info: SourceInfo, config: FlightConfig) -> list[str]:
    """The properties of the source, a line each."""
    lines = [f"Found: {info.kind}, {info.frame_count} frames of {info.width} x {info.height} px."]
    if len(info.times_s) > 1:
        step = np.diff(info.times_s)
        lines.append(
            f"It lasts {info.times_s[-1] - info.times_s[0]:.1f} s; frames are {np.median(step):.3f} s apart "
            f"(median), the longest gap is {step.max():.3f} s."
        )
        taken = select_frames(info.times_s, config.frames)
        lines.append(f"With every: auto, {len(taken)} frames are processed, those nearest to 0.2 s apart.")
    return [*lines, *(f"Warning: {warning}" for warning in info.warnings)]


def _keys(section: BaseModel, indent: str = "  ") -> list[str]:
    lines = []
    for name, info in type(section).model_fields.items():
        value = getattr(section, name)
        lines += _comment(info.description or "", indent)
        if isinstance(value, BaseModel):
            lines += [f"# {indent}{name}:", *_keys(value, f"{indent}  ")]
        else:
            lines.append(f"# {indent}{name}: {_value(value)}")
    return lines


def _of_other_methods(section: str) -> list[str]:
    """Keys of the other methods of a section, a paragraph each."""
    lines = []
    for model in section_models(section)[1:]:
        other = model()
        keys = ", ".join(f"{name}: {_value(getattr(other, name))}" for name in model.model_fields)
        lines += _comment(f"Keys of another method, instead of all these: {keys}", "  ")
    return lines


def _value(value: Any) -> str:
    return yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("\n").removesuffix("\n...")


def _comment(text: str, indent: str) -> list[str]:
    """A paragraph as lines that start with ``##``, unlike keys that are commented out."""
    lines = wrap(" ".join(text.split()), _WIDTH - len(indent), break_long_words=False, break_on_hyphens=False)
    return [f"##{indent} {line}" for line in lines]
