"""Readers of label files, a row of `READERS` each: by what a file is recognised, and how it is read.

Readers give points with the origin at the first pixel's corner, angles clockwise in the image (from +x towards +y), and
classes by name where the file has names. What a format may hold and is not read, as an angle of unknown unit, is
refused.
"""

import csv
import io
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

from velfield.errors import InputError, parse_json
from velfield.sources.frames import SourceInfo
from velfield.sources.labels.annotation import Parsed, box_points, point_pairs
from velfield.sources.labels.text import read_head, read_text_labels, text_kind
from velfield.sources.table import read_text

SUFFIXES = (".txt", ".json", ".geojson", ".xml", ".csv")
_ANGLE_KEYS = ("angle", "theta", "rotation", "orientation", "rotation_deg", "rbox", "rbbox", "rotated_box", "direction")


class Reader(NamedTuple):
    """A format: its name, whether content is of it, and its reader."""

    name: str
    recognises: Callable[[Any], bool]
    read: Callable[[Any, Parsed], None]


def _has(content: Any, *keys: str) -> bool:
    return isinstance(content, dict) and all(key in content for key in keys)


def _first(content: Any) -> Any:
    return content[0] if isinstance(content, list) and content else None


def _no_angle(content: dict[str, Any], *, read: str = "") -> None:
    """Refuse an angle under a key whose unit and direction the format does not define."""
    for key in _ANGLE_KEYS:
        if key != read and isinstance(value := content.get(key), int | float) and value:
            raise ValueError(f"{key} {value:g}, whose unit and direction are not defined")


def _rotation(attributes: Any) -> float | None:
    """CVAT's and Datumaro's attribute: degrees clockwise about the centre."""
    value = attributes.get("rotation") if isinstance(attributes, dict) else None
    return None if value is None else float(value)


# JSON


def _geojson(content: Any, found: Parsed) -> None:
    """Points (a car's centre) or polygons (its corners) in raw pixels; the property ``frame`` names the image."""
    for feature in content["features"] if content["type"] == "FeatureCollection" else [content]:
        properties, geometry = feature.get("properties") or {}, feature.get("geometry")
        frame = str(properties["frame"])
        found.add(frame)
        if geometry is None:
            continue
        if geometry["type"] not in ("Point", "Polygon"):
            raise ValueError(f"geometry {geometry['type']}")
        ring = [geometry["coordinates"]] if geometry["type"] == "Point" else geometry["coordinates"][0]
        points = [(float(x) + 0.5, float(y) + 0.5) for x, y, *_ in ring]
        points = points[:-1] if len(points) > 3 and points[0] == points[-1] else points
        found.draw(frame, str(properties.get("class") or properties.get("label") or "") or None, points)


def _coco(content: Any, found: Parsed) -> None:
    images = {image["id"]: image for image in content["images"]}
    for image in images.values():
        found.add(str(image["file_name"]), (image.get("width"), image.get("height")))
    names = {category["id"]: str(category["name"]) for category in content.get("categories") or ()}
    for one in content["annotations"]:
        image, number = str(images[one["image_id"]]["file_name"]), one.get("category_id")
        if names and number is not None and number not in names:
            raise ValueError(f"category {number}, which is not in categories")
        _no_angle(one)
        attributes = one.get("attributes") or {}
        rotation = _rotation(attributes)
        _no_angle(attributes, read="rotation")
        outline = one.get("segmentation")
        parts = [part for part in outline if len(part) >= 6] if isinstance(outline, list) else []
        points = [point for part in parts for point in point_pairs(part)]
        if not points or rotation or len(one.get("bbox") or ()) > 4:
            if len(one["bbox"]) != 4:
                raise ValueError(f"bbox of {len(one['bbox'])} numbers")
            points = box_points(*one["bbox"])
        found.draw(image, names.get(number, number), points, rotation if len(points) == 2 else None)


def _labelme(content: Any, found: Parsed) -> None:
    image = str(content["imagePath"])
    found.add(image, (content.get("imageWidth"), content.get("imageHeight")))
    for shape in content["shapes"]:
        kind, points = shape.get("shape_type") or "polygon", [(float(x), float(y)) for x, y, *_ in shape["points"]]
        found.draw(image, str(shape.get("label") or "") or None, points[:1] if kind == "circle" else points)


def _via(content: Any, found: Parsed) -> None:
    for entry in content.get("_via_img_metadata", content).values():
        image = str(entry["filename"])
        found.add(image)
        regions = entry["regions"]
        for region in regions.values() if isinstance(regions, dict) else regions:
            _draw_via(found, image, region["shape_attributes"], region["region_attributes"])


