"""Cars found: on a simulated city that was not trained on, and the rules of the detector file."""

import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.detector import CascadeConfig, CascadeTraining, CnnConfig, PaperConfig
from velfield.bench.detection import row_response
from velfield.detection.boosting import BoostedSums
from velfield.detection.cascade.classifier import distinct
from velfield.detection.crops import oriented_patches, upright_chips
from velfield.detection.detect import FrameDetections, detect_frame
from velfield.detection.detector import Detector, train_detector
from velfield.detection.files import load_detector, shipped_detector
from velfield.detection.orientation import axial_difference, structure_axis, with_axes
from velfield.detection.paper.response import dense_response
from velfield.detection.paper.segmentation import moments, segment_response
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError
from velfield.pipeline.stages.labels import scaled
from velfield.synthetic import Flight, small_flight

SCALE = 0.92  # 16 px a car at 0.23 m a pixel
SMALL = CascadeConfig(rounds=120, feature_pool=800, folds=2)
PAPER = PaperConfig(rounds=120, feature_pool=800)
MATCH_PX = 8.0


@cache
def flight(seed: int) -> Flight:
    return small_flight(frames=3, width=640, height=480, seed=seed)


def sample(of: Flight, frame: int) -> LabelledImage:
    labels = of.labels(frame)[["x_px", "y_px", "orientation_rad", "length_px", "width_px"]].to_numpy(copy=True)
    labels[:, :2] = (labels[:, :2] + 0.5) * SCALE - 0.5
    labels[:, 3:] *= SCALE
    return LabelledImage(image=scaled(of.frame(frame), SCALE), cars=labels)


@cache
def detector(method: str) -> Detector:
    return train_detector([sample(flight(5), 0)], {"cascade": SMALL, "paper": PAPER}[method])


def found_in(of: Flight, frame: int, method: str) -> tuple[FrameDetections, LabelledImage]:
    truth = sample(of, frame)
    return detect_frame(truth.image, None, detector(method)), truth


def matches(found: FrameDetections, truth: LabelledImage) -> list[tuple[int, int]]:
    """Pairs (find, car), the best finds first, each car once."""
    pairs, taken = [], set()
    for k in np.argsort(-found.score):
        gap = np.hypot(*(truth.cars[:, :2] - found.xy[k]).T)
        gap[list(taken)] = np.inf
        if gap.min(initial=np.inf) < MATCH_PX:
            taken.add(int(gap.argmin()))
            pairs.append((int(k), int(gap.argmin())))
    return pairs


def test_cars_of_a_city_that_was_not_trained_on() -> None:
    found, truth = found_in(flight(6), 1, "cascade")
    pairs = matches(found, truth)
    assert len(pairs) / len(found.xy) > 0.85
    assert len(pairs) / len(truth.cars) > 0.7


def test_the_axis_of_what_is_found() -> None:
    found, truth = found_in(flight(6), 1, "cascade")
    k, car = np.array(matches(found, truth)).T
    off = np.degrees(axial_difference(np.asarray(found.orientation_rad[k], np.float64), truth.cars[car, 2]))
    assert np.median(off) < 5
    assert np.mean(off < 30) > 0.93
    assert np.all((found.orientation_rad >= 0) & (found.orientation_rad < np.pi))


def test_pictures_go_with_each_find() -> None:
    found, _ = found_in(flight(6), 1, "cascade")
    n = len(found.xy)
    assert found.patches.shape == (n, 16, 8)
    assert found.chips.shape == (n, 32, 32)
    assert found.patches.dtype == found.chips.dtype == np.uint8


def test_training_twice_is_one_detector() -> None:
    quick = SMALL.model_copy(update={"rounds": 40, "feature_pool": 250})
    once, again = (train_detector([sample(flight(5), 0)], quick) for _ in range(2))
    assert again.record == once.record


def test_the_papers_recipe_finds_cars_where_it_was_trained() -> None:
    found, truth = found_in(flight(5), 0, "paper")
    assert len(matches(found, truth)) / len(truth.cars) > 0.4


def test_the_papers_recipe_finds_as_much_by_the_response_at_every_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sampled at every second pixel, the blurred response is the same to a fortieth, a region's place to half a px."""
    ours, truth = found_in(flight(5), 0, "paper")
    sums, sigma = detector("paper").sums, PAPER.response_sigma_px
    blurred = [cv2.GaussianBlur(how(truth.image, sums), (0, 0), sigma) for how in (row_response, dense_response)]
    assert np.std(blurred[0] - blurred[1]) < 0.03 * np.std(blurred[0])

    def at_every_pixel(image: np.ndarray, sums: BoostedSums, *, grey_bits: int) -> np.ndarray:
        return row_response(image, sums, grey_bits)

    monkeypatch.setattr("velfield.detection.paper.detector.dense_response", at_every_pixel)
    plain = detect_frame(truth.image, None, detector("paper"))
    gap = np.hypot(*(ours.xy[:, None] - plain.xy[None]).transpose(2, 0, 1))
    for nearest in (gap.min(axis=0), gap.min(axis=1)):
        assert np.median(nearest) < 0.6
        assert np.mean(nearest < 2.0) > 0.88
    assert abs(len(matches(ours, truth)) - len(matches(plain, truth))) <= 0.05 * len(truth.cars)


