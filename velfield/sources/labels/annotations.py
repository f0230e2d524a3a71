"""Label files of other programs: COCO, LabelMe, VGG Image Annotator; and GeoJSON in raw pixels.

All but GeoJSON count from the first pixel's outer corner: half a pixel less is ours.
"""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from velfield.errors import InputError
from velfield.sources.frames import SourceInfo
from velfield.sources.labels.boxes import Drawn, Point, boxes_of
from velfield.sources.labels.yolo import Box
from velfield.sources.table import read_text

Parsed = tuple[list[Drawn], list[str]]
"""What is drawn, and every picture that is named, also those on which nothing is."""


def is_annotation_file(path: Path) -> bool:
    """Whether a path is for these readers: JSON, a folder of LabelMe's JSON, or a CSV of VIA."""
    if path.is_dir():
        return not any(path.rglob("*.txt")) and any(path.glob("*.json"))
    if path.suffix.lower() in (".json", ".geojson"):
        return True
    return path.suffix.lower() == ".csv" and "region_shape_attributes" in read_text(path, "labels").split("\n", 1)[0]


def read_annotations(path: Path, info: SourceInfo) -> tuple[list[Box], list[str], list[str]]:
    """Boxes, the frames named, notes for people.

    Raises
    ------
    InputError
        Not JSON, none of the formats, something in it that is not as its format has it, no frame of this source.
    """
    drawn: list[Drawn] = []
    pictures: list[str] = []
    for file in sorted(path.glob("*.json")) if path.is_dir() else [path]:
        more, named = _via_csv(file) if file.suffix.lower() == ".csv" else _parsed(file)
        drawn += more
        pictures += named
    return boxes_of(path, drawn, pictures, info)


def _parsed(path: Path) -> Parsed:
    try:
        content = json.loads(read_text(path, "labels"))
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path.name}: found no JSON ({str(error)[:60]}), expected labels; save it again") from None
    reader = _reader_of(content)
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


def _reader_of(content: Any) -> Callable[[Any], Parsed] | None:
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
    """Points (a car's middle) or polygons (its corners) in raw pixels; the property ``frame`` names the picture."""
    features = content["features"] if content["type"] == "FeatureCollection" else [content]
    drawn, pictures = [], []
    for feature in features:
        properties, geometry = feature.get("properties") or {}, feature.get("geometry")
        frame = str(properties["frame"])
        pictures.append(frame)
        if geometry is None:
            continue
        if geometry["type"] not in ("Point", "Polygon"):
            raise ValueError(f"geometry {geometry['type']}")
        ring = [geometry["coordinates"]] if geometry["type"] == "Point" else geometry["coordinates"][0]
        points = [(float(x), float(y)) for x, y, *_ in ring]
        points = points[:-1] if len(points) > 3 and points[0] == points[-1] else points
        drawn.append(Drawn(frame, str(properties.get("class") or properties.get("label") or ""), points))
    return drawn, pictures


def _coco(content: Any) -> Parsed:
    pictures = {image["id"]: str(image["file_name"]) for image in content["images"]}
    names = {category["id"]: str(category["name"]) for category in content.get("categories") or ()}
    drawn = []
    for one in content["annotations"]:
        outline = one.get("segmentation")
        if isinstance(outline, list) and outline and len(outline[0]) >= 8:
            points = _edge_points(zip(outline[0][::2], outline[0][1::2], strict=True))
        else:
            x, y, w, h = (float(v) for v in one["bbox"])
            points = _edge_points([(x, y), (x + w, y + h)])
        drawn.append(Drawn(pictures[one["image_id"]], names.get(one.get("category_id"), ""), points))
    return drawn, list(pictures.values())


def _labelme(content: Any) -> Parsed:
    picture = str(content["imagePath"])
    drawn = []
    for shape in content["shapes"]:
        points = _edge_points(shape["points"])
        kind = shape.get("shape_type") or "polygon"
        if kind == "circle":
            points = points[:1]
        drawn.append(Drawn(picture, str(shape.get("label") or ""), points))
    return drawn, [picture]


def _via(content: Any) -> Parsed:
    drawn, pictures = [], []
    for entry in content.get("_via_img_metadata", content).values():
        picture = str(entry["filename"])
        pictures.append(picture)
        regions = entry["regions"]
        for region in regions.values() if isinstance(regions, dict) else regions:
            drawn.append(
                Drawn(picture, _via_name(region["region_attributes"]), _via_points(region["shape_attributes"]))
            )
    return drawn, pictures


def _via_csv(path: Path) -> Parsed:
    drawn, pictures = [], []
    try:
        for row in csv.DictReader(read_text(path, "VIA labels").splitlines()):
            pictures.append(row["filename"])
            shape = json.loads(row["region_shape_attributes"] or "{}")
            if shape:
                name = _via_name(json.loads(row.get("region_attributes") or "{}"))
                drawn.append(Drawn(row["filename"], name, _via_points(shape)))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path.name}: found VIA's CSV with {str(error)[:60]!r} in it, expected it as VIA writes it; export again"
        ) from None
    return drawn, pictures


def _via_name(attributes: Any) -> str:
    """The first of a region's attributes that says something; of a checkbox, what is ticked."""
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
        return _edge_points([(x, y), (x + float(shape["width"]), y + float(shape["height"]))])
    if kind in ("polygon", "polyline"):
        return _edge_points(zip(shape["all_points_x"], shape["all_points_y"], strict=True))
    if kind in ("point", "circle", "ellipse"):
        return _edge_points([(shape["cx"], shape["cy"])])
    raise ValueError(f"shape {kind}")


def _edge_points(points: Any) -> list[Point]:
    """Points counted from the first pixel's corner, from its centre."""
    return [(float(x) - 0.5, float(y) - 0.5) for x, y, *_ in points]
