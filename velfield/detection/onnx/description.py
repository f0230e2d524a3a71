"""Inputs and outputs of an ONNX detector, from Ultralytics' metadata or from a small YAML file next to the model."""

import ast
import hashlib
import re
from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import onnx
import yaml
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from schemas.detector import OnnxDescription, OnnxLayout, OnnxRecord
from schemas.model import load_yaml
from velfield.errors import InputError, parse_json

MAX_BYTES = 1 << 30
_VEHICLES = (
    *("car", "van", "truck", "lorry", "bus", "taxi", "pickup", "vehicle", "suv", "minibus", "coach", "automobile"),
    *("small vehicle", "large vehicle", "small car", "light vehicle", "heavy vehicle", "motor vehicle", "freight car"),
)
_NAME_KEYS = ("names", "classes", "class_names", "labels", "categories")
_MAX_CLASSES, _MAX_SUPPRESSED = 10_000, 1000
"""Most classes; most boxes that a network leaves after suppression in the graph."""
_THRESHOLD, _DEFAULT_SIDE_PX, _MIN_SIDE_PX, _MAX_SIDE_PX = 0.25, 640, 32, 8192
_COLUMNS: dict[OnnxLayout, int] = {
    "boxes": 4,
    "oriented_boxes": 5,
    "boxes_with_objectness": 5,
    "end_to_end": 6,
    "end_to_end_oriented": 7,
}
"""Numbers for each box, without the scores of its classes."""
_ASK = "describe it in a YAML file of the same name next to it (documentation: Another detector)"


def describe_model(path: Path) -> OnnxRecord:
    """The record of a model file.

    Parameters
    ----------
    path
        The ``.onnx`` file; a ``.yaml`` of its name beside it wins over its metadata.

    Raises
    ------
    InputError
        Not an ONNX model, not one image in and one array of boxes out, or no class that is a vehicle.
    """
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"{path.name}: found {path.stat().st_size >> 20} MiB, expected 1 GiB at most")
    try:
        model = onnx.load(str(path), load_external_data=False)
        inputs = [one for one in model.graph.input if one.name not in {each.name for each in model.graph.initializer}]
        image, boxes = inputs[0], model.graph.output[0]
        files = sorted({entry.value for one in _tensors(model.graph) for entry in one.external_data})
    except Exception as error:  # protobuf's own, and whatever a damaged graph lacks
        raise InputError(
            f"{path.name}: this is no ONNX model ({type(error).__name__}), expected one; export it"
        ) from None
    if files:
        raise InputError(
            f"{path.name}: found weights in other files ({', '.join(files)[:160]}), expected all in the model; "
            "export it without external data"
        )
    if len(inputs) > 1:
        raise InputError(f"{path.name}: found {len(inputs)} inputs, expected one, the image; export it again")
    given = _read_yaml(path.with_suffix(".yaml"))
    metadata = {one.key: one.value for one in model.metadata_props}
    names = given.classes or _class_names(metadata)
    layout = given.layout or _layout(path, metadata, _sizes(boxes), names)
    vehicles = _vehicles(path, names) if given.vehicles is None else _given_vehicles(path, given.vehicles, names)
    check_output(path.name, _sizes(boxes), layout, names, vehicles)
    return OnnxRecord(
        working_car_length_px=16.0,
        threshold=_THRESHOLD if given.threshold is None else given.threshold,
        path=str(path.resolve()),
        digest=hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest(),
        layout=layout,
        classes=names,
        vehicles=vehicles,
        tile_px=_tile(path, given, metadata, _sizes(image)),
    )


