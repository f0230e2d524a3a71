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
from numpy.typing import NDArray

from velfield import open_run
from velfield.detection.ship import boxes_of
from velfield.run import Run

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
        right, found, there = np.sum(
            [_judge(open_run(root / "run"), k, p) for k, p in enumerate(pictures) if k], axis=0
        )
    print(
        f"{asked.folder.name}: {len(pictures) - 1} pictures, {there} cars, {found} found: "
        f"precision {right / max(found, 1):.3f}, recall {right / there:.3f}"
    )


def _judge(run: Run, frame: int, picture: Path) -> tuple[int, int, int]:
    """How many of a picture's finds are on a car of their own (within half its length), finds, and marked cars."""
    _, boxes = boxes_of(picture)
    cars = boxes[boxes[:, 0] == 0]
    table = run.detections()
    table = table[table["frame"] == frame].sort_values("score", ascending=False)
    found = run.to_raw(frame, table[["x_px", "y_px"]].to_numpy())
    taken, right, left_alone = np.zeros(len(cars), bool), 0, 0
    for place in found:
        gap = np.hypot(*(cars[:, 1:3] - place).T) / (cars[:, 3:5].max(axis=1) / 2)
        gap[taken] = np.inf
        if len(cars) and gap.min() <= 1:
            taken[gap.argmin()] = True
            right += 1
        elif _inside(place, boxes[boxes[:, 0] != 0]):  # a lorry, a bus: neither right nor wrong
            left_alone += 1
    return right, len(found) - left_alone, len(cars)


def _inside(place: NDArray[np.float64], boxes: NDArray[np.float64]) -> bool:
    return bool((np.abs(boxes[:, 1:3] - place) <= boxes[:, 3:5] / 2).all(axis=1).any())


if __name__ == "__main__":
    main()
