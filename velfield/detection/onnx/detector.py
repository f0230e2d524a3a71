"""A YOLO-type network in an ONNX file in the place of our detector: raw frames in tiles, boxes or oriented boxes out.

It is run on raw frames at their own resolution, as it was trained on such; its boxes then go the way of another
program's (`--detections`). Frames are grey, so that its three channels are equal.
"""

import hashlib
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import onnxruntime as ort
import pandas as pd

from schemas.arrays import GreyImage, Mask
from schemas.detector import OnnxRecord
from velfield.detection.interface import Detections, Detector
from velfield.detection.onnx.boxes import Boxes, cut_tile, decode, suppress, tile_corners, whole_in_tile
from velfield.detection.onnx.description import check_output, describe_model
from velfield.detection.orientation import fill_missing_orientation
from velfield.detection.runtime import current_device, device_limitations, open_session
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError

_AXIS_SD_RAD = 0.1
_FRACTION = 1.5
"""Boxes in fractions of the input end below this, those beyond its edge too; in pixels no vehicle is as small."""
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


@dataclass(frozen=True)
class OnnxDetector(Detector):
    """A network of another maker's."""

    record: OnnxRecord
    method: ClassVar[str] = "onnx"
    reads_raw_frames: ClassVar[bool] = True

    @classmethod
    def from_file(cls, path: Path) -> "OnnxDetector":
        """The detector in an ``.onnx`` file: see `describe_model`."""
        detector = cls(describe_model(path))
        _ = detector.session  # an operator that is not known shows now, not after registration
        return detector

    @cached_property
    def session(self) -> ort.InferenceSession:
        """The network in onnxruntime, on the device of `use_device`."""
        path = Path(self.record.path)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: the detector's model is gone ({error.strerror}); put it back") from None
        if hashlib.blake2b(data, digest_size=16).hexdigest() != self.record.digest:
            raise InputError(f"{path}: the model has changed since the run began; restore it, or start a new run")
        try:
            return open_session(data, current_device())
        except InputError:
            raise
        except Exception as error:  # onnxruntime's own kinds have no common base
            raise self._refusal(error) from None

    @property
    def limitations(self) -> list[str]:
        """One line if the GPU does not start."""
        return device_limitations(current_device())

    @property
    def notes(self) -> list[str]:
        """One line that says which classes count as vehicles, if the classes have names."""
        classes, vehicles = self.record.classes, self.record.vehicles
        used = ", ".join(classes[number] for number in vehicles) if classes else ""
        left = ", ".join(name for number, name in enumerate(classes) if name and number not in vehicles)
        ignored = f"; ignored: {textwrap.shorten(left, 120, placeholder=' ...')}" if left else ""
        return [f"classes of {Path(self.record.path).name}: vehicles are {used}{ignored}"] if classes else []

    def __getstate__(self) -> dict[str, Any]:
        """Without the session, which no other process can use."""
        return {name: value for name, value in self.__dict__.items() if name != "session"}

    def boxes(self, grey: GreyImage, threshold: float | None = None) -> Boxes:
        """Boxes of vehicles in an image (h, w) uint8, px of the image."""
        min_score, tile_px = self.threshold if threshold is None else threshold, self.record.tile_px
        shape = (grey.shape[0], grey.shape[1])
        parts = []
        for corner in tile_corners(shape, tile_px):
            found = decode(
                self._run(cut_tile(grey, corner, tile_px)), self.record.layout, self.record.vehicles, min_score
            )
            self._check_unit(found)
            whole = found.take(whole_in_tile(found, corner, tile_px, shape))
            parts.append(Boxes(whole.xy + np.array(corner), whole.size, whole.angle_rad, whole.score))
        joined = suppress(Boxes.join(parts), min_score)
        inside = (joined.xy >= 0).all(axis=1) & (joined.xy <= np.array(shape[::-1]) - 1).all(axis=1)
        return joined.take(np.flatnonzero(inside))

    def _run(self, tile: GreyImage) -> np.ndarray:
        image = self.session.get_inputs()[0]
        kind = _TYPES.get(image.type)
        if kind is None:
            raise InputError(f"{Path(self.record.path).name}: found an input of {image.type}, expected float or uint8")
        channels = image.shape[1] if isinstance(image.shape[1], int) else 3
        values = tile if kind is np.uint8 else tile.astype(kind) / kind(255)
        batch = np.ascontiguousarray(np.broadcast_to(values, (1, channels, *tile.shape)))
        try:
            output: np.ndarray = self.session.run(None, {image.name: batch})[0]
        except Exception as error:  # as above
            raise self._refusal(error, f" on a tile of {tile.shape[1]} x {tile.shape[0]} px") from None
        record = self.record  # sizes that the model leaves open are known only now
        check_output(Path(record.path).name, output.shape, record.layout, record.classes, record.vehicles)
        first: np.ndarray = output[0]
        return first

    def _check_unit(self, found: Boxes) -> None:
        """Refuse boxes in fractions of the input: each would lie in a tile's first corner."""
        size = found.size.max(initial=0.0)  # 0 of rows that only fill an output up
        if 0 < size <= _FRACTION and np.abs(found.xy).max() <= _FRACTION:
            name = Path(self.record.path).name
            raise InputError(
                f"{name}: found boxes within {_FRACTION:g} px of the input's corner, like "
                "fractions of its sides, expected pixels; multiply them by its width and height in the graph"
            )

    def _refusal(self, error: Exception, where: str = "") -> InputError:
        first = str(error).splitlines()[0][:160]
        name = Path(self.record.path).name
        return InputError(f"{name}: onnxruntime cannot run this model{where} ({first}); export it again")

    def detect_raw(self, grey: GreyImage, *, threshold: float | None = None) -> pd.DataFrame:
        """Boxes in a raw frame: see `Detector.detect_raw`."""
        found = self.boxes(grey, threshold)
        oriented = "oriented" in self.record.layout
        length, width = found.size.max(axis=1, initial=0.0), found.size.min(axis=1, initial=np.inf)
        along = found.angle_rad + np.where(found.size[:, 0] >= found.size[:, 1], 0.0, np.pi / 2)
        unknown = np.full(len(found), np.nan)
        return pd.DataFrame(
            {
                "x_px": found.xy[:, 0] - 0.5,  # their pixels begin at 0, ours are centred there
                "y_px": found.xy[:, 1] - 0.5,
                "orientation_rad": np.mod(along, np.pi) if oriented else unknown,
                "length_px": length if oriented else unknown,
                "width_px": width if oriented else unknown,
                "abs_box_angle_rad": unknown if oriented else np.arctan2(found.size[:, 1], found.size[:, 0]),
                "score": found.score,
            }
        )

    def detect(self, image: GreyImage, valid: Mask | None = None, *, threshold: float | None = None) -> Detections:
        """Detect cars in any image; orientations that upright boxes lack are estimated."""
        table = self.detect_raw(image, threshold=threshold)
        boxes = np.column_stack([table[["x_px", "y_px", "orientation_rad"]], np.full((len(table), 2), np.nan)])
        axis = fill_missing_orientation(image, boxes)[:, 2]
        area = table["length_px"] * table["width_px"]
        usual = self.record.working_car_length_px**2 / 2
        rows = np.column_stack([boxes[:, :2], np.mod(axis, np.pi), table["score"], np.full(len(table), _AXIS_SD_RAD)])
        return Detections.from_rows(rows, area.fillna(usual).to_numpy(np.float64))

    @classmethod
    def train(cls, samples: Sequence[LabelledImage], config: Any, *, base: Detector | None = None) -> Detector:
        """It cannot be trained here: raises InputError."""
        raise InputError(
            "found an ONNX detector to train, expected a detector of velfield; train it with the program that made it"
        )


DETECTOR = OnnxDetector
