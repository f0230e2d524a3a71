"""Boosting of the aligned method's two steps: what is wrongly found is learnt again, and so are the cars' axes."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import ByteArray, FloatArray
from schemas.detector import CascadeConfig, Round
from velfield.detection.boosting import BoostedSums, random_pool, sums_of
from velfield.detection.cascade.classifier import Look, find_cars, moved, offset_grid
from velfield.detection.cascade.feature_image import COARSE, FINE, Grain
from velfield.detection.cascade.feature_matrix import Bank, bank_of
from velfield.detection.cascade.proposals import propose
from velfield.detection.cascade.scenes import Poses, Scene, is_far, is_wrong, other_poses, varied
from velfield.parallel import parallel_map

CONTRAST_FLOOR = 12.0
"""Grey levels a px added to the mean gradient, by which sums are divided: what is flat is not blown up."""
COARSE_ROUNDS = 40
_COARSE_POOL = 1500
_COARSE_SIGMA_PX = (3.5, 2.5)
_COARSE_BESIDE_PX, _COARSE_TURN_RAD = 2.2, 0.28
"""Half the step between places and turns of the scan: a car that lies so must be liked all the same."""
_FINE_STAGES = (80, 160)
"""Rounds before each mining of what is wrongly found."""
_BESIDE_SD_PX, _TURN_SD_RAD = 0.6, 0.06
_SIGMA_SHARE_XY = (0.6, 0.4)
"""Corners lie closer than the paper's: 6 px along and 4 across where the upright ones have 10, measured best."""
_RECTANGLES = 2
_CARS, _OTHERS, _MINED = 3000, 9000, 4000
_CAR_FRACTION = 0.3
_SHRINKAGE = 0.5
"""Half of what AdaBoost would say: twice the rounds, and cars that were not seen are found better."""
_LIKE_A_CAR = 0.25
"""Quantile of the marked cars' scores above which an unmarked find may be a car that stands."""
_LOOKED_AT = 6
"""So many times the places wanted are looked at, the best of each picture: all of six of 5 Mpx took a quarter hour."""
_WIDE = 20_000.0
_TURN_PRIOR_RAD = np.radians(20.0)
_TURN_PRIOR = 0.15


