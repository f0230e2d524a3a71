"""How the network learns: what each layer hands back, and steps down the slope of the loss.

A layer normalises what it sums by the mean and deviation of the batch while the network is learnt from nothing; these
go into its weights and bias at the end, and a network that learns on has none.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from schemas.arrays import Float32Array
from velfield.detection.cnn.convolution import Layout, convolved, gathered, handed_back, spread
from velfield.detection.cnn.model import BODIES, CORNERS, LAYERS, Network
from velfield.parallel import each

_NORMALISED = tuple(name for name in LAYERS if name not in ("back", "told"))
_MOMENTUM, _LEAST_VARIANCE = 0.05, 1e-5
_FIRST_ODDS = -4.0
"""Log odds of a car at any place, before anything is known: the paper's few per cent."""
_AXIS_WEIGHT = 0.5
_DECAY, _BETAS, _STEEPEST = 1e-2, (0.9, 0.999), 5.0
_WARMING = 0.1
"""Share of the steps over which they grow to their full size."""


@dataclass(frozen=True)
class Batch:
    """What a step learns from.

    Attributes
    ----------
    pictures : (n, h, w) grey of 0 to 1.
    middles : (n, h / 2, w / 2) 1 in a car's middle, falling off about it.
    counted : (n, h / 2, w / 2) 1 where what is told is known, else 0.
    axes : (n, h / 2, w / 2, 2) cosine and sine of twice the axis.
    axes_counted : (n, h / 2, w / 2) how much these count.
    """

    pictures: Float32Array
    middles: Float32Array
    counted: Float32Array
    axes: Float32Array
    axes_counted: Float32Array

    def halves(self) -> "tuple[Batch, Batch]":
        """The first and the second half of the pictures."""
        middle = len(self.pictures) // 2
        parts = (self.pictures, self.middles, self.counted, self.axes, self.axes_counted)
        return Batch(*(part[:middle] for part in parts)), Batch(*(part[middle:] for part in parts))


@dataclass(frozen=True)
class Weighed:
    """What the losses of cars and of axes are divided by: how many there are in a batch."""

    cars: float
    axes: float

    @classmethod
    def of(cls, batch: Batch) -> "Weighed":
        """Of a batch."""
        return cls(float(_at_cars(batch).sum()) + 1, float(batch.axes_counted.sum()) + 1)


def _at_cars(batch: Batch) -> Float32Array:
    return np.asarray(batch.middles**4 * batch.counted, np.float32)


