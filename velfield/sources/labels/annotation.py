"""A shape that a program drew on an image, and what a label file holds."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from velfield.sources.labels.classes import Label
from velfield.sources.labels.shapes import Point, rotated_corners


@dataclass(frozen=True)
class Annotation:
    """A shape drawn on an image."""

    image: str
    """The image's name in the file."""
    label: Label
    """Its class."""
    points: Sequence[Point]
    """Px from the first pixel's corner: one, the centre; two, opposite corners of an upright box; more, corners around
    it."""
    rotation_rad: float | None = None
    """Clockwise turn of the two corners' box about its centre; None where the format has none."""
    score: float = math.nan
    """NaN where unknown."""

    def corners(self) -> Sequence[Point]:
        """The points, those of a rotated box as its four corners."""
        if self.rotation_rad is None or len(self.points) != 2:
            return self.points
        (x0, y0), (x1, y1) = self.points
        return rotated_corners((x0 + x1) / 2, (y0 + y1) / 2, abs(x1 - x0), abs(y1 - y0), self.rotation_rad)


@dataclass
class Parsed:
    """Contents of a file: annotations, every image that it names, also those without any, and these images' sizes."""

    annotations: list[Annotation] = field(default_factory=list)
    images: dict[str, tuple[int, int] | None] = field(default_factory=dict)

    def add(self, image: str, size: tuple[Any, Any] | None = None) -> None:
        """Name an image, with its (width, height) where the file has it."""
        known = size is not None and None not in size and float(size[0]) > 0 and float(size[1]) > 0
        self.images[image] = (int(float(size[0])), int(float(size[1]))) if known and size else self.images.get(image)

    def draw(
        self, image: str, label: Label, points: Iterable[Sequence[float]], rotation_deg: float | None = None
    ) -> None:
        """Add a shape."""
        turn = None if rotation_deg is None else math.radians(rotation_deg)
        places = [(float(point[0]), float(point[1])) for point in points]
        if not all(map(math.isfinite, (*(value for place in places for value in place), turn or 0.0))):
            raise ValueError("a position or an angle that is no finite number")
        self.annotations.append(Annotation(image, label, places, turn))


def box_points(x: Any, y: Any, w: Any, h: Any) -> list[Point]:
    """Opposite corners of an upright box by its top left corner and size."""
    x, y, w, h = (float(v) for v in (x, y, w, h))
    return [(x, y), (x + w, y + h)]


def point_pairs(flat: Sequence[Any]) -> list[Point]:
    """Points of x and y in turn."""
    return [(float(x), float(y)) for x, y in zip(flat[::2], flat[1::2], strict=True)]
