"""Labels: ground-truth positions of cars in raw frames, annotated by people or other programs."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from schemas.tables import LABEL_COLUMNS
from velfield.errors import InputError
from velfield.sources.frames import SourceInfo, local_path
from velfield.sources.labels.annotations import is_annotation_file, read_annotations
from velfield.sources.labels.yolo import Box, looks_like_yolo, read_yolo
from velfield.sources.table import finite_cell, read_csv_rows

FORMATS = (
    "a CSV `frame,x_px,y_px[,orientation_rad,length_px,width_px]` or GeoJSON with `frame`, in raw pixels; a YOLO "
    "folder, a .txt an image; COCO; LabelMe; VIA"
)
_OPTIONAL = ("orientation_rad", "length_px", "width_px")
CSV_COLUMNS = ("frame", "x_px", "y_px", *_OPTIONAL)
_OTHER_FORMATS = {".xml": "XML", ".jpg": "an image", ".png": "an image", ".zip": "an archive", ".shp": "a shapefile"}


@dataclass(frozen=True)
class Labels:
    """The labels of a source.

    Attributes
    ----------
    cars
        Columns of `schemas.tables.LABEL_COLUMNS`.
    ignored
        The same columns for objects of other classes: neither cars nor background.
    frames
        Every frame that is named, in the source's order, also those without a car; each is fully labelled.
    notes
        One line each, for the user.
    """

    cars: pd.DataFrame
    ignored: pd.DataFrame
    frames: tuple[str, ...]
    notes: tuple[str, ...] = ()


def read_labels(path: Path | str, info: SourceInfo) -> Labels:
    """Read labels of a source's frames.

    Parameters
    ----------
    path
        CSV with the columns ``frame,x_px,y_px[,orientation_rad,length_px,width_px]`` in raw pixels, ``frame`` a
        image's file name or a video's 0-based index in the file; a row with ``x_px`` and ``y_px`` empty names a frame
        without cars. Or a YOLO folder or file, by file stem. Or a file of COCO, LabelMe (or a folder of these), VIA, or
        GeoJSON whose features have the property ``frame`` and raw pixels as coordinates.
    info
        The source.

    Raises
    ------
    InputError
        Another format, a frame that is not there, a label outside the image, no labels at all.
    """
    file = local_path(path, "labels")
    others = is_annotation_file(file)
    if others or looks_like_yolo(file):
        boxes, frames, notes = read_annotations(file, info) if others else read_yolo(file, info)
        _check_inside(file, ((box.frame, box.x_px, box.y_px) for box in boxes), info)
        cars = label_table([box for box in boxes if box.is_car])
        ignored = label_table([box for box in boxes if not box.is_car])
    else:
        _refuse_other_formats(file)
        cars, frames = _read_csv(file, info)
        ignored, notes = label_table([]), []
    if not len(cars):
        raise InputError(
            f"{file.name}: found no cars in {len(frames)} frames, expected labels of cars; reads {FORMATS}"
        )
    named = set(frames)
    return Labels(cars, ignored, tuple(name for name in info.names if name in named), tuple(notes))


def label_table(boxes: Sequence[Box]) -> pd.DataFrame:
    """Boxes as a table of `LABEL_COLUMNS`."""
    columns = {name: [getattr(box, name) for box in boxes] for name in LABEL_COLUMNS}
    return pd.DataFrame(columns).astype(LABEL_COLUMNS)


def _read_csv(path: Path, info: SourceInfo) -> tuple[pd.DataFrame, list[str]]:
    boxes: list[Box] = []
    frames: dict[str, None] = {}
    known = set(info.names)
    for line, row in read_csv_rows(path, required=("frame", "x_px", "y_px"), optional=_OPTIONAL, what="labels"):
        frame = row["frame"]
        if frame not in known:
            raise InputError(
                f"{path.name}: line {line}: found frame {frame!r}, {_expected_frame(info)}; fix line {line}"
            )
        frames[frame] = None
        x, y, orientation, length, width = (finite_cell(path, line, row, name) for name in ("x_px", "y_px", *_OPTIONAL))
        if math.isnan(x) != math.isnan(y):
            raise InputError(
                f"{path.name}: line {line}: found one of x_px and y_px empty, expected both or none; fix line {line}"
            )
        if length <= 0 or width <= 0:
            raise InputError(
                f"{path.name}: line {line}: found a car of {length:g} x {width:g} px, expected both > 0; fix it"
            )
        if not math.isnan(x):
            boxes.append(Box(frame, True, x, y, orientation % math.pi, length, width, math.nan, math.nan))
    _check_inside(path, ((box.frame, box.x_px, box.y_px) for box in boxes), info)
    return label_table(boxes), list(frames)


def _expected_frame(info: SourceInfo) -> str:
    if info.kind == "video":
        return f"expected the video's 0-based frame index, 0 to {info.frame_count - 1}"
    return f"expected an image's file name such as {info.names[0]!r}"


def _check_inside(path: Path, positions: Iterable[tuple[str, float, float]], info: SourceInfo) -> None:
    """Refuse labels outside the image: they were made on an image of another size.

    A label may lie on the edge, half a pixel beyond the last centres.
    """
    outside = [
        (frame, x, y)
        for frame, x, y in positions
        if not (-0.5 <= x <= info.width - 0.5 and -0.5 <= y <= info.height - 0.5)
    ]
    if outside:
        frame, x, y = outside[0]
        raise InputError(
            f"{path.name}: found {len(outside)} labels outside the image (first: frame {frame} at x {x:g}, y "
            f"{y:g}), expected "
            f"raw pixels within {info.width}x{info.height}; label the frames at full size"
        )


def _refuse_other_formats(path: Path) -> None:
    kind = _OTHER_FORMATS.get(path.suffix.lower())
    if kind is not None:
        raise InputError(f"{path.name}: found {kind}, expected {FORMATS}; convert the labels")
    if path.suffix.lower() == ".txt":
        raise InputError(f"{path.name}: found a .txt that is not YOLO, expected {FORMATS}; convert the labels")
