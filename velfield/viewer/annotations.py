"""Frames to label, and the labels file."""

import csv
import io
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.annotation import MarkedCar, Marks
from schemas.arrays import GreyImage
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
    """Frames to annotate."""

    names: tuple[str, ...]
    """Name of each in labels."""
    width: int
    height: int
    """Size of every frame, px."""
    read: Callable[[int], GreyImage]
    """Returns the k-th as (h, w) uint8, raw pixels."""
    found: tuple[MarkedCar, ...] = ()
    """Vehicles that a run tracks in them: what a frame without labels begins with."""


def frames_to_annotate(path: Path, *, max_frames: int) -> Frames:
    """The one frame of an image, or at most ``max_frames`` frames spread over a run.

    Raises
    ------
    InputError
        It is neither, or the run's images, whose names are needed, no longer exist.
    """
    if RunLayout(path).flight.exists():
        return _frames_of_run(open_run(path), max_frames)
    if path.is_dir() or not path.exists():
        raise InputError(f"{path}: found no run folder and no image, expected one of them; give the file of a frame")
    grey = read_grey_image(path, FramesConfig().max_pixels)
    return Frames((path.name,), grey.shape[1], grey.shape[0], lambda _: grey)


def _frames_of_run(run: Run, max_frames: int) -> Frames:
    store = run.frames
    source = run.frames.column("source_index")
    good = np.flatnonzero((source >= 0) & (run.frames.column("flags") == 0))
    if not len(good):
        raise InputError(f"{run.layout.root}: found no frame without defects, expected some; see the report")
    chosen = good[np.unique(np.linspace(0, len(good) - 1, min(max_frames, len(good))).round().astype(np.int64))]
    names = _names(run)
    height, width = store.shape
    name = {int(frame): names(int(source[frame])) for frame in chosen}
    found = tuple(car for car in _tracked_cars(run, name) if _is_inside(car, width, height))
    return Frames(tuple(name.values()), width, height, lambda k: store.read(int(chosen[k])), found)


def _tracked_cars(run: Run, names: Mapping[int, str]) -> Iterator[MarkedCar]:
    """The vehicles that a run tracks in frames, by their names, and sees there; none before tracks are computed."""
    if not run.layout.unit_files(run.layout.track_positions):
        return
    seen = run.track_positions()
    seen = seen[seen["frame"].isin(list(names)) & (seen["source"] != "interpolated")]
    seen = seen.merge(run.detections()[["detection_id", "orientation_rad"]], on="detection_id")
    sizes = ["length_px", "width_px"]
    seen = seen.merge(run.vehicles()[["track_id", *sizes]], on="track_id")
    seen[sizes] = seen[sizes].fillna(seen[sizes].median())
    for frame, name in names.items():
        rows = seen[seen["frame"] == frame]
        axis = rows["orientation_rad"].to_numpy(np.float64)
        half = np.column_stack([np.cos(axis), np.sin(axis)]) * rows[["length_px"]].to_numpy() / 2
        middle = rows[["x_px", "y_px"]].to_numpy(np.float64)
        ends = run.to_raw(frame, np.concatenate([middle - half, middle + half])).reshape(2, -1, 2)
        ratio = (rows["width_px"] / rows["length_px"]).to_numpy()
        for (x, y), (dx, dy), wide in zip(ends.mean(axis=0), ends[1] - ends[0], ratio, strict=True):
            length = math.hypot(dx, dy)
            if math.isfinite(length * wide):
                yield MarkedCar(
                    frame=name, x_px=x, y_px=y, orientation_rad=math.atan2(dy, dx) % math.pi,
                    length_px=length, width_px=length * wide,
                )  # fmt: skip


def _names(run: Run) -> Callable[[int], str]:
    """Names of the source's frames in labels: a video's index, or an image's file name."""
    source = run.record.inputs.source
    if source.kind == "video":
        return str
    given = run.record.given
    timestamps = Path(given.timestamps) if given and given.timestamps else None
    if not Path(source.path).is_dir():
        raise InputError(
            f"{run.layout.root}: found no images at {source.path}, expected them there; put them back, or "
            "annotate the file of a frame"
        )
    names = probe(Path(source.path), frames=run.record.config.frames, timestamps=timestamps).names
    return lambda index: names[index]


def read_marks(path: Path) -> Marks:
    """The labels in a CSV; empty where there is no file.

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
    """Replace the labels of the marks' frames in the labels file; returns all its labels.

    Raises
    ------
    InputError
        A mark is of another frame, or outside the image.
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
        if not _is_inside(car, frames.width, frames.height) or car.frame not in marks.frames:
            raise InputError(
                f"found a car at ({car.x_px:g}, {car.y_px:g}) of frame {car.frame!r}, expected it within "
                f"{frames.width}x{frames.height} px and its frame among those sent"
            )


def _is_inside(car: MarkedCar, width: int, height: int) -> bool:
    return -0.5 <= car.x_px <= width - 0.5 and -0.5 <= car.y_px <= height - 0.5


def _csv(marks: Marks) -> str:
    """One row a car; one row with the name alone for a frame without cars."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for name in marks.frames:
        cars = [car for car in marks.cars if car.frame == name]
        if not cars:
            writer.writerow([name, "", "", "", "", ""])
        for car in cars:
            lengths = map(_px, (car.length_px, car.width_px))
            writer.writerow([name, _px(car.x_px), _px(car.y_px), _axial(car.orientation_rad), *lengths])
    return out.getvalue()


def _axial(orientation_rad: float | None) -> str:
    if orientation_rad is None:
        return ""
    text = f"{orientation_rad % math.pi:.4f}"
    return "0.0000" if text == "3.1416" else text  # rounded up to pi, which is 0


def _px(length: float | None) -> str:
    return "" if length is None else f"{length:.2f}"
