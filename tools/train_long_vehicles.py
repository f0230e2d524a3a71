"""Learns what the middle of a lorry or bus looks like, for `long_vehicles`; run when what ships is made."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np

from schemas.arrays import ByteArray, FloatArray
from schemas.detector import LongVehicleRecord, Round
from schemas.flight import DetectionConfig
from velfield.detection.boosting import random_pool
from velfield.detection.cascade.classifier import moved
from velfield.detection.cascade.feature_image import Picture, picture_of, scores_at
from velfield.detection.cascade.feature_matrix import Bank, bank_of
from velfield.detection.cascade.long_vehicles import LEAST_LENGTH, LONG, OFFSETS, LongVehicles
from velfield.detection.cascade.training import CONTRAST_FLOOR
from velfield.detection.detector import BoostedSums, sums_of
from velfield.detection.samples import LabelledImage, Poses, varied
from velfield.parallel import each

ROUNDS = 800
_STAGES = (80, 160)
"""Rounds before each mining of places that are wrongly liked."""
_POOL, _RECTANGLES = 4000, 2
_SIGMA_PX = (7.0, 3.0)
_SHRINKAGE, _FRACTION = 0.5, 0.3
_COPIES, _OFF_COPIES, _CAR_SAMPLES = 6, 10, 27_000
_BESIDE_SD_PX, _TURN_SD_RAD = 1.3, 0.08
"""How far a find of the first classifier lies beside the axis, and how much it is turned."""
_MIDDLE_SD_PX, _OFF_PX, _CAR_OFF_PX = 1.2, (4.0, 20.0), (2.0, 20.0)
_MINED_ABOVE, _MINED_OFF_PX = -0.05, 4.0
_FALSE_SHARE = 0.0005
"""So many cars may be taken for the end of something long, where the classifier was not trained."""


_Finds: TypeAlias = tuple[FloatArray, FloatArray]
"""Poses, and whose they are."""


@dataclass(frozen=True)
class _Scene:
    picture: Picture
    long: FloatArray
    cars: FloatArray


def learn_long_vehicles(
    samples: Sequence[LabelledImage],
    left_out: Sequence[LabelledImage],
    config: DetectionConfig,
    attribution: tuple[str, ...] = (),
) -> LongVehicleRecord:
    """Learn the classifier.

    Parameters
    ----------
    samples
        Pictures whose cars have an orientation and a length; what is `LEAST_LENGTH` times as long as a car is long.
    left_out
        More of them, from which its threshold follows.
    """
    rng = np.random.default_rng(config.seed)
    scenes = [_scene(sample, config.working_car_length_px) for sample in samples]
    pictures = [scene.picture for scene in scenes]
    share = _CAR_SAMPLES / max(1, sum(len(scene.cars) for scene in scenes))
    middles = [_middles(scene, rng) for scene in scenes]
    others = [_others(scene, share, rng) for scene in scenes]
    pool = random_pool(
        _POOL, channels=3, sigma_xy_px=_SIGMA_PX, reach_xy_px=LONG.reach, max_rectangles=_RECTANGLES, rng=rng
    )
    bank = bank_of(
        pool, CONTRAST_FLOOR, [*zip(pictures, middles, strict=True), *zip(pictures, others, strict=True)], rng
    )
    known = bank.samples(zip(pictures, middles, strict=True))
    known_others = bank.samples(zip(pictures, others, strict=True))
    for rounds in _STAGES:
        found = _boosted(bank, known, known_others, rounds, rng)
        tried = [(scene, _beside(scene.long, 9.0, rng), _beside(scene.cars, 2.0, rng)) for scene in scenes]
        mined = [varied(wrong, rng) for wrong in each(partial(_wrongly_liked, sums=sums_of(found)), tried)]
        known_others = np.hstack([known_others, bank.samples(zip(pictures, mined, strict=True))])
    found = _boosted(bank, known, known_others, ROUNDS, rng)
    return LongVehicleRecord(
        working_car_length_px=config.working_car_length_px,
        rounds=found,
        threshold=_threshold(found, [_scene(sample, config.working_car_length_px) for sample in left_out], rng),
        contrast_floor=CONTRAST_FLOOR,
        attribution=attribution,
    )


def _scene(sample: LabelledImage, car_length_px: float) -> _Scene:
    long = sample.cars[:, 3] > LEAST_LENGTH * car_length_px
    return _Scene(picture_of(sample.image, None, LONG), sample.cars[long, :3], sample.cars[~long, :3])


def _along(rows: FloatArray, copies: int, along: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Poses (n * copies, 3), moved along their axes, a little beside them and a little turned."""
    rows = np.repeat(rows, copies, axis=0)
    rows[:, :2] = moved(rows[:, :2], rows[:, 2], np.column_stack([along, rng.normal(0, _BESIDE_SD_PX, len(rows))]))
    rows[:, 2] += rng.normal(0, _TURN_SD_RAD, len(rows))
    return rows


