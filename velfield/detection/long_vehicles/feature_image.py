"""Images, poses and stumps in the layout of the kernels: packed channels, rotated patches, flat corner indices.

The channels are those of integral channel features: grey, gradient along and across the axis of the vehicle. They are
computed once for an image; a patch is sampled and rotated from them for each pose, and its integral images give the sum
of any rectangle in four look-ups.

Sixteen patches are interleaved as the innermost axis of every array (structure of arrays), so that the corner of a
rectangle is one vector load in place of a gather.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import ByteArray, Float32Array, FloatArray, GreyImage, IntArray
from velfield.compiled import kernel
from velfield.detection.long_vehicles.rounds import LANES, score_offsets, signed_corners
from velfield.detection.stumps import BoostedStumps

CHANNELS = 3
"""Grey, |gradient along|, |gradient across|."""
GRADIENT_ZERO = 512
"""Gradients are packed as unsigned ten-bit numbers, with this standing for zero."""


@kernel
def fill_integrals(packed: NDArray[np.uint32], stride: int, poses: Float32Array, out: NDArray[np.int32]) -> None:
    """Integral images of ``LANES`` rotated patches, sampled at the nearest pixel (as accurate as interpolated).

    ``packed`` (h * w,) uint32: grey, and the gradient in x and y. ``poses`` (8, LANES) float32: x, y of the centre plus
    a half; the step in x and y along the patch, and across it; cosine and sine of the axis. ``out`` (CHANNELS,
    across + 1, along + 1, LANES) int32 with zeros in its first row and column.
    """
    across, along = out.shape[1] - 1, out.shape[2] - 1
    half_across, half_along = np.float32((across - 1) / 2), np.float32((along - 1) / 2)
    mask, zero = np.uint32(2 * GRADIENT_ZERO - 1), np.int32(GRADIENT_ZERO)
    index, runs = np.empty(LANES, np.uint64), np.empty((CHANNELS, LANES), np.int32)
    for i in range(across):
        v = np.float32(i) - half_across
        runs[:] = 0
        for j in range(along):
            u = np.float32(j) - half_along
            for lane in range(LANES):
                column = np.int32(poses[0, lane] + v * poses[4, lane] + u * poses[2, lane])
                line = np.int32(poses[1, lane] + v * poses[5, lane] + u * poses[3, lane])
                index[lane] = np.uint64(line * stride + column)
            for lane in range(LANES):
                word = packed[index[lane]]
                gx = np.float32(np.int32(word >> np.uint32(8) & mask) - zero)
                gy = np.float32(np.int32(word >> np.uint32(18) & mask) - zero)
                runs[0, lane] += np.int32(word & np.uint32(255))
                runs[1, lane] += np.int32(abs(gx * poses[6, lane] + gy * poses[7, lane]))
                runs[2, lane] += np.int32(abs(gy * poses[6, lane] - gx * poses[7, lane]))
            for channel in range(CHANNELS):
                for lane in range(LANES):
                    out[channel, i + 1, j + 1, lane] = out[channel, i, j + 1, lane] + runs[channel, lane]


@kernel
def score_poses_kernel(  # type: ignore[no-untyped-def]
    packed, stride, poses, floor, window, window_area, corners, signs, starts, planes, areas, thresholds, leaves,
    bases, rounds, integral, out,
) -> None:  # fmt: skip
    """Scores (groups, offsets, LANES) of poses (groups, 8, LANES); ``integral`` is scratch memory."""
    flat = integral.reshape(-1)
    plane = np.uint64(flat.size // integral.shape[0])
    signed = signed_corners(corners, signs)
    for g in range(len(poses)):
        fill_integrals(packed, stride, poses[g], integral)
        score_offsets(
            flat, window, window_area, plane, floor, signed, starts, planes, areas, thresholds, leaves, bases, rounds,
            out[g],
        )  # fmt: skip


FlatIndices = NDArray[np.uint64]

PAD_PX = 48
"""Images are extended by this at their edges: no rotated patch reaches farther."""
SMOOTHING_SIGMA_PX = 0.6


@dataclass(frozen=True)
class PatchScale:
    """Resolution and size of a classifier's patches.

    Attributes
    ----------
    step : working px a pixel of the patch.
    reach : pixels from the centre that rectangles extend to, along and across the axis.
    """

    step: int
    reach: tuple[int, int]

    @property
    def window_area(self) -> int:
        """Area of the window whose mean grey and gradient normalise the features for brightness and contrast."""
        return 4 * self.reach[0] * self.reach[1]


@dataclass(frozen=True)
class FeatureImage:
    """An image, padded, its channels packed into words.

    Attributes
    ----------
    words : (h * w,) uint32: grey and gradient of the padded image.
    stride : its width.
    """

    scale: PatchScale
    words: NDArray[np.uint32]
    stride: int


def features_of_reduced(image: GreyImage, scale: PatchScale) -> FeatureImage:
    """Channels of an image (h, w) that has the scale's resolution already."""
    padded = cv2.copyMakeBorder(image, PAD_PX, PAD_PX, PAD_PX, PAD_PX, cv2.BORDER_REPLICATE)
    grey = np.asarray(cv2.GaussianBlur(padded, (0, 0), SMOOTHING_SIGMA_PX), np.uint8)
    return FeatureImage(scale, pack_words_kernel(grey).ravel(), grey.shape[1])


