"""Train the network that measures vehicles, on strips drawn at random: `python -m tools.train_dimensions`.

A strip (`velfield.detection.detect.oriented_strips`) is drawn from the simulator's vehicles, and a motorcycle, with
what lies around a vehicle in a street: shadow and parallax in any direction, markings, kerbs, vehicles ahead, behind
and beside. Position, axis and scale are in error as those of detections are.
"""

import argparse
from base64 import b64encode
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from schemas.arrays import FloatArray
from schemas.detector import DimensionsRecord
from velfield.synthetic.traffic.vehicles import LAYERS, draw_tones
from velfield.tracking.dimensions import STRIP_SHAPE, normalise

_PX_PER_M = 3.6
"""Full resolution of a strip: a car of 4.5 m is 16 px long."""
_STEP_PX = 0.25
_SPAN_PX = STRIP_SHAPE[0], STRIP_SHAPE[1]
"""Half the strip's sides, full resolution."""
_MOTORCYCLE = np.array(
    [
        [1.00, -0.22, 0.12, 0.42, 0.30, 3.0],
        [0.80, -0.30, 0.20, 0.50, 0.30, 0.0],
        [0.60, -0.45, 0.45, 0.30, 0.20, 0.0],
        [0.40, -0.50, 0.50, 0.22, 0.20, 4.0],
        [0.15, -0.50, 0.50, 0.20, 0.20, 4.0],
    ]
)
_SHAPES = np.concatenate([LAYERS, _MOTORCYCLE[None]])
_RANGES_M = {
    0: ((3.4, 5.3), (1.55, 2.0), (1.35, 1.8)),
    1: ((4.6, 7.2), (1.8, 2.2), (1.9, 2.8)),
    2: ((6.0, 13.5), (2.2, 2.6), (3.0, 4.0)),
    3: ((8.5, 15.0), (2.4, 2.65), (2.9, 3.4)),
    4: ((1.7, 2.5), (0.6, 0.95), (1.3, 1.8)),
}
"""Length, width and height by shape: car, van, lorry, bus, motorcycle."""
_SHAPE_PROBABILITIES = [0.5, 0.18, 0.14, 0.1, 0.08]


