"""YOLO label files: one an image, by file stem; boxes normalised to the image, upright or oriented."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import yaml

from schemas.model import load_yaml
from velfield.errors import InputError
from velfield.sources.frames import SourceInfo
from velfield.sources.images import natural_key
from velfield.sources.table import read_text

CAR_ASPECT = 0.45
"""Width by length of a typical car: gives the length of a rotated car from its upright box."""
_UPRIGHT_ASPECT = 2.0  # an upright box this long was drawn around a car within some 5 degrees of an axis
_CAR_WORDS = ("car", "vehicle", "auto", "van", "suv", "sedan", "pickup", "taxi")
_NOT_CARS = (
    "truck",
    "bus",
    "train",
    "tram",
    "motor",
    "bicycle",
    "large",
    "trailer",
    "cart",
    "carriage",
    "caravan",
    "cargo",
)
_NO_LABELS = ("classes.txt", "obj.names", "readme.txt", "license.txt", "source.txt")


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


class CarShape(NamedTuple):
    """Orientation and size of the car in a box; NaN where unknown.

    ``abs_box_angle_rad``: |angle| to the image's rows, where the box is upright and the axis therefore ambiguous.
    """

    orientation_rad: float = math.nan
    length_px: float = math.nan
    width_px: float = math.nan
    abs_box_angle_rad: float = math.nan


def looks_like_yolo(path: Path) -> bool:
    """Whether a path is a folder, or a ``.txt`` whose first line is a class and coordinates."""
    if path.is_dir():
        return True
    if path.suffix.lower() != ".txt":
        return False
    words = next((line for line in read_text(path, "labels").splitlines() if line.strip()), "").split()
    return len(words) in (5, 6, 9, 10) and all(_is_number(word) for word in words)


def label_files(path: Path) -> list[Path]:
    """The label files of a folder (or of its ``labels`` folder), or the one file, naturally sorted.

    Raises
    ------
    InputError
        There is none.
    """
    if path.is_file():
        return [path]
    for folder in (path, path / "labels"):
        if folder.is_dir():
            found = [
                file for file in folder.iterdir() if file.suffix.lower() == ".txt" and not file.name.startswith(".")
            ]
            found = [file for file in found if file.name.lower() not in _NO_LABELS]
            if found:
                return sorted(found, key=lambda file: natural_key(file.name))
    raise InputError(
        f"{path.name}: found no .txt files in the labels folder, expected YOLO files named as the images; "
        "give the folder that holds them, or a CSV `frame,x_px,y_px`"
    )


def read_yolo(path: Path, info: SourceInfo) -> tuple[list[Box], list[str], list[str]]:
    """Read YOLO files.

    Parameters
    ----------
    path
        A folder of files ``STEM.txt``, or one such file. STEM is an image's file stem, or a video's frame index.
    info
        The frames that the labels are of; boxes are scaled by their size.

    Returns
    -------
    boxes, the frames named (a file without boxes names a frame without cars), notes for the user.

    Raises
    ------
    InputError
        No file belongs to a frame, a line is not in the format, a box is not of this image.
    """
    by_stem = _frames_by_stem(info)
    files = label_files(path)
    matched = [(file, by_stem[_stem(file, info)]) for file in files if _stem(file, info) in by_stem]
    if not matched:
        raise InputError(
            f"{path.name}: found label files such as {files[0].name!r}, none named as a frame (such as "
            f"{info.names[0]!r}), "
            "expected the image's file stem or the video's 0-based frame index; rename them"
        )
    cars = _car_classes(path)
    boxes = [box for file, frame in matched for box in _read_file(file, frame, info, cars)]
    unmatched = len(files) - len(matched)
    notes = [f"{unmatched} label files name no frame of this source: not used"] if unmatched else []
    return boxes, [frame for _, frame in matched], notes


def _frames_by_stem(info: SourceInfo) -> dict[str, str]:
    stems: dict[str, str] = {}
    for name in info.names:
        stem = name if info.kind == "video" else Path(name).stem
        if stem in stems:
            raise InputError(
                f"found the images {stems[stem]} and {name} of one stem, expected one image a YOLO file; "
                "rename one, or use a CSV `frame,x_px,y_px`"
            )
        stems[stem] = name
    return stems


def _stem(file: Path, info: SourceInfo) -> str:
    return str(int(file.stem)) if info.kind == "video" and file.stem.isdecimal() else file.stem


def _read_file(file: Path, frame: str, info: SourceInfo, cars: set[int]) -> Iterator[Box]:
    for number, line in enumerate(read_text(file, "YOLO labels").splitlines(), 1):
        words = line.split()
        if not words:
            continue
        if len(words) not in (5, 6, 9, 10) or not all(_is_number(word) for word in words):
            raise InputError(
                f"{file.name}: line {number}: found {line.strip()[:60]!r}, expected YOLO `class x y width height` or "
                "`class x1 y1 x2 y2 x3 y3 x4 y4`, normalised to the image; fix line {number}"
            )
        values = [float(word) for word in words]
        _check_normalised(file, number, values[1:5] if len(words) < 9 else values[1:9])
        is_car = int(values[0]) in cars
        score = values[-1] if len(words) in (6, 10) else math.nan
        x, y, shape = _upright_car(values[1:5], info) if len(words) < 9 else _oriented_car(values[1:9], info)
        yield Box(frame, is_car, x, y, *shape, score)


def _check_normalised(file: Path, number: int, values: Sequence[float]) -> None:
    if not all(-0.01 <= value <= 1.01 for value in values):
        raise InputError(
            f"{file.name}: line {number}: found a box at {', '.join(f'{value:g}' for value in values)}, expected "
            "fractions "
            "of the image from 0 to 1; labels in pixels go into a CSV `frame,x_px,y_px`"
        )


def _upright_car(values: Sequence[float], info: SourceInfo) -> tuple[float, float, CarShape]:
    """x, y and shape of an upright box.

    A normalised box runs from 0 to 1 over the image; our origin is the first pixel's centre, half a pixel less.
    """
    x, y = values[0] * info.width - 0.5, values[1] * info.height - 0.5
    w, h = values[2] * info.width, values[3] * info.height
    return x, y, car_in_upright_box(w, h)


def car_in_upright_box(w: float, h: float) -> CarShape:
    """Shape of the car in an upright box."""
    if min(w, h) <= 0:
        return CarShape()
    length = length_from_upright_box(w, h)
    if max(w, h) >= _UPRIGHT_ASPECT * min(w, h):
        return CarShape(0.0 if w > h else math.pi / 2, length, CAR_ASPECT * length)
    return CarShape(length_px=length, width_px=CAR_ASPECT * length, abs_box_angle_rad=tilt_of_upright_box(w, h))


def tilt_of_upright_box(w: float, h: float, *, aspect: float = CAR_ASPECT) -> float:
    """|angle| to the x axis, [0, pi / 2], of a car of a known aspect in an upright box of w x h.

    With c, s >= 0 the cosine and the sine, h (c + r s) = w (s + r c).

    Examples
    --------
    >>> [round(tilt_of_upright_box(w, h), 2) for w, h in ((20.0, 9.0), (9.0, 20.0), (10.0, 10.0))]
    [0.0, 1.57, 0.79]
    """
    tilt = math.atan2(h - aspect * w, w - aspect * h)
    return min(max(tilt, 0.0), math.pi / 2)


def length_from_upright_box(w: float, h: float, *, aspect: float = CAR_ASPECT) -> float:
    """Length of a rotated car of a known aspect in its upright box of w x h, px.

    With L the length, r the aspect, S = |sin 2 theta|: w h = L^2 (r + (1 + r^2) S / 2) and
    w^2 + h^2 = L^2 (1 + r^2 + 2 r S); their quotient gives S, then either gives L.

    Examples
    --------
    >>> round(length_from_upright_box(40.0, 18.0), 3)  # along an axis
    40.0
    >>> side = 40 * (1 + 0.45) / 2**0.5  # at 45 degrees
    >>> round(length_from_upright_box(side, side), 3)
    40.0
    """
    squares = w * w + h * h
    quotient = w * h / squares
    sine = (quotient * (1 + aspect**2) - aspect) / ((1 + aspect**2) / 2 - 2 * aspect * quotient)
    sine = min(max(sine, 0.0), 1.0)
    return math.sqrt(squares / (1 + aspect**2 + 2 * aspect * sine))


def _oriented_car(values: Sequence[float], info: SourceInfo) -> tuple[float, float, CarShape]:
    """x, y and shape of four corners in order around the box."""
    corners = [(values[i] * info.width - 0.5, values[i + 1] * info.height - 0.5) for i in (0, 2, 4, 6)]
    x, y = (sum(corner[axis] for corner in corners) / 4 for axis in (0, 1))
    sides = [_mean_side(corners, 0, 1), _mean_side(corners, 1, 2)]
    lengths = [math.hypot(*side) for side in sides]
    along = 0 if lengths[0] >= lengths[1] else 1
    orientation = math.atan2(sides[along][1], sides[along][0]) % math.pi
    return x, y, CarShape(orientation % math.pi, lengths[along], lengths[1 - along])


def _mean_side(corners: Sequence[tuple[float, float]], first: int, second: int) -> tuple[float, float]:
    """Mean of a side and the one opposite, as a vector."""
    other_first, other_second = (first + 2) % 4, (second + 2) % 4
    dx = corners[second][0] - corners[first][0] - (corners[other_second][0] - corners[other_first][0])
    dy = corners[second][1] - corners[first][1] - (corners[other_second][1] - corners[other_first][1])
    return dx / 2, dy / 2


def _car_classes(path: Path) -> set[int]:
    """Numbers of the classes that are cars: by the names beside the labels, where there are names, else class 0."""
    folder = path if path.is_dir() else path.parent
    for near in (folder, folder.parent):
        for name in ("classes.txt", "obj.names"):
            if (near / name).is_file():
                return car_class_numbers(enumerate(read_text(near / name, "class names").split("\n")), near / name)
        for name in ("data.yaml", "dataset.yaml"):
            if (near / name).is_file():
                return car_class_numbers(_yaml_names(near / name), near / name)
    return {0}


def _yaml_names(path: Path) -> list[tuple[int, str]]:
    try:
        content = load_yaml(read_text(path, "class names"))
        names = content["names"]
        pairs = names.items() if isinstance(names, dict) else enumerate(names)
        return [(int(number), str(name)) for number, name in pairs]
    except (yaml.YAMLError, TypeError, KeyError, ValueError):
        raise InputError(
            f"{path.name}: found no `names` of classes in it, expected YOLO's data file; fix or move it"
        ) from None


def car_class_numbers(names: Iterable[tuple[int, str]], path: Path) -> set[int]:
    """Numbers of the names that are of cars.

    Raises
    ------
    InputError
        None is.
    """
    known = [(number, name.strip().lower()) for number, name in names if name.strip()]
    cars = {
        number
        for number, name in known
        if any(word in name for word in _CAR_WORDS) and not any(word in name for word in _NOT_CARS)
    }
    if not cars:
        listed = ", ".join(name for _, name in known[:8])
        raise InputError(
            f"{path.name}: found the classes {listed}, expected one of cars (car, vehicle, van); name one so"
        )
    return cars


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