@kernel
def pack_words_kernel(grey: ByteArray) -> NDArray[np.uint32]:
    """Grey, and half of each gradient (Sobel's, mirrored at the edge) above its zero, in one word a pixel."""
    height, width = np.uint64(grey.shape[0]), np.uint64(grey.shape[1])
    one, two = np.uint64(1), np.uint64(2)
    words = np.empty(grey.shape, np.uint32)
    # Of a column of three pixels, with one column beyond either edge: their smooth sum, and the last less the first.
    sums, slopes = np.empty(width + two, np.int16), np.empty(width + two, np.int16)
    for y in range(height):
        above = grey[y - one] if y > 0 else grey[min(one, height - one)]
        below = grey[y + one] if y + one < height else grey[max(height, two) - two]
        at = grey[y]
        for x in range(width):
            sums[x + one] = np.int16(above[x]) + np.int16(below[x]) + np.int16(2) * np.int16(at[x])
        for x in range(width):
            slopes[x + one] = np.int16(below[x]) - np.int16(above[x])
        for line in (sums, slopes):
            line[0], line[width + one] = line[min(two, width)], line[max(width, two) - one]
        for x in range(width):
            across = slopes[x] + slopes[x + two] + np.int16(2) * slopes[x + one]
            along = sums[x + two] - sums[x]
            high = np.uint32((across >> 1) + GRADIENT_ZERO) << np.uint32(18)
            words[y, x] = np.uint32(at[x]) | np.uint32((along >> 1) + GRADIENT_ZERO) << np.uint32(8) | high
    return words


def pack_poses(xy: FloatArray, angles: FloatArray, scale: PatchScale) -> Float32Array:
    """Poses (groups, 8, LANES) of positions (n, 2) and axes (n,); the last pose is repeated to fill the last group."""
    n = len(xy)
    c, s = np.cos(angles), np.sin(angles)
    x, y = ((xy[:, k] + 0.5) / scale.step + PAD_PX for k in (0, 1))
    rows = np.stack([x, y, c, s, -s, c, c, s])
    filled = rows[:, np.minimum(np.arange(n + -n % LANES), n - 1)]
    return np.ascontiguousarray(filled.reshape(8, -1, LANES).transpose(1, 0, 2), np.float32)