class Strips:
    """Draws vehicles and their strips."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        half = (np.arange(int(2 * side / _STEP_PX)) * _STEP_PX - side + _STEP_PX / 2 for side in _SPAN_PX)
        self.u, self.v = np.meshgrid(*half, indexing="ij")

    def draw(self) -> tuple[FloatArray, FloatArray]:
        """A mean strip of one vehicle and its length and width, px of the full resolution."""
        rng = self.rng
        scale = _PX_PER_M * rng.uniform(0.8, 1.25)
        shape = int(rng.choice(5, p=_SHAPE_PROBABILITIES))
        size = self._size(shape) * scale
        others = self._neighbours(size, scale)
        has_shadow = rng.uniform() < 0.7
        sun = _polar(rng.uniform(0, 1.4) * has_shadow, rng.uniform(0, 2 * np.pi))
        slope, light = _polar(rng.uniform(0, 0.3), rng.uniform(0, 2 * np.pi)), rng.uniform(0.4, 0.8)
        vehicles = [(shape, size, (0.0, 0.0), 0.0, draw_tones(1, rng)[0]), *others]
        shift = np.array([rng.normal(0, 1.5 if size[0] < 26 else 4.0), rng.normal(0, 0.7)])
        turn, place = rng.normal(0, 0.03), self._ground(scale)
        frames = int(rng.integers(1, 6))
        total = np.zeros(STRIP_SHAPE)
        for _ in range(frames):
            at, angle = shift + rng.normal(0, 0.7, 2), turn + rng.normal(0, 0.035)
            ground = place if rng.uniform() < 0.3 else self._ground(scale)
            total += self._strip(vehicles, ground, sun, slope, light, at, angle)
        return self._tone(total / frames) + rng.normal(0, 2.5 / np.sqrt(frames), STRIP_SHAPE), size[:2]

    def _size(self, shape: int) -> FloatArray:
        return np.array([self.rng.uniform(*limits) for limits in _RANGES_M[shape]])

    def _neighbours(
        self, size: FloatArray, scale: float
    ) -> list[tuple[int, FloatArray, tuple[float, float], float, FloatArray]]:
        rng, found = self.rng, []
        for way in (-1, 1):
            if rng.uniform() < 0.35:
                other = self._size(0) * scale
                gap = (rng.uniform(0.8, 4.0)) * scale
                at = way * (size[0] / 2 + gap + other[0] / 2), rng.normal(0, 0.2) * scale
                found.append((0, other, at, 0.0, draw_tones(1, rng)[0]))
            if rng.uniform() < 0.15 and size[0] < 22:
                at = rng.normal(0, 0.5) * scale, way * rng.uniform(2.45, 3.4) * scale
                found.append((0, self._size(0) * scale, at, 0.0, draw_tones(1, rng)[0]))
        return found

    def _ground(self, scale: float) -> FloatArray:
        """A piece of street."""
        rng, shape = self.rng, self.u.shape
        level = rng.uniform(55, 175)
        ground = np.full(shape, level)
        for cells, strength in (((5, 3), 5.0), ((17, 7), 3.0)):
            noise = rng.normal(0, rng.uniform(0, strength), cells).astype(np.float32)
            ground += cv2.resize(noise, shape[::-1], interpolation=cv2.INTER_CUBIC)
        for way in (-1, 1):
            if rng.uniform() < 0.3:
                edge = rng.uniform(1.5, 2.6) * scale
                ground[way * self.v > edge] = np.clip(level + rng.normal(0, 40), 20, 240)
            if rng.uniform() < 0.5:
                line, half = rng.normal(1.75, 0.15) * scale, 0.08 * scale
                ground[np.abs(way * self.v - line) < half] = rng.uniform(level, 235)
        if rng.uniform() < 0.12:
            at, half = rng.uniform(-30, 30), rng.uniform(0.1, 0.4) * scale
            ground[np.abs(self.u - at) < half] = rng.uniform(level, 235)
        if rng.uniform() < 0.08:
            at = rng.uniform(-30, 30)
            ground[(np.abs(self.u - at) < 2 * scale) & (np.abs(self.v) < 0.15 * scale)] = 225
        return ground

    def _strip(
        self,
        vehicles: list[tuple[int, FloatArray, tuple[float, float], float, FloatArray]],
        ground: FloatArray,
        sun: FloatArray,
        slope: FloatArray,
        light: float,
        at: FloatArray,
        angle: float,
    ) -> FloatArray:
        """The strip of a detection that is displaced by ``at`` and rotated by ``angle``."""
        c, s = np.cos(angle), np.sin(angle)
        u, v = at[0] + c * self.u - s * self.v, at[1] + s * self.u + c * self.v
        image, body = ground.copy(), np.zeros(ground.shape, bool)
        shaded = np.zeros(ground.shape, bool)
        for shape, size, (x, y), _, _tones in vehicles:
            for layer in _SHAPES[shape]:
                z = layer[0] * size[2]
                shaded |= _inside(u - x - z * sun[0], v - y - z * sun[1], layer, size)
        image[shaded] *= light
        for shape, size, (x, y), _, tones in vehicles:
            for layer in _SHAPES[shape]:  # the highest first
                z = layer[0] * size[2]
                here = _inside(u - x - z * slope[0], v - y - z * slope[1], layer, size) & ~body
                image[here] = tones[int(layer[5])]
                body |= here
        blurred = cv2.GaussianBlur(image, (0, 0), self.rng.uniform(0.5, 0.9) / _STEP_PX)
        return np.asarray(cv2.resize(blurred, STRIP_SHAPE[::-1], interpolation=cv2.INTER_AREA), np.float64)

    def _tone(self, strip: FloatArray) -> FloatArray:
        """Exposure and contrast of another camera."""
        gamma, gain = self.rng.uniform(0.7, 1.4), self.rng.uniform(0.7, 1.15)
        return np.asarray(np.clip(255 * gain * (np.clip(strip, 0, 255) / 255) ** gamma, 0, 255))


def _polar(length: float, angle: float) -> FloatArray:
    return length * np.array([np.cos(angle), np.sin(angle)])


def _inside(a: FloatArray, b: FloatArray, layer: FloatArray, size: FloatArray) -> FloatArray:
    """Whether positions are in a layer's rectangle with rounded corners."""
    length, width = size[:2]
    middle, half = 0.5 * (layer[1] + layer[2]) * length, 0.5 * (layer[2] - layer[1]) * length
    radius = layer[4] * width
    da = np.maximum(np.abs(a - middle) - (half - radius), 0)
    db = np.maximum(np.abs(b) - (layer[3] * width - radius), 0)
    return np.asarray(da * da + db * db <= radius * radius)


