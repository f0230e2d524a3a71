"""Whole runs on real footage whose cars are marked: labels of the first picture only, or none, judged on the others.

python -m tests.benchmarks.real_footage FOLDER    where FOLDER holds pictures, each with a YOLO file beside it
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tools.training_data import read_boxes
from velfield import open_run
from velfield.run.run import Run

_STANDS_WITHIN = 0.3
"""Car lengths on the map."""
FPS = "2"  # the interval is not stated; the cars' speeds make sense with this one


def main() -> None:
    """Run, judge, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--no-labels", action="store_true")
    parser.add_argument("settings", nargs="*", help="handed to velfield run as --set")
    asked = parser.parse_args()
    pictures = sorted(path for path in asked.folder.glob("*.png") if path.with_suffix(".txt").exists())
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for name in ("pictures", "labels"):
            (root / name).mkdir()
        for path in pictures:
            shutil.copy(path, root / "pictures")
        shutil.copy(pictures[0].with_suffix(".txt"), root / "labels")
        command = [sys.executable, "-m", "flows.cli", "run", str(root / "pictures"), "--fps", FPS]
        command += [] if asked.no_labels else ["--labels", str(root / "labels")]
        command += [word for setting in asked.settings for word in ("--set", setting)]
        subprocess.run([*command, "--out", str(root / "run")], check=True)
        run = open_run(root / "run")
        boxes = [read_boxes(picture)[1] for picture in pictures]
        moving = find_moving(run, boxes)
        judged = [judge(run, k, run.detections(), boxes[k], moving[k]) for k in range(1, len(pictures))]
    right, right_moving, wrong, there, move = np.sum(judged, axis=0)
    print(f"{asked.folder.name}: {len(judged)} pictures, {right + wrong} found")
    for name, hits, cars in (("all cars", right, there), ("those that move", right_moving, move)):
        precision, recall = hits / max(hits + wrong, 1), hits / cars
        f1 = 2 * precision * recall / max(precision + recall, 1e-9)
        print(f"{name:16} {cars:5}: precision {precision:.3f}, recall {recall:.3f}, F1 {f1:.3f}")


def find_moving(run: Run, boxes: list[NDArray[np.float64]]) -> list[NDArray[np.bool_]]:
    """Which of the marked cars of each picture have none in their place on the map in the picture before or after."""
    cars = [table[table[:, 0] == 0] for table in boxes]
    places = [run.to_base(k, np.ascontiguousarray(table[:, 1:3])) for k, table in enumerate(cars)]
    moving = []
    for k, (here, table) in enumerate(zip(places, cars, strict=True)):
        beside = [places[j] for j in (k - 1, k + 1) if 0 <= j < len(places) and len(places[j])]
        gaps = [np.hypot(*(here[:, None] - other).transpose(2, 0, 1)).min(axis=1) for other in beside]
        moving.append(np.max(gaps, axis=0) > _STANDS_WITHIN * table[:, 5] if gaps else np.zeros(len(here), np.bool_))
    return moving


def judge(
    run: Run, frame: int, table: pd.DataFrame, boxes: NDArray[np.float64], moving: NDArray[np.bool_]
) -> tuple[int, int, int, int, int]:
    """Finds on a car of their own (within half its length), of these on one that moves, on none; cars, and moving."""
    cars = boxes[boxes[:, 0] == 0]
    table = table[table["frame"] == frame].sort_values("score", ascending=False)
    found = run.to_raw(frame, table[["x_px", "y_px"]].to_numpy())
    taken, wrong = np.zeros(len(cars), np.bool_), 0
    for place in found:
        gap = np.hypot(*(cars[:, 1:3] - place).T) / (cars[:, 3:5].max(axis=1) / 2)
        gap[taken] = np.inf
        if len(cars) and gap.min() <= 1:
            taken[gap.argmin()] = True
        elif not _inside(place, boxes[boxes[:, 0] != 0]):  # a lorry, a bus: neither right nor wrong
            wrong += 1
    return int(taken.sum()), int((taken & moving).sum()), wrong, len(cars), int(moving.sum())


def _inside(place: NDArray[np.float64], boxes: NDArray[np.float64]) -> bool:
    return bool((np.abs(boxes[:, 1:3] - place) <= boxes[:, 3:5] / 2).all(axis=1).any())


if __name__ == "__main__":
    main()