def test_a_higher_threshold_finds_fewer() -> None:
    truth = sample(flight(6), 1)
    fewer = detect_frame(truth.image, None, detector("cascade"), threshold=detector("cascade").threshold + 0.3)
    assert len(fewer.xy) < len(found_in(flight(6), 1, "cascade")[0].xy)


def test_nothing_is_found_where_the_frame_does_not_reach() -> None:
    truth = sample(flight(6), 1)
    valid = np.zeros(truth.image.shape, bool)
    valid[:, : truth.image.shape[1] // 2] = True
    found = detect_frame(truth.image, valid, detector("cascade"))
    assert len(found.xy) > 0
    assert found.xy[:, 0].max() < truth.image.shape[1] // 2 + 4


def test_too_few_cars_to_learn_from() -> None:
    truth = sample(flight(5), 0)
    with pytest.raises(InputError, match="3 labelled cars, 8 needed"):
        train_detector([LabelledImage(image=truth.image, cars=truth.cars[:3])], SMALL)


def test_a_detector_comes_back_from_its_file(tmp_path: Path) -> None:
    detector("cascade").save(tmp_path / "d.json")
    assert load_detector(tmp_path / "d.json").record == detector("cascade").record


@pytest.mark.parametrize("damage", ["not json", "another file", "no rounds", "a rectangle without area"])
def test_a_detector_file_that_is_not_ours_is_one_clear_line(tmp_path: Path, damage: str) -> None:
    record = json.loads(detector("cascade").record.model_dump_json())
    if damage == "no rounds":
        record["rounds"] = []
    if damage == "a rectangle without area":
        rectangle = record["rounds"][0]["rectangles"][0]
        rectangle["x1"] = rectangle["x0"]
    text = {"not json": "{", "another file": '{"kind": "other"}'}.get(damage, json.dumps(record))
    (tmp_path / "d.json").write_text(text)
    with pytest.raises(InputError) as caught:
        load_detector(tmp_path / "d.json")
    assert "expected a detector file" in str(caught.value)
    assert "\n" not in str(caught.value)


def bar(angle: float, side: int = 64) -> np.ndarray:
    """A bright bar through the middle, blurred at its edges."""
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    inside = 1 / (1 + np.exp(2 * (np.abs(u) - 8))) / (1 + np.exp(2 * (np.abs(v) - 4)))
    return (60 + 150 * inside).astype(np.uint8)


@pytest.mark.parametrize("degrees", [0.0, 20.0, 45.0, 90.0, 130.0])
@pytest.mark.parametrize("boxed", [False, True])
def test_a_windscreen_does_not_turn_the_axis_of_a_marked_car(degrees: float, *, boxed: bool) -> None:
    """What lies across a car is sharper than its sides, and there is as much of it."""
    image, angle = np.full((64, 64), 100, np.uint8), np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)
    for along, length, width, grey in ((0.0, 16, 7, 170), (-3.5, 2.0, 5.5, 60), (3.5, 2.0, 5.5, 60)):
        corners = cv2.boxPoints(((32 + along * c, 32 + along * s), (length, width), degrees))
        cv2.fillConvexPoly(image, np.rint(corners * 16).astype(np.int32), (grey,), cv2.LINE_AA, 4)
    car = np.array([[32.0, 32.0, np.nan, np.nan, np.nan]])
    tilts = np.array([np.arcsin(abs(s))]) if boxed else None
    found = with_axes(cv2.GaussianBlur(image, (0, 0), 0.8), car, tilts)[0, 2]
    assert np.degrees(axial_difference(found, angle)) < (4 if boxed else 8)


@pytest.mark.parametrize("angle", np.linspace(0, np.pi, 7, endpoint=False))
def test_the_structure_tensor_gives_the_axis_of_a_bar(angle: float) -> None:
    axis, _ = structure_axis(bar(angle))
    assert axial_difference(np.array([float(axis[32, 32])]), np.array([angle]))[0] < np.radians(6)


