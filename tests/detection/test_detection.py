"""Detectors trained on one simulated city and run on another; continuing an earlier detector."""

from functools import cache

import numpy as np
import pytest

from schemas.detector import CnnConfig, PaperConfig
from velfield.detection.detect import FrameDetections, detect_frame
from velfield.detection.interface import Detector
from velfield.detection.orientation import axial_difference
from velfield.detection.registry import shipped_detector, train_detector
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError
from velfield.pipeline.stages.labels import rescale
from velfield.synthetic.cases import small_flight
from velfield.synthetic.flight import Flight

SCALE = 0.92  # 16 px a car at 0.23 m a pixel
PAPER = PaperConfig(rounds=120, feature_pool=800)
MATCH_PX = 8.0


@cache
def flight(seed: int) -> Flight:
    return small_flight(frames=3, width=640, height=480, seed=seed)


def sample(of: Flight, frame: int) -> LabelledImage:
    labels = of.labels(frame)[["x_px", "y_px", "orientation_rad", "length_px", "width_px"]].to_numpy(copy=True)
    labels[:, :2] = (labels[:, :2] + 0.5) * SCALE - 0.5
    labels[:, 3:] *= SCALE
    return LabelledImage(image=rescale(of.frame(frame), SCALE), cars=labels)


@cache
def detector(method: str) -> Detector:
    return shipped_detector() if method == "cnn" else train_detector([sample(flight(5), 0)], PAPER)


def detect(of: Flight, frame: int, method: str) -> tuple[FrameDetections, LabelledImage]:
    truth = sample(of, frame)
    return detect_frame(truth.image, None, detector(method)), truth


def matches(found: FrameDetections, truth: LabelledImage) -> list[tuple[int, int]]:
    """Pairs (detection, car), the best detections first, each car once."""
    pairs, taken = [], set()
    for k in np.argsort(-found.score):
        gap = np.hypot(*(truth.cars[:, :2] - found.xy[k]).T)
        gap[list(taken)] = np.inf
        if gap.min(initial=np.inf) < MATCH_PX:
            taken.add(int(gap.argmin()))
            pairs.append((int(k), int(gap.argmin())))
    return pairs


def test_the_network_on_a_city_that_it_was_not_trained_on() -> None:
    found, truth = detect(flight(6), 1, "cnn")
    pairs = matches(found, truth)
    assert len(pairs) / len(found.xy) > 0.85
    assert len(pairs) / len(truth.cars) > 0.7


def test_orientations_of_the_network() -> None:
    found, truth = detect(flight(6), 1, "cnn")
    k, car = np.array(matches(found, truth)).T
    off = np.degrees(axial_difference(np.asarray(found.orientation_rad[k], np.float64), truth.cars[car, 2]))
    assert np.median(off) < 5
    assert np.mean(off < 30) > 0.93
    assert np.all((found.orientation_rad >= 0) & (found.orientation_rad < np.pi))
    assert np.all(found.orientation_sd_rad > 0)


def test_detections_of_a_frame_go_from_top_to_bottom_with_their_crops() -> None:
    found, _ = detect(flight(6), 1, "cnn")
    n = len(found)
    assert np.all(np.diff(found.xy[:, 1]) >= 0)
    assert found.chips.shape == (n, 32, 32)
    assert found.chips.dtype == np.uint8


def test_the_papers_detector_where_it_was_trained() -> None:
    found, truth = detect(flight(5), 0, "paper")
    assert len(matches(found, truth)) / len(truth.cars) > 0.4


@pytest.mark.parametrize("method", ["cnn", "paper"])
def test_a_higher_threshold_detects_fewer(method: str) -> None:
    truth, normal = sample(flight(6), 1), detector(method)
    strict = normal.detect(truth.image, threshold=normal.threshold + 0.3)
    assert len(strict) < len(normal.detect(truth.image))
    assert strict.score.min() > normal.threshold + 0.3


@pytest.mark.parametrize("method", ["cnn", "paper"])
def test_nothing_is_detected_where_the_frame_does_not_reach(method: str) -> None:
    truth = sample(flight(6), 1)
    valid = np.zeros(truth.image.shape, bool)
    valid[:, : truth.image.shape[1] // 2] = True
    found = detect_frame(truth.image, valid, detector(method))
    assert len(found.xy) > 0
    assert found.xy[:, 0].max() < truth.image.shape[1] // 2 + 4


@pytest.mark.parametrize("method", ["cnn", "paper"])
def test_an_empty_road_has_no_cars(method: str) -> None:
    found = detect_frame(np.full((96, 128), 120, np.uint8), None, detector(method))
    assert len(found) == 0
    assert found.chips.shape == (0, 32, 32)
    assert found.chips.shape == (0, 32, 32)


def test_a_detector_that_does_not_fit_is_not_continued() -> None:
    with pytest.raises(InputError, match="found a detector of method paper to continue"):
        train_detector([sample(flight(5), 0)], CnnConfig(), base=detector("paper"))
    with pytest.raises(InputError, match="cars of 16 px to continue, expected 20 px"):
        train_detector([sample(flight(5), 0)], CnnConfig(working_car_length_px=20.0))


def test_the_shipped_detector_names_its_data() -> None:
    shipped = shipped_detector()
    assert any("CC-BY 4.0" in line for line in shipped.record.attribution)
    assert any("CC-BY 3.0" in line for line in shipped.record.attribution)
