"""Labels and external detections in raw pixels; what is none is refused."""

import math
import shutil

import numpy as np
import pytest

from schemas.tables import LABEL_COLUMNS
from velfield.errors import InputError
from velfield.sources.frames import SourceInfo
from velfield.sources.labels.labels import RAW_DETECTION_COLUMNS, read_detections, read_labels

FOLDER = SourceInfo("folder", 200, 100, 3, np.arange(3) / 5, ("a.png", "b.png", "c.png"))
VIDEO = SourceInfo("video", 200, 100, 50, np.arange(50) / 25, tuple(str(index) for index in range(50)))


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def assert_refused(path, match, info=FOLDER, read=read_labels):
    with pytest.raises(InputError, match=match) as caught:
        read(path, info)
    assert "\n" not in str(caught.value)
    assert ";" in str(caught.value)


def test_a_csv_of_all_columns_is_read_in_raw_pixels(tmp_path):
    path = write(
        tmp_path / "l.csv",
        "frame,x_px,y_px,orientation_rad,length_px,width_px\na.png,10.5,20,0.5,16,7\na.png,30,40,-0.5,,\nb.png,,,,,\n",
    )
    labels = read_labels(path, FOLDER)
    assert list(labels.cars) == list(LABEL_COLUMNS)
    assert labels.cars.dtypes.equals(labels.cars.astype(LABEL_COLUMNS).dtypes)  # pandas 2 has no type of text
    assert labels.cars["x_px"].tolist() == [10.5, 30.0]
    assert labels.cars["orientation_rad"].tolist() == pytest.approx([0.5, math.pi - 0.5])
    assert labels.cars["length_px"].isna().tolist() == [False, True]
    assert labels.frames == ("a.png", "b.png")


def test_a_video_is_labelled_by_frame_index_before_every(tmp_path):
    path = write(tmp_path / "l.csv", "\ufeffframe,x_px,y_px\n17,10,20\n3,1,2\n")
    labels = read_labels(path, VIDEO)
    assert labels.cars["frame"].tolist() == ["17", "3"]
    assert labels.frames == ("3", "17")


def test_a_yolo_folder_is_read_by_stem_and_other_classes_are_left_alone(tmp_path):
    write(tmp_path / "y" / "classes.txt", "car\nbus\ntree\n")
    write(tmp_path / "y" / "a.txt", "0 0.5 0.5 0.1 0.05\n2 0.25 0.5 0.2 0.2\n")
    write(tmp_path / "y" / "b.txt", "")
    write(tmp_path / "y" / "elsewhere.txt", "0 0.5 0.5 0.1 0.1\n")
    labels = read_labels(tmp_path / "y", FOLDER)
    assert labels.frames == ("a.png", "b.png")
    assert (len(labels.cars), len(labels.ignored)) == (1, 1)
    assert labels.cars.loc[0, ["x_px", "y_px"]].tolist() == [99.5, 49.5]
    assert labels.notes == (
        "classes by classes.txt: cars are car (1); ignored: tree (1)",
        "1 labelled images are no frames of this source: not used",
    )


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("l.csv", "frame,x_px,y_px\na.png,500,20\n", "1 labels outside the image .*200x100"),
        ("l.csv", "frame,x_px,y_px\nz.png,5,20\n", "line 2: found frame 'z.png', expected an image's file name"),
        ("l.csv", "frame,x_px,y_px\na.png,5,\n", "one of x_px and y_px empty"),
        ("l.csv", "frame,x_px,y_px\n", "found no cars"),
        ("l.csv", "frame,x_px,y_px\na.png,,\n", "found no cars"),
        ("l.csv", "frame,x_px,y_px,length_px\na.png,5,5,-2\n", "both > 0"),
        ("l.csv", "filename,left,top,width,height\na.png,1,2,3,4\n", "expected labels as CSV `frame,x_px,y_px"),
        ("l.csv", "frame,x_px,y_px,orientation_rad\na.png,5,5,84\n", "convert degrees"),
        ("l.xml", "<annotation/>", "found XML of another kind"),
        ("l.txt", "1 2 3 4\n", "a .txt that is not YOLO"),
        ("a.txt", "0 0.5 0.5 0.1 0.1\n0 12 34 10 10\n", "fractions of the image"),
        ("a.txt", "0 0.5 0.5 0.1 0.1\ncar 1 2\n", "line 2: found 'car 1 2', expected YOLO.*; fix line 2"),
        ("q.txt", "0 0.5 0.5 0.1 0.1\n", "no frame of this source has such a name"),
        ("y/z.txt", "0 0.5 0.5 0.1 0.1\n", "no frame of this source has such a name"),
        ("y/readme.md", "", "no .txt, .json or .xml files"),
    ],
)
def test_what_is_no_label_of_these_frames_is_refused(tmp_path, name, content, match):
    path = write(tmp_path / name, content)
    assert_refused(path.parent if name.startswith("y/") else path, match)


def test_addresses_and_nothing_there_are_refused(tmp_path):
    assert_refused("http://example.org/labels.csv", "is not supported, expected a local path")
    assert_refused(tmp_path / "none.csv", "found no labels")


def test_two_images_of_one_stem_cannot_have_yolo_labels(tmp_path):
    info = SourceInfo("folder", 200, 100, 2, np.arange(2) / 5, ("a.jpg", "a.png"))
    assert_refused(write(tmp_path / "a.txt", "0 0.5 0.5 0.1 0.1\n"), "of one stem", info)


def test_detections_of_others_are_read_with_what_they_know(tmp_path):
    path = write(tmp_path / "d.csv", "frame,x_px,y_px,score,track\nb.png,10,20,0.7,x\na.png,30,40,,y\n")
    table = read_detections(path, FOLDER)
    assert list(table) == list(RAW_DETECTION_COLUMNS)
    assert table.dtypes.equals(table.astype(RAW_DETECTION_COLUMNS).dtypes)
    assert table["source_index"].tolist() == [0, 1]
    assert table["score"].tolist() == [1.0, 0.7]
    yolo = write(tmp_path / "y" / "c.txt", "0 0.5 0.5 0.1 0.05 0.25\n").parent
    assert read_detections(yolo, FOLDER)[["frame", "score"]].to_numpy().tolist() == [["c.png", 0.25]]


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ("frame,x_px,y_px\na.png,500,20\n", "1 detections outside the image"),
        ("frame,x_px,y_px\n", "found no detections"),
        ("frame,x,y\na.png,1,20\n", "expected detections as CSV"),
    ],
)
def test_bad_detections_are_refused(tmp_path, content, match):
    assert_refused(write(tmp_path / "d.csv", content), match, read=read_detections)


@pytest.mark.footage
def test_kit_ais_labels_are_read_with_the_names_of_their_classes(footage, tmp_path):
    from schemas.flight import FramesConfig
    from velfield.sources.source import probe

    folder = footage("kit_ais") / "MOS155_street"
    info = probe(folder, frames=FramesConfig(fps=2))
    assert_refused(folder, r"classes 0 \(1311 boxes\), 2 .* without names", info)
    for file in folder.glob("*.txt"):
        shutil.copy(file, tmp_path)
    write(tmp_path / "classes.txt", "car\n\nlorry\ntrailer\n")
    labels = read_labels(tmp_path, info)
    assert (len(labels.cars), len(labels.ignored), len(labels.frames)) == (1311, 27, 25)
    assert 28 < labels.cars["length_px"].median() < 40  # about 37 x 17 px by its source