def learn_proposer(
    scenes: Sequence[Scene], config: CascadeConfig, channels: int, rng: np.random.Generator
) -> tuple[Round, ...]:
    """The coarse classifier of step one."""
    cars = [_coarse_cars(scene, _copies(scenes), rng) for scene in scenes]
    others = []
    for scene in scenes:
        poses = other_poses(scene, _OTHERS // len(scenes), rng)
        others.append(poses.where(is_far(poses.rows, scene)))
    bank = _bank(scenes, COARSE, cars, others, min(config.feature_pool, _COARSE_POOL), _COARSE_SIGMA_PX, channels, rng)
    known_cars = bank.samples(zip((scene.coarse for scene in scenes), cars, strict=True))
    known_others = bank.samples(zip((scene.coarse for scene in scenes), others, strict=True))
    most = _MINED // len(scenes)
    for _ in range(2):
        sums = sums_of(_boosted(bank, known_cars, known_others, COARSE_ROUNDS, rng))
        mined = [varied(wrong, rng) for wrong in parallel_map(partial(_wrongly_proposed, sums=sums, most=most), scenes)]
        known_others = np.hstack([known_others, bank.samples(zip((s.coarse for s in scenes), mined, strict=True))])
    return _boosted(bank, known_cars, known_others, COARSE_ROUNDS, rng)


def learn_classifier(
    scenes: Sequence[Scene],
    config: CascadeConfig,
    channels: int,
    rng: np.random.Generator,
) -> tuple[tuple[Round, ...], tuple[Scene, ...]]:
    """The classifier of step two, and the scenes with the cars' axes as it sees them."""
    scenes = tuple(scenes)
    cars = [_fine_cars(scene, _copies(scenes), rng) for scene in scenes]
    others = [other_poses(scene, _OTHERS // len(scenes), rng) for scene in scenes]
    sigma = config.corner_sigma_px * _SIGMA_SHARE_XY[0], config.corner_sigma_px * _SIGMA_SHARE_XY[1]
    bank = _bank(scenes, FINE, cars, others, config.feature_pool, sigma, channels, rng)
    known_others = bank.samples(zip((scene.fine for scene in scenes), others, strict=True))
    most = _MINED // len(scenes)
    for rounds in _FINE_STAGES:
        known_cars = bank.samples(zip((scene.fine for scene in scenes), cars, strict=True))
        sums = sums_of(_boosted(bank, known_cars, known_others, rounds, rng))
        scenes = tuple(parallel_map(partial(_realigned, sums=sums), scenes))
        mined = [varied(wrong, rng) for wrong in parallel_map(partial(_wrongly_found, sums=sums, most=most), scenes)]
        known_others = np.hstack([known_others, bank.samples(zip((s.fine for s in scenes), mined, strict=True))])
        cars = [_fine_cars(scene, _copies(scenes), rng) for scene in scenes]
    known_cars = bank.samples(zip((scene.fine for scene in scenes), cars, strict=True))
    return _boosted(bank, known_cars, known_others, config.rounds, rng), scenes


def _copies(scenes: Sequence[Scene]) -> int:
    return max(4, _CARS // max(1, sum(len(scene.cars) for scene in scenes)))


def _bank(
    scenes: Sequence[Scene],
    grain: Grain,
    cars: Sequence[Poses],
    others: Sequence[Poses],
    features: int,
    sigma_xy_px: tuple[float, float],
    channels: int,
    rng: np.random.Generator,
) -> Bank:
    pool = random_pool(
        features,
        channels=channels,
        sigma_xy_px=sigma_xy_px,
        reach_xy_px=grain.reach,
        max_rectangles=_RECTANGLES,
        rng=rng,
    )
    pictures = [scene.fine if grain is FINE else scene.coarse for scene in scenes]
    parts = [*zip(pictures, cars, strict=True), *zip(pictures, others, strict=True)]
    return bank_of(pool, CONTRAST_FLOOR, parts, rng)


def _boosted(
    bank: Bank, cars: ByteArray, others: ByteArray, rounds: int, rng: np.random.Generator
) -> tuple[Round, ...]:
    return bank.learnt(cars, others, rounds=rounds, fraction=_CAR_FRACTION, shrinkage=_SHRINKAGE, rng=rng)


def _fine_cars(scene: Scene, copies: int, rng: np.random.Generator) -> Poses:
    """Cars, a little beside themselves and a little turned."""
    rows = np.repeat(scene.cars, copies, axis=0)
    noise = rng.normal(0, 1, (len(rows), 3)) * [_BESIDE_SD_PX, _BESIDE_SD_PX, _TURN_SD_RAD]
    return varied(rows + noise, rng)


def _coarse_cars(scene: Scene, copies: int, rng: np.random.Generator) -> Poses:
    """Cars as the scan meets them: up to half a step beside a place, and half a turn."""
    rows = np.repeat(scene.cars, copies, axis=0)
    noise = rng.uniform(-1, 1, (len(rows), 3)) * [_COARSE_BESIDE_PX, _COARSE_BESIDE_PX, _COARSE_TURN_RAD]
    return varied(rows + noise, rng)


def _wrongly_proposed(scene: Scene, sums: BoostedSums, most: int) -> FloatArray:
    shape = scene.sample.image.shape
    found = propose(scene.coarse, shape, scene.sample.valid, sums, contrast_floor=CONTRAST_FLOOR, per_megapixel=_WIDE)
    return _surely_wrong(found, is_far(found, scene), scene, Look(scene.coarse, sums, CONTRAST_FLOOR))[:most]


def _wrongly_found(scene: Scene, sums: BoostedSums, most: int) -> FloatArray:
    look = Look(scene.fine, sums, CONTRAST_FLOOR)
    found = find_cars(look, scene.places[: _LOOKED_AT * most], min_score=-1.0)
    found = found[np.argsort(-found[:, 3], kind="stable")]
    return _surely_wrong(found, is_wrong(found, scene), scene, look)[:most]


def _surely_wrong(found: FloatArray, wrong: NDArray[np.bool_], scene: Scene, look: Look) -> FloatArray:
    """Of a picture not wholly marked, what is liked less than most marked cars: the rest may be cars that stand."""
    if not scene.sample.complete and len(scene.cars):
        here = look.scores(scene.cars[:, :2], scene.cars[:, 2], np.zeros(1), np.zeros((1, 2), np.int64))
        wrong = wrong & (found[:, 3] < np.quantile(here, _LIKE_A_CAR))
    return np.asarray(found[wrong])


_REALIGN_TURNS = np.radians(np.arange(-24.0, 25.0, 8.0))
_REALIGN_OFFSETS = offset_grid(1, 1)


def _realigned(scene: Scene, sums: BoostedSums) -> Scene:
    """Cars whose label does not tell the axis, turned to where the classifier so far likes them best.

    An axis from a box's shape is some ten degrees off; what most cars agree on sets the rest right.
    """
    if scene.told.all():
        return scene
    cars, look = scene.cars[~scene.told], Look(scene.fine, sums, CONTRAST_FLOOR)
    found = look.scores(cars[:, :2], cars[:, 2], _REALIGN_TURNS, _REALIGN_OFFSETS)
    found = found - np.float32(_TURN_PRIOR) * (_REALIGN_TURNS / _TURN_PRIOR_RAD)[:, None].astype(np.float32) ** 2
    best = found.reshape(len(cars), -1).argmax(axis=1)
    turn, offset = np.unravel_index(best, found.shape[1:])
    axes = cars[:, 2] + _REALIGN_TURNS[turn]
    aligned = scene.cars.copy()
    aligned[~scene.told, :2] = moved(cars[:, :2], axes, np.asarray(0.5 * _REALIGN_OFFSETS[offset], np.float64))
    aligned[~scene.told, 2] = np.mod(axes, np.pi)
    return replace(scene, cars=aligned)