def check_output(
    name: str, sizes: tuple[int | None, ...], layout: OnnxLayout, classes: tuple[str, ...], vehicles: tuple[int, ...]
) -> None:
    """Refuse an output that is not of a layout: its columns would be read as others, without an error.

    Parameters
    ----------
    name
        Name of the model, for the message.
    sizes
        Sizes of the output, (1, ...); None where the model leaves one open.
    layout, classes, vehicles
        As in `OnnxRecord`.

    Raises
    ------
    InputError
        Another number of dimensions, or of rows or columns.
    """
    extra = _COLUMNS[layout]
    axis = 1 if layout in ("boxes", "oriented_boxes") else 2
    if layout.startswith("end_to_end"):
        least, most, expected = extra, extra, str(extra)
    elif classes:
        least = most = extra + len(classes)
        expected = f"{extra} + {len(classes)} classes"
    else:  # they may be left out, where the numbers of the vehicles are given
        least, most = extra + max(vehicles) + 1, None
        expected = f"{least} or more"
    size = sizes[axis] if len(sizes) == 3 else 0
    if size is not None and (size < least or (most is not None and size > most)):
        wanted = f"(1, {expected}, n)" if axis == 1 else f"(1, n, {expected})"
        raise InputError(
            f"{name}: found an output of {sizes}, expected {wanted} of the layout {layout}; give its layout and all "
            "its classes in a YAML file of the same name next to it (documentation: Another detector)"
        )


def _tensors(graph: onnx.GraphProto) -> Iterator[onnx.TensorProto]:
    """All constant tensors of a graph and of the graphs within it."""
    yield from graph.initializer
    for sparse in graph.sparse_initializer:
        yield from (sparse.values, sparse.indices)
    for attribute in (one for node in graph.node for one in node.attribute):
        yield from (attribute.t, *attribute.tensors)
        for inner in (attribute.g, *attribute.graphs):
            if inner.node or inner.initializer:
                yield from _tensors(inner)


def _read_yaml(path: Path) -> OnnxDescription:
    if not path.is_file():
        return OnnxDescription()
    try:
        return OnnxDescription.model_validate(load_yaml(path.read_text(encoding="utf-8")) or {})
    except ValidationError as error:
        faults = "; ".join(_fault(one) for one in error.errors())
        keys = ", ".join(OnnxDescription.model_fields)
        raise InputError(f"{path.name}: {faults}; expected the keys {keys}; fix them") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        place = "" if mark is None else f" at line {mark.line + 1}"
        raise InputError(f"{path.name}: this is not YAML{place}, expected a description of the model; fix it") from None


def _fault(error: ErrorDetails) -> str:
    place, problem = ".".join(map(str, error["loc"])) or "the file", error["msg"]
    if error["type"] == "extra_forbidden":
        close = get_close_matches(place, list(OnnxDescription.model_fields), n=1, cutoff=0.5)
        return f"{place}: no such key" + (f", did you mean {close[0]!r}?" if close else "")
    if error["loc"][:1] == ("vehicles",) and error["type"].startswith("int"):
        return f"{place}: found {str(error['input'])[:40]!r}, expected the number of a class, the first is 0"
    return f"{place}: {problem[:1].lower()}{problem[1:]}"


def _class_names(metadata: dict[str, str]) -> tuple[str, ...]:
    """Names in order of their numbers: a dictionary or a list, as JSON or Python writes them, or one name a line.

    Examples
    --------
    >>> _class_names({"names": '{"0": "bus", "10": "van", "2": "car"}'})[:3]
    ('bus', '', 'car')
    """
    text = next((metadata[key] for key in _NAME_KEYS if metadata.get(key, "").strip()), "")
    names: Any = None
    for parse in (parse_json, ast.literal_eval):
        try:
            names = parse(text)
            break
        except (ValueError, SyntaxError, MemoryError, RecursionError):
            continue
    if isinstance(names, dict):
        numbers = _numbers(names)
        return tuple(numbers.get(number, "") for number in range(max(numbers, default=-1) + 1))
    if isinstance(names, list | tuple):
        return tuple(map(str, names))
    lines = [name.strip() for name in re.split(r"[\n,;]", text)]
    return tuple(lines) if any(lines) and not re.search(r"[{}\[\]]", text) else ()


def _numbers(names: dict[Any, Any]) -> dict[int, str]:
    """Names by number; those of a dictionary that goes from names to numbers too. Empty where neither is so."""
    for pairs in (names.items(), ((value, key) for key, value in names.items())):
        try:
            found = {int(number): str(name) for number, name in pairs}
        except (TypeError, ValueError):
            continue
        return found if found and min(found) >= 0 and max(found) < _MAX_CLASSES else {}
    return {}


def _sizes(value: Any) -> tuple[int | None, ...]:
    return tuple(one.dim_value or None for one in value.type.tensor_type.shape.dim)


