"""Frames to mark cars on, and the labels file that the marks go to."""

import csv
import io
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.annotation import MarkedCar, Marks
from schemas.flight import FramesConfig
from velfield.errors import InputError
from velfield.run.commits import write_atomically
from velfield.run.layout import RunLayout
from velfield.run.run import Run, open_run
from velfield.sources.images import read_grey_image
from velfield.sources.labels.labels import CSV_COLUMNS
from velfield.sources.source import probe
from velfield.sources.table import finite_cell, read_csv_rows

_OPTIONAL = ("orientation_rad", "length_px", "width_px")


@dataclass(frozen=True)
class Frames:
    """Frames to annotate.

    Attributes
    ----------
    names
        What labels call each.
    width, height
        Size of every frame, px.
    read
        Gives the k-th as (h, w) uint8, raw pixels.
    """

    names: tuple[str, ...]
    width: int
    height: int
    read: Callable[[int], NDArray[np.uint8]]


def frames_to_annotate(place: Path, *, most: int) -> Frames:
    """The frames of an image, or ``most`` frames spread over a run.

    Raises
    ------
    InputError
        It is neither, or the run's images are gone, so that their names are not known.
    """
    if RunLayout(place).flight.exists():
        return _frames_of_run(open_run(place), most)
    if place.is_dir() or not place.exists():
        raise InputError(f"{place}: found no run folder and no image, expected one of them; name a frame's file")
    grey = read_grey_image(place, FramesConfig().max_pixels)
    return Frames((place.name,), grey.shape[1], grey.shape[0], lambda _: grey)


def _frames_of_run(run: Run, most: int) -> Frames:
    store = run.frames
    source = run.frames.column("source_index")
    good = np.flatnonzero((source >= 0) & (run.frames.column("flags") == 0))
    if not len(good):
        raise InputError(f"{run.layout.root}: found no frame without fault, expected some to annotate; see the report")
    chosen = good[np.unique(np.linspace(0, len(good) - 1, min(most, len(good))).round().astype(np.int64))]
    names = _names(run)
    height, width = store.shape
    return Frames(
        tuple(names(int(source[frame])) for frame in chosen), width, height, lambda k: store.read(int(chosen[k]))
    )


def _names(run: Run) -> Callable[[int], str]:
    """What labels call a frame of the source: a video's index, or an image's file name."""
    told = run.record.inputs.source
    if told.kind == "video":
        return str
    given = run.record.given
    timestamps = Path(given.timestamps) if given and given.timestamps else None
    if not Path(told.path).is_dir():
        raise InputError(
            f"{run.layout.root}: its images are not at {told.path}, and labels go by their names; put them back, or "
            "annotate a frame's file"
        )
    names = probe(Path(told.path), frames=run.record.config.frames, timestamps=timestamps).names
    return lambda index: names[index]


def read_marks(path: Path) -> Marks:
    """The labels that stand in a CSV already; none where there is no file.

    Raises
    ------
    InputError
        It is no labels file.
    """
    frames: dict[str, None] = {}
    cars = []
    if path.exists():
        for line, row in read_csv_rows(path, required=("frame", "x_px", "y_px"), optional=_OPTIONAL, what="labels"):
            frames[row["frame"]] = None
            numbers = {name: finite_cell(path, line, row, name) for name in ("x_px", "y_px", *_OPTIONAL)}
            known = {name: value for name, value in numbers.items() if not math.isnan(value)}
            if "x_px" in known and "y_px" in known:
                cars.append(MarkedCar.model_validate({"frame": row["frame"], **known}))
    return Marks(frames=tuple(frames), cars=tuple(cars))


def write_marks(path: Path, marks: Marks, frames: Frames) -> Marks:
    """Put marks in the place of what the labels file said of their frames; returns all that it says now.

    Raises
    ------
    InputError
        A mark is of a frame that was not to be annotated, or stands outside of the image.
    """
    _check(marks, frames)
    before = read_marks(path)
    replaced = {*marks.frames, *marks.cleared}
    kept = [car for car in before.cars if car.frame not in replaced]
    named = [name for name in before.frames if name not in replaced]
    after = Marks(frames=(*named, *marks.frames), cars=(*kept, *marks.cars))
    write_atomically(path, _csv(after).encode())
    return after


def _check(marks: Marks, frames: Frames) -> None:
    for name in (*marks.frames, *marks.cleared, *(car.frame for car in marks.cars)):
        if name not in frames.names:
            raise InputError(f"found marks of frame {name!r}, expected one of {len(frames.names)} frames shown")
    for car in marks.cars:
        inside = -0.5 <= car.x_px <= frames.width - 0.5 and -0.5 <= car.y_px <= frames.height - 0.5
        if not inside or car.frame not in marks.frames:
            raise InputError(
                f"found a car at ({car.x_px:g}, {car.y_px:g}) of frame {car.frame!r}, expected it within "
                f"{frames.width}x{frames.height} px and its frame among those sent"
            )


def _csv(marks: Marks) -> str:
    """A row a car; of a frame without cars a row that names it."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for name in marks.frames:
        writer.writerows(_rows(name, (car for car in marks.cars if car.frame == name)))
    return out.getvalue()


def _rows(frame: str, cars: Iterable[MarkedCar]) -> list[list[str]]:
    rows = [
        [frame, _px(car.x_px), _px(car.y_px), _axial(car.orientation_rad), _px(car.length_px), _px(car.width_px)]
        for car in cars
    ]
    return rows or [[frame, "", "", "", "", ""]]


def _axial(orientation_rad: float | None) -> str:
    if orientation_rad is None:
        return ""
    text = f"{orientation_rad % math.pi:.4f}"
    return "0.0000" if text == "3.1416" else text  # rounded up to pi, which is 0


def _px(length: float | None) -> str:
    return "" if length is None else f"{length:.2f}"
