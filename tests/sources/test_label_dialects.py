"""Label dialects by rule: what each program writes of the same cars is read as these cars, or refused in one line."""

import json
import math
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from velfield.errors import InputError
from velfield.sources.frames import SourceInfo
from velfield.sources.labels.labels import Labels, read_detections, read_labels

SIZE = 800, 600
FOLDER = SourceInfo("folder", *SIZE, 3, np.arange(3) / 5, ("a.png", "b.png", "DJI_0001.png"))
VIDEO = SourceInfo("video", *SIZE, 60, np.arange(60) / 25, tuple(map(str, range(60))))
CENTRES = [(120.0, 80.0), (400.5, 300.25), (700.0, 500.0), (60.0, 400.0)]
ANGLES = {
    "turned": (147.0, 12.0, 84.0, 175.0),
    "past half a turn": (327.0, 190.0, 264.0, 355.0),
    "some along rows": (0.0, 30.0, 90.0, 0.0),
}
LENGTH, WIDTH = 18.0, 8.0
Car = tuple[float, float, float]
Writer = Callable[[str, list[Car]], str]


def cars(angles: str) -> list[Car]:
    return [(x, y, math.radians(turn)) for (x, y), turn in zip(CENTRES, ANGLES[angles], strict=True)]


def corners(car: Car) -> list[tuple[float, float]]:
    """From the first pixel's corner, as other programs count."""
    x, y, turn = car
    c, s = math.cos(turn), math.sin(turn)
    half = [(-LENGTH / 2, -WIDTH / 2), (LENGTH / 2, -WIDTH / 2), (LENGTH / 2, WIDTH / 2), (-LENGTH / 2, WIDTH / 2)]
    return [(x + 0.5 + u * c - v * s, y + 0.5 + u * s + v * c) for u, v in half]


def flat(car: Car) -> list[float]:
    return [value for point in corners(car) for value in point]


def box(car: Car) -> tuple[float, float, float, float]:
    """The rectangle before it is rotated: left, top, width, height."""
    return car[0] + 0.5 - LENGTH / 2, car[1] + 0.5 - WIDTH / 2, LENGTH, WIDTH


def cvat_coco(image: str, found: list[Car]) -> str:
    annotations = [
        {"image_id": 1, "category_id": 3, "segmentation": [], "bbox": box(car)}
        | {"attributes": {"occluded": False, "rotation": math.degrees(car[2])}}
        for car in found
    ]
    return coco(image, annotations)


def coco_polygon(image: str, found: list[Car]) -> str:
    annotations = [{"image_id": 1, "category_id": 3, "segmentation": [flat(car)], "bbox": box(car)} for car in found]
    return coco(image, annotations)


def coco(image: str, annotations: list[dict[str, object]]) -> str:
    images = [{"id": 1, "file_name": image, "width": SIZE[0], "height": SIZE[1]}]
    categories = [{"id": 3, "name": "car"}, {"id": 7, "name": "bus"}]
    return json.dumps({"images": images, "categories": categories, "annotations": annotations})


def cvat_images(image: str, found: list[Car]) -> str:
    root = ET.Element("annotations")
    picture = ET.SubElement(root, "image", name=image, width=str(SIZE[0]), height=str(SIZE[1]))
    for car in found:
        ET.SubElement(picture, "box", cvat_box(car), label="car")
    return ET.tostring(root, "unicode")


def cvat_box(car: Car) -> dict[str, str]:
    x, y, w, h = box(car)
    numbers = {"xtl": x, "ytl": y, "xbr": x + w, "ybr": y + h, "rotation": math.degrees(car[2])}
    return {name: str(value) for name, value in numbers.items()}


def cvat_polygons(image: str, found: list[Car]) -> str:
    root = ET.Element("annotations")
    picture = ET.SubElement(root, "image", name=image)
    for car in found:
        ET.SubElement(picture, "polygon", label="car", points=";".join(f"{x},{y}" for x, y in corners(car)))
    return ET.tostring(root, "unicode")


