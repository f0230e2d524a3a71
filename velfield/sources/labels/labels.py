"""Labels: ground-truth positions of cars in raw frames, annotated by people or other programs; and detections by other
programs, which are in the same formats."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from schemas.tables import LABEL_COLUMNS
from velfield.errors import InputError
from velfield.sources.folder import natural_key
from velfield.sources.frames import SourceInfo, local_path
from velfield.sources.labels.annotation import Annotation, Parsed
from velfield.sources.labels.classes import choose_cars, names_of_numbers
from velfield.sources.labels.formats import FORMATS, SUFFIXES, is_readable, label_files, read_file
from velfield.sources.labels.frame_names import match_frames
from velfield.sources.labels.shapes import CarShape, car_shape, is_upright_rectangle
from velfield.sources.table import finite_cell, read_csv_rows

_OPTIONAL = ("orientation_rad", "length_px", "width_px")
CSV_COLUMNS = ("frame", "x_px", "y_px", *_OPTIONAL)
_MIN_ROTATION_RAD = 1e-3
_SAME_ASPECT = 0.01
_MAX_RAD = 2 * math.pi + 0.01
RAW_DETECTION_COLUMNS: dict[str, str] = {
    "frame": "str",  # its name in labels
    "source_index": "int64",  # its index in SourceInfo
    "x_px": "float64",  # raw pixels
    "y_px": "float64",
    "orientation_rad": "float64",  # axial, raw image; NaN where unknown
    "length_px": "float64",  # NaN where unknown
    "width_px": "float64",
    "abs_box_angle_rad": "float64",  # as of `schemas.tables.LABEL_COLUMNS`
    "score": "float64",  # 1 where unknown
}


@dataclass(frozen=True)
class Box:
    """One labelled object, in raw pixels; NaN where unknown."""

    frame: str
    is_car: bool
    x_px: float
    y_px: float
    orientation_rad: float
    length_px: float
    width_px: float
    abs_box_angle_rad: float
    score: float


@dataclass(frozen=True)
class Labels:
    """The labels of a source."""

    cars: pd.DataFrame
    """Columns of `schemas.tables.LABEL_COLUMNS`."""
    ignored: pd.DataFrame
    """The same columns for objects of other classes: neither cars nor background."""
    frames: tuple[str, ...]
    """Every frame that is named, in the source's order, also those without a car; each is fully labelled."""
    notes: tuple[str, ...] = ()
    """One line each, for the user: which classes are cars, how images were matched with frames."""


def read_labels(path: Path | str, info: SourceInfo) -> Labels:
    """Read labels of a source's frames.

    CSV with the columns ``frame,x_px,y_px[,orientation_rad,length_px,width_px]`` in raw pixels, ``frame`` an image's
    file name or a video's 0-based index in the file; a row with ``x_px`` and ``y_px`` empty names a frame without cars.
    Or a file of another program, or a folder of these (documentation: Label formats).

    Raises
    ------
    InputError
        Another format, a frame that is not there, a label outside the image, no labels at all.
    """
    file = local_path(path, "labels")
    boxes, frames, notes = _read_boxes(file, info, "labels", optional=_OPTIONAL)
    cars = label_table([box for box in boxes if box.is_car])
    if not len(cars):
        raise InputError(
            f"{file.name}: found no cars in {len(frames)} frames, expected labels of cars; reads {FORMATS}"
        )
    named = set(frames)
    ignored = label_table([box for box in boxes if not box.is_car])
    return Labels(cars, ignored, tuple(name for name in info.names if name in named), tuple(notes))


def read_detections(path: Path | str, info: SourceInfo) -> pd.DataFrame:
    """Read another program's detections of a source's frames, used in place of our detector's.

    Formats as for `read_labels`; a CSV may have the column ``score``, and others, which are ignored; a line of YOLO may
    end in a score. Objects that are not cars are left out; frames that have no row have no detections. The table of
    `RAW_DETECTION_COLUMNS` is in order of frames.

    Raises
    ------
    InputError
        As of `read_labels`, or no detections at all.
    """
    file = local_path(path, "detections")
    boxes, _, _ = _read_boxes(file, info, "detections", optional=None)
    index_of = {name: index for index, name in enumerate(info.names)}
    rows = [{**vars(box), "source_index": index_of[box.frame]} for box in boxes if box.is_car]
    if not rows:
        raise InputError(
            f"{file.name}: found no detections, expected {FORMATS}; omit --detections to use velfield's detector"
        )
    table = pd.DataFrame(rows)[list(RAW_DETECTION_COLUMNS)].astype(RAW_DETECTION_COLUMNS).fillna({"score": 1.0})
    return table.sort_values("source_index", kind="stable", ignore_index=True)


