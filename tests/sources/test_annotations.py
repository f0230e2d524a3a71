"""Labels of other programs: each format's car comes out at its place in raw pixels; what is none of them is refused."""

import json
import math

import numpy as np
import pytest

from velfield.errors import InputError
from velfield.sources.frames import SourceInfo
from velfield.sources.labels.labels import read_labels

FOLDER = SourceInfo("folder", 200, 100, 3, np.arange(3) / 5, ("a.png", "b.png", "c.png"))
VIDEO = SourceInfo("video", 200, 100, 50, np.arange(50) / 25, tuple(str(index) for index in range(50)))
TURN = math.radians(30)
CORNERS = [  # of a car of 20 x 8 px about (60, 40), counted from the first pixel's centre
    (60 + u * math.cos(TURN) - v * math.sin(TURN), 40 + u * math.sin(TURN) + v * math.cos(TURN))
    for u, v in ((-10, -4), (10, -4), (10, 4), (-10, 4))
]
EDGE = [[x + 0.5, y + 0.5] for x, y in CORNERS]
FLAT = [value for point in EDGE for value in point]


def geojson():
    ring = [*CORNERS, CORNERS[0]]
    polygon = {"type": "Polygon", "coordinates": [ring]}
    point = {"type": "Point", "coordinates": [150.0, 20.0]}
    features = [
        {"type": "Feature", "properties": {"frame": "a.png"}, "geometry": polygon},
        {"type": "Feature", "properties": {"frame": "a.png"}, "geometry": point},
        {"type": "Feature", "properties": {"frame": "b.png"}, "geometry": None},
    ]
    return {"type": "FeatureCollection", "features": features}


def coco():
    return {
        "images": [{"id": 7, "file_name": "images/a.png"}, {"id": 8, "file_name": "b.jpg"}],
        "categories": [{"id": 1, "name": "car"}, {"id": 2, "name": "bus"}],
        "annotations": [
            {"image_id": 7, "category_id": 1, "bbox": [0, 0, 1, 1], "segmentation": [FLAT]},
            {"image_id": 7, "category_id": 1, "bbox": [140.5, 16.5, 20, 8]},
            {"image_id": 7, "category_id": 2, "bbox": [10, 10, 40, 10]},
        ],
    }


def labelme():
    shapes = [
        {"label": "car", "points": EDGE, "shape_type": "polygon"},
        {"label": "car", "points": [[140.5, 16.5], [160.5, 24.5]], "shape_type": "rectangle"},
        {"label": "tree", "points": [[5, 5]], "shape_type": "point"},
    ]
    return {"imagePath": "..\\images\\a.png", "shapes": shapes}


def via():
    polygon = {"name": "polygon", "all_points_x": [p[0] for p in EDGE], "all_points_y": [p[1] for p in EDGE]}
    rect = {"name": "rect", "x": 140.5, "y": 16.5, "width": 20, "height": 8}
    regions = [
        {"shape_attributes": polygon, "region_attributes": {"kind": "car"}},
        {"shape_attributes": rect, "region_attributes": {"kind": {"car": True}}},
        {"shape_attributes": {"name": "point", "cx": 5, "cy": 5}, "region_attributes": {"kind": "lorry"}},
    ]
    return {"_via_img_metadata": {"a.png123": {"filename": "a.png", "regions": regions}}}


@pytest.mark.parametrize(("content", "others"), [(geojson, 0), (coco, 1), (labelme, 1), (via, 1)])
def test_a_car_is_where_it_was_drawn(tmp_path, content, others):
    path = tmp_path / "labels.json"
    path.write_text(json.dumps(content()))
    labels = read_labels(path, FOLDER)
    first, second = labels.cars.iloc[0], labels.cars.iloc[1]
    assert first[["x_px", "y_px"]].tolist() == pytest.approx([60, 40], abs=1e-3)
    assert first[["orientation_rad", "length_px", "width_px"]].tolist() == pytest.approx([TURN, 20, 8], abs=1e-2)
    assert second[["x_px", "y_px"]].tolist() == pytest.approx([150, 20])
    assert (len(labels.cars), len(labels.ignored)) == (2, others)
    assert labels.frames[0] == "a.png"


def test_an_image_on_which_nothing_is_drawn_is_labelled_all_the_same(tmp_path):
    (tmp_path / "l.json").write_text(json.dumps(coco()))
    assert read_labels(tmp_path / "l.json", FOLDER).frames == ("a.png", "b.png")


def test_a_folder_of_labelme_files_and_a_csv_of_via(tmp_path):
    (tmp_path / "me").mkdir()
    for name in ("a.png", "c.png"):
        (tmp_path / "me" / f"{name[0]}.json").write_text(json.dumps(labelme() | {"imagePath": name}))
    assert read_labels(tmp_path / "me", FOLDER).frames == ("a.png", "c.png")
    shape = json.dumps({"name": "rect", "x": 140.5, "y": 16.5, "width": 20, "height": 8}).replace('"', '""')
    csv = f'filename,region_shape_attributes,region_attributes\nb.png,"{shape}","{{}}"\n'
    (tmp_path / "via.csv").write_text(csv)
    assert read_labels(tmp_path / "via.csv", FOLDER).cars["x_px"].tolist() == [150.0]


def test_frames_of_a_video_are_named_by_number(tmp_path):
    (tmp_path / "l.json").write_text(json.dumps(labelme() | {"imagePath": "frame_000017.jpg"}))
    assert read_labels(tmp_path / "l.json", VIDEO).frames == ("17",)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{", "no JSON"),
        ("[1, 2]", "JSON of another kind, expected labels of GeoJSON, COCO"),
        ('{"a": 1}', "JSON of another kind"),
        (json.dumps(coco() | {"annotations": [{"image_id": 99, "bbox": [1, 1, 2, 2]}]}), "COCO labels with KeyError"),
        (json.dumps(labelme() | {"shapes": [{"points": "x"}]}), "LabelMe labels with ValueError"),
        (json.dumps(labelme() | {"imagePath": "elsewhere.png"}), "no frame of this source has such a name"),
        (json.dumps(labelme() | {"shapes": [{"label": "tree", "points": [[5, 5]]}]}), "expected one of cars"),
        (json.dumps(labelme() | {"shapes": [{"label": "car", "points": [[500, 5]]}]}), "outside the image"),
        (json.dumps(geojson() | {"features": []}), "found labels of the images none"),
    ],
)
def test_what_is_no_label_of_these_frames_is_one_clear_line(tmp_path, text, match):
    (tmp_path / "l.json").write_text(text)
    with pytest.raises(InputError, match=match) as caught:
        read_labels(tmp_path / "l.json", FOLDER)
    assert "\n" not in str(caught.value)
    assert ";" in str(caught.value)