def _draw_via(found: Parsed, image: str, shape: Any, attributes: Any) -> None:
    kind, label = shape["name"], _via_name(attributes)
    _no_angle(shape, read="theta" if kind == "ellipse" else "")
    if kind == "rect":
        found.draw(image, label, box_points(shape["x"], shape["y"], shape["width"], shape["height"]))
    elif kind in ("polygon", "polyline"):
        found.draw(image, label, list(zip(shape["all_points_x"], shape["all_points_y"], strict=True)))
    elif kind == "ellipse" and shape.get("rx") and shape.get("ry"):
        x, y, rx, ry = (float(shape[key]) for key in ("cx", "cy", "rx", "ry"))
        found.draw(image, label, [(x - rx, y - ry), (x + rx, y + ry)], math.degrees(float(shape.get("theta") or 0)))
    elif kind in ("point", "circle", "ellipse"):
        found.draw(image, label, [(shape["cx"], shape["cy"])])
    else:
        raise ValueError(f"shape {kind}")


def _via_name(attributes: Any) -> str | None:
    """The first non-empty attribute of a region; of a checkbox, the ticked option."""
    for value in attributes.values():
        if isinstance(value, dict):
            value = next((key for key, ticked in value.items() if ticked), "")
        if value:
            return str(value)
    return None


def _label_studio(content: Any, found: Parsed) -> None:
    """Per cent of the image, turned clockwise by degrees about the box's first corner, at the top left before."""
    for task in content:
        data = task.get("data", task)
        image = next(str(value) for key, value in data.items() if key in ("image", "img", "ocr", "frame", "url"))
        done = [one for one in task.get("annotations") or task.get("completions") or () if not one.get("was_cancelled")]
        drawn = done[0]["result"] if done else task.get("label") or []
        image = image.split("?d=")[-1]
        found.add(image)
        for one in drawn:
            value = one.get("value", one)
            kind = next((key for key in value if key.endswith("labels") and isinstance(value[key], list)), None)
            if kind is None:
                continue  # a relation, a choice or the shape without its class, which follows
            size = float(one["original_width"]), float(one["original_height"])
            found.add(image, size)
            _draw_percent(found, image, str(value[kind][0]), value, size)


def _draw_percent(found: Parsed, image: str, label: str, value: Any, size: tuple[float, float]) -> None:
    scale_x, scale_y = size[0] / 100, size[1] / 100
    if "points" in value:
        found.draw(image, label, [(x * scale_x, y * scale_y) for x, y in value["points"]])
        return
    x, y, rotation = value["x"] * scale_x, value["y"] * scale_y, float(value.get("rotation") or 0)
    if "radiusX" in value:
        rx, ry = value["radiusX"] * scale_x, value["radiusY"] * scale_y
        found.draw(image, label, [(x - rx, y - ry), (x + rx, y + ry)], rotation)
    elif "height" not in value:
        found.draw(image, label, [(x, y)])
    else:
        w, h, turn = value["width"] * scale_x, value["height"] * scale_y, math.radians(rotation)
        cx = x + w / 2 * math.cos(turn) - h / 2 * math.sin(turn)
        cy = y + w / 2 * math.sin(turn) + h / 2 * math.cos(turn)
        found.draw(image, label, box_points(cx - w / 2, cy - h / 2, w, h), rotation)


def _datumaro(content: Any, found: Parsed) -> None:
    names = [str(one["name"]) for one in content["categories"]["label"]["labels"]]
    for item in content["items"]:
        picture = item.get("image") or {}
        image, size = str(picture.get("path") or item["id"]), picture.get("size")
        found.add(image, (size[1], size[0]) if size else None)
        for one in item["annotations"]:
            kind = one["type"]
            if kind not in ("bbox", "polygon", "points", "rotated_bbox", "polyline"):
                continue
            label = names[one["label_id"]] if one.get("label_id") is not None else None
            if kind == "rotated_bbox":
                x, y, w, h, rotation = (float(one[key]) for key in ("cx", "cy", "w", "h", "r"))
                found.draw(image, label, box_points(x - w / 2, y - h / 2, w, h), rotation)
            elif kind == "bbox":
                found.draw(image, label, box_points(*one["bbox"]), _rotation(one.get("attributes")))
            else:
                found.draw(image, label, point_pairs(one["points"]))


def _supervisely(content: Any, found: Parsed) -> None:
    image = str(content["name"])
    found.add(image, (content["size"]["width"], content["size"]["height"]))
    for one in content["objects"]:
        kind, label = one["geometryType"], str(one["classTitle"])
        if kind not in ("rectangle", "polygon", "point"):
            raise ValueError(f"shape {kind}")
        found.draw(image, label, one["points"]["exterior"])


