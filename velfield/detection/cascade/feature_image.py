"""Pictures, poses and rounds as the kernels of the aligned classifier want them."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray
from velfield.detection.boosting import BoostedSums
from velfield.detection.cascade import kernels

Offsets = NDArray[np.uint64]

PAD_PX = 48
"""A picture is continued by so much at its edges: no turned patch reaches farther."""
SMOOTH_PX = 0.6


@dataclass(frozen=True)
class Grain:
    """How finely a classifier looks: working px a pixel, and how many of these a rectangle reaches along and across."""

    step: int
    reach: tuple[int, int]

    @property
    def window_area(self) -> int:
        """Of the window about a place whose mean grey and gradient make features independent of light and contrast."""
        return 4 * self.reach[0] * self.reach[1]


FINE = Grain(1, (14, 11))
COARSE = Grain(2, (10, 8))


@dataclass(frozen=True)
class Picture:
    """A picture, padded, its pixels packed.

    Attributes
    ----------
    words : (h * w,) uint32: grey and gradient of the padded picture.
    difference : (h * w,) uint8 |frame - background|; (1,) where there is none.
    stride : its width.
    channels : 3, or 4 with the difference.
    """

    grain: Grain
    words: NDArray[np.uint32]
    difference: GreyImage
    stride: int
    channels: int


def picture_of(image: GreyImage, background: GreyImage | None = None, grain: Grain = FINE) -> Picture:
    """Pack a picture (h, w) and, where there is one, its difference to the background."""
    grey, window = _smooth(image, grain), np.ones((3, 3), np.uint8)
    zero = kernels.GRADIENT_ZERO
    gx, gy = (np.asarray(cv2.Sobel(grey, cv2.CV_16S, 1 - k, k) // 2 + zero, np.uint32) for k in (0, 1))
    words = grey | gx << np.uint32(8) | gy << np.uint32(18)
    difference = np.zeros(1, np.uint8)
    if background is not None:
        ground = _smooth(background, grain)
        # Outside the range within a pixel, not |grey - background|: half a pixel of jitter lights up every roof's edge.
        low, high = cv2.erode(ground, window), cv2.dilate(ground, window)
        difference = np.maximum(cv2.subtract(grey, high), cv2.subtract(low, grey))
    return Picture(grain, words.ravel(), difference.ravel(), grey.shape[1], 3 if background is None else 4)


def _smooth(image: GreyImage, grain: Grain) -> GreyImage:
    height, width = image.shape
    if grain.step > 1:
        image = np.pad(image, ((0, -height % grain.step), (0, -width % grain.step)), mode="edge")
        size = image.shape[1] // grain.step, image.shape[0] // grain.step
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    padded = cv2.copyMakeBorder(image, PAD_PX, PAD_PX, PAD_PX, PAD_PX, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.GaussianBlur(padded, (0, 0), SMOOTH_PX), np.uint8)


def poses_of(
    xy: FloatArray,
    angles: FloatArray,
    grain: Grain,
    *,
    sizes: FloatArray | None = None,
    mirrored: NDArray[np.bool_] | None = None,
) -> Float32Array:
    """Poses (groups, 8, LANES) of places (n, 2) and axes (n,), the last group filled up with the last pose."""
    n = len(xy)
    size = np.ones(n) if sizes is None else sizes
    side = size if mirrored is None else np.where(mirrored, -size, size)
    c, s = np.cos(angles), np.sin(angles)
    x, y = ((xy[:, k] + 0.5) / grain.step + PAD_PX for k in (0, 1))
    rows = np.stack([x, y, c * size, s * size, -s * side, c * side, c, s])
    filled = np.pad(rows, ((0, 0), (0, -n % kernels.LANES)), mode="edge")
    return np.ascontiguousarray(filled.reshape(8, -1, kernels.LANES).transpose(1, 0, 2), np.float32)


@dataclass(frozen=True)
class Patch:
    """Size of a turned patch: what rectangles reach and the offsets that are tried must lie in it."""

    along: int
    across: int
    channels: int
    grain: Grain

    @classmethod
    def for_offsets(cls, offsets: IntArray, channels: int, grain: Grain) -> "Patch":
        """The smallest patch in which rectangles stay at all of these offsets (m, 2)."""
        reach = np.abs(offsets).max(axis=0) + grain.reach
        return cls(2 * int(reach[0]), 2 * int(reach[1]), channels, grain)

    def room(self) -> NDArray[np.int32]:
        """Integral pictures to be filled, zero in the first row and column."""
        return np.zeros((self.channels, self.across + 1, self.along + 1, kernels.LANES), np.int32)

    def flat(self, x: IntArray, y: IntArray) -> IntArray:
        """Distance of (x, y) from the first corner, in elements."""
        return (y * (self.along + 1) + x) * kernels.LANES

    def bases(self, offsets: IntArray) -> Offsets:
        """Where the centre, moved by offsets (m, 2), stands."""
        return self.flat(offsets[:, 0] + self.along // 2, offsets[:, 1] + self.across // 2).astype(np.uint64)

    def corners(self, table: NDArray[np.int32]) -> Offsets:
        """Four corners of each rectangle (sign, x0, y0, x1, y1) from the centre; unsigned, so that they wrap."""
        _, x0, y0, x1, y1 = table.astype(np.int64).T
        corners = [self.flat(x1, y1), self.flat(x0, y1), self.flat(x1, y0), self.flat(x0, y0)]
        return np.stack(corners, axis=1).astype(np.uint64)

    @cached_property
    def window(self) -> Offsets:
        """Corners of the window about a place whose light and contrast are taken out."""
        u, v = self.grain.reach
        return self.corners(np.array([[1, -u, -v, u, v]], np.int32))

    def planes(self, channels: NDArray[np.int32]) -> Offsets:
        """Where each round's channel starts."""
        return (channels.astype(np.int64) * ((self.along + 1) * (self.across + 1) * kernels.LANES)).astype(np.uint64)


