"""Pre-training of the network in PyTorch: many times the steps that adapting it to a flight needs.

PyTorch is no dependency of velfield: `pip install torch` before ``make detector``. The module is built from
`network.TOPOLOGY`, the one definition of the layers, with two more outputs in its head, the logarithms of length and
width: by them the other layers learn what sizes are. The layer of sizes that is written is fitted afterwards
(`tools.sizes`).

Training starts from a network that knows cars already. Its layers are normalised by batch, with gains and offsets that
leave the network as it was (`start_from`). A step takes 0.06 s of one core.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from schemas.arrays import Float32Array
from tools.hard_patches import HardPatchDataset
from velfield.detection.cnn.dataset import PATCH_PX, Patch, PatchDataset, highest_gaussians, to_batch
from velfield.detection.cnn.model import find_peaks
from velfield.detection.cnn.network import (
    STRIDE,
    TOPOLOGY,
    USUAL_SIZE_PX,
    Conv,
    DepthToSpace,
    Layer,
    Network,
    Residual,
    SpaceToDepth,
    Topology,
)
from velfield.detection.cnn.trainer import (
    ADAM_BETAS,
    MAX_GRAD_NORM,
    WEIGHT_DECAY,
    Batch,
    lr_schedule,
)
from velfield.detection.samples import LabelledImage

SIZED_TOPOLOGY: Topology = (*TOPOLOGY[:-2], Conv("head", 1, 32, 20, relu=False), DepthToSpace())
"""Five outputs at each pixel of the heatmap: the logit, the orientation's cosine and sine, log length and log width."""
LEARNING_RATE = 2e-3
_ORIENTATION_WEIGHT, _SIZE_WEIGHT = 0.5, 2.0
_AVERAGE = 0.998
"""Decay of the exponential moving average of the weights, which is what is kept."""
_MOMENTUM, _MIN_VARIANCE = 0.05, 1e-5
_MAX_LOGIT = 11.0
_CERTAIN_CAR, _CERTAIN_GROUND, _KNOWN_RADIUS_PX = 0.4, 0.15, 9.0
"""Probability on an unlabelled tile: the mean over eight views where there is a car, the highest where there is none;
about a car its surroundings are known too."""


class _Convolution(nn.Module):  # type: ignore[misc]
    """A `Conv`: normalised by batch where a ReLU follows."""

    def __init__(self, layer: Conv) -> None:
        super().__init__()
        self.layer = layer
        padding = 1 if layer.stride == 2 else layer.kernel // 2
        self.conv = nn.Conv2d(
            layer.channels_in, layer.channels_out, layer.kernel, layer.stride, padding, bias=not layer.relu
        )
        self.norm = nn.BatchNorm2d(layer.channels_out, _MIN_VARIANCE, _MOMENTUM) if layer.relu else None
        self.offset: Tensor | None = None

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv(x)
        if self.norm is None:
            return x
        if self.offset is not None:
            self._normalise_as(x, self.offset)
        return F.relu(self.norm(x))

    def _normalise_as(self, x: Tensor, bias: Tensor) -> None:
        """Take the statistics of this batch, and gains and offsets that undo them and add a bias."""
        assert self.norm is not None
        with torch.no_grad():
            mean, variance = x.mean((0, 2, 3)), x.var((0, 2, 3))
            self.norm.running_mean.copy_(mean)
            self.norm.running_var.copy_(variance)
            self.norm.weight.copy_((variance + _MIN_VARIANCE).sqrt())
            self.norm.bias.copy_(bias + mean)
        self.offset = None

    def load(self, weights: Float32Array, bias: Float32Array) -> None:
        """Weights (taps, channels in, out) and bias; those of fewer channels out fill the first of each pixel."""
        kernel, values = torch.from_numpy(weights), torch.from_numpy(bias)
        blocks = 4 if self.layer.name == "head" else 1
        taps, channels_in, out = kernel.shape[0], kernel.shape[1], kernel.shape[2] // blocks
        side = self.layer.kernel
        kernel = kernel.reshape(side, side, channels_in, blocks, out).permute(3, 4, 2, 0, 1)
        assert taps == side**2
        with torch.no_grad():
            nn.init.zeros_(self.conv.weight)
            self.conv.weight.view(blocks, -1, *self.conv.weight.shape[1:])[:, :out] = kernel
            if self.conv.bias is None:
                self.offset = values.clone()
            else:
                nn.init.zeros_(self.conv.bias)
                self.conv.bias.view(blocks, -1)[:, :out] = values.view(blocks, out)

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


