"""The layer of sizes of a fine-tuned network: it gives what that of the network it began with gives.

Fine-tuning changes the features that the layer reads: with the weights as they were a bus was measured up to 1.6 times
too long. A linear map of the new features to the former sizes, at the vehicles of the labelled images, undoes it.
"""

import numpy as np

from schemas.arrays import Float32Array
from velfield.detection.cnn.dataset import PatchDataset
from velfield.detection.cnn.graph import network_graph
from velfield.detection.cnn.inference import Predictor
from velfield.detection.cnn.model import find_peaks, read_at
from velfield.detection.cnn.network import SIZE_LAYER, STRIDE, Network
from velfield.detection.runtime import open_session, serialize

LOG_SCALE_RANGE = 0.5
"""Of the patches, either way: cars of all sizes stand for vehicles of all sizes. Less leaves lengths near to the usual
one where the scale is wrong by a fifth."""
_BATCHES = 24
_MIN_PROBABILITY = 0.3
_RIDGE = 0.01
"""Weight of the former weights, in vehicles a vehicle, of features of unit variance."""


def copy_sizes(network: Network, former: Network, patches: PatchDataset) -> Network:
    """The network with a layer of sizes that agrees with the former one's where it sees vehicles in the patches.

    The former one must have such a layer.
    """
    session = open_session(serialize(network_graph(network, with_features=True)), "cpu")
    predict = Predictor(former)
    rows = [np.empty((0, SIZE_LAYER.channels_in + SIZE_LAYER.channels_out), np.float32)]
    for step in range(_BATCHES):
        images = to_bytes(np.stack([patch.image for patch in patches.make_patches(step)]))
        outputs = session.run(["probability", "orientation", "features"], {"image": images[:, None]})
        for probability, orientation, features, wanted in zip(*outputs, predict(images)[2], strict=True):
            peaks = find_peaks(probability[0], orientation, None, stride=STRIDE, min_probability=_MIN_PROBABILITY)
            rows.append(np.hstack([read_at(part, peaks[:, :2]) for part in (features, wanted)]))
    seen, wanted = np.split(np.concatenate(rows).astype(np.float64), [SIZE_LAYER.channels_in], axis=1)
    weights, bias = former.weights[SIZE_LAYER.name][0].astype(np.float64), former.biases[SIZE_LAYER.name]
    if len(seen):
        mean, sd = seen.mean(axis=0), seen.std(axis=0) + 1e-3
        x, missing = (seen - mean) / sd, wanted - seen @ weights - bias
        change = np.linalg.solve(x.T @ x + _RIDGE * len(x) * np.eye(x.shape[1]), x.T @ (missing - missing.mean(axis=0)))
        weights = weights + change / sd[:, None]
        bias = bias + missing.mean(axis=0) - mean @ (change / sd[:, None])
    return Network(
        {**network.weights, SIZE_LAYER.name: weights[None].astype(np.float32)},
        {**network.biases, SIZE_LAYER.name: bias.astype(np.float32)},
    )


def to_bytes(images: Float32Array) -> np.ndarray:
    """Grey images in [0, 1] as bytes, which a network takes."""
    return np.rint(np.clip(images, 0, 1) * 255).astype(np.uint8)
