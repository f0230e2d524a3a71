"""Detections from the network: decoding of heatmaps, rotation and shift of the image, truncation."""

from functools import cache

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage
from velfield.bench.scenes import simulated_image
from velfield.detection.cnn.inference import Predictor
from velfield.detection.cnn.model import (
    SMOOTHING_SIGMA,
    detect_cars,
    find_peaks,
)
from velfield.detection.nms import nms_oriented
from velfield.detection.orientation import axial_difference
from velfield.detection.registry import shipped_detector

WINDOWS = (64, 48), (32, 32)
"""First row and column of two crops."""


def network() -> Predictor:
    shipped = shipped_detector()
    return shipped.predictor


@cache
def scene() -> GreyImage:
    return simulated_image(9503).image[120:264, 120:264].copy()


@cache
def scene_detections() -> FloatArray:
    return detect_cars(network(), scene(), None)


def likely(found: FloatArray) -> FloatArray:
    """Likely cars, each once."""
    found = nms_oriented(found, 16.0)
    return found[found[:, 3] > 0.1]


def nearest(found: FloatArray, expected: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance from each expected car to the nearest detection, px, and the difference of their orientations, rad."""
    gap = np.hypot(*(expected[:, None, :2] - found[None, :, :2]).transpose(2, 0, 1))
    return gap.min(axis=1), axial_difference(found[gap.argmin(axis=1), 2], expected[:, 2])


def test_detections_shift_with_the_image() -> None:
    """Of two crops, where both see as far as the network does."""
    image = simulated_image(9503).image
    there, here = (likely(detect_cars(network(), image[y : y + 304, x : x + 304].copy(), None)) for y, x in WINDOWS)
    inner = there[((there[:, :2] > 112) & (there[:, :2] < 208)).all(axis=1)]
    assert len(inner) >= 2
    distance, difference = nearest(here, inner[:, :5] + np.array([16, 32, 0, 0, 0]))
    assert distance.max() < 0.1
    assert difference.max() < 0.02


def test_detections_rotate_with_the_image() -> None:
    rotated = likely(detect_cars(network(), np.ascontiguousarray(np.rot90(scene(), -1)), None))
    expected = likely(scene_detections())
    assert len(expected) >= 4
    # a quarter turn clockwise: (x, y) -> (h - 1 - y, x)
    expected = np.column_stack([len(scene()) - 1 - expected[:, 1], expected[:, 0], expected[:, 2] + np.pi / 2])
    distance, difference = nearest(rotated, expected)
    assert np.median(distance) < 1.0
    assert np.median(difference) < np.radians(3)
    assert (distance < 4).mean() > 0.85


def test_a_car_truncated_by_the_frame_is_not_detected() -> None:
    """Two cars on a road: one whole, which is detected, one cut in half by the border."""
    image = np.full((96, 160), 90, np.uint8)
    image[:] += np.random.default_rng(0).integers(0, 12, image.shape).astype(np.uint8)
    for x in (0, 80):
        image[44:52, max(x - 8, 0) : x + 8] = 225
        image[46:50, max(x - 3, 0) : x + 3] = 60
    detections = detect_cars(network(), image, None)
    cars = detections[detections[:, 3] > 0]
    assert (np.hypot(cars[:, 0] - 79.5, cars[:, 1] - 47.5) < 4).any()
    assert not (cars[:, 0] < 3).any()


def test_peaks_are_those_of_the_plain_form() -> None:
    rng = np.random.default_rng(2)
    probability = cv2.GaussianBlur(rng.random((60, 80), np.float32), (0, 0), 1.5) * 1.4
    orientation = rng.normal(size=(2, 60, 80)).astype(np.float32)
    valid = rng.random((120, 160)) < 0.8
    found = find_peaks(probability, orientation, valid, stride=2, min_probability=0.5)
    smooth = cv2.GaussianBlur(probability, (0, 0), SMOOTHING_SIGMA)
    peak = (smooth >= cv2.dilate(smooth, np.ones((3, 3), np.uint8))) & (smooth > 0.5) & valid[::2, ::2]
    y, x = np.nonzero(peak)
    assert len(found) == len(x) > 20
    np.testing.assert_array_equal(found[:, 4], smooth[y, x])
    np.testing.assert_array_equal(found[:, 2:4], orientation[:, y, x].T)
    assert np.abs(found[:, :2] - (2 * np.column_stack([x, y]) + 0.5)).max() <= 1
    inner = (x > 0) & (x < 79) & (y > 0) & (y < 59)
    log = np.log(smooth.astype(np.float64))
    y, x = y[inner], x[inner]
    offset = (log[y, x + 1] - log[y, x - 1]) / (2 * (2 * log[y, x] - log[y, x - 1] - log[y, x + 1]))
    np.testing.assert_allclose(found[inner, 0], 2 * (x + np.clip(offset, -0.5, 0.5)) + 0.5, atol=1e-4)


def test_the_number_of_threads_changes_nothing_that_matters() -> None:
    """A session has one thread, so that the order of its sums never changes; with more, scores differ by rounding."""
    import onnxruntime as ort

    from velfield.detection.cnn.graph import network_to_onnx
    from velfield.detection.runtime import open_session

    model = network_to_onnx(shipped_detector().network)
    session = open_session(model, "cpu")
    assert session.get_session_options().intra_op_num_threads == 1
    image = np.random.default_rng(3).integers(0, 255, (1, 1, 64, 96), dtype=np.uint8)
    (expected,) = session.run(["probability"], {"image": image})
    for threads in (2, 8):
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        other = ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        np.testing.assert_allclose(other.run(["probability"], {"image": image})[0], expected, atol=1e-6)
