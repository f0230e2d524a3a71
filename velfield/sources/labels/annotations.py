"""Label files of other programs: COCO, LabelMe, VGG Image Annotator; and GeoJSON in raw pixels.

All but GeoJSON have the origin at the first pixel's corner; ours is its centre, half a pixel less.
"""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

from velfield.errors import InputError, parse_json
from velfield.sources.frames import SourceInfo
from velfield.sources.labels.boxes import Annotation, Point, boxes_from_annotations
from velfield.sources.labels.yolo import Box
from velfield.sources.table import read_text

Parsed = tuple[list[Annotation], list[str]]
"""Annotations, and every image that is named, also those without any."""


def is_annotation_file(path: Path) -> bool:
    """Whether a path is an annotation file: JSON, a folder of LabelMe's JSON, or a CSV of VIA."""
    if path.is_dir():
        return not any(path.rglob("*.txt")) and any(path.glob("*.json"))
    if path.suffix.lower() in (".json", ".geojson"):
        return True
    return path.suffix.lower() == ".csv" and "region_shape_attributes" in read_text(path, "labels").split("\n", 1)[0]


def read_annotations(path: Path, info: SourceInfo) -> tuple[list[Box], list[str], list[str]]:
    """Boxes, the frames that the labels name, notes for the user.

    Raises
    ------
    InputError
        Not JSON, none of the formats, content that violates the format, no frame of this source.
    """
    annotations: list[Annotation] = []
    images: list[str] = []
    for file in sorted(path.glob("*.json")) if path.is_dir() else [path]:
        more, named = _via_csv(file) if file.suffix.lower() == ".csv" else _parse(file)
        annotations += more
        images += named
    return boxes_from_annotations(path, annotations, images, info)


def _parse(path: Path) -> Parsed:
    try:
        content = parse_json(read_text(path, "labels"))
    except ValueError as error:
        raise InputError(f"{path.name}: found no JSON ({str(error)[:60]}), expected labels; save it again") from None
    reader = _find_reader(content)
    if reader is None:
        raise InputError(
            f"{path.name}: found JSON of another kind, expected COCO, LabelMe, VIA or GeoJSON labels; convert it to one"
        )
    try:
        return reader(content)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        what = reader.__name__.strip("_")
        raise InputError(
            f"{path.name}: found {what} labels with {type(error).__name__} {str(error)[:60]!r} in them, expected each "
            f"as {what} writes it; export it again"
        ) from None


def _find_reader(content: Any) -> Callable[[Any], Parsed] | None:
    if not isinstance(content, dict) or not content:
        return None
    if content.get("type") in ("FeatureCollection", "Feature"):
        return _geojson
    if "annotations" in content and "images" in content:
        return _coco
    if "shapes" in content and "imagePath" in content:
        return _labelme
    metadata = content.get("_via_img_metadata", content)
    first = next(iter(metadata.values()), None) if isinstance(metadata, dict) else None
    return _via if isinstance(first, dict) and "regions" in first and "filename" in first else None


def _geojson(content: Any) -> Parsed:
    """Points (a car's centre) or polygons (its corners) in raw pixels; the property ``frame`` names the image."""
    features = content["features"] if content["type"] == "FeatureCollection" else [content]
    annotations, images = [], []
    for feature in features:
        properties, geometry = feature.get("properties") or {}, feature.get("geometry")
        frame = str(properties["frame"])
        images.append(frame)
        if geometry is None:
            continue
        if geometry["type"] not in ("Point", "Polygon"):
            raise ValueError(f"geometry {geometry['type']}")
        ring = [geometry["coordinates"]] if geometry["type"] == "Point" else geometry["coordinates"][0]
        points = [(float(x), float(y)) for x, y, *_ in ring]
        points = points[:-1] if len(points) > 3 and points[0] == points[-1] else points
        annotations.append(Annotation(frame, str(properties.get("class") or properties.get("label") or ""), points))
    return annotations, images


def _coco(content: Any) -> Parsed:
    images = {image["id"]: str(image["file_name"]) for image in content["images"]}
    names = {category["id"]: str(category["name"]) for category in content.get("categories") or ()}
    annotations = []
    for one in content["annotations"]:
        outline = one.get("segmentation")
        if isinstance(outline, list) and outline and len(outline[0]) >= 8:
            points = _from_corner_origin(zip(outline[0][::2], outline[0][1::2], strict=True))
        else:
            x, y, w, h = (float(v) for v in one["bbox"])
            points = _from_corner_origin([(x, y), (x + w, y + h)])
        annotations.append(Annotation(images[one["image_id"]], names.get(one.get("category_id"), ""), points))
    return annotations, list(images.values())


def _labelme(content: Any) -> Parsed:
    image = str(content["imagePath"])
    annotations = []
    for shape in content["shapes"]:
        points = _from_corner_origin(shape["points"])
        kind = shape.get("shape_type") or "polygon"
        if kind == "circle":
            points = points[:1]
        annotations.append(Annotation(image, str(shape.get("label") or ""), points))
    return annotations, [image]


def _via(content: Any) -> Parsed:
    annotations, images = [], []
    for entry in content.get("_via_img_metadata", content).values():
        image = str(entry["filename"])
        images.append(image)
        regions = entry["regions"]
        for region in regions.values() if isinstance(regions, dict) else regions:
            annotations.append(
                Annotation(image, _via_name(region["region_attributes"]), _via_points(region["shape_attributes"]))
            )
    return annotations, images


def _via_csv(path: Path) -> Parsed:
    annotations, images = [], []
    try:
        for row in csv.DictReader(read_text(path, "VIA labels").splitlines()):
            images.append(row["filename"])
            shape = parse_json(row["region_shape_attributes"] or "{}")
            if shape:
                name = _via_name(parse_json(row.get("region_attributes") or "{}"))
                annotations.append(Annotation(row["filename"], name, _via_points(shape)))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path.name}: found VIA's CSV with {str(error)[:60]!r} in it, expected it as VIA writes it; export again"
        ) from None
    return annotations, images


def _via_name(attributes: Any) -> str:
    """The first non-empty attribute of a region; of a checkbox, the ticked option."""
    for value in attributes.values():
        if isinstance(value, dict):
            value = next((key for key, ticked in value.items() if ticked), "")
        if value:
            return str(value)
    return ""


def _via_points(shape: Any) -> list[Point]:
    kind = shape["name"]
    if kind == "rect":
        x, y = float(shape["x"]), float(shape["y"])
        return _from_corner_origin([(x, y), (x + float(shape["width"]), y + float(shape["height"]))])
    if kind in ("polygon", "polyline"):
        return _from_corner_origin(zip(shape["all_points_x"], shape["all_points_y"], strict=True))
    if kind in ("point", "circle", "ellipse"):
        return _from_corner_origin([(shape["cx"], shape["cy"])])
    raise ValueError(f"shape {kind}")


def _from_corner_origin(points: Any) -> list[Point]:
    """Points with the origin at the first pixel's corner, moved to its centre."""
    return [(float(x) - 0.5, float(y) - 0.5) for x, y, *_ in points]
