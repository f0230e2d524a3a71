"""A contact sheet for people: what a detector takes for cars in the pictures that it learnt from, and what not."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from velfield.detection.crops import upright_chips
from velfield.detection.detect import detect_frame
from velfield.detection.detector import Detector
from velfield.detection.evaluation import MATCH_PX, matched
from velfield.detection.samples import LabelledImage

Chips = NDArray[np.uint8]

_COLUMNS, _ZOOM, _HEAD_PX, _MOST = 16, 2, 22, 96
FOUND, MISSED, MARKED_NOT = "marked and found", "marked, not found", "found, not marked"


def taken_for_cars(detector: Detector, samples: Sequence[LabelledImage]) -> dict[str, Chips]:
    """Upright crops (n, 32, 32) of each kind, the surest finds first."""
    kinds: dict[str, list[Chips]] = {FOUND: [], MISSED: [], MARKED_NOT: []}
    for sample in samples:
        found = detect_frame(sample.image, sample.valid, detector, sample.background)
        order = np.argsort(-found.score, kind="stable")
        right = matched(found.xy[order], sample.cars)
        gap = np.hypot(*(sample.cars[:, None, :2] - found.xy[None, :, :2]).transpose(2, 0, 1))
        missed = gap.min(axis=1, initial=np.inf) >= MATCH_PX
        kinds[FOUND].append(found.chips[order][right])
        kinds[MARKED_NOT].append(found.chips[order][~right])
        kinds[MISSED].append(upright_chips(sample.image, sample.cars[missed, :2]))
    return {name: np.concatenate(chips) for name, chips in kinds.items()}


def review_sheet(kinds: Mapping[str, Chips]) -> NDArray[np.uint8]:
    """The sheet (h, w, 3) uint8: under each kind's name and number its first crops."""
    return np.concatenate([_section(name, chips) for name, chips in kinds.items()])


def _section(name: str, chips: Chips) -> NDArray[np.uint8]:
    side = chips.shape[1] * _ZOOM
    head = np.full((_HEAD_PX, _COLUMNS * side, 3), 255, np.uint8)
    cv2.putText(head, f"{name}: {len(chips)}", (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    rows = [head]
    for start in range(0, min(len(chips), _MOST), _COLUMNS):
        row = np.full((side, _COLUMNS * side), 255, np.uint8)
        for k, chip in enumerate(chips[start : start + _COLUMNS]):
            row[:, k * side : (k + 1) * side] = cv2.resize(chip, (side, side), interpolation=cv2.INTER_CUBIC)
        rows.append(np.repeat(row[..., None], 3, axis=2))
    return np.concatenate(rows)