def start_from(network: Network, images: Float32Array) -> nn.Module:
    """A module that predicts what a network does, in training and after it.

    Outputs that the network lacks are zero. The statistics of the normalisation are those of ``images`` (n, h, w).
    """
    module = _Layers(SIZED_TOPOLOGY)
    for part in _convolutions(module):
        part.load(network.weights[part.layer.name], network.biases[part.layer.name])
    with torch.no_grad():
        module.eval()(torch.from_numpy(images)[:, None])
    return module


def _convolutions(module: nn.Module) -> list[_Convolution]:
    return [part for part in module.modules() if isinstance(part, _Convolution)]


def to_network(module: nn.Module) -> Network:
    """The trained network for inference, without a layer of sizes."""
    folded = {part.layer.name: part.folded() for part in _convolutions(module)}
    weights, biases = ({name: parts[k] for name, parts in folded.items()} for k in range(2))
    for arrays in (weights, biases):
        values = arrays["head"]
        arrays["head"] = np.ascontiguousarray(values.reshape(*values.shape[:-1], 4, 5)[..., :3]).reshape(
            *values.shape[:-1], 12
        )
    return Network(weights, biases)


@dataclass(frozen=True)
class SizedBatch:
    """A batch with sizes: (n, h / 2, w / 2, 2) logarithms of length and width over `USUAL_SIZE_PX`, and their weight
    in the loss."""

    batch: Batch
    size: Float32Array
    size_weight: Float32Array

    @classmethod
    def of(cls, patches: Sequence[Patch]) -> "SizedBatch":
        """Batch of the given patches."""
        sizes, weights = zip(*(_encode_sizes(patch) for patch in patches), strict=True)
        return cls(to_batch(patches), np.stack(sizes), np.stack(weights))


def _encode_sizes(patch: Patch) -> tuple[Float32Array, Float32Array]:
    heatmap, number = highest_gaussians(patch.vehicles)
    logarithms = np.concatenate([np.log(patch.vehicles[:, 3:5] / USUAL_SIZE_PX), np.full((1, 2), np.nan)])[number]
    known = np.isfinite(logarithms) * (np.square(heatmap) * patch.mask)[..., None]
    return np.nan_to_num(logarithms).astype(np.float32), known.astype(np.float32)


def pretrain(
    groups: Sequence[Sequence[LabelledImage]],
    weights: Sequence[float],
    *,
    start: Network,
    seed: int,
    steps: int,
    tiles: Sequence[LabelledImage] = (),
    tiles_from: int = 0,
    tiles_weight: float = 2.0,
    on_step: Callable[[int, float, nn.Module], None] | None = None,
) -> Network:
    """Train a network further; ``groups`` and ``weights`` as for `PatchDataset`.

    Parameters
    ----------
    tiles
        Unlabelled images. From the step ``tiles_from`` on they are a group of their own, labelled where the network of
        that step and ``start`` are certain of them (`label_tiles`).
    on_step
        Called with each step's number, its loss, and the averaged module.
    """
    patches = HardPatchDataset(groups, weights, seed)
    first = np.concatenate([patches.make_batch(step).images for step in range(4)])
    batches = _load(patches, range(steps))
    module, average = (start_from(start, first).to(memory_format=torch.channels_last) for _ in range(2))
    optimiser = torch.optim.AdamW(module.parameters(), lr=LEARNING_RATE, betas=ADAM_BETAS, weight_decay=WEIGHT_DECAY)
    module.train()
    for step in range(steps):
        if tiles and step == tiles_from:
            labelled = label_tiles(average, start, tiles)
            more = HardPatchDataset([*groups, labelled], [*weights, tiles_weight], seed)
            batches = _load(more, range(step, steps))
        for group in optimiser.param_groups:
            group["lr"] = LEARNING_RATE * lr_schedule(step / steps)
        batch = next(batches)
        out = module(torch.from_numpy(batch.batch.images)[:, None])
        loss = focal_loss(out[:, :3], batch.batch) + _size_loss(out[:, 3:], batch)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(module.parameters(), MAX_GRAD_NORM)
        optimiser.step()
        _update_average(average, module, min(_AVERAGE, (step + 1) / (step + 10)))
        if on_step is not None:
            on_step(step, float(loss.detach()), average)
    return to_network(average)