@pytest.mark.parametrize("angle", [0.3, 1.2, 2.5])
def test_oriented_patches_turn_every_bar_alike(angle: float) -> None:
    upright = oriented_patches(bar(0.0), np.array([[31.5, 31.5]]), np.array([0.0]))[0].astype(int)
    turned = oriented_patches(bar(angle), np.array([[31.5, 31.5]]), np.array([angle]))[0].astype(int)
    assert np.abs(upright - turned).mean() < 4


def test_chips_are_cut_about_the_rounded_place() -> None:
    image = np.arange(64 * 64, dtype=np.uint32).reshape(64, 64).astype(np.uint8)
    chip = upright_chips(image, np.array([[30.4, 20.6]]))[0]
    assert chip[16, 16] == image[21, 30]


def test_regions_grow_from_maxima_and_have_the_axis_of_their_covariance() -> None:
    response = np.full((80, 120), -1.0, np.float32)
    response[20:28, 10:40] = 2.0
    response[50:74, 80:88] = 2.0
    response[5:7, 100:102] = 2.0
    smooth, labels = segment_response(response, sigma_px=1.0, threshold=0.0, min_region_px=10)
    found = moments(labels, smooth)
    assert len(found) == 2
    np.testing.assert_allclose(found[:, :2], [[24.5, 23.5], [83.5, 61.5]], atol=0.5)
    assert axial_difference(found[:, 2], np.array([0.0, np.pi / 2])).max() < 0.05


def test_the_gap_between_two_cars_of_a_queue_is_no_third_one() -> None:
    queue = np.array([[20.0, 40.0, 0.0, 0.9, 0.1], [38.0, 40.0, 0.0, 0.8, 0.1], [29.0, 40.5, 0.0, 0.7, 0.1]])
    beside = np.array([[20.0, 49.0, 0.0, 0.5, 0.1], [56.0, 40.0, 0.1, 0.4, 0.1]])
    kept = distinct(np.concatenate([queue, beside]), 16.0)
    assert kept[:, 3].tolist() == [0.9, 0.8, 0.5, 0.4]


def test_of_two_finds_on_one_car_the_better_stays() -> None:
    cars = np.array([[20.0, 40.0, 0.0, 0.3, 0.1], [23.0, 41.0, 0.2, 0.8, 0.1]])
    assert distinct(cars, 16.0)[:, 3].tolist() == [0.8]
    assert distinct(np.empty((0, 5)), 16.0).shape == (0, 5)


def test_few_cars_continue_an_earlier_detector() -> None:
    truth = sample(flight(5), 0)
    few = LabelledImage(image=truth.image, cars=truth.cars[:12], complete=False)
    earlier = detector("cascade")
    continued = train_detector([few], SMALL, base=earlier)
    assert 0.9 * SMALL.rounds < len(continued.record.rounds) - len(earlier.record.rounds) <= SMALL.rounds
    assert continued.record.attribution == earlier.record.attribution
    assert continued.threshold == pytest.approx((0.15 + 4 * earlier.threshold) / 5)
    assert f_measure(continued, sample(flight(6), 1)) > 0.7


def test_marked_cars_teach_the_network_where_it_knows_their_size() -> None:
    config = CnnConfig(fine_tune_steps=3)
    truth = sample(flight(5), 0)
    few = LabelledImage(image=truth.image, cars=truth.cars[:12], complete=False)
    assert train_detector([few], config).record.method == "cnn"
    cascade = CascadeTraining(rounds=40, feature_pool=250)
    other = CnnConfig(working_car_length_px=20.0, cascade=cascade)
    assert train_detector([few], other).record.method == "cascade"


def f_measure(of: Detector, truth: LabelledImage) -> float:
    found = detect_frame(truth.image, None, of)
    return 2 * len(matches(found, truth)) / max(len(found.xy) + len(truth.cars), 1)


def test_a_detector_of_another_kind_is_not_continued() -> None:
    with pytest.raises(InputError, match="detector of method paper to continue"):
        train_detector([sample(flight(5), 0)], SMALL, base=detector("paper"))
    other = SMALL.model_copy(update={"working_car_length_px": 20.0})
    with pytest.raises(InputError, match="cars of 16 px to continue, expected 20 px"):
        train_detector([sample(flight(5), 0)], other, base=detector("cascade"))


def test_the_shipped_detector_names_whose_pictures_it_learnt_from_and_finds_cars_of_unseen_cities() -> None:
    shipped = shipped_detector()
    assert any("CC-BY 4.0" in line for line in shipped.record.attribution)
    assert any("CC-BY 3.0" in line for line in shipped.record.attribution)
    assert f_measure(shipped, sample(flight(6), 1)) > 0.75
    assert f_measure(shipped, sample(flight(5), 0)) > 0.75
