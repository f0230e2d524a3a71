"""Pre-training of the network in PyTorch: many times the steps that adapting it to a flight needs.

PyTorch is no dependency of velfield: `pip install torch` before ``make detector``. A step takes 0.1 s on one core where
the project's own training, which adapts the network at run time, takes 0.2. The module is
built from `model.TOPOLOGY`, the one definition of the layers.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from schemas.arrays import Float32Array
from velfield.detection.cnn.dataset import PatchDataset
from velfield.detection.cnn.network import (
    TOPOLOGY,
    Conv,
    DepthToSpace,
    Layer,
    Network,
    Residual,
    SpaceToDepth,
    Topology,
)
from velfield.detection.cnn.trainer import ADAM_BETAS, MAX_GRAD_NORM, WEIGHT_DECAY, Batch, lr_schedule
from velfield.detection.samples import LabelledImage

LEARNING_RATE = 3e-3
_AVERAGE = 0.998
"""Of the exponential moving average of the weights, which is what is kept."""
_MOMENTUM, _MIN_VARIANCE = 0.05, 1e-5
_RESIDUAL_GAIN, _PRIOR_LOGIT = 0.5, -4.0
_ORIENTATION_WEIGHT, _DISTILLATION_WEIGHT = 0.5, 0.5
_MAX_LOGIT = 11.0


class _Convolution(nn.Module):  # type: ignore[misc]
    """A `Conv`: normalised by batch where a ReLU follows."""

    def __init__(self, layer: Conv) -> None:
        super().__init__()
        self.layer = layer
        padding = 1 if layer.stride == 2 else layer.kernel // 2
        self.conv = nn.Conv2d(
            layer.channels_in, layer.channels_out, layer.kernel, layer.stride, padding, bias=not layer.relu
        )
        nn.init.kaiming_normal_(self.conv.weight, nonlinearity="relu")
        if self.conv.bias is not None:
            nn.init.zeros_(self.conv.bias)
        self.norm = nn.BatchNorm2d(layer.channels_out, _MIN_VARIANCE, _MOMENTUM) if layer.relu else None

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv(x)
        return x if self.norm is None else F.relu(self.norm(x))

    def folded(self) -> tuple[Float32Array, Float32Array]:
        """Weights (taps, channels in, out) and bias, the normalisation folded in."""
        weight = self.conv.weight.detach().double().numpy()
        if self.norm is None:
            assert self.conv.bias is not None
            bias = self.conv.bias.detach().double().numpy()
        else:
            variance, mean = (part.double().numpy() for part in (self.norm.running_var, self.norm.running_mean))
            gain = self.norm.weight.detach().double().numpy() / np.sqrt(variance + _MIN_VARIANCE)
            weight, bias = weight * gain[:, None, None, None], self.norm.bias.detach().double().numpy() - mean * gain
        taps = weight.transpose(2, 3, 1, 0).reshape(-1, weight.shape[1], weight.shape[0])
        return taps.astype(np.float32), bias.astype(np.float32)


class _Layers(nn.Module):  # type: ignore[misc]
    """A sequence of layers of a topology."""

    def __init__(self, layers: Topology) -> None:
        super().__init__()
        self.layers = layers
        self.parts = nn.ModuleList(_module(layer) for layer in layers)

    def forward(self, x: Tensor) -> Tensor:
        for layer, part in zip(self.layers, self.parts, strict=True):
            if isinstance(layer, Residual):
                x = part(x) + x
                x = F.relu(x) if layer.relu else x
            elif isinstance(layer, SpaceToDepth):
                n, c, h, w = x.shape
                x = x.reshape(n, c, h // 2, 2, w // 2, 2).permute(0, 3, 5, 1, 2, 4).reshape(n, 4 * c, h // 2, w // 2)
            elif isinstance(layer, DepthToSpace):
                n, c, h, w = x.shape
                x = x.reshape(n, 2, 2, c // 4, h, w).permute(0, 3, 4, 1, 5, 2).reshape(n, c // 4, 2 * h, 2 * w)
            else:
                x = part(x)
        return x


def _module(layer: Layer) -> nn.Module:
    if isinstance(layer, Conv):
        return _Convolution(layer)
    return _Layers(layer.layers) if isinstance(layer, Residual) else nn.Identity()


def build_module(seed: int, topology: Topology = TOPOLOGY) -> nn.Module:
    """The network with random weights (He), the gain of each residual block's last convolution halved."""
    torch.manual_seed(seed)
    module = _Layers(topology)
    for part in module.modules():
        if isinstance(part, _Layers):
            for layer, child in zip(part.layers, part.parts, strict=True):
                last = child.parts[-1] if isinstance(layer, Residual) and isinstance(child, _Layers) else None
                if isinstance(last, _Convolution) and last.norm is not None:
                    nn.init.constant_(last.norm.weight, _RESIDUAL_GAIN)
        elif isinstance(part, _Convolution) and part.layer.name == "head":
            assert part.conv.bias is not None
            with torch.no_grad():
                part.conv.bias[::3] = _PRIOR_LOGIT
    return module