def _either_way(count: int, between: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    return rng.uniform(*between, count) * np.where(rng.random(count) < 0.5, -1, 1)


def _beside(rows: FloatArray, reach_px: float, rng: np.random.Generator) -> _Finds:
    """Where finds may lie."""
    return _along(rows, 2, rng.uniform(-reach_px, reach_px, 2 * len(rows)), rng), np.repeat(rows, 2, axis=0)


def _middles(scene: _Scene, rng: np.random.Generator) -> Poses:
    along = rng.normal(0, _MIDDLE_SD_PX, _COPIES * len(scene.long))
    return varied(_along(scene.long, _COPIES, along, rng), rng)


def _others(scene: _Scene, share: float, rng: np.random.Generator) -> Poses:
    """Off the middle of what is long; cars, and places before and behind them."""
    copies = max(1, round(share / 3))
    off = _either_way(_OFF_COPIES * len(scene.long), _OFF_PX, rng)
    on_car = rng.normal(0, _MIDDLE_SD_PX, copies * len(scene.cars))
    by_car = _either_way(2 * copies * len(scene.cars), _CAR_OFF_PX, rng)
    parts = [
        _along(scene.long, _OFF_COPIES, off, rng),
        _along(scene.cars, copies, on_car, rng),
        _along(scene.cars, 2 * copies, by_car, rng),
    ]
    return varied(np.concatenate(parts), rng)


def _boosted(
    bank: Bank, middles: ByteArray, others: ByteArray, rounds: int, rng: np.random.Generator
) -> tuple[Round, ...]:
    return bank.learnt(middles, others, rounds=rounds, fraction=_FRACTION, shrinkage=_SHRINKAGE, rng=rng)


def _wrongly_liked(tried: tuple[_Scene, _Finds, _Finds], sums: BoostedSums) -> FloatArray:
    """The two best places along each find's axis, where they are no middle."""
    scene, long, cars = tried
    wrong = [np.empty((0, 3))]
    for (rows, whose), far_px in ((long, _MINED_OFF_PX), (cars, -1.0)):
        if not len(rows):
            continue
        scores = scores_at(sums, scene.picture, rows[:, :2], rows[:, 2], OFFSETS, contrast_floor=CONTRAST_FLOOR)
        which = np.arange(len(rows))
        for _ in range(2):
            best = scores.argmax(axis=1)
            there = moved(rows[:, :2], rows[:, 2], OFFSETS[best].astype(np.float64) * LONG.step)
            off = np.hypot(*(there - whose[:, :2]).T) > far_px
            chosen = off & (scores[which, best] > _MINED_ABOVE)
            wrong.append(np.column_stack([there, rows[:, 2]])[chosen])
            for beside in range(-2, 3):
                scores[which, np.clip(best + beside, 0, len(OFFSETS) - 1)] = -np.inf
    return np.concatenate(wrong)


def _threshold(found: tuple[Round, ...], scenes: Sequence[_Scene], rng: np.random.Generator) -> float:
    """What all but a few cars of scenes left out stay below."""
    record = LongVehicleRecord(working_car_length_px=1.0, rounds=found, threshold=0.0, contrast_floor=CONTRAST_FLOOR)
    classifier = LongVehicles(record, sums_of(found))
    best = [np.empty(0)]
    for scene in scenes:
        rows, _ = _beside(scene.cars, 2.0, rng)
        scores = classifier.scores(scene.picture, rows[:, :2], rows[:, 2])
        best.append(scores.max(axis=1, initial=-1.0))
    return float(np.quantile(np.concatenate(best), 1 - _FALSE_SHARE))