@dataclass
class Learner:
    """A network that is being learnt.

    Attributes
    ----------
    values : what is learnt, by name: ``NAME.w``, ``NAME.b`` and, of a normalised layer, ``NAME.g``, its gain.
    means, variances : of what normalised layers sum, over the last batches.
    """

    values: dict[str, Float32Array]
    means: dict[str, Float32Array] = field(default_factory=dict)
    variances: dict[str, Float32Array] = field(default_factory=dict)
    _moments: dict[str, tuple[Float32Array, Float32Array]] = field(default_factory=dict)
    _steps: int = 0

    @classmethod
    def from_nothing(cls, seed: int) -> "Learner":
        """Random weights."""
        rng, values = np.random.default_rng(seed), {}
        for name, (taps, into, out) in LAYERS.items():
            values[f"{name}.w"] = rng.normal(0, np.sqrt(2 / (taps * into)), (taps, into, out)).astype(np.float32)
            values[f"{name}.b"] = np.zeros(out, np.float32)
            if name in _NORMALISED:
                values[f"{name}.g"] = np.ones(out, np.float32)
        values["told.b"][0] = _FIRST_ODDS
        for _, second in BODIES:
            values[f"{second}.g"] *= np.float32(0.5)
        return cls(values)

    @classmethod
    def of(cls, network: Network) -> "Learner":
        """Going on from a network."""
        values = {f"{name}.w": network.weights[name].copy() for name in LAYERS}
        return cls({**values, **{f"{name}.b": network.biases[name].copy() for name in LAYERS}})

    def network(self) -> Network:
        """What was learnt, gains and means in its weights."""
        weights, biases = {}, {}
        for name in LAYERS:
            weight, bias = self.values[f"{name}.w"], self.values[f"{name}.b"]
            if f"{name}.g" in self.values:
                gain = self.values[f"{name}.g"] / np.sqrt(self.variances[name] + _LEAST_VARIANCE)
                weight, bias = weight * gain, bias - self.means[name] * gain
            weights[name], biases[name] = weight.astype(np.float32), bias.astype(np.float32)
        return Network(weights, biases)

    def learn(self, batch: Batch, size: float) -> float:
        """A step of so large a size; the loss before it."""
        loss, slopes = self.slopes(batch)
        steepness = np.sqrt(sum(float((slope.astype(np.float64) ** 2).sum()) for slope in slopes.values()))
        shrink = np.float32(min(1.0, _STEEPEST / max(steepness, 1e-12)))
        self._steps += 1
        for name, slope in slopes.items():
            self._move(name, slope * shrink, size)
        return loss

    def _move(self, name: str, slope: Float32Array, size: float) -> None:
        """Adam's step with decay apart from it (Loshchilov and Hutter)."""
        value = self.values[name]
        first, second = self._moments.get(name, (np.zeros_like(value), np.zeros_like(value)))
        first = (_BETAS[0] * first + (1 - _BETAS[0]) * slope).astype(np.float32)
        second = (_BETAS[1] * second + (1 - _BETAS[1]) * slope**2).astype(np.float32)
        self._moments[name] = first, second
        grown = (1 - _BETAS[0] ** self._steps), (1 - _BETAS[1] ** self._steps)
        step = first / grown[0] / (np.sqrt(second / grown[1]) + 1e-8)
        self.values[name] = (value * (1 - size * _DECAY) - size * step).astype(np.float32)

    def slopes(self, batch: Batch) -> tuple[float, dict[str, Float32Array]]:
        """The loss, and its slope by everything that is learnt.

        Where no layer is normalised by its batch, both halves of it are gone through at once: what they hand back adds
        up to the same, whatever the number of processors.
        """
        weighed = Weighed.of(batch)
        if any(f"{name}.g" in self.values for name in LAYERS) or len(batch.pictures) < 2:
            return self._slopes(batch, weighed)
        (first, of_first), (second, of_second) = each(lambda half: self._slopes(half, weighed), batch.halves())
        return first + second, {name: slope + of_second[name] for name, slope in of_first.items()}

    def _slopes(self, batch: Batch, weighed: Weighed) -> tuple[float, dict[str, Float32Array]]:
        tape = _Tape(self)
        whole = Layout(*batch.pictures.shape)
        half = whole.halved()
        quarter = half.halved()
        grain = tape.rectified("grain", whole.laid_out(batch.pictures[..., None]), whole)
        corners = tape.rectified("edges", gathered(grain, whole), half)
        for name in CORNERS:
            corners = tape.rectified(name, corners, half)
        body = tape.rectified("parts", gathered(corners, half), quarter)
        for first, second in BODIES:
            body = body + tape.rectified(second, tape.rectified(first, body, quarter), quarter)
        joined = np.maximum(spread(tape.summed("back", body, quarter), half) + corners, 0)
        said = tape.summed("told", tape.rectified("middle", joined, half), half)
        loss, slope = loss_of(half.inner(said), batch, weighed)

        back = tape.back("middle", tape.back("told", half.laid_out(slope))) * (joined > 0)
        by_body = tape.back("back", gathered(back, half))
        for first, second in reversed(BODIES):
            by_body = by_body + tape.back(first, tape.back(second, by_body))
        by_corners = back + spread(tape.back("parts", by_body), half)
        for name in reversed(CORNERS):
            by_corners = tape.back(name, by_corners)
        tape.back("grain", spread(tape.back("edges", by_corners), whole))
        return loss, tape.slopes


