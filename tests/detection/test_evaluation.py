"""Evaluation on held-out cars: matching and curves against naive loops, spatial folds, thresholds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from velfield.detection.evaluation import (
    MATCH_PX,
    HeldOutScores,
    f_measure_plateau,
    held_out_half,
    match_greedy,
    merge_scores,
    precision_recall_curve,
    to_curve_record,
)
from velfield.detection.review import FALSE_POSITIVES, MISSED, TRUE_POSITIVES, contact_sheet
from velfield.detection.samples import LabelledImage, in_region, restrict_to_region

SEEDS = st.integers(0, 2**32 - 1)


def held_out(seed: int, detections: int = 60, cars: int = 40, complete: bool = True) -> HeldOutScores:
    """Detections of which the better ones are more often correct, some of equal score."""
    rng = np.random.default_rng(seed)
    score = np.round(rng.uniform(-0.2, 1, detections), 2)
    correct = rng.random(detections) < np.clip(score, 0.05, 0.95)
    correct[np.flatnonzero(correct)[cars:]] = False
    return HeldOutScores(score, correct, cars, complete)


@given(SEEDS, st.integers(0, 25), st.integers(0, 25))
@settings(max_examples=60)
def test_greedy_matching_is_the_naive_loop(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    detections, cars = rng.uniform(0, 60, (n, 4)), rng.uniform(0, 60, (m, 3))
    free, expected = set(range(m)), []
    for row in detections:
        near = {c: float(np.hypot(*(cars[c, :2] - row[:2]))) for c in free}
        nearest = min(near, key=near.__getitem__, default=None)
        hit = nearest is not None and near[nearest] < MATCH_PX
        expected.append(hit)
        if hit:
            free.remove(nearest)
    correct = match_greedy(detections, cars)
    assert correct.tolist() == expected
    assert correct.sum() <= min(n, m)


@given(SEEDS)
@settings(max_examples=30)
def test_precision_and_recall_are_those_of_a_naive_loop(seed: int) -> None:
    scores = held_out(seed)
    curve = precision_recall_curve(scores, "cars of a test")
    if curve is None:
        assert not scores.correct.any()
        return
    assert curve.description == "40 cars of a test"
    order = np.argsort(-scores.score, kind="stable")
    assert len(curve.threshold) == len(order)  # few points: none left out
    for k in range(len(order)):
        true_positives = sum(bool(scores.correct[i]) for i in order[: k + 1])
        assert curve.precision[k] == pytest.approx(true_positives / (k + 1), abs=1e-4)
        assert curve.recall[k] == pytest.approx(true_positives / 40, abs=1e-4)
        assert curve.threshold[k] == pytest.approx(scores.score[order[k]], abs=1e-4)


def test_the_operating_point_is_on_the_plateau_of_the_f_measure() -> None:
    curve = precision_recall_curve(held_out(3, detections=300, cars=200), "cars")
    assert curve.operating_point is not None
    precision, recall = np.array(curve.precision), np.array(curve.recall)
    f = 1.64 * precision * recall / (0.64 * precision + recall)
    assert f[curve.operating_point] > 0.98 * f.max()


def test_with_incomplete_labels_the_operating_point_follows_from_recall_alone() -> None:
    """Precision is unknown: what is not labelled may be a car."""
    complete, incomplete = (precision_recall_curve(held_out(3, 300, 200, kind), "cars") for kind in (True, False))
    recall = incomplete.recall[incomplete.operating_point or 0]
    assert 0.95 * incomplete.recall[-1] <= recall < 0.97 * incomplete.recall[-1]
    assert recall > complete.recall[complete.operating_point or 0]


def test_without_a_correct_detection_there_is_no_curve() -> None:
    assert precision_recall_curve(HeldOutScores(np.ones(3), np.zeros(3, bool), 5, True), "cars") is None
    assert precision_recall_curve(HeldOutScores(np.empty(0), np.empty(0, bool), 5, True), "cars") is None


@pytest.mark.parametrize("points", [1, 2, 399, 400, 5000])
def test_a_curve_is_thinned_but_keeps_its_operating_point_and_ends(points: int) -> None:
    threshold = np.linspace(0.9, -0.1, points)
    at = points // 3
    curve = to_curve_record(threshold, 1 - threshold, threshold, at, "cars")
    assert len(curve.threshold) <= min(points, 401)
    assert curve.threshold[curve.operating_point or 0] == pytest.approx(threshold[at], abs=1e-4)
    assert curve.threshold[0] == pytest.approx(threshold[0], abs=1e-4)
    assert curve.threshold[-1] == pytest.approx(threshold[-1], abs=1e-4)


@pytest.mark.parametrize("beta", [0.5, 1.0, 2.0])
def test_the_plateau_is_all_that_is_nearly_as_good_as_the_best(beta: float) -> None:
    rng = np.random.default_rng(1)
    precision, recall = np.sort(rng.random(50))[::-1], np.sort(rng.random(50))
    f = (1 + beta**2) / (1 / precision + beta**2 / recall)  # the weighted harmonic mean
    assert f_measure_plateau(precision, recall, beta=beta).tolist() == np.flatnonzero(f > 0.985 * f.max()).tolist()


def test_a_larger_beta_prefers_recall() -> None:
    precision, recall = np.linspace(1.0, 0.3, 71), np.linspace(0.3, 1.0, 71)
    places = [np.median(f_measure_plateau(precision, recall, beta=beta)) for beta in (0.3, 1.0, 3.0)]
    assert places == sorted(places)
    assert places[0] < places[2]


def test_scores_of_images_are_put_together() -> None:
    parts = [held_out(1, 10, 8), held_out(2, 20, 9, complete=False)]
    merged = merge_scores(parts)
    assert merged.car_count == 17
    assert not merged.complete
    assert merged.score.tolist() == [*parts[0].score, *parts[1].score]
    assert merged.correct.tolist() == [*parts[0].correct, *parts[1].correct]


def labelled(seed: int, cars: int, shape: tuple[int, int]) -> LabelledImage:
    rng = np.random.default_rng(seed)
    table = np.full((cars, 5), np.nan)
    table[:, :2] = rng.uniform(0, 1, (cars, 2)) * [shape[1] - 1, shape[0] - 1]
    return LabelledImage(image=np.zeros(shape, np.uint8), cars=table)


@given(SEEDS, st.integers(0, 60), st.sampled_from([(40, 90), (90, 40)]))
@settings(max_examples=40)
def test_half_of_an_image_is_held_out_with_its_cars(seed: int, cars: int, shape: tuple[int, int]) -> None:
    sample = labelled(seed, cars, shape)
    region = held_out_half(sample)
    assert region.shape == shape
    assert sum(len(restrict_to_region(sample, part).cars) for part in (region, ~region)) == cars


@pytest.mark.parametrize(("shape", "axis"), [((40, 200), 0), ((200, 40), 1)])
def test_what_is_held_out_are_two_stripes_across_the_longer_side_with_half_the_cars(
    shape: tuple[int, int], axis: int
) -> None:
    sample = labelled(0, 160, shape)
    region = held_out_half(sample)
    assert (region == region.any(axis=axis, keepdims=True)).all()
    assert int(np.abs(np.diff(region.any(axis=axis).astype(int))).sum()) == 3  # one touches an end
    assert 70 <= len(restrict_to_region(sample, region).cars) <= 90


def test_restricting_an_image_keeps_what_belongs_together() -> None:
    sample = labelled(1, 30, (60, 80))
    angles = np.arange(30.0)
    valid = np.zeros((60, 80), bool)
    valid[10:] = True
    whole = LabelledImage(sample.image, sample.cars, valid=valid, abs_box_angle_rad=angles)
    region = np.zeros((60, 80), bool)
    region[:, 40:] = True
    part = restrict_to_region(whole, region)
    inside = in_region(region, sample.cars)
    assert part.cars[:, 0].min() >= 39.5
    assert part.abs_box_angle_rad.tolist() == angles[inside].tolist()
    assert part.valid is not None
    assert (part.valid == (region & valid)).all()


def test_the_contact_sheet_has_a_section_for_each_kind() -> None:
    crops = np.full((20, 32, 32), 90, np.uint8)
    sheet = contact_sheet({TRUE_POSITIVES: crops, MISSED: crops[:0], FALSE_POSITIVES: crops[:16]})
    assert sheet.shape == (3 * 22 + 3 * 64, 1024, 3)
    assert (sheet[22 : 22 + 64] == 90).all()  # the first row is full
    assert (sheet[22 + 64 : 22 + 128, 4 * 64 :] == 255).all()  # four crops in the second
