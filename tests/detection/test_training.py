"""`velfield train`: pictures and labels to a detector file, a contact sheet, and clear words where it cannot be."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from flows.cli import app
from flows.commands import train as train_command
from schemas.flight import FramesConfig
from velfield.detection.cascade.scenes import scene_of
from velfield.detection.files import load_detector, shipped_detector
from velfield.detection.orientation import axial_difference
from velfield.detection.review import review_sheet
from velfield.errors import InputError
from velfield.pipeline.stages.labels import labelled_images, odd_length
from velfield.sources.labels.labels import read_labels
from velfield.sources.source import probe
from velfield.synthetic import small_flight

QUICK = ["--set", "detection.fine_tune_steps=6"]


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
    assert train(marked, "--out", str(out), "--review", str(sheet)) == 0
    detector = load_detector(out)
    assert detector.record.cars == 14
    assert detector.record.method == "cnn"
    assert detector.record.layers != shipped_detector().record.layers
    assert cv2.imread(str(sheet)).shape[1] == 1024
    said = capsys.readouterr().out
    assert "14 cars, labelled frames: 1" in said
    assert "label 16 or more" in said
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


def test_a_turned_car_in_an_upright_box_is_learnt_along_its_axis(tmp_path: Path) -> None:
    """The box tells the angle but for its sign, the picture the sign; a box's length alone says nothing of either."""
    flight = small_flight(frames=1, width=640, height=480, seed=12)
    cars = flight.labels(0)
    cars = cars[cars["length_px"] < 25]
    turn = cv2.getRotationMatrix2D((320, 240), -30, 1.0)  # its streets lie along rows and columns
    xy = cars[["x_px", "y_px"]].to_numpy() @ turn[:, :2].T + turn[:, 2]
    length, width, axis = (cars[name].to_numpy() for name in ("length_px", "width_px", "orientation_rad"))
    axis = axis + np.radians(30)
    c, s = np.abs(np.cos(axis)), np.abs(np.sin(axis))
    boxes = np.column_stack([(xy + 0.5) / [640, 480], (length * c + width * s) / 640, (length * s + width * c) / 480])
    seen = (np.abs(boxes[:, :2] - 0.5) < 0.48).all(axis=1)
    rows, axis = np.column_stack([np.zeros(len(boxes)), boxes])[seen], axis[seen]
    picture = cv2.warpAffine(flight.frame(0), turn, (640, 480), borderMode=cv2.BORDER_REFLECT)
    cv2.imwrite(str(tmp_path / "0.png"), picture)
    (tmp_path / "labels").mkdir()
    np.savetxt(tmp_path / "labels" / "0.txt", rows, fmt="%.6f")
    info = probe(tmp_path, frames=FramesConfig(fps=1.0))
    (image,) = labelled_images(tmp_path, info, read_labels(tmp_path / "labels", info), work_per_raw=0.92)
    off = np.degrees(axial_difference(scene_of(image, has_background=False).cars[:, 2], axis))
    assert len(off) > 15
    assert np.mean(off < 15) > 0.85


def test_marked_cars_that_are_not_as_long_as_cars_are_warned_of() -> None:
    assert odd_length(20.0, 0.23) == odd_length(float("nan"), 0.23) == odd_length(20.0, None) == []
    (short,), (long,) = odd_length(13.0, 0.23), odd_length(13.0, 0.8)
    assert "3.0 m long, expected 3.3 to 6" in short
    assert "give 0.34 if they are cars" in short
    assert "10.4 m long" in long


def test_a_folder_that_is_not_there_is_said_before_anything_is_learnt(tmp_path: Path) -> None:
    out = tmp_path / "no" / "d.json"
    with pytest.raises(InputError, match=r"found no folder .*no, expected one to write to; make it"):
        train_command.train(tmp_path, labels=tmp_path / "labels.csv", out=out)
