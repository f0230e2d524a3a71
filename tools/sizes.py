"""Fits the layer of sizes to a network that detects: `network.SIZE_LAYER` on the output of its layer `SIZE_SOURCE`.

The other layers stay as they are, bit for bit. Patches are those of pre-training, with haze, blur and the losses of
video, over a wider range of scales. The features are read where the network sees a labelled vehicle, as in inference.
The loss is the likelihood of log length and log width under normal distributions whose standard deviations the layer
gives too. It needs PyTorch (`pip install torch`), and takes three minutes of one core.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import nn

from schemas.arrays import Float32Array, FloatArray
from tools.hard_patches import HardPatchDataset
from velfield.detection.cnn.dataset import Patch, PatchDataset
from velfield.detection.cnn.graph import network_graph
from velfield.detection.cnn.inference import Predictor
from velfield.detection.cnn.model import detect_cars, find_peaks, read_at
from velfield.detection.cnn.network import SIZE_LAYER, STRIDE, USUAL_SIZE_PX, Network
from velfield.detection.cnn.sizes import LOG_SCALE_RANGE, to_bytes
from velfield.detection.cnn.trainer import lr_schedule
from velfield.detection.nms import nms_oriented
from velfield.detection.runtime import open_session, serialize
from velfield.detection.samples import LabelledImage

STEPS = 5000
"""Batches of patches whose vehicles are read."""
_FIT_STEPS, _FIT_BATCH, _FIT_RATE = 6000, 1024, 3e-3
_MIN_PROBABILITY, _NEAR_PX, _NEAR_LENGTHS = 0.3, 4.0, 0.15
"""Of a peak that shows a labelled vehicle; its distance from the centre, or that in lengths where it is more."""
_EDGE_PX = 16
"""Vehicles so near to the border of a patch are not read."""
_MIN_LOG_SD, _MAX_LOG_SD = -4.0, 1.0
_LONG_RATIO = 1.35


def fit_sizes(
    network: Network,
    groups: Sequence[Sequence[LabelledImage]],
    weights: Sequence[float],
    *,
    seed: int,
    steps: int = STEPS,
) -> Network:
    """The network with a layer of sizes fitted to it; ``groups`` and ``weights`` as for `PatchDataset`."""
    dataset = HardPatchDataset(groups, weights, seed, log_scale_range=LOG_SCALE_RANGE)
    features, logarithms = _read_vehicles(network, dataset, steps)
    weight, bias = _fit(features, logarithms, seed)
    return Network(
        {**network.weights, SIZE_LAYER.name: np.ascontiguousarray(weight.T)[None]},
        {**network.biases, SIZE_LAYER.name: bias},
    )


def _read_vehicles(network: Network, dataset: PatchDataset, steps: int) -> tuple[Float32Array, Float32Array]:
    """Features (n, channels) of the vehicles that the network sees, and logarithms (n, 2) of length and width."""
    session = open_session(serialize(network_graph(network, with_features=True)), "cpu")
    found = [np.empty((0, SIZE_LAYER.channels_in + 2), np.float32)]
    for step in range(steps):
        patches = dataset.make_patches(step)
        images = to_bytes(np.stack([patch.image for patch in patches]))
        outputs = session.run(["probability", "orientation", "features"], {"image": images[:, None]})
        for patch, probability, orientation, features in zip(patches, *outputs, strict=True):
            peaks = find_peaks(probability[0], orientation, None, stride=STRIDE, min_probability=_MIN_PROBABILITY)
            rows, at = _seen_vehicles(patch, peaks[:, :2])
            seen = read_at(features, peaks[at, :2])
            found.append(np.column_stack([seen, np.log(patch.vehicles[rows, 3:5] / USUAL_SIZE_PX)]))
    table = np.concatenate(found).astype(np.float32)
    return table[:, : SIZE_LAYER.channels_in], table[:, SIZE_LAYER.channels_in :]


def _seen_vehicles(patch: Patch, peaks: FloatArray) -> tuple[np.ndarray, np.ndarray]:
    """Vehicles of known length that a peak (n, 2) shows, (k,), and the peak of each, (k,)."""
    vehicles, side = patch.vehicles, len(patch.image)
    if not len(vehicles) or not len(peaks):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    distance = np.hypot(*(peaks[:, None] - vehicles[None, :, :2]).transpose(2, 0, 1))
    nearest, back = distance.argmin(axis=0), distance.argmin(axis=1)
    near = distance.min(axis=0) < np.maximum(_NEAR_PX, _NEAR_LENGTHS * np.nan_to_num(vehicles[:, 3]))
    at = peaks[nearest]
    inside = ((at >= _EDGE_PX) & (at < side - _EDGE_PX)).all(axis=1)
    column, row = (np.clip(at[:, k] / STRIDE, 0, side // STRIDE - 1).astype(np.int64) for k in (0, 1))
    known = np.isfinite(vehicles[:, 3]) & (patch.mask[row, column] > 0)
    rows = np.flatnonzero(near & inside & known & (back[nearest] == np.arange(len(vehicles))))
    return rows, nearest[rows]


def _fit(features: Float32Array, logarithms: Float32Array, seed: int) -> tuple[Float32Array, Float32Array]:
    """Weights (4, channels) and bias (4,) of the greatest likelihood, by Adam; NaN where a size is not known."""
    generator = torch.Generator().manual_seed(seed)
    mean, sd = features.mean(axis=0), features.std(axis=0) + 1e-3
    x, y = torch.from_numpy((features - mean) / sd), torch.from_numpy(logarithms)
    weight = torch.zeros(SIZE_LAYER.channels_out, SIZE_LAYER.channels_in, requires_grad=True)
    bias = torch.tensor([0.0, 0.0, -2.0, -2.0], requires_grad=True)
    optimiser = torch.optim.Adam([weight, bias])
    for step in range(_FIT_STEPS):
        for group in optimiser.param_groups:
            group["lr"] = _FIT_RATE * lr_schedule(step / _FIT_STEPS)
        rows = torch.randint(0, len(x), (_FIT_BATCH,), generator=generator)
        out = nn.functional.linear(x[rows], weight, bias)
        log_sd = out[:, 2:].clamp(_MIN_LOG_SD, _MAX_LOG_SD)
        known = torch.isfinite(y[rows])
        error = torch.where(known, out[:, :2] - y[rows].nan_to_num(), 0.0)
        loss = (0.5 * (error * torch.exp(-log_sd)) ** 2 + log_sd)[known].mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    scaled = weight.detach().double().numpy() / sd
    return scaled.astype(np.float32), (bias.detach().double().numpy() - scaled @ mean).astype(np.float32)


def size_errors(network: Network, samples: Sequence[LabelledImage]) -> str:
    """Errors of the length of single detections in labelled images, in words: of cars, and of longer vehicles."""
    predict, errors = Predictor(network), [np.empty((0, 2))]
    for sample in samples:
        cars = sample.cars[np.isfinite(sample.cars[:, 3])]
        found = nms_oriented(detect_cars(predict, sample.image, sample.valid), USUAL_SIZE_PX[0])
        if not len(cars) or not len(found):
            continue
        distance = np.hypot(*(found[:, None, :2] - cars[None, :, :2]).transpose(2, 0, 1))
        nearest = distance.argmin(axis=0)
        seen = np.flatnonzero(distance.min(axis=0) < np.maximum(_NEAR_PX, _NEAR_LENGTHS * cars[:, 3]))
        errors.append(np.column_stack([cars[seen, 3], np.log(found[nearest[seen], 5] / cars[seen, 3])]))
    length, error = np.concatenate(errors).T
    parts = []
    for name, some in (
        ("cars", length < _LONG_RATIO * USUAL_SIZE_PX[0]),
        ("longer", length >= _LONG_RATIO * USUAL_SIZE_PX[0]),
    ):
        if some.any():
            median, rms = np.median(error[some]), np.sqrt(np.mean(error[some] ** 2))
            parts.append(f"{some.sum()} {name}: median {median:+.3f}, RMS {rms:.3f}")
    return "; ".join(parts)
