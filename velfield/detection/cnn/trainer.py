"""Fine-tuning of the network: forward and backward pass, focal loss, AdamW with warm-up and cosine decay.

The training loop is our own on numpy: jax measured no faster (309 against 351 ms a step, before this loop took 0.55 of
its time) and adds 380 MB of wheels, and the wheel of torch brings CUDA.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from schemas.arrays import Float32Array
from velfield.detection.cnn.layers import conv2d, conv2d_backward, depth_to_space, relu_backward, space_to_depth
from velfield.detection.cnn.network import (
    TOPOLOGY,
    Conv,
    DepthToSpace,
    Layer,
    Network,
    Residual,
    SpaceToDepth,
    convolutions,
)
from velfield.parallel import count_steps, parallel_map

_ORIENTATION_LOSS_WEIGHT = 0.5
WEIGHT_DECAY, ADAM_BETAS, MAX_GRAD_NORM = 1e-2, (0.9, 0.999), 5.0
_WARMUP_FRACTION = 0.1
"""Fraction of the steps over which the learning rate rises linearly."""
_WARMUP_START, _FINAL_FACTOR = 0.05, 1e-3
_MAX_LOGIT = 11

Backward: TypeAlias = Callable[[Float32Array], Float32Array]
"""From the gradient by a layer's output to that by its input; keeps the gradients by its parameters aside."""


@dataclass(frozen=True)
class Batch:
    """Images of one training step and their targets."""

    images: Float32Array
    """(n, h, w) grey in [0, 1]."""
    heatmap: Float32Array
    """(n, h / 2, w / 2) 1 at a car's centre, a Gaussian around it."""
    mask: Float32Array
    """(n, h / 2, w / 2) 1 where the heatmap is known, else 0."""
    orientation: Float32Array
    """(n, h / 2, w / 2, 2) cosine and sine of twice the orientation."""
    orientation_weight: Float32Array
    """(n, h / 2, w / 2) weight of the orientation in the loss."""

    def halves(self) -> "tuple[Batch, Batch]":
        """The first and the second half of the images."""
        middle = len(self.images) // 2
        parts = (self.images, self.heatmap, self.mask, self.orientation, self.orientation_weight)
        return Batch(*(part[:middle] for part in parts)), Batch(*(part[middle:] for part in parts))


@dataclass(frozen=True)
class LossNormaliser:
    """Divisors of the two losses: the number of cars in a batch, as summed weights, plus one."""

    cars: float
    orientation: float

    @classmethod
    def of(cls, batch: Batch) -> "LossNormaliser":
        """Normalisers of a whole batch; its halves are divided by the same numbers."""
        return cls(float(_positive_weight(batch).sum()) + 1, float(batch.orientation_weight.sum()) + 1)


def _positive_weight(batch: Batch) -> Float32Array:
    square = batch.heatmap * batch.heatmap  # a power of 4 takes ten times as long
    return np.asarray(square * square * batch.mask, np.float32)