def to_network(module: nn.Module, topology: Topology = TOPOLOGY) -> Network:
    """The trained network for inference."""
    folded = {part.layer.name: part.folded() for part in module.modules() if isinstance(part, _Convolution)}
    return Network({n: w for n, (w, _) in folded.items()}, {n: b for n, (_, b) in folded.items()}, topology)


def pretrain(
    groups: Sequence[Sequence[LabelledImage]],
    weights: Sequence[float],
    *,
    seed: int,
    steps: int,
    teacher: Network | None = None,
    on_step: Callable[[int, float], None] | None = None,
) -> Network:
    """Train a network from random weights; ``groups`` and ``weights`` as for `PatchDataset`.

    Parameters
    ----------
    teacher
        Distillation: its probability and orientation are targets too, except where a label says that it errs.
    """
    dataset = PatchDataset(groups, weights, seed, hard=True)
    module, average = build_module(seed), build_module(seed)
    optimiser = torch.optim.AdamW(module.parameters(), lr=LEARNING_RATE, betas=ADAM_BETAS, weight_decay=WEIGHT_DECAY)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = LEARNING_RATE * lr_schedule(step / steps)
        batch = dataset(step)
        out = module(torch.from_numpy(batch.images)[:, None])
        loss = focal_loss(out, batch)
        if teacher is not None:
            loss = loss + _distillation_loss(out, batch, *_predict(teacher, batch.images))
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(module.parameters(), MAX_GRAD_NORM)
        optimiser.step()
        _update_average(average, module, min(_AVERAGE, (step + 1) / (step + 10)))
        if on_step is not None:
            on_step(step, float(loss.detach()))
    return to_network(average)


def _update_average(average: nn.Module, module: nn.Module, share: float) -> None:
    with torch.no_grad():
        for mean, value in zip(average.state_dict().values(), module.state_dict().values(), strict=True):
            if mean.dtype.is_floating_point:
                mean.mul_(share).add_(value, alpha=1 - share)


def focal_loss(out: Tensor, batch: Batch) -> Tensor:
    """The loss of `trainer.focal_loss_and_gradient`."""
    heatmap, mask = torch.from_numpy(batch.heatmap), torch.from_numpy(batch.mask)
    target, weight = torch.from_numpy(batch.orientation), torch.from_numpy(batch.orientation_weight)
    logit = out[:, 0].clamp(-_MAX_LOGIT, _MAX_LOGIT)
    p, positive, negative = torch.sigmoid(logit), heatmap**4 * mask, (1 - heatmap) ** 2 * mask
    above = (p - heatmap).clamp(min=0)
    of_cars = -positive * (1 - p) ** 2 * F.logsigmoid(logit) - negative * above**2 * F.logsigmoid(-logit)
    of_orientation = weight[:, None] * (out[:, 1:] - target.permute(0, 3, 1, 2)) ** 2
    return of_cars.sum() / (positive.sum() + 1) + _ORIENTATION_WEIGHT * of_orientation.sum() / (weight.sum() + 1)


def _predict(teacher: Network, images: Float32Array) -> tuple[Tensor, Tensor]:
    grey = np.rint(images * 255).astype(np.uint8)
    probability, orientation = teacher.predict(grey)
    return torch.from_numpy(probability), torch.from_numpy(orientation)


def _distillation_loss(out: Tensor, batch: Batch, probability: Tensor, orientation: Tensor) -> Tensor:
    heatmap, mask = torch.from_numpy(batch.heatmap), torch.from_numpy(batch.mask)
    used = mask * ((heatmap < 0.3) | (probability > 0.3))
    logit = out[:, 0].clamp(-_MAX_LOGIT, _MAX_LOGIT)
    probability = probability.clamp(1e-6, 1 - 1e-6)
    difference = F.binary_cross_entropy_with_logits(logit, probability, reduction="none")
    difference = difference - F.binary_cross_entropy(probability, probability, reduction="none")
    focus = (probability - torch.sigmoid(logit.detach())).abs() + 0.02
    of_cars = 4 * (difference * used * focus).sum() / ((heatmap**4 * mask).sum() + 1)
    weight = probability**2 * used
    of_orientation = (weight[:, None] * (out[:, 1:] - orientation) ** 2).sum() / (weight.sum() + 1)
    return _DISTILLATION_WEIGHT * (of_cars + _ORIENTATION_WEIGHT * of_orientation)