class _Steps(Dataset[SizedBatch]):  # type: ignore[misc]
    """The batches of some steps, made in another process."""

    def __init__(self, patches: PatchDataset, steps: range) -> None:
        self.patches, self.steps = patches, steps

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, index: int) -> SizedBatch:
        cv2.setNumThreads(1)
        return SizedBatch.of(self.patches.make_patches(self.steps[index]))


def _load(patches: PatchDataset, steps: range) -> Iterator[SizedBatch]:
    """Made in a process that is started anew: one forked from threads of OpenCV may wait for ever."""
    options = {"num_workers": 1, "prefetch_factor": 8, "multiprocessing_context": "spawn"}
    return iter(DataLoader(_Steps(patches, steps), batch_size=None, collate_fn=_same, **options))


def _same(batch: SizedBatch) -> SizedBatch:
    return batch


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


def _size_loss(out: Tensor, batch: SizedBatch) -> Tensor:
    target, weight = (torch.from_numpy(part).permute(0, 3, 1, 2) for part in (batch.size, batch.size_weight))
    of_sizes = (weight * (out - target) ** 2).sum((0, 2, 3)) / (weight.sum((0, 2, 3)) + 1)
    return _SIZE_WEIGHT * of_sizes.sum()


def label_tiles(module: nn.Module, second: Network, tiles: Sequence[LabelledImage]) -> list[LabelledImage]:
    """Unlabelled images (at most `PATCH_PX` a side) with cars and background where these are certain.

    A car is certain where the mean over eight views (turned by right angles, mirrored) is high and a ``second`` network
    sees it too; the ground is certain where no view shows a car. All else is not ``valid``.
    """
    other = start_from(second, np.stack([_padded(tile) for tile in tiles[:64]])).eval()
    return [_label_tile(module.eval(), other, tile) for tile in tiles]


def _padded(tile: LabelledImage) -> Float32Array:
    height, width = tile.image.shape
    ends = PATCH_PX - height, PATCH_PX - width
    whole = cv2.copyMakeBorder(tile.image, 0, ends[0], 0, ends[1], cv2.BORDER_REFLECT_101)
    return np.asarray(whole, np.float32) / np.float32(255)


def _label_tile(module: nn.Module, second: nn.Module, tile: LabelledImage) -> LabelledImage:
    image = _padded(tile)
    views = [np.rot90(side, k) for side in (image, image[:, ::-1]) for k in range(4)]
    with torch.no_grad():
        out = module(torch.from_numpy(np.ascontiguousarray(np.stack(views)))[:, None]).numpy()
        seen = torch.sigmoid(second(torch.from_numpy(image)[None, None])[0, 0]).numpy()
    probability = 1 / (1 + np.exp(-out[:, 0]))
    back = [np.rot90(map_, -(k % 4)) for k, map_ in enumerate(probability)]
    aligned = np.stack([view if k < 4 else view[:, ::-1] for k, view in enumerate(back)])
    mean, highest = aligned.mean(axis=0).astype(np.float32), aligned.max(axis=0)
    height, width = tile.image.shape
    inside = np.zeros((PATCH_PX, PATCH_PX), bool)
    inside[:height, :width] = True
    peaks = find_peaks(mean, out[0, 1:3], inside, stride=STRIDE, min_probability=_CERTAIN_CAR)
    near = cv2.dilate(seen, np.ones((5, 5), np.uint8))
    rows, columns = (np.rint((peaks[:, k] - 0.5) / STRIDE).astype(int) for k in (1, 0))
    peaks = peaks[near[np.clip(rows, 0, len(near) - 1), np.clip(columns, 0, len(near) - 1)] > _CERTAIN_CAR / 2]
    ground = cv2.resize(highest, (PATCH_PX, PATCH_PX), interpolation=cv2.INTER_LINEAR)[:height, :width]
    valid = ground < _CERTAIN_GROUND
    y, x = np.mgrid[:height, :width]
    for centre in peaks[:, :2]:
        valid |= np.hypot(x - centre[0], y - centre[1]) < _KNOWN_RADIUS_PX
    axis = np.mod(0.5 * np.arctan2(peaks[:, 3], peaks[:, 2]), np.pi)
    cars = np.column_stack([peaks[:, :2], axis, np.full((len(peaks), 2), np.nan)])
    return replace(tile, cars=cars, valid=valid)