def label_table(boxes: Sequence[Box]) -> pd.DataFrame:
    """Boxes as a table of `LABEL_COLUMNS`."""
    columns = {name: [getattr(box, name) for box in boxes] for name in LABEL_COLUMNS}
    return pd.DataFrame(columns).astype(LABEL_COLUMNS)


def _read_boxes(
    path: Path, info: SourceInfo, what: str, *, optional: tuple[str, ...] | None
) -> tuple[list[Box], list[str], list[str]]:
    """Boxes, the frames that are named, notes."""
    if path.is_file() and path.suffix.lower() in (".csv", ".txt") and not is_readable(path):
        boxes, frames = _read_csv(path, info, what, optional)
        notes: list[str] = []
    else:
        boxes, frames, notes = _read_files(path, info, what)
    _check_inside(path, boxes, info, what)
    return boxes, frames, notes


def _read_files(path: Path, info: SourceInfo, what: str) -> tuple[list[Box], list[str], list[str]]:
    files = _files(path, what)
    found = Parsed()
    texts = {file.name: file for file in files if file.suffix.lower() == ".txt"}
    if len(texts) < sum(file.suffix.lower() == ".txt" for file in files):
        twice = Counter(file.name for file in files).most_common(1)[0][0]
        raise InputError(
            f"{path.name}: found {twice} in several folders, expected one a frame; give one of the folders"
        )
    # A file of one image is read only where that is a frame of the source: a folder may hold those of others.
    frame_of, notes = match_frames(texts, info) if texts else ({}, [])
    for file in files:
        if file.name in texts and file.name not in frame_of:
            found.add(file.name)
        else:
            read_file(file, info, found, name=file.name)
    if not texts:
        frame_of, notes = match_frames(found.images, info) if found.images else ({}, [])
    if not frame_of:
        first = repr(next(iter(found.images))) if found.images else "none"
        raise InputError(
            f"{path.name}: found labels of the images {first} and others, but no frame of this source has such a "
            f"name (they are named {info.names[0]!r} and so on); rename them"
        )
    drawn = [one for one in found.annotations if one.image in frame_of]
    names, origin = dict[int, str](), path.name
    if any(isinstance(one.label, int) for one in drawn):
        names, origin = names_of_numbers(path, files) if texts else ({}, path.name)
    cars, more = choose_cars([one.label for one in drawn], names, origin)
    boxes, scaled = _to_boxes(path, drawn, found, frame_of, info, cars)
    unmatched = len(found.images) - len(frame_of)
    lost = [f"{unmatched} labelled images are no frames of this source: not used"] if unmatched else []
    return boxes, list(frame_of.values()), [*more, *notes, *scaled, *lost]


def _files(path: Path, what: str) -> list[Path]:
    """The label files at a path, of one kind, naturally sorted."""
    if path.is_file():
        if path.suffix.lower() not in SUFFIXES:
            kind = f"a {path.suffix or 'nameless'} file"
            raise InputError(f"{path.name}: found {kind}, expected {what}: {FORMATS}; convert the {what}")
        return [path]
    found = [file for file in label_files(path) if file.suffix.lower() != ".csv" or is_readable(file)]
    kinds = sorted({".json" if file.suffix.lower() == ".geojson" else file.suffix.lower() for file in found})
    if len(kinds) > 1:
        raise InputError(
            f"{path.name}: found files of {' and '.join(kinds)}, expected one kind of {what}; give one file"
        )
    if not found:
        raise InputError(
            f"{path.name}: found no .txt, .json or .xml files in the folder, expected {what}; give the folder that "
            "holds them, or a CSV `frame,x_px,y_px`"
        )
    return sorted(found, key=lambda file: natural_key(str(file)))


