"""The shipped detector on labelled pictures that it was not trained on, each set at its true scale, and on cities.

python -m tests.benchmarks.unseen_pictures FOLDER    where FOLDER holds the sets of tools.training_data, and minsk
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from schemas.arrays import FloatArray
from tools.training_data import read_sites, read_upright
from velfield.bench.scenes import simulated_image
from velfield.detection.evaluation import MATCH_PX, f_measure, match_labels
from velfield.detection.orientation import axial_difference
from velfield.detection.registry import shipped_detector
from velfield.detection.samples import LabelledImage

_CITIES = range(9801, 9807)
_LOWEST = -0.3
"""Score from which the average precision counts detections."""
_LONG_PX, _NEAR_LONG = 22.4, 0.2
"""1.4 cars; fraction of its length within which a longer vehicle's centre is found."""


def main() -> None:
    """Detect, print a line a set."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    sets = {f"{site.name}, held out": site.held_out for site in read_sites(folder) if site.held_out}
    sets["minsk"] = read_upright(sorted((folder / "minsk").glob("*.jpg")))
    sets["simulated cities"] = [simulated_image(seed) for seed in _CITIES]
    for name, samples in sets.items():
        print(f"{name:28} {_judge(samples)}")


def _judge(samples: Sequence[LabelledImage]) -> str:
    detector = shipped_detector()
    scores, correct, axes, long = [], [], [], []
    for sample in samples:
        found = detector.detect(sample.image, sample.valid, threshold=_LOWEST)
        found = found.take(np.argsort(-found.score, kind="stable"))
        right, counted = match_labels(found.xy, sample.cars, sample.ignore)
        scores.append(found.score[counted])
        correct.append(right[counted])
        sure = found.score > detector.threshold
        axes.append(_axis_errors(found.xy[right & sure], found.orientation_rad[right & sure], sample.cars))
        for car in sample.cars[sample.cars[:, 3] > _LONG_PX]:
            near = np.hypot(*(found.xy[sure] - car[:2]).T) < max(MATCH_PX, _NEAR_LONG * car[3])
            long.append(bool(near.any()))
    score, right = np.concatenate(scores), np.concatenate(correct)
    count, sure = sum(len(sample.cars) for sample in samples), score > detector.threshold
    precision, recall = right[sure].mean(), right[sure].sum() / count
    errors = np.degrees(np.concatenate(axes))
    parts = [
        f"{count} vehicles in {len(samples)} pictures: precision {precision:.3f}, recall {recall:.3f}",
        f"F1 {f_measure(precision, recall):.3f}",
        f"average precision {_average(score, right, count):.3f}",
    ]
    if len(errors):
        parts.append(f"axis: median {np.median(errors):.1f} degrees, {(errors < 10).mean():.2f} within 10")
    if long:
        parts.append(f"longer than 1.4 cars: {sum(long)} of {len(long)}")
    return "; ".join(parts)


def _axis_errors(xy: FloatArray, axis_rad: FloatArray, cars: FloatArray) -> FloatArray:
    """Of detections that are right, against the labelled axes that are known."""
    nearest = np.hypot(*(xy[:, None] - cars[None, :, :2]).transpose(2, 0, 1)).argmin(axis=1) if len(xy) else []
    labelled = cars[nearest, 2] if len(xy) else np.empty(0)
    error = np.abs(axial_difference(axis_rad, labelled))
    return error[np.isfinite(error)]


def _average(score: FloatArray, right: FloatArray, count: int) -> float:
    """Area under precision against recall."""
    order = np.argsort(-score, kind="stable")
    found = np.cumsum(right[order])
    precision = np.maximum.accumulate((found / np.arange(1, len(found) + 1))[::-1])[::-1]
    return float((np.diff(found, prepend=0) * precision).sum() / count)


if __name__ == "__main__":
    main()
