"""External detections: cars detected by another program in raw frames, used in place of our detector's."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from velfield.errors import InputError
from velfield.sources.frames import SourceInfo, local_path
from velfield.sources.labels.yolo import looks_like_yolo, read_yolo
from velfield.sources.table import finite_cell, read_csv_rows

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
FORMATS = "a CSV `frame,x_px,y_px[,orientation_rad,length_px,width_px,score]` in raw pixels, or a YOLO folder"
_OPTIONAL = ("orientation_rad", "length_px", "width_px", "score")


def read_detections(path: Path | str, info: SourceInfo) -> pd.DataFrame:
    """Read detections of a source's frames.

    Parameters
    ----------
    path
        CSV with ``frame,x_px,y_px`` and the optional columns; others are ignored. Or a YOLO folder,
        whose files may hold a score as the last number of a line.
    info
        The source. Frames that have no row have no detections.

    Returns
    -------
    DataFrame of `RAW_DETECTION_COLUMNS`, in order of frames. A detection outside the image is an error.

    Raises
    ------
    InputError
        Another format, a frame that is not there, no detections at all, one outside the image.
    """
    file = local_path(path, "detections")
    table = _from_yolo(file, info) if looks_like_yolo(file) else _from_csv(file, info)
    if table.empty:
        raise InputError(
            f"{file.name}: found no detections, expected {FORMATS}; leave --detections out to use velfield's detector"
        )
    x, y = table["x_px"].to_numpy(), table["y_px"].to_numpy()
    inside = (x >= -0.5) & (x <= info.width - 0.5) & (y >= -0.5) & (y <= info.height - 0.5)
    if not inside.all():
        first = table.iloc[int(np.argmin(inside))]
        raise InputError(
            f"{file.name}: found {np.count_nonzero(~inside)} detections outside the image (first: frame "
            f"{first['frame']} at "
            f"x {first['x_px']:g}, y {first['y_px']:g}), expected raw pixels within {info.width}x{info.height}; "
            "detect on the frames at full size"
        )
    return table.sort_values("source_index", kind="stable", ignore_index=True)


def _from_yolo(path: Path, info: SourceInfo) -> pd.DataFrame:
    boxes, _, _ = read_yolo(path, info)
    index_of = {name: index for index, name in enumerate(info.names)}
    return _table(
        [
            (
                box.frame,
                index_of[box.frame],
                box.x_px,
                box.y_px,
                box.orientation_rad,
                box.length_px,
                box.width_px,
                box.abs_box_angle_rad,
                box.score,
            )
            for box in boxes
            if box.is_car
        ]
    )


def _from_csv(path: Path, info: SourceInfo) -> pd.DataFrame:
    if path.suffix.lower() not in (".csv", ".txt"):
        raise InputError(f"{path.name}: found a {path.suffix or 'nameless'} file, expected {FORMATS}; convert it")
    index_of = {name: index for index, name in enumerate(info.names)}
    rows = []
    for line, row in read_csv_rows(path, required=("frame", "x_px", "y_px"), what="detections"):
        if row["frame"] not in index_of:
            raise InputError(
                f"{path.name}: line {line}: found frame {row['frame']!r}, expected a frame such as {info.names[0]!r}; "
                f"fix line {line}"
            )
        x, y, orientation, length, width, score = (
            finite_cell(path, line, row, name) for name in ("x_px", "y_px", *_OPTIONAL)
        )
        if math.isnan(x) or math.isnan(y):
            raise InputError(f"{path.name}: line {line}: found x_px or y_px empty, expected both; fix line {line}")
        rows.append((row["frame"], index_of[row["frame"]], x, y, orientation % math.pi, length, width, math.nan, score))
    return _table(rows)


def _table(rows: Sequence[tuple[object, ...]]) -> pd.DataFrame:
    table = pd.DataFrame(rows, columns=list(RAW_DETECTION_COLUMNS)).astype(RAW_DETECTION_COLUMNS)
    table["score"] = table["score"].fillna(1.0)
    return table
