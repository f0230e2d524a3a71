"""Training of the paper's classifier: AdaBoost on pixels of upright images, near car centres and away from cars."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage, IntArray, Mask
from schemas.detector import PaperConfig, PaperRecord
from velfield.detection.samples import LabelledImage
from velfield.paper.boosting import (
    FeaturePool,
    assign_bins,
    boost,
    draw_feature_pool,
    quantile_bin_edges,
    rounds_from_stumps,
)
from velfield.paper.response import GREY_BITS, MARGIN_PX, dense_response, padded_integral
from velfield.paper.stumps import BoostedStumps

_REACH_PX = 40
_MAX_CAR_SAMPLES = 4000
_QUANTILE = 0.2
_EDGE_SAMPLES = 4000


def train_paper(samples: Sequence[LabelledImage], config: PaperConfig) -> PaperRecord:
    """Train: pixels within ``car_radius_px`` of a car's centre are positive, those beyond ``background_radius_px``
    negative."""
    rng = np.random.default_rng(config.seed)
    pool = draw_feature_pool(
        config.feature_pool,
        sigma_xy_px=(config.corner_sigma_px, config.corner_sigma_px),
        reach_xy_px=(_REACH_PX, _REACH_PX),
        max_rectangles=config.max_rectangles,
        rng=rng,
    )
    values, is_car = [], []
    for sample in samples:
        xy, positive = _sample_pixels(sample, config, rng, _MAX_CAR_SAMPLES // len(samples))
        values.append(_feature_values(sample.image, xy, pool))
        is_car.append(positive)
    measured, cars = np.concatenate(values).T.astype(np.float32), np.concatenate(is_car)
    edges = quantile_bin_edges(measured[:, rng.permutation(measured.shape[1])[:_EDGE_SAMPLES]])
    stumps = boost(
        assign_bins(measured, edges), edges, cars, rounds=config.rounds, car_fraction=config.car_fraction, rng=rng
    )
    rounds = rounds_from_stumps(pool, stumps)
    threshold = config.threshold
    if threshold is None:
        threshold = _choose_threshold(samples, BoostedStumps.from_rounds(rounds), config)
    return PaperRecord(
        working_car_length_px=config.working_car_length_px,
        grey_bits=GREY_BITS,
        rounds=rounds,
        threshold=threshold,
        cars=sum(len(sample.cars) for sample in samples),
        response_sigma_px=config.response_sigma_px,
        min_region_px=config.min_region_px,
    )


def _sample_pixels(
    sample: LabelledImage, config: PaperConfig, rng: np.random.Generator, max_cars: int
) -> tuple[IntArray, Mask]:
    """Pixels (n, 2) to train on, and which are positive: ``car_fraction`` of them."""
    height, width = sample.image.shape
    distance = _distance_to_nearest(height, width, np.ascontiguousarray(sample.cars[:, :2]))
    for x, y, radius in sample.ignore:
        ys, xs = np.ogrid[:height, :width]
        between = np.hypot(xs - x, ys - y) < radius
        distance[between & (distance > config.car_radius_px)] = config.background_radius_px
    if sample.valid is not None:
        distance[~sample.valid] = config.background_radius_px
    cars = np.argwhere(distance < config.car_radius_px)
    others = np.argwhere(distance > config.background_radius_px)
    cars = cars[rng.permutation(len(cars))[:max_cars]]
    others = others[rng.permutation(len(others))[: int(len(cars) * (1 - config.car_fraction) / config.car_fraction)]]
    return np.concatenate([cars, others])[:, ::-1], np.arange(len(cars) + len(others)) < len(cars)


def _distance_to_nearest(height: int, width: int, cars: FloatArray) -> FloatArray:
    """Distance (h, w) to the nearest car, px; infinite beyond 32 px."""
    out = np.full((height, width), np.inf)
    for x, y in cars:
        rows, columns = (slice(max(0, int(at) - 32), max(0, int(at) + 33)) for at in (y, x))
        part = out[rows, columns]
        down, along = np.ogrid[rows.start : rows.start + part.shape[0], columns.start : columns.start + part.shape[1]]
        np.minimum(part, np.hypot(along - x, down - y), out=part)
    return out


def _feature_values(image: GreyImage, xy: IntArray, pool: FeaturePool) -> NDArray[np.int32]:
    """Values (n, features) of all features at pixels (n, 2)."""
    integral = padded_integral(image, GREY_BITS)
    x, y = xy[:, 0] + MARGIN_PX, xy[:, 1] + MARGIN_PX
    out = np.zeros((len(xy), len(pool)), np.int32)
    for f in range(len(pool)):
        for sign, x0, y0, x1, y1 in pool.table[pool.starts[f] : pool.starts[f + 1]]:
            area = (
                integral[y + y1, x + x1]
                - integral[y + y0, x + x1]
                - integral[y + y1, x + x0]
                + integral[y + y0, x + x0]
            )
            out[:, f] += sign * area
    return out


def _choose_threshold(samples: Sequence[LabelledImage], stumps: BoostedStumps, config: PaperConfig) -> float:
    """Half of what the blurred response exceeds at four of five labelled cars: the paper gives no threshold, though its
    regions need one."""
    peaks = []
    for sample in samples:
        smooth = cv2.GaussianBlur(dense_response(sample.image, stumps), (0, 0), config.response_sigma_px)
        x, y = (np.rint(sample.cars[:, k]).astype(int) for k in (0, 1))
        inside = (x >= 0) & (y >= 0) & (x < smooth.shape[1]) & (y < smooth.shape[0])
        peaks.append(smooth[y[inside], x[inside]])
    return float(np.quantile(np.concatenate(peaks), _QUANTILE)) / 2