def train(strips: FloatArray, sizes: FloatArray, *, seed: int, epochs: int) -> DimensionsRecord:
    """Maximum likelihood of log length and log width under normal distributions, by Adam.

    Parameters
    ----------
    strips, sizes
        (n, length, width), and (n, 2) length and width, px.
    """
    rng = np.random.default_rng(seed)
    x, y = normalise(strips).reshape(len(strips), -1), np.log(sizes)
    widths = [x.shape[1], 96, 48, 4]
    layers = [(rng.normal(0, np.sqrt(2 / a), (a, b)), np.zeros(b)) for a, b in pairwise(widths)]
    layers[-1] = (layers[-1][0] * 0.1, np.array([np.log(16.0), np.log(7.0), -2.0, -2.0]))
    parameters = [p for layer in layers for p in layer]
    first, second = [np.zeros_like(p) for p in parameters], [np.zeros_like(p) for p in parameters]
    step, batch, steps = 0, 256, epochs * (len(x) // 256)
    for _ in range(epochs):
        order = rng.permutation(len(x))
        for start in range(0, len(x) - batch + 1, batch):
            rows = order[start : start + batch]
            part = _flip(x[rows], rng)
            gradients, step = _gradients(parameters, part, y[rows]), step + 1
            rate = 2e-3 * 0.5 * (1 + np.cos(np.pi * step / steps))
            for k, gradient in enumerate(gradients):
                gradient = gradient + 1e-4 * parameters[k] * (parameters[k].ndim == 2)
                first[k] += 0.1 * (gradient - first[k])
                second[k] += 0.001 * (gradient**2 - second[k])
                update = first[k] / (1 - 0.9**step) / (np.sqrt(second[k] / (1 - 0.999**step)) + 1e-8)
                parameters[k] -= rate * update
    pack = [b64encode(p.astype("<f2").tobytes()).decode() for p in parameters]
    return DimensionsRecord(widths=widths, weights_f16=pack[::2], biases_f16=pack[1::2])


def _flip(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    strips = x.reshape(-1, *STRIP_SHAPE)
    if rng.uniform() < 0.5:
        strips = strips[:, ::-1]
    if rng.uniform() < 0.5:
        strips = strips[:, :, ::-1]
    return strips.reshape(len(x), -1)


def _gradients(p: list[FloatArray], x: FloatArray, y: FloatArray) -> list[FloatArray]:
    a = np.maximum(x @ p[0] + p[1], 0)
    b = np.maximum(a @ p[2] + p[3], 0)
    out = b @ p[4] + p[5]
    mean, log_sd = out[:, :2], np.clip(out[:, 2:], -5, 1)
    error, precision = mean - y, np.exp(-2 * log_sd)
    d = np.concatenate([error * precision, 1 - error**2 * precision], axis=1) / len(x)
    d = np.clip(d, -20 / len(x), 20 / len(x))
    db = (d @ p[4].T) * (b > 0)
    da = (db @ p[2].T) * (a > 0)
    return [x.T @ da, da.sum(0), a.T @ db, db.sum(0), b.T @ d, d.sum(0)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("velfield/tracking/shipped_dimensions.json"))
    parser.add_argument("--vehicles", type=int, default=40000)
    parser.add_argument("--epochs", type=int, default=60)
    parser.add_argument("--seed", type=int, default=7)
    given = parser.parse_args()
    maker = Strips(given.seed)
    drawn = [maker.draw() for _ in range(given.vehicles)]
    record = train(
        np.stack([d[0] for d in drawn]), np.stack([d[1] for d in drawn]), seed=given.seed, epochs=given.epochs
    )
    given.out.write_text(record.model_dump_json())


if __name__ == "__main__":
    main()
