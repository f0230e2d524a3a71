"""`velfield train`: pictures and labels to a detector file, a contact sheet, and clear words where it cannot be."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from flows.cli import app
from velfield.detection.detector import load_detector
from velfield.detection.review import review_sheet
from velfield.errors import InputError
from velfield.synthetic import small_flight

QUICK = ["--set", "detection.rounds=30", "--set", "detection.feature_pool=200"]


@pytest.fixture(scope="module")
def marked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two pictures of a simulated city, and COCO labels of one with 14 marked cars."""
    place = tmp_path_factory.mktemp("marked")
    flight = small_flight(frames=2, width=320, height=240, seed=12)
    (place / "pictures").mkdir()
    for k in (0, 1):
        cv2.imwrite(str(place / "pictures" / f"{k}.png"), flight.frame(k))
    cars = flight.labels(0)[["x_px", "y_px", "orientation_rad", "length_px", "width_px"]].to_numpy()[:14]
    outlines = [cv2.boxPoints(((x + 0.5, y + 0.5), (length, w), np.degrees(a))) for x, y, a, length, w in cars]
    content = {
        "images": [{"id": 1, "file_name": "0.png"}],
        "categories": [{"id": 3, "name": "car"}],
        "annotations": [
            {"image_id": 1, "category_id": 3, "segmentation": [o.ravel().tolist()], "bbox": [0, 0, 1, 1]}
            for o in outlines
        ],
    }
    (place / "coco.json").write_text(json.dumps(content))
    return place


def train(place: Path, *words: str) -> int:
    line = ["train", str(place / "pictures"), "--labels", str(place / "coco.json"), *QUICK, *words]
    return int(app(line, result_action="return_value", exit_on_error=False) or 0)


def test_marked_cars_become_a_detector_and_a_sheet(
    marked: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, sheet = tmp_path / "d.json", tmp_path / "sheet.png"
    assert train(marked, "--out", str(out), "--review", str(sheet), "--continue", "shipped") == 0
    detector = load_detector(out)
    assert detector.record.cars == 14
    assert len(detector.record.rounds) > 1000
    assert cv2.imread(str(sheet)).shape[1] == 1024
    said = capsys.readouterr().out
    assert "14 cars of 1 frames" in said
    assert "mark 16 or more" in said
    assert "marked and found" in said


def test_what_to_continue_must_be_a_detector(marked: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such detector file"):
        train(marked, "--out", str(tmp_path / "d.json"), "--continue", str(tmp_path / "none.json"))


def test_cars_of_unknown_size_are_asked_for(marked: Path, tmp_path: Path) -> None:
    (tmp_path / "l.csv").write_text("frame,x_px,y_px\n0.png,20,30\n")
    line = ["train", str(marked / "pictures"), "--labels", str(tmp_path / "l.csv"), "--out", str(tmp_path / "d.json")]
    with pytest.raises(InputError, match="give --gsd-m"):
        app(line, result_action="return_value", exit_on_error=False)


def test_the_sheet_has_a_part_for_each_kind() -> None:
    chips = np.full((20, 32, 32), 90, np.uint8)
    sheet = review_sheet({"found": chips, "none": chips[:0]})
    assert sheet.shape == (2 * 22 + 2 * 64, 1024, 3)