def grey_areas(table: NDArray[np.int32], starts: NDArray[np.int32], channels: NDArray[np.int32]) -> Float32Array:
    """Signed area of each feature on grey, by which the mean grey is taken out; 0 on the other channels."""
    areas = table[:, 0] * (table[:, 3] - table[:, 1]) * (table[:, 4] - table[:, 2])
    total = np.add.reduceat(areas, starts[:-1]) if len(areas) else np.empty(0)
    return np.where(channels == 0, total, 0).astype(np.float32)


def scores_at(
    sums: BoostedSums,
    picture: Picture,
    xy: FloatArray,
    angles: FloatArray,
    offsets: IntArray,
    *,
    contrast_floor: float,
    rounds: int | None = None,
) -> Float32Array:
    """Scores (n, offsets) of places (n, 2), per square root of the rounds: comparable from training to training.

    ``offsets`` (m, 2) are whole px along and across the axis.
    """
    n = len(sums) if rounds is None else min(rounds, len(sums))
    patch = Patch.for_offsets(offsets, picture.channels if np.any(sums.channels[:n] == 3) else 3, picture.grain)
    poses = poses_of(xy, angles, picture.grain)
    out = np.empty((len(poses), len(offsets), kernels.LANES), np.float32)
    kernels.score_poses(
        picture.words,
        picture.difference,
        picture.stride,
        poses,
        contrast_floor,
        patch.window,
        patch.grain.window_area,
        patch.corners(sums.rectangles),
        sums.rectangles[:, 0].copy(),
        sums.starts,
        patch.planes(sums.channels),
        grey_areas(sums.rectangles, sums.starts, sums.channels),
        sums.thresholds,
        sums.leaves,
        patch.bases(offsets),
        n,
        patch.room(),
        out,
    )
    return np.asarray(out.transpose(0, 2, 1).reshape(-1, len(offsets))[: len(xy)] / np.float32(np.sqrt(n)))
