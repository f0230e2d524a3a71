"""A contact sheet for people: true positives, missed cars and false positives of a detector on its training images."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from schemas.arrays import ByteArray, GreyImage
from velfield.detection.crops import upright_chips
from velfield.detection.detect import detect_frame
from velfield.detection.evaluation import MATCH_PX, match_greedy
from velfield.detection.interface import Detector
from velfield.detection.samples import LabelledImage

_COLUMNS, _ZOOM, _HEAD_PX, _MAX_CROPS = 16, 2, 22, 96
TRUE_POSITIVES, MISSED, FALSE_POSITIVES = "true positives", "missed (false negatives)", "false positives"


def collect_tp_fn_fp_crops(detector: Detector, samples: Sequence[LabelledImage]) -> dict[str, ByteArray]:
    """Upright crops (n, 32, 32) uint8 of each kind, the highest scores first."""
    kinds: dict[str, list[ByteArray]] = {TRUE_POSITIVES: [], MISSED: [], FALSE_POSITIVES: []}
    for sample in samples:
        detections = detect_frame(sample.image, sample.valid, detector)
        order = np.argsort(-detections.score, kind="stable")
        correct = match_greedy(detections.xy[order], sample.cars)
        gap = np.hypot(*(sample.cars[:, None, :2] - detections.xy[None, :, :2]).transpose(2, 0, 1))
        missed = gap.min(axis=1, initial=np.inf) >= MATCH_PX
        kinds[TRUE_POSITIVES].append(detections.chips[order][correct])
        kinds[FALSE_POSITIVES].append(detections.chips[order][~correct])
        kinds[MISSED].append(upright_chips(sample.image, sample.cars[missed, :2]))
    return {name: np.concatenate(crops) for name, crops in kinds.items()}


def contact_sheet(kinds: Mapping[str, ByteArray]) -> GreyImage:
    """The sheet (h, w, 3) uint8: each kind's name and number, and under it its first crops."""
    return np.concatenate([_section(name, crops) for name, crops in kinds.items()])


def _section(name: str, crops: ByteArray) -> ByteArray:
    side = crops.shape[1] * _ZOOM
    head = np.full((_HEAD_PX, _COLUMNS * side, 3), 255, np.uint8)
    cv2.putText(head, f"{name}: {len(crops)}", (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    rows = [head]
    for start in range(0, min(len(crops), _MAX_CROPS), _COLUMNS):
        row = np.full((side, _COLUMNS * side), 255, np.uint8)
        for k, crop in enumerate(crops[start : start + _COLUMNS]):
            row[:, k * side : (k + 1) * side] = cv2.resize(crop, (side, side), interpolation=cv2.INTER_CUBIC)
        rows.append(np.repeat(row[..., None], 3, axis=2))
    return np.concatenate(rows)
