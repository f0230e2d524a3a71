"""Labels from motion on constructed scenes: cars with shadows, parked cars, one-off changes, roofs with parallax."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from schemas.detector import CnnConfig
from velfield.detection.motion.difference import (
    MotionFrame,
    absolute_difference,
    background_from_median,
)
from velfield.detection.motion.labels import MotionLabels, choose_frames, labels_from_motion, working_scale
from velfield.errors import InputError

INTERVAL_S = 0.2
LENGTH, WIDTH = 16.0, 7.0
SHADOW = np.array([5.0, 2.0])
SIZE = (420, 520)


@dataclass(frozen=True)
class Car:
    """A car of the scene: position at time 0, velocity in px/s (along its axis), grey."""

    x: float
    y: float
    vx: float
    vy: float
    grey: int

    def at(self, time_s: float) -> tuple[float, float]:
        return self.x + self.vx * time_s, self.y + self.vy * time_s

    @property
    def heading(self) -> float:
        return float(np.arctan2(self.vy, self.vx)) if (self.vx or self.vy) else 0.0


def traffic() -> list[Car]:
    """Two roads that do not cross: three lanes each way along x, two along a diagonal; bright and dark cars."""
    cars = []
    for lane in range(6):
        speed = (1 if lane < 3 else -1) * (70 + 12 * lane)
        for k in range(6):
            grey = (235, 30)[(k + lane) % 2]
            cars.append(Car(90.0 * k + 11 * lane, 40.0 + 22 * lane, speed, 0.0, grey))
    for lane in range(2):
        for k in range(6):
            cars.append(Car(70.0 * k, 230.0 + 35 * k + 30 * lane, 60.0, 30.0, (230, 35)[k % 2]))
    return cars


def box(image: NDArray[np.uint8], x: float, y: float, heading: float, grey: int) -> None:
    corners = cv2.boxPoints(((x, y), (LENGTH, WIDTH), float(np.degrees(heading))))
    cv2.fillConvexPoly(image, np.round(corners * 16).astype(np.int32), grey, cv2.LINE_AA, 4)


def ground(rng: np.random.Generator) -> NDArray[np.uint8]:
    rough = cv2.GaussianBlur(rng.normal(0, 60, SIZE), (0, 0), 3)
    return np.clip(130 + rough, 60, 200).astype(np.uint8)


def scene(cars: list[Car], *, frames: int = 12, seed: int = 0) -> list[MotionFrame]:
    """Frames of cars, each with its shadow, on a textured road; sensor noise of two grey levels."""
    rng = np.random.default_rng(seed)
    road = ground(rng)
    made = []
    for k in range(frames):
        image = road.copy()
        for car in cars:
            x, y = car.at(k * INTERVAL_S)
            for step in np.linspace(1, 0, 6):
                box(image, x + step * SHADOW[0], y + step * SHADOW[1], car.heading, 15)
            box(image, x, y, car.heading, car.grey)
        noisy = np.clip(image + rng.normal(0, 2, SIZE), 0, 255).astype(np.uint8)
        made.append(MotionFrame(noisy, np.ones(SIZE, np.bool_), k * INTERVAL_S))
    return made


def hits(labels: MotionLabels, cars: list[Car], radius: float = 4.0) -> tuple[float, float]:
    """Precision of the labels, and recall of the moving cars well inside the image."""
    right = total = found = there = 0
    for k, part in enumerate(labels.frames):
        if not part.labelled:
            continue
        truth = np.array([car.at(k * INTERVAL_S) for car in cars if car.vx or car.vy])
        inside = np.all((truth > 30) & (truth < np.array(SIZE[::-1]) - 30), axis=1)
        gap = np.hypot(*(part.cars[:, None, :2] - truth[None]).transpose(2, 0, 1))
        right, total = right + int((gap.min(axis=1) < radius).sum()), total + len(part.cars)
        found, there = found + int((gap.min(axis=0)[inside] < radius).sum()), there + int(inside.sum())
    return right / total, found / there


def test_moving_cars_are_labelled_without_their_shadows() -> None:
    cars = traffic()
    labels = labels_from_motion(scene(cars), car_length_px=LENGTH)
    precision, recall = hits(labels, cars)
    assert precision > 0.97
    assert recall > 0.8
    assert labels.usable
    assert not labels.warnings
    assert labels.precision_estimate > 0.9
    assert np.hypot(*(labels.shadow_px - SHADOW)) < 2.5


def test_orientation_size_and_heading_of_labels() -> None:
    cars = traffic()
    labels = labels_from_motion(scene(cars), car_length_px=LENGTH)
    table = np.concatenate([part.cars for part in labels.frames])
    heading = np.concatenate([part.heading_rad for part in labels.frames])
    known = np.array([0.0, np.arctan2(30, 60)])
    off = np.abs(np.mod(table[:, None, 2] - known + np.pi / 2, np.pi) - np.pi / 2).min(axis=1)
    assert np.median(off) < np.radians(2)
    assert np.all((table[:, 2] >= 0) & (table[:, 2] < np.pi))
    assert np.allclose(np.mod(heading, np.pi), table[:, 2])
    assert abs(np.median(table[:, 3]) - LENGTH) < 2.5
    assert abs(np.median(table[:, 4]) - WIDTH) < 2


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.8])
def test_the_length_of_a_car_is_estimated(scale: float) -> None:
    frames = [
        MotionFrame(
            np.asarray(cv2.resize(frame.image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8),
            np.ones(cv2.resize(frame.image, None, fx=scale, fy=scale).shape, np.bool_),
            frame.time_s,
        )
        for frame in scene(traffic())
    ]
    labels = labels_from_motion(frames)
    assert labels.usable
    assert labels.car_length_px == pytest.approx(LENGTH * scale, rel=0.15)
    assert working_scale(CnnConfig(), None, labels, labels_scale=scale) == pytest.approx(1.0, rel=0.15)


def test_a_stationary_car_is_neither_labelled_nor_ignored() -> None:
    stationary = [Car(100.0 + 60 * k, 210.0, 0.0, 0.0, 240) for k in range(5)]
    labels = labels_from_motion(scene(traffic() + stationary), car_length_px=LENGTH)
    positions = np.array([[car.x, car.y] for car in stationary])
    for part in labels.frames:
        for table in (part.cars, part.ignore):
            gap = np.hypot(*(table[:, None, :2] - positions[None]).transpose(2, 0, 1))
            assert np.all(gap > 6)


def test_what_appears_once_is_ignored_not_labelled() -> None:
    frames = scene(traffic())
    image = frames[5].image.copy()
    box(image, 300.0, 212.0, 0.3, 250)
    frames[5] = MotionFrame(image, frames[5].valid, frames[5].time_s)
    part = labels_from_motion(frames, car_length_px=LENGTH).frames[5]
    assert np.hypot(part.cars[:, 0] - 300, part.cars[:, 1] - 212).min() > 10
    assert np.hypot(part.ignore[:, 0] - 300, part.ignore[:, 1] - 212).min() < 6


def test_first_and_last_frame_have_no_neighbours_and_no_labels() -> None:
    labels = labels_from_motion(scene(traffic()), car_length_px=LENGTH)
    assert [part.labelled for part in labels.frames] == [False] + [True] * 10 + [False]
    assert len(labels.frames[0].cars) == 0
    assert len(labels.frames[0].ignore) > 10


def test_too_few_cars_are_a_warning_with_a_remedy() -> None:
    labels = labels_from_motion(scene(traffic()[:3]), car_length_px=LENGTH)
    assert not labels.usable
    assert "too few cars move" in labels.warnings[0]
    assert "--labels" in labels.warnings[0]


def test_a_static_scene_has_no_labels_and_no_estimated_length() -> None:
    labels = labels_from_motion(scene([]))
    assert labels.count == 0
    assert not labels.usable
    with pytest.raises(InputError, match="--gsd-m"):
        working_scale(CnnConfig(), None, labels)


def test_roofs_with_parallax_are_not_labelled_as_cars() -> None:
    """Every roof moves by the same vector, whatever its orientation."""
    rng = np.random.default_rng(3)
    road, frames = ground(rng), []
    roofs = [(rng.uniform(20, 500), rng.uniform(20, 400), rng.uniform(0, np.pi)) for _ in range(60)]
    for k in range(12):
        image = road.copy()
        for x, y, angle in roofs:
            box(image, x + 3.2 * (k - 6), y + 1.0 * (k - 6), angle, 225)
        frames.append(MotionFrame(image, np.ones(SIZE, np.bool_), k * INTERVAL_S))
    labels = labels_from_motion(frames, car_length_px=LENGTH)
    assert not labels.usable
    assert "parallax" in labels.warnings[0]
    assert "--labels" in labels.warnings[0]


def test_invalid_frames_are_input_errors() -> None:
    frames = scene(traffic(), frames=3)
    with pytest.raises(InputError, match="3 registered frames or more"):
        labels_from_motion(frames[:2])
    with pytest.raises(InputError, match="time order"):
        labels_from_motion([frames[0], frames[2], frames[1]])
    small = MotionFrame(frames[0].image[:50], frames[0].valid[:50], 9.0)
    with pytest.raises(InputError, match="of one shape"):
        labels_from_motion([*frames, small])


def test_a_frame_is_not_linked_over_a_gap_in_time() -> None:
    frames = scene(traffic())
    gapped = [MotionFrame(f.image, f.valid, f.time_s + (5.0 if k >= 6 else 0.0)) for k, f in enumerate(frames)]
    labelled = [part.labelled for part in labels_from_motion(gapped, car_length_px=LENGTH).frames]
    assert labelled == [False, True, True, True, True, False, False, True, True, True, True, False]


def test_long_flights_are_sampled_in_bursts_of_three() -> None:
    chosen = choose_frames(np.arange(1000) * 0.2)
    assert len(chosen) == 48
    assert chosen[0] == 0
    assert chosen[-1] == 999
    assert np.all(np.diff(chosen).reshape(-1)[0::3] == 1)
    assert np.array_equal(choose_frames(np.arange(36) * 0.2), np.arange(36))


def test_half_a_pixel_of_misregistration_is_no_foreground() -> None:
    rng = np.random.default_rng(2)
    sharp = np.where(rng.random((40, 40)) > 0.5, 200, 60).astype(np.uint8).repeat(8, 0).repeat(8, 1)
    smooth = cv2.GaussianBlur(sharp, (0, 0), 1.0)
    shifted = cv2.warpAffine(
        smooth, np.array([[1, 0, 0.5], [0, 1, 0.5]]), smooth.shape[::-1], borderMode=cv2.BORDER_REPLICATE
    )
    everywhere = np.ones(smooth.shape, np.bool_)
    plain = np.abs(shifted.astype(float) - smooth)
    assert plain.max() > 15
    assert absolute_difference(shifted, everywhere, background_from_median(smooth)).max() < 4


def registered_frames(path: Path, wanted: list[int]) -> list[MotionFrame]:
    """Frames of a nearly static video on the grid of the first, by one homography each."""
    with av.open(str(path)) as container:
        greys = {
            k: cv2.cvtColor(frame.to_ndarray(format="rgb24"), cv2.COLOR_RGB2GRAY)
            for k, frame in enumerate(container.decode(video=0))
            if k in wanted
        }
    sift, matcher = cv2.SIFT_create(2000), cv2.BFMatcher(crossCheck=True)
    found = {k: sift.detectAndCompute(cv2.pyrDown(grey), None) for k, grey in greys.items()}
    points = {k: 2.0 * cv2.KeyPoint_convert(keys) for k, (keys, _) in found.items()}
    frames, reference = [], found[wanted[0]][1]
    for k in sorted(wanted):
        pairs = [(m.queryIdx, m.trainIdx) for m in matcher.match(found[k][1], reference)]
        here, there = (np.array([points[n][pair[side]] for pair in pairs]) for side, n in ((0, k), (1, wanted[0])))
        near = np.hypot(*(here - there).T) < 8
        matrix, _ = cv2.findHomography(here[near], there[near], cv2.USAC_MAGSAC, 1.0)
        size = greys[k].shape[::-1]
        image = cv2.warpPerspective(greys[k], matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        valid = cv2.warpPerspective(np.full(size[::-1], 255, np.uint8), matrix, size) == 255
        frames.append(MotionFrame(image, valid, k / 25))
    return frames


@pytest.mark.footage
@pytest.mark.slow
def test_labels_on_real_video_agree_with_manual_ones(footage: Callable[[str], Path]) -> None:
    """Frame 90 of kharkiv, against manual labels: labels are cars, and most moving cars are labelled."""
    marks = pd.read_csv(Path(__file__).parents[1] / "data" / "kharkiv_marks.csv")
    wanted = [90, 85, 95, 0, 30, 60, 120, 150, 175]
    frames = registered_frames(footage("kharkiv") / "drone.mp4", wanted)
    labels = labels_from_motion(frames, car_length_px=10.0)
    cars = labels.frames[sorted(wanted).index(90)].cars
    positions = marks[["x_px", "y_px"]].to_numpy(float)
    gap = np.hypot(*(cars[:, None, :2] - positions[None]).transpose(2, 0, 1))
    known = (marks["kind"] != "unclear").to_numpy()
    on_car = gap[:, known].min(axis=1) <= 5
    on_unclear = (gap[:, ~known] <= marks["radius_px"].to_numpy()[~known]).any(axis=1)
    moving = (marks["kind"] == "moving").to_numpy()
    assert on_car.sum() / (on_car | ~on_unclear).sum() > 0.85
    assert (gap[:, moving].min(axis=0) <= 5).mean() > 0.5