def label_studio(image: str, found: list[Car]) -> str:
    results = []
    for car in found:
        x, y = corners(car)[0]  # the top left corner before the turn, about which it turned
        value = {"x": x / SIZE[0] * 100, "y": y / SIZE[1] * 100, "rotation": math.degrees(car[2]) % 360}
        value |= {"width": LENGTH / SIZE[0] * 100, "height": WIDTH / SIZE[1] * 100}
        size = {"original_width": SIZE[0], "original_height": SIZE[1]}
        results.append({"type": "rectanglelabels", "value": value | {"rectanglelabels": ["Car"]}} | size)
    task = {"id": 1, "data": {"image": f"/data/upload/1/0a1b2c3d-{image}"}, "annotations": [{"result": results}]}
    return json.dumps([task])


def datumaro(image: str, found: list[Car]) -> str:
    drawn = [{"type": "bbox", "label_id": 1, "bbox": box(car)} for car in found]
    for one, car in zip(drawn, found, strict=True):
        one["attributes"] = {"rotation": math.degrees(car[2])}
    item = {"id": image.rsplit(".")[0], "annotations": drawn, "image": {"path": image, "size": [SIZE[1], SIZE[0]]}}
    categories = {"label": {"labels": [{"name": "bus"}, {"name": "car"}]}}
    return json.dumps({"info": {}, "categories": categories, "items": [item]})


def datumaro_rotated(image: str, found: list[Car]) -> str:
    content = json.loads(datumaro(image, found))
    content["items"][0]["annotations"] = [
        {"type": "rotated_bbox", "label_id": 1, "cx": car[0] + 0.5, "cy": car[1] + 0.5, "w": LENGTH, "h": WIDTH}
        | {"r": math.degrees(car[2])}
        for car in found
    ]
    return json.dumps(content)


def labelme(image: str, found: list[Car]) -> str:
    shapes = [{"label": "car", "points": corners(car), "shape_type": "rotation", "direction": car[2]} for car in found]
    return json.dumps({"imagePath": image, "imageWidth": SIZE[0], "imageHeight": SIZE[1], "shapes": shapes})


def via(image: str, found: list[Car]) -> str:
    regions = [
        {"shape_attributes": {"name": "polygon", "all_points_x": flat(car)[::2], "all_points_y": flat(car)[1::2]}}
        | {"region_attributes": {"type": "car"}}
        for car in found
    ]
    return json.dumps({image: {"filename": image, "size": 1, "regions": regions}})


def ro_label_img(image: str, found: list[Car]) -> str:
    root = ET.Element("annotation")
    ET.SubElement(root, "filename").text = image
    for car in found:
        one = ET.SubElement(root, "object")
        ET.SubElement(one, "name").text = "car"
        rotated = ET.SubElement(one, "robndbox")
        values = {"cx": car[0] + 0.5, "cy": car[1] + 0.5, "w": LENGTH, "h": WIDTH, "angle": car[2]}
        for key, value in values.items():
            ET.SubElement(rotated, key).text = str(value)
    return ET.tostring(root, "unicode")


def cvat_voc(image: str, found: list[Car]) -> str:
    root = ET.Element("annotation")
    ET.SubElement(root, "filename").text = image
    for car in found:
        one, (x, y, w, h) = ET.SubElement(root, "object"), box(car)
        ET.SubElement(one, "name").text = "car"
        bounds = ET.SubElement(one, "bndbox")
        for key, value in zip(("xmin", "ymin", "xmax", "ymax"), (x, y, x + w, y + h), strict=True):
            ET.SubElement(bounds, key).text = str(value)
        attribute = ET.SubElement(ET.SubElement(one, "attributes"), "attribute")
        ET.SubElement(attribute, "name").text, ET.SubElement(attribute, "value").text = (
            "rotation",
            str(math.degrees(car[2])),
        )
    return ET.tostring(root, "unicode")


def supervisely(_: str, found: list[Car]) -> str:
    drawn = [
        {"classTitle": "car", "geometryType": "polygon", "points": {"exterior": corners(car), "interior": []}}
        for car in found
    ]
    return json.dumps({"size": {"width": SIZE[0], "height": SIZE[1]}, "objects": drawn})


