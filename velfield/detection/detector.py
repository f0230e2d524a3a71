"""A trained detector: boosted sums of rectangles with a threshold, read from and written to JSON."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from schemas.detector import DetectorRecord, PrecisionRecallCurve, Round
from velfield.detection.cnn.model import Network, network_from_record
from velfield.errors import InputError

MAX_BYTES = 20_000_000
_SHIPPED = "shipped_detector.json"


@dataclass(frozen=True)
class BoostedSums:
    """Rounds of boosting as arrays, for the kernels.

    Attributes
    ----------
    rectangles
        (r, 5) int32: sign, x0, y0, x1, y1 from the centre.
    starts
        (rounds + 1,) int32: rectangles of round k are ``starts[k]:starts[k + 1]``.
    channels
        (rounds,) int32.
    thresholds, leaves
        (rounds,) and (rounds, 2) float32: what is said at or below, and above.
    """

    rectangles: NDArray[np.int32]
    starts: NDArray[np.int32]
    channels: NDArray[np.int32]
    thresholds: NDArray[np.float32]
    leaves: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.thresholds)


@dataclass(frozen=True)
class Detector:
    """A detector file, in use."""

    record: DetectorRecord

    @property
    def threshold(self) -> float:
        """Threshold T on the response."""
        return self.record.threshold

    @property
    def curve(self) -> PrecisionRecallCurve | None:
        """Precision and recall on cars left out of training."""
        return self.record.curve

    def check_car_length(self, wanted_px: float) -> None:
        """Raise InputError where cars of this length, working px, are not those that it can be continued on."""
        length_px = self.record.working_car_length_px
        if length_px != wanted_px:
            raise InputError(
                f"found a detector of cars of {length_px:g} px to continue, expected {wanted_px:g} px; "
                "set detection.working_car_length_px"
            )

    @cached_property
    def uses_background(self) -> bool:
        """Whether it looks at |frame - background|."""
        return self.record.motion is not None or any(r.channel == 3 for r in self.record.rounds)

    @cached_property
    def network(self) -> Network:
        """The network's weights; only of the method of that name."""
        return network_from_record(self.record.network or {})

    @cached_property
    def sums(self) -> BoostedSums:
        """The rounds as arrays."""
        return sums_of(self.record.rounds)

    @cached_property
    def proposer_sums(self) -> BoostedSums:
        """The rounds of step one as arrays; none for the dense method."""
        return sums_of(self.record.proposer.rounds if self.record.proposer else ())


def sums_of(rounds: Sequence[Round]) -> BoostedSums:
    """Rounds as arrays."""
    table = [(r.sign, r.x0, r.y0, r.x1, r.y1) for one in rounds for r in one.rectangles]
    starts = np.cumsum([0, *(len(one.rectangles) for one in rounds)])
    return BoostedSums(
        rectangles=np.array(table, np.int32).reshape(-1, 5),
        starts=starts.astype(np.int32),
        channels=np.array([one.channel for one in rounds], np.int32),
        thresholds=np.array([one.threshold for one in rounds], np.float32),
        leaves=np.array([(one.below, one.above) for one in rounds], np.float32),
    )


def save_detector(detector: Detector, path: Path) -> None:
    """Write a detector file."""
    path.write_text(detector.record.model_dump_json())


def load_detector(path: Path) -> Detector:
    """Read a detector file.

    Raises
    ------
    InputError
        Not there, too large, not ours, or a number out of range.
    """
    if not path.is_file():
        raise InputError(
            f"{path}: no such detector file; give one that `velfield train` wrote, or leave the option out"
        )
    if path.stat().st_size > MAX_BYTES:
        raise InputError(
            f"{path}: found {path.stat().st_size} bytes, a detector file has {MAX_BYTES} at most; is it ours?"
        )
    return _parsed(path.read_bytes(), str(path))


def _parsed(data: bytes, name: str) -> Detector:
    try:
        return Detector(DetectorRecord.model_validate_json(data))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise InputError(
            f"{name}: {where}: {first['msg'].lower()}; expected a detector file as velfield writes it (detector.json): "
            "make one with `velfield train`"
        ) from None


def shipped_detector() -> Detector:
    """The detector that comes with velfield, for flights with neither labels nor enough motion."""
    resource = files("velfield.detection").joinpath(_SHIPPED)
    return _parsed(resource.read_bytes(), _SHIPPED)
