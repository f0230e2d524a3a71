"""Labels as text, a file an image and a line a car: YOLO (upright, oriented, outlines), DOTA, VisDrone."""

import math
import re
from pathlib import Path

from velfield.errors import InputError
from velfield.sources.frames import SourceInfo
from velfield.sources.labels.annotation import Annotation, Parsed, box_points, point_pairs
from velfield.sources.table import is_number, read_text

_HEAD_BYTES = 4000


def read_head(path: Path) -> list[str]:
    """The first lines of a file, the last of them perhaps cut."""
    with path.open("rb") as file:
        return file.read(_HEAD_BYTES).decode("utf-8-sig", "replace").splitlines()


def text_kind(path: Path) -> str | None:
    """Dialect of a .txt file, by its first line of labels; empty if it has none."""
    lines = (line.strip() for line in read_head(path))
    line = next((one for one in lines if one and not re.match(r"(imagesource|gsd)\s*:", one)), "")
    words = line.split()
    if not line:
        return ""
    if len(words) in (9, 10) and all(map(is_number, words[:8])) and not is_number(words[8]):
        return "DOTA"
    if len(words) >= 5 and all(map(is_number, words)):
        return "YOLO"
    cells = [cell for cell in line.split(",") if cell]
    return "VisDrone" if len(cells) == 8 and all(map(is_number, cells)) else None


_VISDRONE = (
    *("ignored regions", "pedestrian", "people", "bicycle", "car", "van", "truck", "tricycle", "awning-tricycle"),
    *("bus", "motor", "others"),
)


def read_text_labels(path: Path, info: SourceInfo, found: Parsed, image: str) -> None:
    kind = text_kind(path)
    found.add(image)
    for number, line in enumerate(read_text(path, f"{kind or 'YOLO'} labels").splitlines(), 1):
        words = line.split()
        if not words or (kind == "DOTA" and re.match(r"(imagesource|gsd)\s*:", line)):
            continue
        if kind == "DOTA" and len(words) in (9, 10) and all(map(is_number, words[:8])):
            found.draw(image, words[8], point_pairs(words[:8]))
            continue
        cells = [cell.strip() for cell in line.split(",") if cell.strip()]
        if kind == "VisDrone" and len(cells) == 8 and all(map(is_number, cells)) and 0 <= int(cells[5]) <= 11:
            found.draw(image, _VISDRONE[int(cells[5])], box_points(*cells[:4]))
            continue
        if kind in ("DOTA", "VisDrone") or not all(map(is_number, words)) or len(words) not in (5, 6, *range(8, 4000)):
            expected = {"DOTA": "DOTA `x1 y1 ... x4 y4 class difficulty`", "VisDrone": "VisDrone's eight numbers"}.get(
                kind or "",
                "YOLO `class x y width height` or `class x1 y1 x2 y2 x3 y3 x4 y4`, normalised to the image",
            )
            raise InputError(
                f"{path.name}: line {number}: found {line.strip()[:60]!r}, expected {expected}; fix line {number}"
            )
        found.annotations.append(_yolo(path, number, image, [float(word) for word in words], info))


def _yolo(path: Path, line: int, image: str, values: list[float], info: SourceInfo) -> Annotation:
    """A box (class x y w h), corners or an outline (class x1 y1 x2 y2 ...), and a score behind either."""
    place = f"{path.name}: line {line}"
    score = values.pop() if len(values) % 2 == 0 else math.nan
    if not math.isnan(score) and not 0 <= score <= 1:
        raise InputError(
            f"{place}: found {score:g} behind the box, expected a score from 0 to 1; export rotated boxes as "
            "four corners"
        )
    if values[0] != int(values[0]) or values[0] < 0:
        raise InputError(f"{place}: found the class {values[0]:g}, expected a whole number from 0 on; fix line {line}")
    if not all(-0.01 <= value <= 1.01 for value in values[1:]):
        raise InputError(
            f"{place}: found a box at {', '.join(f'{value:g}' for value in values[1:9])}, expected fractions of the "
            "image from 0 to 1; labels in pixels go into a CSV `frame,x_px,y_px`"
        )
    points = [(x * info.width, y * info.height) for x, y in point_pairs(values[1:])]
    if len(points) == 2:
        (x, y), (w, h) = points
        points = box_points(x - w / 2, y - h / 2, w, h)
    return Annotation(image, int(values[0]), points, score=score)
