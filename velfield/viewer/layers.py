"""The layers of a field that the page shows, their titles and colour ranges.

The list follows the store: a layer that it does not have is not shown, one that is unknown here is shown by its
``long_name``.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from schemas.view import LayerKind, ViewLayer
from velfield.analysis.intervals import vehicles_for_quantile
from velfield.report.figures import colour_scale_max

_COLOUR_PERCENTILE = 98.0
"""Percentile of the known pixels at the end of the colour scale: outliers would compress it."""


@dataclass(frozen=True)
class _Known:
    """A layer that is known here. It is explained by the ``long_name`` of its array, then by the hint; a velocity,
    whose arrays are its components, by the hint alone."""

    name: str
    title: str
    hint: str
    kind: LayerKind
    of: tuple[str, ...] = ()
    main: bool = False

    @property
    def arrays(self) -> tuple[str, ...]:
        """Names of its arrays, by default its own."""
        return self.of or (self.name,)


_MODAL, _MEAN = ("modal_vx", "modal_vy"), ("mean_vx", "mean_vy")
_NEEDED = f"Uncertain where fewer than {vehicles_for_quantile(0.85)} vehicles passed."
_KNOWN = (
    _Known(
        "direction",
        "Direction",
        "Direction of the most frequent velocity, in which most vehicles go. No colour where they are stationary.",
        "direction",
        of=_MODAL,
        main=True,
    ),
    _Known("speed", "Speed", "Speed of the most frequent velocity.", "speed", of=_MODAL, main=True),
    _Known("speed_p85", "85th percentile speed", f"85 % of vehicles are slower. {_NEEDED}", "speed", main=True),
    _Known("count", "Vehicles", "A vehicle counts once at each pixel that it passes.", "count", main=True),
    _Known(
        "direction_ci90_half_width",
        "Uncertainty of direction",
        "Small values mean that the layer Direction is accurate.",
        "angle",
        main=True,
    ),
    _Known("speed_se", "Uncertainty of speed", "Known from two vehicles on.", "speed", main=True),
    _Known("speed_p50", "Median speed", "Half of the vehicles are slower.", "speed"),
    _Known("speed_p15", "15th percentile speed", f"15 % of vehicles are slower. {_NEEDED}", "speed"),
    _Known("direction_se", "Standard error of direction", "Known from two vehicles on.", "angle"),
    _Known(
        "mean_direction",
        "Mean direction",
        "Direction of the mean velocity. Where vehicles go several ways, none may go this way.",
        "direction",
        of=_MEAN,
    ),
    _Known(
        "stationary_fraction",
        "Fraction stationary",
        "High at stop lines, in queues and where vehicles park.",
        "fraction",
    ),
    _Known("occupancy", "Occupancy", "Long where they queue or park.", "time", of=("occupancy_ms",)),
    _Known(
        "mode_fraction",
        "At the mode",
        "100 %: all vehicles have the direction and speed of the layers Direction and Speed.",
        "fraction",
    ),
    _Known("circular_variance", "Variance of direction", "0: all go one way; 1: no preferred direction.", "plain"),
    _Known(
        "entropy",
        "Entropy of velocity",
        "0: all vehicles have one velocity; the larger, the more their velocities differ.",
        "plain",
    ),
    _Known(
        "speed_p50_ci90_lower", "Median speed, lower bound", "The median of more such traffic is rarely lower.", "speed"
    ),
    _Known(
        "speed_p50_ci90_upper",
        "Median speed, upper bound",
        "The median of more such traffic is rarely higher.",
        "speed",
    ),
)
_SPEED_SCALE = frozenset(
    {"speed", "speed_p85", "speed_p50", "speed_p15", "speed_p50_ci90_lower", "speed_p50_ci90_upper"}
)
"""Layers on the colour scale of the modal speed, so that they compare."""

_INNER = ("velocity_variance_sum",)
"""Needed for sums of fields, not shown."""

Reader = Callable[[str], NDArray[Any]]


def view_layers(attributes: Mapping[str, Mapping[str, Any]], read: Reader) -> list[ViewLayer]:
    """The layers to show.

    Parameters
    ----------
    attributes
        Attributes of every (y, x) array of the store, by its name.
    read
        Returns an array by its name, (y, x).
    """
    known = [layer for layer in _KNOWN if all(name in attributes for name in layer.arrays)]
    taken = {*_INNER, *(name for layer in _KNOWN for name in layer.arrays)}
    known += [_unknown(name, attrs) for name, attrs in attributes.items() if name not in taken]
    magnitudes = {layer.name: _magnitudes([np.asarray(read(name)) for name in layer.arrays]) for layer in known}
    speed_max = colour_scale_max(magnitudes["speed"]) if "speed" in magnitudes else None
    return [
        ViewLayer(
            name=layer.name,
            title=layer.title,
            description=_explanation(layer, attributes),
            kind=layer.kind,
            arrays=layer.arrays,
            units=str(attributes[layer.arrays[0]].get("units", "1")),
            colour_max=speed_max if speed_max and layer.name in _SPEED_SCALE else _colour_max(magnitudes[layer.name]),
            data_max=float(magnitudes[layer.name].max(initial=0.0)),
            main=layer.main,
        )
        for layer in known
    ]


_KINDS: dict[str, LayerKind] = {"px s-1": "speed", "rad": "angle", "ms": "time"}


def _unknown(name: str, attributes: Mapping[str, Any]) -> _Known:
    """A layer that is not in `_KNOWN`."""
    title = str(attributes.get("long_name", name.replace("_", " ")))
    kind = _KINDS.get(str(attributes.get("units", "1")), "plain")
    change = "change" in name
    hint = "The later field minus the earlier one, where the difference is significant." if change else ""
    return _Known(name, _capitalised(title), hint, "change" if change else kind, main=change)


def _explanation(layer: _Known, attributes: Mapping[str, Mapping[str, Any]]) -> str:
    """What a layer's numbers mean, in a few short sentences."""
    name = "" if len(layer.arrays) > 1 else str(attributes[layer.arrays[0]].get("long_name", ""))
    return " ".join(part for part in (f"{_capitalised(name)}." if name else "", layer.hint) if part)


def _capitalised(text: str) -> str:
    return text[:1].upper() + text[1:]


def _magnitudes(arrays: Sequence[NDArray[Any]]) -> FloatArray:
    """Absolute values of the known values, of counts those above zero; speeds of velocities."""
    known = np.isfinite(arrays[0]) if arrays[0].dtype.kind == "f" else arrays[0] != 0  # a count is 0 nearly everywhere
    for array in arrays[1:]:
        known &= np.isfinite(array)
    return np.asarray(np.hypot(*([array[known].astype(np.float64) for array in arrays] + [0.0])[:2]), np.float64)


def _colour_max(magnitudes: FloatArray) -> float:
    """End of the colour scale: the 98th percentile of the non-zero magnitudes."""
    positive = magnitudes[magnitudes > 0]
    return float(np.percentile(positive, _COLOUR_PERCENTILE)) if positive.size else 1.0