@dataclass
class Trainer:
    """Parameters of a network in training, and the state of the optimiser."""

    parameters: dict[str, Float32Array]
    """By name: ``LAYER.w`` and ``LAYER.b``."""
    _moments: dict[str, tuple[Float32Array, Float32Array]] = field(default_factory=dict)
    _steps: int = 0

    @classmethod
    def from_network(cls, network: Network) -> "Trainer":
        """A trained network, for fine-tuning; without its layer of sizes, which would not fit the others afterwards."""
        names = convolutions(TOPOLOGY)
        parameters = {f"{name}.w": network.weights[name].copy() for name in names}
        parameters |= {f"{name}.b": network.biases[name].copy() for name in names}
        return cls(parameters)

    def network(self) -> Network:
        """The trained network."""
        names = convolutions(TOPOLOGY)
        weights, biases = ({name: self.parameters[f"{name}.{part}"].copy() for name in names} for part in "wb")
        return Network(weights, biases)

    def train_step(self, batch: Batch, learning_rate: float) -> float:
        """One step of the optimiser, gradients clipped by their norm; returns the loss before it."""
        loss, gradients = self.loss_and_gradients(batch)
        norm = np.sqrt(sum(float((gradient.astype(np.float64) ** 2).sum()) for gradient in gradients.values()))
        clip = np.float32(min(1.0, MAX_GRAD_NORM / max(norm, 1e-12)))
        self._steps += 1
        for name, gradient in gradients.items():
            self._update(name, gradient * clip, learning_rate)
        return loss

    def _update(self, name: str, gradient: Float32Array, learning_rate: float) -> None:
        """AdamW: Adam with decoupled weight decay (Loshchilov and Hutter 2019)."""
        value = self.parameters[name]
        first, second = self._moments.get(name, (np.zeros_like(value), np.zeros_like(value)))
        first = (ADAM_BETAS[0] * first + (1 - ADAM_BETAS[0]) * gradient).astype(np.float32)
        second = (ADAM_BETAS[1] * second + (1 - ADAM_BETAS[1]) * gradient**2).astype(np.float32)
        self._moments[name] = first, second
        unbiased = (1 - ADAM_BETAS[0] ** self._steps), (1 - ADAM_BETAS[1] ** self._steps)
        step = first / unbiased[0] / (np.sqrt(second / unbiased[1]) + 1e-8)
        decayed = value * (1 - learning_rate * WEIGHT_DECAY)
        self.parameters[name] = (decayed - learning_rate * step).astype(np.float32)

    def predict(self, images: Float32Array) -> Float32Array:
        """Logits and orientation vectors (n, h / 2, w / 2, 3) of images (n, h, w), grey in [0, 1]."""
        return _Pass(self).forward(TOPOLOGY, images[..., None])[0]

    def loss_and_gradients(self, batch: Batch) -> tuple[float, dict[str, Float32Array]]:
        """Loss, and its gradient by every parameter.

        Both halves of the batch are computed by themselves: their gradients add up to those of the whole, whatever the
        number of processors.
        """
        normaliser = LossNormaliser.of(batch)
        if len(batch.images) < 2:
            return self._loss_and_gradients(batch, normaliser)
        (first, of_first), (second, of_second) = parallel_map(
            lambda half: self._loss_and_gradients(half, normaliser), batch.halves()
        )
        return first + second, {name: gradient + of_second[name] for name, gradient in of_first.items()}

    def _loss_and_gradients(self, batch: Batch, normaliser: LossNormaliser) -> tuple[float, dict[str, Float32Array]]:
        differentiable = _Pass(self)
        out, backward = differentiable.forward(TOPOLOGY, batch.images[..., None])
        loss, gradient = focal_loss_and_gradient(out, batch, normaliser)
        backward(gradient)
        return loss, differentiable.gradients


class _Pass:
    """A forward pass that can be differentiated (reverse mode): every layer returns its output and its backward pass.

    Attributes
    ----------
    gradients : gradients of the loss by the parameters, filled in by the backward pass.
    """

    def __init__(self, trainer: Trainer) -> None:
        self.trainer = trainer
        self.gradients: dict[str, Float32Array] = {}

    def forward(self, layers: Sequence[Layer], values: Float32Array) -> tuple[Float32Array, Backward]:
        """Output (n, h, w, channels) of a sequence of layers, and the backward pass."""
        steps: list[Backward] = []
        for layer in layers:
            values, step = self._layer(layer, values)
            steps.append(step)

        def backward(gradient: Float32Array) -> Float32Array:
            # Each step is dropped once done, with the activations that it holds: hundreds of megabytes a batch.
            while steps:
                gradient = steps.pop()(gradient)
            return gradient

        return values, backward

    def _layer(self, layer: Layer, values: Float32Array) -> tuple[Float32Array, Backward]:
        if isinstance(layer, SpaceToDepth):
            return space_to_depth(values), depth_to_space
        if isinstance(layer, DepthToSpace):
            return depth_to_space(values), space_to_depth
        if isinstance(layer, Residual):
            return self._residual(layer, values)
        return self._conv(layer, values)

    def _residual(self, block: Residual, values: Float32Array) -> tuple[Float32Array, Backward]:
        branch, backward_branch = self.forward(block.layers, values)
        out = branch + values
        if block.relu:
            np.maximum(out, 0, out=out)

        def backward(gradient: Float32Array) -> Float32Array:
            if block.relu:
                gradient, _ = relu_backward(gradient, out)
            by_values = backward_branch(gradient)
            by_values += gradient
            return by_values

        return out, backward

    def _conv(self, layer: Conv, values: Float32Array) -> tuple[Float32Array, Backward]:
        name = layer.name
        out = conv2d(
            values, self.trainer.parameters[f"{name}.w"], self.trainer.parameters[f"{name}.b"], relu=layer.relu
        )

        def backward(gradient: Float32Array) -> Float32Array:
            if layer.relu:
                gradient, by_bias = relu_backward(gradient, out)
            else:
                by_bias = gradient.sum(axis=(0, 1, 2))
            self.gradients[f"{name}.b"] = by_bias
            return self._convolve_backward(layer, values, gradient)

        return out, backward

    def _convolve_backward(self, layer: Conv, values: Float32Array, gradient: Float32Array) -> Float32Array:
        """Keep the gradient by the weights; the gradient by the input, which nobody needs of the image itself."""
        weights, is_first = self.trainer.parameters[f"{layer.name}.w"], layer is TOPOLOGY[0]
        by_values, by_weights = conv2d_backward(values, weights, gradient, by_images=not is_first)
        self.gradients[f"{layer.name}.w"] = by_weights
        return gradient if by_values is None else by_values


