"""Boxes of a YOLO-type network: its outputs decoded, those of overlapping tiles joined."""

from dataclasses import dataclass

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray
from schemas.detector import OnnxLayout

OVERLAP = 0.25
"""Overlap of a tile with the next, as a fraction of its side: a vehicle at a tile's edge is whole in the next one."""
_MAX_OVERLAP = 0.5
"""Boxes that overlap by more than this (intersection over union) are of one vehicle."""
_EDGE_PX = 2.0
_PAD = 114


@dataclass(frozen=True)
class Boxes:
    """Boxes of an image, in no order."""

    xy: FloatArray
    """(n, 2) centre, px."""
    size: FloatArray
    """(n, 2) length along and width across ``angle_rad``, px."""
    angle_rad: FloatArray
    """(n,) from +x towards +y; 0 of upright boxes."""
    score: FloatArray
    """(n,) in [0, 1]."""

    def take(self, rows: IntArray) -> "Boxes":
        """Some of them, in the order given."""
        return Boxes(self.xy[rows], self.size[rows], self.angle_rad[rows], self.score[rows])

    def __len__(self) -> int:
        return len(self.score)

    @classmethod
    def join(cls, parts: list["Boxes"]) -> "Boxes":
        """All of several parts."""
        every = [*parts, cls(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), np.empty(0))]
        return cls(*(np.concatenate([getattr(one, name) for one in every]) for name in cls.__dataclass_fields__))


def decode(output: Float32Array, layout: OnnxLayout, vehicles: tuple[int, ...], min_score: float) -> Boxes:
    """Boxes of vehicles in a network's output for one tile, px of the tile.

    Parameters
    ----------
    output
        (channels, n) of ``boxes`` and ``oriented_boxes``: x, y, w, h, a score for each class, the angle; (n, columns)
        of ``boxes_with_objectness``: x, y, w, h, objectness, a score for each class; of ``end_to_end``: x0, y0, x1, y1,
        score, class; of ``end_to_end_oriented``: x, y, w, h, score, class, angle.
    """
    rows = np.asarray(output if layout.startswith(("end", "boxes_with")) else output.T, np.float64)
    if layout.startswith("end_to_end"):
        kept = np.isin(rows[:, 5].round().astype(int), vehicles) & (rows[:, 4] >= min_score)
        rows = rows[kept]
        if layout == "end_to_end_oriented":
            return Boxes(rows[:, :2], rows[:, 2:4], rows[:, 6], rows[:, 4])
        corners = rows[:, :4].reshape(-1, 2, 2)
        return Boxes(corners.mean(axis=1), corners[:, 1] - corners[:, 0], np.zeros(len(rows)), rows[:, 4])
    first = 5 if layout == "boxes_with_objectness" else 4
    last = rows.shape[1] - (layout == "oriented_boxes")
    scores = rows[:, first:last] * (rows[:, 4:5] if first == 5 else 1.0)
    best = scores.argmax(axis=1)  # a lorry that looks more like a container is none
    score = scores[np.arange(len(rows)), best]
    kept = np.isin(best, vehicles) & (score >= min_score)
    angle = rows[kept, -1] if layout == "oriented_boxes" else np.zeros(int(kept.sum()))
    return Boxes(rows[kept, :2], rows[kept, 2:4], angle, score[kept])


def tile_corners(shape: tuple[int, int], tile_px: tuple[int, int]) -> list[tuple[int, int]]:
    """Corners (x, y) of tiles that cover an image (h, w), each overlapping the next.

    Examples
    --------
    >>> tile_corners((480, 1000), (640, 640))
    [(0, 0), (360, 0)]
    """
    columns, rows = (_starts(size, tile) for size, tile in zip(shape[::-1], tile_px, strict=True))
    return [(x, y) for y in rows for x in columns]


def _starts(size: int, tile: int) -> list[int]:
    if size <= tile:
        return [0]
    count = int(np.ceil((size - tile) / (tile * (1 - OVERLAP)))) + 1
    return [int(start) for start in np.linspace(0, size - tile, count).round()]


def cut_tile(grey: GreyImage, corner: tuple[int, int], tile_px: tuple[int, int]) -> GreyImage:
    """A tile of an image, padded to its full size beyond it."""
    x, y = corner
    part = grey[y : y + tile_px[1], x : x + tile_px[0]]
    pad = tile_px[1] - part.shape[0], tile_px[0] - part.shape[1]
    return np.asarray(cv2.copyMakeBorder(part, 0, pad[0], 0, pad[1], cv2.BORDER_CONSTANT, value=(_PAD,)), np.uint8)


def whole_in_tile(boxes: Boxes, corner: tuple[int, int], tile_px: tuple[int, int], shape: tuple[int, int]) -> IntArray:
    """Rows of the boxes that no inner edge of the tile cuts: what is cut there is whole in the next tile."""
    half = _half_extent(boxes)
    low, high = boxes.xy - half, boxes.xy + half
    inner_low = np.array([corner[0] > 0, corner[1] > 0])
    inner_high = np.array([corner[0] + tile_px[0] < shape[1], corner[1] + tile_px[1] < shape[0]])
    cut = (inner_low & (low < _EDGE_PX)) | (inner_high & (high > np.array(tile_px) - _EDGE_PX))
    fits = (2 * half < OVERLAP * np.array(tile_px)).all(axis=1)  # longer than the overlap it is whole nowhere
    return np.flatnonzero(~(cut.any(axis=1) & fits))


def _half_extent(boxes: Boxes) -> FloatArray:
    c, s = np.abs(np.cos(boxes.angle_rad)), np.abs(np.sin(boxes.angle_rad))
    length, width = boxes.size.T
    return np.column_stack([length * c + width * s, length * s + width * c]) / 2


def suppress(boxes: Boxes, min_score: float) -> Boxes:
    """Non-maximum suppression: of boxes that overlap, the one with the highest score."""
    if not len(boxes):
        return boxes
    upright = np.abs(boxes.angle_rad).max() < 1e-3
    scores = boxes.score.tolist()
    if upright:
        corners = np.column_stack([boxes.xy - boxes.size / 2, boxes.size]).tolist()
        kept = cv2.dnn.NMSBoxes(corners, scores, min_score, _MAX_OVERLAP)
    else:
        rotated = [
            ((x, y), (w, h), angle)
            for (x, y), (w, h), angle in zip(
                boxes.xy.tolist(), boxes.size.tolist(), np.degrees(boxes.angle_rad).tolist(), strict=True
            )
        ]
        kept = cv2.dnn.NMSBoxesRotated(rotated, scores, min_score, _MAX_OVERLAP)
    return boxes.take(np.sort(np.asarray(kept, np.int64).ravel()))