def _to_boxes(
    path: Path,
    drawn: Sequence[Annotation],
    found: Parsed,
    frame_of: dict[str, str],
    info: SourceInfo,
    cars: set[str | int | None],
) -> tuple[list[Box], list[str]]:
    """Boxes in raw pixels of shapes; notes where they were drawn on resized images."""
    scales = {image: _scale(path, image, found.images.get(image), info) for image in frame_of}
    shapes = [one.corners() for one in drawn]
    # Boxes that the format could turn, and of which none is, were drawn along the image: their axis is not known.
    are_turned = any(abs(one.rotation_rad or 0.0) > _MIN_ROTATION_RAD for one in drawn)
    are_turned |= any(len(points) == 4 and not is_upright_rectangle(points) for points in shapes)
    boxes = []
    for one, points in zip(drawn, shapes, strict=True):
        x_scale, y_scale = scales[one.image]
        points = [(x * x_scale - 0.5, y * y_scale - 0.5) for x, y in points]
        if not are_turned and is_upright_rectangle(points):
            points = [points[0], points[2]]
        x, y, shape = car_shape(points)
        boxes.append(Box(frame_of[one.image], one.label in cars, x, y, *shape, one.score))
    resized = next((found.images[image] for image, scale in scales.items() if scale != (1.0, 1.0)), None)
    return boxes, [
        f"labels drawn on images of {resized[0]}x{resized[1]} are scaled to the frames' {info.width}x{info.height}"
    ] if resized else []


def _scale(path: Path, image: str, size: tuple[int, int] | None, info: SourceInfo) -> tuple[float, float]:
    """Raw px a px of the image that was labelled; one of another aspect may not show the whole frame."""
    if size is None or size == (info.width, info.height):
        return 1.0, 1.0
    x_scale, y_scale = info.width / size[0], info.height / size[1]
    if abs(math.log(x_scale / y_scale)) > _SAME_ASPECT:
        raise InputError(
            f"{path.name}: found labels of {image!r} drawn on an image of {size[0]}x{size[1]}, expected the frames' "
            f"{info.width}x{info.height} or their shape; label frames that are not cropped, padded or stretched"
        )
    return x_scale, y_scale


def _read_csv(path: Path, info: SourceInfo, what: str, optional: tuple[str, ...] | None) -> tuple[list[Box], list[str]]:
    """Boxes and frames of velfield's own CSV; a row without a position names a frame without cars."""
    if path.suffix.lower() == ".txt" and "," not in path.read_text(encoding="utf-8", errors="replace").split("\n")[0]:
        raise InputError(f"{path.name}: found a .txt that is not YOLO or DOTA, expected {FORMATS}; convert the {what}")
    boxes: list[Box] = []
    frames: dict[str, None] = {}
    known = set(info.names)
    for line, row in read_csv_rows(path, required=("frame", "x_px", "y_px"), optional=optional, what=what):
        frame = row["frame"]
        if frame not in known:
            raise InputError(
                f"{path.name}: line {line}: found frame {frame!r}, {_expected_frame(info)}; fix line {line}"
            )
        frames[frame] = None
        x, y, turn, length, width, score = (
            finite_cell(path, line, row, name) for name in ("x_px", "y_px", *_OPTIONAL, "score")
        )
        if math.isnan(x) != math.isnan(y) or (what == "detections" and math.isnan(x)):
            raise InputError(
                f"{path.name}: line {line}: found one of x_px and y_px empty, expected both or none; fix line {line}"
            )
        if length <= 0 or width <= 0:
            raise InputError(
                f"{path.name}: line {line}: found a car of {length:g} x {width:g} px, expected both > 0; fix it"
            )
        if abs(turn) > _MAX_RAD:
            raise InputError(
                f"{path.name}: line {line}: found orientation_rad {turn:g}, expected radians (from +x towards +y, "
                "down); convert degrees"
            )
        if not math.isnan(x):
            boxes.append(Box(frame, True, x, y, *CarShape(turn % math.pi, length, width), score))
    return boxes, list(frames)


def _expected_frame(info: SourceInfo) -> str:
    if info.kind == "video":
        return f"expected the video's 0-based frame index, 0 to {info.frame_count - 1}"
    return f"expected an image's file name such as {info.names[0]!r}"


def _check_inside(path: Path, boxes: Sequence[Box], info: SourceInfo, what: str) -> None:
    """Refuse boxes outside the image: they were made on an image of another size.

    A box's centre may lie on the edge, half a pixel beyond the last pixels' centres.
    """
    outside = [
        box for box in boxes if not (-0.5 <= box.x_px <= info.width - 0.5 and -0.5 <= box.y_px <= info.height - 0.5)
    ]
    if outside:
        first = outside[0]
        raise InputError(
            f"{path.name}: found {len(outside)} {what} outside the image (first: frame {first.frame} at x "
            f"{first.x_px:g}, y {first.y_px:g}), expected raw pixels within {info.width}x{info.height}; label the "
            "frames at full size"
        )
