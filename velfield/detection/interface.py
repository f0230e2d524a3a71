"""Interface of all car detectors, and of their detections.

A detector is trained on labelled images (`Detector.train`), detects cars on images in base orientation, rescaled to a
car's usual length (`Detector.detect`), and is a record that goes into a JSON file (`Detector.save`); by the name of
its method it comes back (`velfield.detection.registry`).
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from schemas.arrays import FloatArray, GreyImage, IntArray, Mask
from schemas.detector import BaseRecord, PrecisionRecallCurve
from velfield.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

    from velfield.detection.samples import LabelledImage


@dataclass(frozen=True)
class Detections:
    """Cars of an image, in no order."""

    xy: FloatArray
    """(n, 2) float64, working px."""
    orientation_rad: FloatArray
    """(n,) axial, [0, pi), from +x towards +y (down)."""
    orientation_sd_rad: FloatArray
    """(n,) its standard deviation."""
    area_px: FloatArray
    """(n,) working px^2."""
    score: FloatArray
    """(n,) above the score threshold."""
    sizes: FloatArray
    """(n, 4) length and width, working px, and the standard deviations of their logarithms; NaN where the detector does
    not measure them."""

    @classmethod
    def from_rows(cls, rows: FloatArray, area_px: FloatArray, sizes: FloatArray | None = None) -> "Detections":
        """Detections from rows (n, 5) of x, y, axis, score, standard deviation of the axis, from areas (n,) and sizes;
        None: not measured."""
        sizes = np.full((len(rows), 4), np.nan) if sizes is None else sizes
        return cls(rows[:, :2], rows[:, 2], rows[:, 4], area_px, rows[:, 3], sizes)

    @classmethod
    def from_all(cls, rows: FloatArray) -> "Detections":
        """Inverse of `to_rows`."""
        return cls.from_rows(rows[:, :5], rows[:, 5], rows[:, 6:10])

    def to_rows(self) -> FloatArray:
        """Rows (n, 10): those of `from_rows`, the area and the sizes."""
        rows = np.empty((len(self), 10))
        self._fill(rows)
        return rows

    def _fill(self, rows: FloatArray) -> None:
        rows[:, :2], rows[:, 2], rows[:, 3] = self.xy, self.orientation_rad, self.score
        rows[:, 4], rows[:, 5], rows[:, 6:] = self.orientation_sd_rad, self.area_px, self.sizes

    def take(self, rows: IntArray) -> "Detections":
        """Some of them, in the order given."""
        of_axis = self.orientation_rad[rows], self.orientation_sd_rad[rows]
        return Detections(self.xy[rows], *of_axis, self.area_px[rows], self.score[rows], self.sizes[rows])

    def shifted(self, x: float, y: float) -> "Detections":
        """Detections of a crop whose first corner is at (x, y), in pixels of the whole image."""
        return replace(self, xy=self.xy + np.array([x, y]))

    def __len__(self) -> int:
        return len(self.score)


def concatenate(parts: Sequence[Detections]) -> Detections:
    """All of several parts, in their order."""
    rows, start = np.empty((sum(map(len, parts)), 10)), 0
    for part in parts:
        part._fill(rows[start : start + len(part)])
        start += len(part)
    return Detections.from_all(rows)


@dataclass(frozen=True)
class Detector(ABC):
    """A trained detector; each method has a class of its own, which narrows `record`."""

    record: BaseRecord
    method: ClassVar[str]
    reads_raw_frames: ClassVar[bool] = False
    """Whether it is run on raw frames (`detect_raw`), at their own resolution, and not on the working grid."""
    context_px: ClassVar[int] = 32
    """Margin around a car that the detector reads, working px on every side: the margin of a crop."""
    box_cost_px: ClassVar[int] = 4000
    """Fixed cost of searching one more crop, as an area."""

    @abstractmethod
    def detect(self, image: GreyImage, valid: Mask | None = None, *, threshold: float | None = None) -> Detections:
        """Detect cars.

        Parameters
        ----------
        image
            (h, w) uint8 on the working grid.
        valid
            (h, w): where the frame covers it; none: everywhere.
        threshold
            Score threshold in place of the detector's own.
        """

    def find(self, image: GreyImage, valid: Mask | None = None, *, threshold: float | None = None) -> Detections:
        """Candidates of a crop that has `context_px` or more on every side: what `refine` makes the detections of."""
        return self.detect(image, valid, threshold=threshold)

    def find_in_crops(
        self,
        image: GreyImage,
        valid: Mask | None,
        crops: IntArray,
        *,
        threshold: float | None = None,
    ) -> Detections:
        """Candidates of an image of crops side by side, each of which has `context_px` or more on every side.

        Each crop is taken by itself; a detector may do better where that changes nothing.

        Parameters
        ----------
        crops
            (n, 4) first row, first column, height and width.
        """
        found = []
        for row, column, height, width in crops.tolist():
            part = np.s_[row : row + height, column : column + width]
            covered = None if valid is None else valid[part]
            found.append(self.find(image[part], covered, threshold=threshold).shifted(column, row))
        return concatenate(found)

    def detect_raw(self, grey: GreyImage, *, threshold: float | None = None) -> "pd.DataFrame":
        """Boxes of cars in a raw frame, of a detector that `reads_raw_frames`.

        Returns
        -------
        The columns of `velfield.sources.labels.labels.RAW_DETECTION_COLUMNS` from ``x_px`` on.
        """
        raise NotImplementedError

    def refine(self, found: Detections, kept: Detections | None = None) -> Detections:
        """Detections of a whole frame from the candidates of its parts.

        Parameters
        ----------
        kept
            Detections that an earlier call gave, which stay unless a candidate is better.
        """
        return found if kept is None else concatenate([found, kept])

    @classmethod
    @abstractmethod
    def train(cls, samples: Sequence["LabelledImage"], config: Any, *, base: "Detector | None" = None) -> "Detector":
        """Train on labelled images.

        Parameters
        ----------
        config
            The section of this method.
        base
            An earlier detector of this method to continue, where the method can.

        Raises
        ------
        InputError
            ``base`` cannot be continued.
        """

    @property
    def threshold(self) -> float:
        """Score threshold."""
        return self.record.threshold

    @property
    def curve(self) -> PrecisionRecallCurve | None:
        """Precision and recall on cars held out of training."""
        return self.record.curve

    @property
    def weak_margin(self) -> float:
        """Candidates that a track can confirm score at most this much below the threshold; 0: no such candidates."""
        return 0.0

    def check_car_length(self, expected_px: float) -> None:
        """Raise InputError if the detector was trained on cars of another length, working px."""
        length_px = self.record.working_car_length_px
        if length_px != expected_px:
            raise InputError(
                f"found a detector of cars of {length_px:g} px to continue, expected {expected_px:g} px; "
                "set detection.working_car_length_px"
            )

    def in_light_of(self, images: Sequence[GreyImage]) -> "Detector":
        """The detector, adjusted if possible to how bright these images (h, w) of the flight are."""
        return self

    def for_flight(self, images: Sequence[GreyImage], config: Any) -> "Detector":
        """The detector, adjusted if possible to images (h, w) of the flight on the working grid; ``config`` is the
        section of its method, or of another."""
        return self

    @property
    def notes(self) -> list[str]:
        """Assumptions made about the detector's file, and what takes longer on this machine; one line each."""
        return []

    @property
    def limitations(self) -> list[str]:
        """Settings of the detector that this machine cannot follow, one line each."""
        return []

    def to_json(self) -> str:
        """The content of its file."""
        return self.record.model_dump_json()

    def save(self, path: Path) -> None:
        """Write a detector file."""
        path.write_text(self.to_json(), encoding="utf-8")
