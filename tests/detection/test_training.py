"""`velfield train`: images and labels in, a detector file and a contact sheet out; bad input is one clear line."""

import json
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from flows.cli import app
from flows.commands import train as train_command
from schemas.flight import FramesConfig
from schemas.tables import LABEL_COLUMNS
from velfield.detection.orientation import axial_difference, fill_missing_orientation
from velfield.detection.registry import load_detector, shipped_detector
from velfield.errors import InputError
from velfield.pipeline.stages.labels import check_label_scale, check_vehicle_length, labelled_images
from velfield.sources.labels.labels import read_labels
from velfield.sources.source import probe
from velfield.synthetic.cases import small_flight

QUICK = ["--set", "detection.fine_tune_steps=6"]


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two images of a simulated city, and COCO labels of one with 14 cars."""
    place = tmp_path_factory.mktemp("labelled")
    flight = small_flight(frames=2, width=320, height=240, seed=12)
    (place / "images").mkdir()
    for k in (0, 1):
        cv2.imwrite(str(place / "images" / f"{k}.png"), flight.frame(k))
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
    line = ["train", str(place / "images"), "--labels", str(place / "coco.json"), *QUICK, *words]
    return int(app(line, result_action="return_value", exit_on_error=False) or 0)


def test_labels_become_a_detector_and_a_contact_sheet(
    labelled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, sheet = tmp_path / "d.json", tmp_path / "sheet.png"
    assert train(labelled, "--out", str(out), "--review", str(sheet)) == 0
    detector = load_detector(out)
    assert detector.record.cars == 14
    assert detector.record.method == "cnn"
    assert detector.record.onnx != shipped_detector().record.onnx
    assert cv2.imread(str(sheet)).shape[1] == 1024
    printed = capsys.readouterr().out
    assert "14 cars, labelled frames: 1, score threshold" in printed
    assert "label 16 or more" in printed
    assert "true positives" in printed


def test_a_base_to_continue_must_be_a_detector_file(labelled: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such detector file"):
        train(labelled, "--out", str(tmp_path / "d.json"), "--continue", str(tmp_path / "none.json"))


def test_cars_of_unknown_length_need_the_ground_sample_distance(labelled: Path, tmp_path: Path) -> None:
    (tmp_path / "l.csv").write_text("frame,x_px,y_px\n0.png,20,30\n")
    line = ["train", str(labelled / "images"), "--labels", str(tmp_path / "l.csv"), "--out", str(tmp_path / "d.json")]
    with pytest.raises(InputError, match="give --gsd-m"):
        app(line, result_action="return_value", exit_on_error=False)


def test_an_upright_box_about_a_rotated_car_becomes_an_oriented_label(tmp_path: Path) -> None:
    """The box gives the angle but for its sign, the image the sign; a box's length alone gives neither."""
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
    rotated = cv2.warpAffine(flight.frame(0), turn, (640, 480), borderMode=cv2.BORDER_REFLECT)
    cv2.imwrite(str(tmp_path / "0.png"), rotated)
    (tmp_path / "labels").mkdir()
    np.savetxt(tmp_path / "labels" / "0.txt", rows, fmt="%.6f")
    info = probe(tmp_path, frames=FramesConfig(fps=1.0))
    (image,) = labelled_images(tmp_path, info, read_labels(tmp_path / "labels", info), work_per_raw=0.92)
    found = fill_missing_orientation(image.image, image.cars, image.abs_box_angle_rad)[:, 2]
    off = np.degrees(axial_difference(found, axis))
    assert len(off) > 15
    assert np.mean(off < 15) > 0.85


def test_labels_that_are_not_as_long_as_cars_are_warned_of() -> None:
    assert (
        check_vehicle_length(20.0, 0.23)
        == check_vehicle_length(float("nan"), 0.23)
        == check_vehicle_length(20.0, None)
        == []
    )
    (short,), (long,) = check_vehicle_length(13.0, 0.23), check_vehicle_length(13.0, 0.8)
    assert "3.0 m long, expected 3.3 to 6" in short
    assert "give 0.34 if they are cars" in short
    assert "10.4 m long" in long


@pytest.mark.parametrize(("factor", "n_warnings"), [(1.0, 0), (1.2, 1), (1 / 1.2, 1)])
def test_a_wrong_gsd_is_reported_by_the_labelled_cars(factor: float, n_warnings: int) -> None:
    rng = np.random.default_rng(4)
    cars = pd.DataFrame(
        {name: pd.Series(np.nan, index=range(60), dtype=kind) for name, kind in LABEL_COLUMNS.items() if kind != "str"}
    )
    cars["length_px"] = rng.normal(4.4, 0.35, 60) / 0.23 / 1.1
    cars["width_px"] = 8.0
    cars["orientation_rad"] = 0.3
    lines = check_label_scale(cars, 1.1, 0.23 * factor)
    assert len(lines) == n_warnings
    assert all("by --gsd-m is used, but it is" in line for line in lines)


def test_a_folder_that_is_missing_is_an_error_before_anything_is_trained(tmp_path: Path) -> None:
    out = tmp_path / "no" / "d.json"
    with pytest.raises(InputError, match=r"the folder .*no does not exist; create it first"):
        train_command.train(tmp_path, labels=tmp_path / "labels.csv", out=out)