def geojson(image: str, found: list[Car]) -> str:
    rings = [[(x - 0.5, y - 0.5) for x, y in [*corners(car), corners(car)[0]]] for car in found]
    features = [
        {"type": "Feature", "properties": {"frame": image}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
        for ring in rings
    ]
    return json.dumps({"type": "FeatureCollection", "features": features})


def yolo_obb(_: str, found: list[Car]) -> str:
    rows = [[f"{v / SIZE[k % 2]:.8f}" for k, v in enumerate(flat(car))] for car in found]
    return "".join(f"0 {' '.join(row)}\n" for row in rows)


def dota(_: str, found: list[Car]) -> str:
    rows = "".join(f"{' '.join(f'{v:.4f}' for v in flat(car))} small-vehicle 0\n" for car in found)
    return f"imagesource:GoogleEarth\ngsd:0.146\n{rows}"


def own_csv(image: str, found: list[Car]) -> str:
    rows = "".join(f"{image},{x},{y},{turn % (2 * math.pi)},{LENGTH},{WIDTH}\n" for x, y, turn in found)
    return f"frame,x_px,y_px,orientation_rad,length_px,width_px\n{rows}"


DIALECTS = {
    "cvat_coco.json": cvat_coco,
    "coco_polygon.json": coco_polygon,
    "cvat_images.xml": cvat_images,
    "cvat_polygons.xml": cvat_polygons,
    "label_studio.json": label_studio,
    "datumaro.json": datumaro,
    "datumaro_rotated.json": datumaro_rotated,
    "labelme.json": labelme,
    "via.json": via,
    "ro_label_img.xml": ro_label_img,
    "cvat_voc.xml": cvat_voc,
    "geojson.json": geojson,
    "own_csv.csv": own_csv,
    # One file an image, named as it.
    "a.json": supervisely,
    "a.txt": yolo_obb,
    "./a.txt": dota,
}


def assert_are(labels: Labels, truth: list[Car], *, frame: str = "a.png") -> None:
    found = labels.cars
    assert labels.frames == (frame,)
    assert found[["x_px", "y_px"]].to_numpy() == pytest.approx(np.array([car[:2] for car in truth]), abs=0.01)
    off = found["orientation_rad"].to_numpy() - np.array([car[2] for car in truth])
    assert np.abs((off + np.pi / 2) % np.pi - np.pi / 2) == pytest.approx(0, abs=0.01)
    assert found[["length_px", "width_px"]].to_numpy() == pytest.approx(
        np.array([[LENGTH, WIDTH]] * len(truth)), abs=0.05
    )


@pytest.mark.parametrize(("name", "angles"), list(product(DIALECTS, ANGLES)))
def test_every_dialect_has_the_axes_that_were_drawn(tmp_path: Path, name: str, angles: str) -> None:
    (tmp_path / name).write_text(DIALECTS[name]("a.png", cars(angles)))
    labels = read_labels(tmp_path / name, FOLDER)
    assert_are(labels, cars(angles))
    assert any("cars" in note for note in labels.notes) or name in ("own_csv.csv", "geojson.json")


RECT = {"x": 140.5, "y": 16.5, "width": 20, "height": 8}


def add_geojson(content: Any) -> None:
    point = {"type": "Point", "coordinates": [150.0, 20.0]}
    for frame, geometry in (("a.png", point), ("b.png", None)):
        content["features"].append({"type": "Feature", "properties": {"frame": frame}, "geometry": geometry})


def add_coco(content: Any) -> None:
    content["images"].append({"id": 8, "file_name": "b.jpg"})
    content["annotations"] += [
        {"image_id": 1, "category_id": 3, "bbox": list(RECT.values())},
        {"image_id": 1, "category_id": 7, "bbox": [10, 10, 40, 10]},
    ]


def add_labelme(content: Any) -> None:
    content["imagePath"] = "..\\images\\a.png"
    content["shapes"] += [
        {"label": "car", "points": [[140.5, 16.5], [160.5, 24.5]], "shape_type": "rectangle"},
        {"label": "tree", "points": [[5, 5]], "shape_type": "point"},
    ]


def add_via(content: Any) -> None:
    content["a.png"]["regions"] += [
        {"shape_attributes": {"name": "rect", **RECT}, "region_attributes": {"type": {"car": True}}},
        {"shape_attributes": {"name": "point", "cx": 5, "cy": 5}, "region_attributes": {"type": "lorry"}},
    ]
    content["_via_img_metadata"] = {**content}


MIXED = (
    (geojson, add_geojson, 0, 2),
    (coco_polygon, add_coco, 1, 2),
    (labelme, add_labelme, 1, 1),
    (via, add_via, 1, 1),
)


@pytest.mark.parametrize(("write", "add", "others", "frames"), MIXED)
def test_shapes_of_several_kinds_and_images_without_any_are_read(
    tmp_path: Path, write: Writer, add: Callable[[Any], None], others: int, frames: int
) -> None:
    content = json.loads(write("a.png", cars("turned")[:1]))
    add(content)
    (tmp_path / "l.json").write_text(json.dumps(content))
    labels = read_labels(tmp_path / "l.json", FOLDER)
    assert labels.cars[["x_px", "y_px"]].to_numpy() == pytest.approx(np.array([CENTRES[0], (150, 20)]), abs=0.01)
    assert len(labels.ignored) == others
    assert labels.frames == ("a.png", "b.png")[:frames]


def test_a_folder_of_labelme_files_and_a_csv_of_via(tmp_path: Path) -> None:
    (tmp_path / "me").mkdir()
    for name in ("a.png", "b.png"):
        (tmp_path / "me" / f"{name[0]}.json").write_text(labelme(name, cars("turned")))
    assert read_labels(tmp_path / "me", FOLDER).frames == ("a.png", "b.png")
    shape = json.dumps({"name": "rect", **RECT}).replace('"', '""')
    csv = f'filename,region_shape_attributes,region_attributes\nb.png,"{shape}","{{}}"\n'
    (tmp_path / "via.csv").write_text(csv)
    assert read_labels(tmp_path / "via.csv", FOLDER).cars["x_px"].tolist() == [150.0]


UPRIGHT = ("cvat_coco.json", "coco_polygon.json", "cvat_images.xml", "label_studio.json", "datumaro.json", "a.txt")


@pytest.mark.parametrize("name", UPRIGHT)
def test_boxes_of_which_none_is_turned_have_no_axis(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(DIALECTS[name]("a.png", [(100.0, 50.0, 0.0), (300.0, 200.0, 0.0)]))
    square = read_labels(tmp_path / name, FOLDER).cars
    assert square["length_px"].to_numpy() == pytest.approx(square["width_px"].to_numpy() / 0.45)


NAMES_IN_FOLDER = ("a.jpg", "a_png.rf.0ab12c.jpg", "0a1b2c3d-a.png", "images\\a.png", "train/images/a.jpeg")
NAMES_IN_VIDEO = {
    "frame_000017.PNG": 17,
    "frame_0017_jpg.rf.0ab1c2d3.jpg": 17,
    "DJI_0001_frame17.jpg": 17,
    "DJI_0001-f017.jpg": 17,
    "clip_00017.png": 17,
    "17.png": 17,
    "clip_680ms.png": 17,
    "clip_0.68s.png": 17,
    "shot-00-00-00.680.png": 17,
    "vlcsnap_00h00m00s680.png": 17,
    "DJI_0001_0017.jpg": None,  # which of the two is the frame?
    "DJI_20260504103000_0017_D.jpg": None,
    "crossing.png": None,
    "clip_00-00-01.png": None,  # a second has 25 frames
    "clip_1s.png": None,
    "clip_10-30-05.125.png": None,  # a time of day
    "frame_1700.png": None,
}


@pytest.mark.parametrize(("image", "write"), list(product(NAMES_IN_FOLDER, (cvat_coco, labelme))))
def test_renamed_images_of_a_folder_are_found(tmp_path: Path, image: str, write: Writer) -> None:
    (tmp_path / "l.json").write_text(write(image, cars("turned")))
    assert_are(read_labels(tmp_path / "l.json", FOLDER), cars("turned"))


@pytest.mark.parametrize(("image", "write"), list(product(NAMES_IN_VIDEO, (cvat_coco, via, yolo_obb))))
def test_the_frame_of_a_video_is_the_right_one_or_asked_for(tmp_path: Path, image: str, write: Writer) -> None:
    path = tmp_path / (f"{image.rsplit('.', 1)[0]}.txt" if write is yolo_obb else "l.json")
    path.write_text(write(image, cars("turned")))
    frame = NAMES_IN_VIDEO[image]
    if frame is None:
        with pytest.raises(InputError, match="; rename"):
            read_labels(path, VIDEO)
        return
    labels = read_labels(path, VIDEO)
    assert_are(labels, cars("turned"), frame=str(frame))
    assert image == "17.png" or any(f"is frame {frame} of the video" in note for note in labels.notes)


def test_several_names_show_which_number_is_the_frame(tmp_path: Path) -> None:
    for number in (5, 9):
        (tmp_path / f"DJI_0001_{number:04d}.txt").write_text(yolo_obb("", cars("turned")))
    assert read_labels(tmp_path, VIDEO).frames == ("5", "9")
    for number in range(1, 61, 59):
        (tmp_path / f"one{number}").mkdir()
    (tmp_path / "DJI_0001_0060.txt").write_text("")
    labels = read_labels(tmp_path, VIDEO)  # 60 frames, of which one is the 60th: counted from 1
    assert labels.frames == ("4", "8", "59")
    assert any("counted from 1" in note for note in labels.notes)


def test_tracks_of_cvat_are_labels_of_the_frames_where_they_are_seen(tmp_path: Path) -> None:
    root = ET.Element("annotations")
    track = ET.SubElement(root, "track", label="car")
    for frame, outside in ((3, "0"), (4, "0"), (5, "1")):
        ET.SubElement(track, "box", cvat_box(cars("turned")[0]), frame=str(frame), outside=outside)
    (tmp_path / "l.xml").write_text(ET.tostring(root, "unicode"))
    assert read_labels(tmp_path / "l.xml", VIDEO).frames == ("3", "4")


LAYOUTS = {
    "Ultralytics": ("labels/train", "data.yaml"),
    "Roboflow": ("train/labels", "data.yaml"),
    "flat": (".", "data.yaml"),
    "one up": ("labels", "dataset.yaml"),
    "own name": ("labels/val", "cars.yaml"),
    "CVAT": ("obj_train_data", "obj.names"),
    "labelImg": ("labels", "classes.txt"),
    "Darknet": ("train", "train/_darknet.labels"),
    "Label Studio": ("labels", "notes.json"),
}
NAMES = {
    "yaml list": "names: [bus, car]\n",
    "yaml dict": "names:\n  0: bus\n  1: car\n",
    "yaml text keys": "names: {'0': bus, '1': car}\n",
}


@pytest.mark.parametrize(("layout", "given", "names"), list(product(LAYOUTS, ("labels", "top"), NAMES)))
def test_classes_are_known_by_the_names_of_every_layout(tmp_path: Path, layout: str, given: str, names: str) -> None:
    folder, file = LAYOUTS[layout]
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    (tmp_path / folder / "a.txt").write_text("1 0.5 0.5 0.02 0.04\n" * 2 + "0 0.25 0.5 0.1 0.04\n")
    (tmp_path / "train.txt").write_text("data/obj_train_data/a.png\n")
    text = NAMES[names] if file.endswith("yaml") else "bus\ncar\n"
    if file.endswith(".json"):
        text = json.dumps({"categories": [{"id": 1, "name": "car"}, {"id": 0, "name": "bus"}]})
    (tmp_path / file).write_text(text)
    labels = read_labels(tmp_path if given == "top" else tmp_path / folder, FOLDER)
    assert labels.cars["x_px"].tolist() == [399.5, 399.5]
    assert labels.ignored["x_px"].tolist() == [199.5]
    assert f"classes by {Path(file).name}: cars are car (2); ignored: bus (1)" in labels.notes


def of_labelme(shapes: list[dict[str, object]]) -> str:
    return json.dumps({"imagePath": "a.png", "shapes": shapes})


QUESTIONS = {
    "several numbers without names": ("a.txt", "0 0.5 0.5 0.1 0.1\n1 0.2 0.5 0.1 0.1\n", "without names, expected"),
    "a number beyond the names": ("a.txt", "5 0.5 0.5 0.1 0.1\n", "class 5 in labels, but no name"),
    "names that are numbers": ("a.txt", "0 0.5 0.5 0.1 0.1\n1 0.5 0.2 0.1 0.1\n", "without names, expected"),
    "an angle behind a box": ("a.txt", "0 0.5 0.5 0.1 0.1 -0.7\n", "rotated boxes as four corners"),
    "a fraction as class": ("a.txt", "0.5 0.5 0.5 0.1 0.1\n", "found the class 0.5"),
    "five numbers of a box": (
        "l.json",
        coco("a.png", [{"image_id": 1, "bbox": [5, 5, 9, 9, 30]}]),
        "bbox of 5 numbers",
    ),
    "an angle of unknown unit": (
        "l.json",
        coco("a.png", [{"image_id": 1, "category_id": 3, "bbox": [5, 5, 9, 9], "attributes": {"angle": 1.2}}]),
        "angle 1.2, whose unit",
    ),
    "a category that is not there": (
        "l.json",
        coco("a.png", [{"image_id": 1, "category_id": 4, "bbox": [5, 5, 9, 9]}]),
        "category 4, which is not",
    ),
    "an image of another shape": ("l.json", cvat_coco("a.png", cars("turned")).replace("600", "800"), "not cropped"),
    "augmented copies": (
        "l.json",
        json.dumps(
            json.loads(cvat_coco("a_png.rf.1.jpg", cars("turned")))
            | {"images": [{"id": 1, "file_name": "a_png.rf.1.jpg"}, {"id": 2, "file_name": "a_png.rf.2.jpg"}]}
        ),
        "augmented or repeated",
    ),
    "no finite number": (
        "l.json",
        coco("a.png", [{"image_id": 1, "category_id": 3, "bbox": [5, 5, float("inf"), 9]}]),
        "no finite number",
    ),
    "no JSON": ("l.json", "{", "no JSON"),
    "a list of numbers": ("l.json", "[1, 2]", "JSON of another kind, expected labels of GeoJSON, COCO"),
    "an object of another kind": ("l.json", '{"a": 1}', "JSON of another kind"),
    "an image that is not there": ("l.json", coco("a.png", [{"image_id": 99, "bbox": [1, 1, 2, 2]}]), "with KeyError"),
    "points that are none": ("l.json", of_labelme([{"points": "x"}]), "LabelMe labels with ValueError"),
    "an image of another source": ("l.json", labelme("elsewhere.png", cars("turned")), "no frame of this source has"),
    "no car": ("l.json", of_labelme([{"label": "tree", "points": [[5, 5]]}]), "expected one of cars"),
    "a car outside": ("l.json", of_labelme([{"label": "car", "points": [[900, 5]]}]), "outside the image"),
    "no image": ("l.json", json.dumps({"type": "FeatureCollection", "features": []}), "labels of the images none"),
    "a document type": ("l.xml", "<!DOCTYPE a [<!ENTITY b 'c'>]><annotations/>", "document type"),
}


@pytest.mark.parametrize("question", QUESTIONS)
def test_what_may_be_meant_in_two_ways_is_asked(tmp_path: Path, question: str) -> None:
    name, content, match = QUESTIONS[question]
    (tmp_path / name).write_text(content)
    if question == "a number beyond the names":
        (tmp_path / "classes.txt").write_text("car\n")
    if question == "names that are numbers":
        (tmp_path / "data.yaml").write_text("names: ['0', '1']\n")
    for read in (read_labels, read_detections):
        with pytest.raises(InputError, match=match) as caught:
            read(tmp_path / name, FOLDER)
        assert "\n" not in str(caught.value)
        assert ";" in str(caught.value)


def test_labels_of_a_reduced_image_are_scaled(tmp_path: Path) -> None:
    content = json.loads(cvat_coco("a.png", [(x / 2 - 0.25, y / 2 - 0.25, turn) for x, y, turn in cars("turned")]))
    content["images"][0] |= {"width": 400, "height": 300}
    for one in content["annotations"]:
        x, y, w, h = one["bbox"]
        one["bbox"] = [x + w / 4, y + h / 4, w / 2, h / 2]
    (tmp_path / "l.json").write_text(json.dumps(content))
    labels = read_labels(tmp_path / "l.json", FOLDER)
    assert_are(labels, cars("turned"))
    assert any("scaled to the frames' 800x600" in note for note in labels.notes)