@dataclass(frozen=True)
class RotatedPatch:
    """Layout of a rotated patch's integral images: it holds the rectangles at all offsets that are scored."""

    along: int
    across: int
    scale: PatchScale

    @classmethod
    def for_offsets(cls, offsets: IntArray, scale: PatchScale) -> "RotatedPatch":
        """The smallest patch that holds the rectangles at all of these offsets (m, 2)."""
        reach = np.abs(offsets).max(axis=0) + scale.reach
        return cls(2 * int(reach[0]), 2 * int(reach[1]), scale)

    def allocate(self) -> NDArray[np.int32]:
        """Integral images to be filled, zero in the first row and column."""
        return np.zeros((CHANNELS, self.across + 1, self.along + 1, LANES), np.int32)

    def flat_index(self, x: IntArray, y: IntArray) -> IntArray:
        """Flat index of (x, y), relative to the first corner."""
        return np.asarray((y * (self.along + 1) + x) * LANES, np.int64)

    def centres(self, offsets: IntArray) -> FlatIndices:
        """Flat indices of the centre displaced by offsets (m, 2)."""
        return self.flat_index(offsets[:, 0] + self.along // 2, offsets[:, 1] + self.across // 2).astype(np.uint64)

    def corners(self, table: NDArray[np.int32]) -> FlatIndices:
        """Flat indices of the corners of rectangles (sign, x0, y0, x1, y1) from the centre; unsigned: they wrap."""
        _, x0, y0, x1, y1 = table.astype(np.int64).T
        corners = [
            self.flat_index(x1, y1),
            self.flat_index(x0, y1),
            self.flat_index(x1, y0),
            self.flat_index(x0, y0),
        ]
        return np.stack(corners, axis=1).astype(np.uint64)

    @cached_property
    def window(self) -> FlatIndices:
        """Flat indices of the corners of the window that normalises for brightness and contrast."""
        u, v = self.scale.reach
        return self.corners(np.array([[1, -u, -v, u, v]], np.int32))

    def planes(self, channels: NDArray[np.int32]) -> FlatIndices:
        """Flat index of the start of each round's channel."""
        return (channels.astype(np.int64) * ((self.along + 1) * (self.across + 1) * LANES)).astype(np.uint64)


def signed_grey_areas(table: NDArray[np.int32], starts: NDArray[np.int32], channels: NDArray[np.int32]) -> Float32Array:
    """Signed area of each feature on grey, by which the mean grey is subtracted; 0 on the other channels."""
    areas = table[:, 0] * (table[:, 3] - table[:, 1]) * (table[:, 4] - table[:, 2])
    total = np.add.reduceat(areas, starts[:-1]) if len(areas) else np.empty(0)
    return np.where(channels == 0, total, 0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class OffsetScorer:
    """A classifier at offsets (m, 2), whole px along and across the axis of a pose, and what its kernel reads."""

    stumps: BoostedStumps
    offsets: IntArray
    scale: PatchScale

    @cached_property
    def _patch(self) -> RotatedPatch:
        return RotatedPatch.for_offsets(self.offsets, self.scale)

    @cached_property
    def _rectangles(self) -> tuple[FlatIndices, NDArray[np.int32], NDArray[np.int32], FlatIndices, Float32Array]:
        """Corners and signs of the rectangles, where those of each round start, and its channel and area."""
        stumps = self.stumps
        areas = signed_grey_areas(stumps.rectangles, stumps.starts, stumps.channels)
        signs = stumps.rectangles[:, 0].copy()
        return self._patch.corners(stumps.rectangles), signs, stumps.starts, self._patch.planes(stumps.channels), areas

    def scores(
        self, features: FeatureImage, xy: FloatArray, angles: FloatArray, *, contrast_floor: float, rounds: int
    ) -> Float32Array:
        """Scores (n, m) of the first rounds at positions (n, 2) and axes (n,).

        They are divided by the square root of the number of rounds, so that they compare between classifiers.
        """
        patch, poses = self._patch, pack_poses(xy, angles, self.scale)
        out = np.empty((len(poses), len(self.offsets), LANES), np.float32)
        score_poses_kernel(
            features.words,
            features.stride,
            poses,
            contrast_floor,
            patch.window,
            patch.scale.window_area,
            *self._rectangles,
            self.stumps.thresholds,
            self.stumps.leaves,
            patch.centres(self.offsets),
            rounds,
            patch.allocate(),
            out,
        )
        by_pose = out.transpose(0, 2, 1).reshape(-1, len(self.offsets))[: len(xy)]
        return np.asarray(by_pose / np.float32(np.sqrt(rounds)))