def _create_ml(content: Any, found: Parsed) -> None:
    for entry in content:
        image = str(entry["image"])
        found.add(image)
        for one in entry["annotations"]:
            x, y, w, h = (float(one["coordinates"][key]) for key in ("x", "y", "width", "height"))
            found.draw(image, str(one["label"]), box_points(x - w / 2, y - h / 2, w, h))


# XML


def _cvat_images(root: Any, found: Parsed) -> None:
    for image in root.iter("image"):
        name = image.attrib["name"]
        found.add(name, (image.get("width"), image.get("height")))
        for shape in image:
            _draw_cvat(found, name, image_label=shape.get("label"), shape=shape)


def _cvat_video(root: Any, found: Parsed) -> None:
    """Tracks; ``frame`` is the video's 0-based index."""
    size = root.find(".//original_size")
    of_video = (size.findtext("width"), size.findtext("height")) if size is not None else None
    for track in root.iter("track"):
        for shape in track:
            if shape.get("outside") != "1":
                name = f"frame_{int(shape.attrib['frame']):06d}"
                found.add(name, of_video)
                _draw_cvat(found, name, track.get("label"), shape)


def _draw_cvat(found: Parsed, image: str, image_label: str | None, shape: Any) -> None:
    kind, get = shape.tag, shape.attrib
    if kind == "box":
        corners = [(get["xtl"], get["ytl"]), (get["xbr"], get["ybr"])]
        found.draw(image, image_label, [(float(x), float(y)) for x, y in corners], float(get.get("rotation") or 0))
    elif kind == "ellipse":
        x, y, rx, ry = (float(get[key]) for key in ("cx", "cy", "rx", "ry"))
        found.draw(image, image_label, [(x - rx, y - ry), (x + rx, y + ry)], float(get.get("rotation") or 0))
    elif kind in ("polygon", "polyline", "points"):
        points = [tuple(map(float, point.split(","))) for point in get["points"].split(";")]
        found.draw(image, image_label, points)
    elif kind == "cuboid":
        raise ValueError("shape cuboid")


def _voc(root: Any, found: Parsed) -> None:
    """Pascal VOC, with roLabelImg's rotated boxes (radians), CVAT's attribute ``rotation`` and Roboflow's corners."""
    image = str(root.findtext("filename"))
    found.add(image, (root.findtext("size/width"), root.findtext("size/height")))
    for one in root.iter("object"):
        label, box, rotated, outline = (one.findtext("name"), *map(one.find, ("bndbox", "robndbox", "polygon")))
        if rotated is not None:
            x, y, w, h, angle = (float(rotated.findtext(key)) for key in ("cx", "cy", "w", "h", "angle"))
            found.draw(image, label, box_points(x - w / 2, y - h / 2, w, h), math.degrees(angle))
        elif outline is not None and outline.find("x1") is not None:
            count = len(outline) // 2
            found.draw(
                image, label, [(outline.findtext(f"x{k}"), outline.findtext(f"y{k}")) for k in range(1, count + 1)]
            )
        else:
            x0, y0, x1, y1 = (float(box.findtext(key)) for key in ("xmin", "ymin", "xmax", "ymax"))
            turns = [a.findtext("value") for a in one.iter("attribute") if a.findtext("name") == "rotation"]
            found.draw(image, label, [(x0, y0), (x1, y1)], float(turns[0]) if turns else None)


_JSON = (
    Reader("GeoJSON", lambda one: _has(one, "type") and one["type"] in ("FeatureCollection", "Feature"), _geojson),
    Reader("COCO", lambda one: _has(one, "annotations", "images"), _coco),
    Reader("LabelMe", lambda one: _has(one, "shapes", "imagePath"), _labelme),
    Reader("Datumaro", lambda one: _has(one, "items", "categories"), _datumaro),
    Reader("Supervisely", lambda one: _has(one, "objects", "size"), _supervisely),
    Reader("CreateML", lambda one: _has(_first(one), "image", "annotations") and "data" not in one[0], _create_ml),
    Reader(
        "Label Studio", lambda one: _has(_first(one), "data") or _has(_first(one), "image", "annotator"), _label_studio
    ),
    Reader("VIA", lambda one: _is_via(one), _via),
)
_XML = (
    Reader("CVAT", lambda root: root.tag == "annotations" and root.find("track") is None, _cvat_images),
    Reader("CVAT", lambda root: root.tag == "annotations", _cvat_video),
    Reader("Pascal VOC", lambda root: root.tag == "annotation" and root.find("filename") is not None, _voc),
)
FORMATS = (
    "a CSV `frame,x_px,y_px[,orientation_rad,length_px,width_px]`; YOLO or DOTA, a .txt an image; COCO, CVAT, "
    "Datumaro, Label Studio, LabelMe, VIA, Pascal VOC, Supervisely; GeoJSON with `frame`, in raw pixels"
)