def focal_loss_and_gradient(out: Float32Array, batch: Batch, normaliser: LossNormaliser) -> tuple[float, Float32Array]:
    """Loss of the network's output, and its gradient by that output.

    The heatmap has a focal loss as in CornerNet (Law and Deng 2018): pixels predicted well count little, and those near
    a car's centre count less as background. The orientation has a weighted squared error.

    Parameters
    ----------
    out
        (n, h / 2, w / 2, 3) of the network: logit and orientation vector.
    batch
        The targets.
    normaliser
        Normalisers of the whole batch.
    """
    heatmap, mask = batch.heatmap, batch.mask
    logits = np.clip(out[..., 0], -_MAX_LOGIT, _MAX_LOGIT)
    p = 1 / (1 + np.exp(-logits))
    positive, negative, cars = _positive_weight(batch), (1 - heatmap) ** 2 * mask, normaliser.cars
    excess = np.maximum(p - heatmap, 0)
    log_p, log_not_p = np.log(p), np.log1p(-p)
    loss = float((-positive * (1 - p) ** 2 * log_p - negative * excess**2 * log_not_p).sum()) / cars
    by_p = positive * (2 * (1 - p) * log_p - (1 - p) ** 2 / p)
    by_p += negative * (excess**2 / (1 - p) - 2 * excess * log_not_p)
    gradient = np.zeros_like(out)
    gradient[..., 0] = by_p * p * (1 - p) / cars
    residual = out[..., 1:] - batch.orientation
    weight = np.float32(_ORIENTATION_LOSS_WEIGHT / normaliser.orientation) * batch.orientation_weight[..., None]
    gradient[..., 1:] = 2 * weight * residual
    return loss + float((weight * residual**2).sum()), gradient


def train(
    trainer: Trainer,
    batches: Callable[[int], Batch],
    *,
    steps: int,
    learning_rate: float,
    on_step: Callable[[int, float], None] | None = None,
) -> Network:
    """Train for a number of steps with the learning rates of `lr_schedule`.

    Parameters
    ----------
    batches
        Gives the batch of a step, such as a `PatchDataset`.
    learning_rate
        The highest one.
    on_step
        Called with each step's number and loss.
    """
    count_steps(0, announced=steps)
    for step in range(steps):
        count_steps(1)
        loss = trainer.train_step(batches(step), learning_rate * lr_schedule(step / max(steps, 1)))
        if on_step is not None:
            on_step(step, loss)
    return trainer.network()


def lr_schedule(progress: float) -> float:
    """Factor of the learning rate after a fraction of the steps: linear warm-up, then cosine decay."""
    if progress < _WARMUP_FRACTION:
        return _WARMUP_START + (1 - _WARMUP_START) * progress / _WARMUP_FRACTION
    decay = (progress - _WARMUP_FRACTION) / (1 - _WARMUP_FRACTION)
    return float(0.5 * (1 + np.cos(np.pi * decay))) + _FINAL_FACTOR