def _layout(path: Path, metadata: dict[str, str], sizes: tuple[int | None, ...], names: tuple[str, ...]) -> OnnxLayout:
    """By the task that Ultralytics names, and the size of the output: (1, channels, boxes) or (1, boxes, columns)."""
    task = metadata.get("task", "detect" if names else "")
    if task not in ("detect", "obb") or len(sizes) != 3:
        found = f"the task {task!r}" if task else "no metadata"
        raise InputError(f"{path.name}: found {found} and an output of {sizes}, expected a detector's; {_ASK}")
    oriented = task == "obb"
    box = 4 + oriented
    possible: list[OnnxLayout] = []
    if sizes[1] == box + len(names):
        possible.append("oriented_boxes" if oriented else "boxes")
    if sizes[2] == 5 + len(names) and not oriented:
        possible.append("boxes_with_objectness")
    if sizes[2] == 6 + oriented:
        possible.append("end_to_end_oriented" if oriented else "end_to_end")
    # Six columns may also be those of one or two classes: after suppression in the graph few boxes are left.
    is_end = metadata.get("end2end") == "True" or "'nms': True" in metadata.get("args", "")
    if not is_end and sizes[2] == 6 + oriented and len(names) <= 2:
        is_end = sizes[1] is not None and sizes[1] <= _MAX_SUPPRESSED
        possible = [one for one in possible if one.startswith("end") == is_end and sizes[1] is not None]
    elif is_end:
        possible = [one for one in possible if one.startswith("end")]
    if len(possible) != 1:
        raise InputError(f"{path.name}: found an output of {sizes} for {len(names)} classes, expected boxes; {_ASK}")
    return possible[0]


def _vehicles(path: Path, names: tuple[str, ...]) -> tuple[int, ...]:
    plain = [name.lower().replace("-", " ").replace("_", " ").strip() for name in names]
    found = tuple(index for index, name in enumerate(plain) if {name, name.removesuffix("s")} & {*_VEHICLES})
    if not found:
        raise InputError(
            f"{path.name}: found the classes {', '.join(names)[:120] or 'unnamed'}, expected one that is a vehicle; "
            "list their numbers as `vehicles: [...]` in a YAML file of the same name next to it"
        )
    return found


def _given_vehicles(path: Path, vehicles: tuple[int, ...], names: tuple[str, ...]) -> tuple[int, ...]:
    """The vehicle classes of the YAML file, checked: numbers of no class would silently match no box."""
    highest = len(names) - 1 if names else None
    wrong = [one for one in vehicles if one < 0 or (highest is not None and one > highest)]
    if wrong or not vehicles:
        found = ", ".join(map(str, wrong)) if wrong else "none"
        expected = "numbers from 0 on" if highest is None else f"numbers from 0 to {highest} ({', '.join(names)[:120]})"
        raise InputError(
            f"{path.with_suffix('.yaml').name}: found vehicles: {found}, expected {expected}; correct them"
        )
    return vehicles


def _tile(
    path: Path, given: OnnxDescription, metadata: dict[str, str], sizes: tuple[int | None, ...]
) -> tuple[int, int]:
    """Width and height of the network's input, px."""
    if len(sizes) != 4:
        raise InputError(f"{path.name}: found an input of {len(sizes)} dimensions, expected an image (1, 3, h, w)")
    if sizes[3] in (1, 3) and sizes[1] not in (1, 3):
        raise InputError(
            f"{path.name}: found an input of {sizes}, expected an image (1, 3, h, w); export it with channels first"
        )
    width, height = sizes[3], sizes[2]
    if not width or not height:
        width = height = given.image_size_px or _side(metadata)
    if not _MIN_SIDE_PX <= min(width, height) <= max(width, height) <= _MAX_SIDE_PX:
        raise InputError(
            f"{path.name}: found an input of {width} x {height} px, expected {_MIN_SIDE_PX} to {_MAX_SIDE_PX} a side; "
            "export it for tiles of that size"
        )
    return width, height


def _side(metadata: dict[str, str]) -> int:
    """By Ultralytics' metadata, where it is there."""
    try:
        size = ast.literal_eval(metadata.get("imgsz", str(_DEFAULT_SIDE_PX)))
        return int(max(size) if isinstance(size, list | tuple) else size)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return _DEFAULT_SIDE_PX