def _is_via(content: Any) -> bool:
    metadata = content.get("_via_img_metadata", content) if isinstance(content, dict) else None
    first = next(iter(metadata.values()), None) if isinstance(metadata, dict) else None
    return _has(first, "regions", "filename")


# Text


def _via_csv(text: str, found: Parsed) -> None:
    for row in csv.DictReader(io.StringIO(text)):
        found.add(row["filename"])
        shape = parse_json(row["region_shape_attributes"] or "{}")
        if shape:
            _draw_via(found, row["filename"], shape, parse_json(row.get("region_attributes") or "{}"))


def _corner_csv(text: str, found: Parsed) -> None:
    """TensorFlow's and Roboflow's: filename, class and the corners of an upright box."""
    for row in csv.DictReader(io.StringIO(text), skipinitialspace=True):
        found.add(row["filename"], (row.get("width"), row.get("height")) if row.get("width") else None)
        if row.get("xmin"):
            corners = [(row["xmin"], row["ymin"]), (row["xmax"], row["ymax"])]
            found.draw(row["filename"], row.get("class") or row.get("label") or None, corners)  # type: ignore[arg-type]


_CSV = (
    Reader("VIA's CSV", lambda header: "region_shape_attributes" in header, _via_csv),
    Reader("TensorFlow's CSV", lambda header: {"filename", "xmin", "ymax"} <= header, _corner_csv),
)


def _csv_reader(path: Path) -> Reader | None:
    header = {name.strip().strip('"') for name in next(iter(read_head(path)), "").split(",")}
    return next((reader for reader in _CSV if reader.recognises(header)), None)


def is_readable(path: Path) -> bool:
    """Whether a file is of a format of this module by its suffix, or by the header of a CSV."""
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return _csv_reader(path) is not None
    return suffix in (".json", ".geojson", ".xml") or (suffix == ".txt" and text_kind(path) is not None)


def read_file(path: Path, info: SourceInfo, found: Parsed, *, name: str) -> None:
    """Add what a file holds; ``name``: of the image whose labels a .txt holds.

    Raises
    ------
    InputError
        The file has none of the formats, or its content violates the format.
    """
    suffix = path.suffix.lower()
    if suffix == ".txt":
        read_text_labels(path, info, found, name)
        return
    text = read_text(path, "labels")
    reader: Reader | None
    content: Any = text
    if suffix == ".csv":
        reader = _csv_reader(path)
    else:
        content, readers = (_parse_xml(path, text), _XML) if suffix == ".xml" else (_parse_json(path, text), _JSON)
        reader = next((one for one in readers if one.recognises(content)), None)
        if reader is not None and reader.name == "Supervisely":
            content = {**content, "name": name}
    if reader is None:
        kind = "XML" if suffix == ".xml" else "JSON"
        names = ", ".join(dict.fromkeys(one.name for one in (*_JSON, *_XML)))
        raise InputError(f"{path.name}: found {kind} of another kind, expected labels of {names}; convert it to one")
    try:
        reader.read(content, found)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, StopIteration) as error:
        raise InputError(
            f"{path.name}: found {reader.name} labels with {type(error).__name__} {str(error)[:90]!r}, expected "
            f"each as {reader.name} writes it; export it again"
        ) from None


def _parse_json(path: Path, text: str) -> Any:
    try:
        return parse_json(text)
    except ValueError as error:
        raise InputError(f"{path.name}: found no JSON ({str(error)[:60]}), expected labels; save it again") from None


def _parse_xml(path: Path, text: str) -> Any:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path.name}: found XML with a document type, expected labels without one; remove it")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"{path.name}: found no XML ({str(error)[:60]}), expected labels; save it again") from None


def label_files(path: Path) -> Iterator[Path]:
    """Files below a folder that may hold labels, in no order; without hidden ones and lists of names or images."""
    for file in path.rglob("*"):
        name = file.name.lower()
        is_list = file.suffix.lower() == ".txt" and (name.startswith(_NO_LABELS) or file.stem.lower() in _SPLITS)
        if file.suffix.lower() in SUFFIXES and not is_list and name not in _NO_JSON and name[0] != ".":
            yield file


_NO_LABELS = ("classes.", "readme", "license", "source.", "predefined_classes", "requirements")
_SPLITS = ("train", "val", "valid", "test")
_NO_JSON = ("notes.json", "meta.json", "obj_class_to_machine_color.json")