class _Tape:
    """What each layer was given, so that it can hand the slope back."""

    def __init__(self, learner: Learner) -> None:
        self.learner = learner
        self.slopes: dict[str, Float32Array] = {}
        self._undo: dict[str, Callable[[Float32Array], Float32Array]] = {}

    def summed(self, name: str, values: Float32Array, layout: Layout) -> Float32Array:
        """A layer without more."""
        learnt = self.learner.values
        weights = learnt[f"{name}.w"]
        out = convolved(values, weights, layout) + learnt[f"{name}.b"]
        layout.clear_border(out)

        def undo(slope: Float32Array) -> Float32Array:
            self.slopes[f"{name}.b"] = slope.sum(axis=0)
            by_values, self.slopes[f"{name}.w"] = handed_back(values, weights, slope, layout)
            return by_values

        self._undo[name] = undo
        return out

    def rectified(self, name: str, values: Float32Array, layout: Layout) -> Float32Array:
        """A layer, normalised where it is learnt so, and what is below zero set to it."""
        if f"{name}.g" in self.learner.values:
            out = self._normalised(name, values, layout)
        else:
            out = self.summed(name, values, layout)
        np.maximum(out, 0, out=out)
        undo = self._undo[name]
        self._undo[name] = lambda slope: undo(slope * (out > 0))
        return out

    def _normalised(self, name: str, values: Float32Array, layout: Layout) -> Float32Array:
        learner = self.learner
        weights, gain = learner.values[f"{name}.w"], learner.values[f"{name}.g"]
        summed = convolved(values, weights, layout)
        inner = layout.inner(summed)
        mean, variance = inner.mean(axis=(0, 1, 2)), inner.var(axis=(0, 1, 2))
        for kept, seen in ((learner.means, mean), (learner.variances, variance)):
            kept[name] = seen if name not in kept else (1 - _MOMENTUM) * kept[name] + _MOMENTUM * seen
        scale = 1 / np.sqrt(variance + _LEAST_VARIANCE)
        normal = (summed - mean) * scale
        layout.clear_border(normal)
        out = normal * gain + learner.values[f"{name}.b"]
        layout.clear_border(out)
        pixels = layout.count * layout.height * layout.width

        def undo(slope: Float32Array) -> Float32Array:
            self.slopes[f"{name}.b"], self.slopes[f"{name}.g"] = slope.sum(axis=0), (slope * normal).sum(axis=0)
            through = slope - (self.slopes[f"{name}.b"] + normal * self.slopes[f"{name}.g"]) / np.float32(pixels)
            through *= gain * scale
            layout.clear_border(through)
            by_values, self.slopes[f"{name}.w"] = handed_back(values, weights, through, layout)
            return by_values

        self._undo[name] = undo
        return np.asarray(out, np.float32)

    def back(self, name: str, slope: Float32Array) -> Float32Array:
        """The slope by what a layer was given, from that by what came out; its own are kept.

        What the layer was given is let go: kept until rubbish is collected, it is hundreds of megabytes a step.
        """
        return np.asarray(self._undo.pop(name)(slope), np.float32)


def loss_of(said: Float32Array, batch: Batch, weighed: Weighed) -> tuple[float, Float32Array]:
    """How wrong what is said is, and the slope of that by it, (n, h / 2, w / 2, 3).

    A focal loss: places that are told well count little, and near a car's middle it is no fault to like a place.
    """
    middles, counted = batch.middles, batch.counted
    odds = np.clip(said[..., 0], -11, 11)
    likely = 1 / (1 + np.exp(-odds))
    car, other, cars = _at_cars(batch), (1 - middles) ** 2 * counted, weighed.cars
    above = np.maximum(likely - middles, 0)
    log_car, log_other = np.log(likely), np.log1p(-likely)
    loss = float((-car * (1 - likely) ** 2 * log_car - other * above**2 * log_other).sum()) / cars
    by_likely = car * (2 * (1 - likely) * log_car - (1 - likely) ** 2 / likely)
    by_likely += other * (above**2 / (1 - likely) - 2 * above * log_other)
    slope = np.zeros_like(said)
    slope[..., 0] = by_likely * likely * (1 - likely) / cars
    off = said[..., 1:] - batch.axes
    weight = np.float32(_AXIS_WEIGHT / weighed.axes) * batch.axes_counted[..., None]
    slope[..., 1:] = 2 * weight * off
    return loss + float((weight * off**2).sum()), slope


def learnt(
    learner: Learner,
    batches: Callable[[int], Batch],
    *,
    steps: int,
    size: float,
    tell: Callable[[int, float], None] | None = None,
) -> Network:
    """Take steps that grow, then shrink along a cosine.

    Parameters
    ----------
    batches
        A batch by the step's number.
    size
        The largest step.
    tell
        Hears each step's number and loss.
    """
    for step in range(steps):
        loss = learner.learn(batches(step), size * _share(step / max(steps, 1)))
        if tell is not None:
            tell(step, loss)
    return learner.network()


def _share(done: float) -> float:
    if done < _WARMING:
        return 0.05 + 0.95 * done / _WARMING
    return float(0.5 * (1 + np.cos(np.pi * (done - _WARMING) / (1 - _WARMING)))) + 1e-3
