"""The network in use: its file, fine-tuning and the score threshold, images of any size."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from schemas.detector import CnnConfig
from velfield.bench.scenes import simulated_image
from velfield.detection.cnn.detector import CnnDetector
from velfield.detection.cnn.fine_tuning import fine_tune
from velfield.detection.cnn.graph import network_from_record, network_to_record
from velfield.detection.cnn.inference import Predictor, predict_heatmap
from velfield.detection.cnn.model import detect_cars
from velfield.detection.cnn.network import Network
from velfield.detection.cnn.trainer import Trainer
from velfield.detection.detect import detect_frame, with_sizes
from velfield.detection.registry import shipped_detector
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError


@cache
def city(seed: int) -> LabelledImage:
    return simulated_image(seed)


def shipped() -> Network:
    return shipped_detector().network


@pytest.mark.parametrize("shape", [(61, 83), (4, 4), (30, 500)])
def test_images_of_any_size_are_processed(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
    assert predict_heatmap(Predictor(shipped()), image)[0].shape == (-(-shape[0] // 2), -(-shape[1] // 2))
    assert detect_cars(Predictor(shipped()), image, None).shape[1] == 9


def test_fine_tuning_is_deterministic_and_keeps_the_attribution() -> None:
    few = replace(city(9504), cars=city(9504).cars[:12], complete=False)
    config = CnnConfig(fine_tune_steps=5)
    record = shipped_detector().record
    one, again = (fine_tune([few], shipped(), record, config) for _ in range(2))
    assert one == again
    assert one.attribution == record.attribution
    assert one.threshold == record.threshold  # too few cars to hold some out
    assert one.onnx != record.onnx


def test_a_fine_tuned_network_measures_as_the_one_that_it_began_with() -> None:
    labelled, other = city(9504), simulated_image(9506, large_share=0.3).image
    record = fine_tune([labelled], shipped(), shipped_detector().record, CnnConfig(fine_tune_steps=40))
    before, after = (detect_cars(Predictor(one), other, None) for one in (shipped(), network_from_record(record.onnx)))
    distance = np.hypot(*(before[:, None, :2] - after[None, :, :2]).transpose(2, 0, 1))
    same = distance.min(axis=1) < 3
    change = np.log(after[distance.argmin(axis=1)[same], 5:7] / before[same, 5:7])
    assert same.sum() > 40
    assert np.abs(np.median(change, axis=0)).max() < 0.06
    long = before[same, 5] > 24
    assert long.sum() > 3
    assert np.abs(np.median(change[long, 0])) < 0.12


def test_labels_that_do_not_lie_on_cars_are_refused() -> None:
    """Those of another picture would train a detector that finds nothing."""
    labelled, other = city(9504), city(9505)
    config, record = CnnConfig(fine_tune_steps=2), shipped_detector().record
    with pytest.raises(InputError, match="labels do not lie on the cars of these pictures"):
        fine_tune([replace(labelled, cars=other.cars)], shipped(), record, config)


def test_the_threshold_of_few_cars_is_shrunk_towards_the_pretrained_one() -> None:
    labelled = city(9504)
    config, record = CnnConfig(fine_tune_steps=2), shipped_detector().record
    own = fine_tune([labelled], shipped(), record, config)
    strict = record.model_copy(update={"threshold": record.threshold + 0.1})
    shrunk = fine_tune([labelled], shipped(), strict, config)
    weight = len(labelled.cars) / (len(labelled.cars) + 150)
    assert shrunk.threshold - own.threshold == pytest.approx(0.1 * (1 - weight))
    assert own.curve.threshold[own.curve.operating_point] == pytest.approx(
        own.threshold, abs=0.05
    )  # of few cars it has few points


def test_lengths_and_widths_are_those_of_the_vehicles() -> None:
    scene = city(9504)
    found = shipped_detector().detect(scene.image)
    distance = np.hypot(*(found.xy[:, None] - scene.cars[None, :, :2]).transpose(2, 0, 1))
    seen = np.flatnonzero(distance.min(axis=0) < 4)
    assert len(seen) > 20
    error = np.log(found.sizes[distance.argmin(axis=0)[seen], :2] / scene.cars[seen, 3:5])
    assert (np.abs(np.median(error, axis=0)) < 0.1).all()
    assert (np.median(np.abs(error), axis=0) < 0.12).all()
    sd = found.sizes[distance.argmin(axis=0)[seen], 2:]
    assert 0.6 < np.mean(np.abs(error) < 1.645 * sd) <= 1


def test_a_vehicle_that_something_else_found_is_measured_as_if_the_network_had() -> None:
    image = city(9504).image
    found = shipped_detector().detect(image)
    inner = ((found.xy > 48) & (found.xy < np.array(image.shape[::-1]) - 48)).all(axis=1)
    unknown = replace(found, sizes=np.full((len(found), 4), np.nan))
    measured = with_sizes(image, unknown)
    assert inner.sum() > 10
    assert np.quantile(np.abs(np.log(measured.sizes / found.sizes))[inner, :2], 0.9) < 0.05
    assert with_sizes(image, found) is found
    assert len(with_sizes(image, unknown.take(np.empty(0, np.int64)))) == 0


def test_a_network_without_a_layer_of_sizes_detects_the_same_and_the_one_that_ships_measures() -> None:
    """As velfield 1 wrote its files, and as fine-tuning leaves the network."""
    network = network_from_record(network_to_record(Trainer.from_network(shipped()).network()))
    assert shipped().measures
    assert not network.measures
    image = city(9504).image
    wanted, found = (detect_cars(Predictor(one), image, None) for one in (shipped(), network))
    np.testing.assert_array_equal(found[:, :5], wanted[:, :5])
    assert np.isnan(found[:, 5:]).all()
    record = shipped_detector().record.model_copy(update={"onnx": network_to_record(network)})
    assert np.isfinite(detect_frame(image, None, CnnDetector(record)).sizes).all()
