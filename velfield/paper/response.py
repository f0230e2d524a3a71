"""The paper's dense response: all rounds' rectangle sums at every second pixel, whole rows at a time, in 16 bits.

Between those pixels the response is linear; it is blurred by 3 px afterwards anyway. The integral image is split into
four phases, one for each parity of row and column, so that the corners of a row of pixels lie side by side in memory
(SIMD).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Float32Array, GreyImage, Mask
from velfield.compiled import kernel
from velfield.paper.stumps import BoostedStumps

MARGIN_PX = 64
"""Images are extended by this at their edges: no rectangle reaches farther."""
STEP_PX = 2
GREY_BITS = 5
"""Bits of a new detector: five to eight detect cars alike, and with five all but the widest sums fit 16 bits."""
_MAX_INT16 = 32767
MAX_AREA_PX = _MAX_INT16 // (2**GREY_BITS - 1)
"""A sum whose rectangles of one sign cover no more fits 16 bits."""


def quantise_and_pad(image: GreyImage, grey_bits: int) -> GreyImage:
    """The image with ``grey_bits`` of its grey levels, extended by the margin."""
    coarse = image >> np.uint8(8 - grey_bits)
    return np.pad(coarse, MARGIN_PX, mode="reflect" if min(image.shape) > MARGIN_PX else "edge")


def dense_response(image: GreyImage, stumps: BoostedStumps, *, grey_bits: int = GREY_BITS) -> Float32Array:
    """The classifier's response C at every pixel, (h, w) float32 (paper: car detection).

    At every second pixel of every second row all rounds are summed, exactly but for their leaves, which are rounded to
    1/32767 of the sum of all; between them it is linear.
    """
    sampled = response_at_even_pixels(image, stumps, grey_bits=grey_bits)
    height, width = image.shape
    to_sampled = np.array([[1 / STEP_PX, 0, 0], [0, 1 / STEP_PX, 0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    full = cv2.warpAffine(sampled, to_sampled, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(full, np.float32)


def response_at_even_pixels(image: GreyImage, stumps: BoostedStumps, *, grey_bits: int) -> Float32Array:
    """The response at the pixels (2 i, 2 j)."""
    shape = tuple((side + STEP_PX - 1) // STEP_PX for side in image.shape)
    if not len(stumps):
        return np.zeros(shape, np.float32)
    integral = cv2.integral(quantise_and_pad(image, grey_bits), sdepth=cv2.CV_32S)
    rises = (stumps.leaves[:, 1] - stumps.leaves[:, 0]).astype(np.float64)
    unit = max(float(np.abs(rises).sum()), 1e-12) / (_MAX_INT16 - len(stumps))
    response = np.zeros(shape, np.int16)
    short = _fits_16_bits(stumps, grey_bits)
    for chosen, dtype in ((short, np.int16), (~short, np.int32)):
        rounds = np.flatnonzero(chosen)
        if len(rounds):
            limits = np.iinfo(dtype)
            thresholds = np.clip(np.floor(stumps.thresholds[rounds]), limits.min, limits.max).astype(dtype)
            steps = np.rint(rises[rounds] / unit).astype(np.int16)
            phases = _split_phases(integral.astype(dtype, copy=False))
            corners = _corner_indices(phases, stumps.rectangles)
            _add_rounds(
                phases.reshape(-1), phases.shape[-1], corners, stumps.starts, rounds, thresholds, steps, response
            )
    return (response * np.float32(unit) + np.float32(stumps.leaves[:, 0].sum())).astype(np.float32)


def _fits_16_bits(stumps: BoostedStumps, grey_bits: int) -> Mask:
    """Whether a round's sum fits 16 bits: then an overflow on the way to it cancels out."""
    sign, x0, y0, x1, y1 = stumps.rectangles.T.astype(np.int64)
    area = (x1 - x0) * (y1 - y0) * (2**grey_bits - 1)
    largest = [np.add.reduceat(np.where(sign == s, area, 0), stumps.starts[:-1]) for s in (1, -1)]
    return np.asarray(np.maximum(*largest) <= _MAX_INT16)


def _split_phases(integral: NDArray[np.signedinteger]) -> NDArray[np.signedinteger]:
    """(2, 2, rows, columns): every second row and column of the integral image, from each parity on."""
    rows, columns = ((side + 1) // STEP_PX for side in integral.shape)
    out = np.zeros((STEP_PX, STEP_PX, rows, columns), integral.dtype)
    for p in range(STEP_PX):
        for q in range(STEP_PX):
            part = integral[p::STEP_PX, q::STEP_PX]
            out[p, q, : part.shape[0], : part.shape[1]] = part
    return out


def _corner_indices(phases: NDArray[np.signedinteger], rectangles: NDArray[np.int32]) -> NDArray[np.uint64]:
    """(r, 4): flat indices of each rectangle's corners for the first pixel; the first and last are added."""
    x0, y0, x1, y1 = rectangles[:, 1:].T.astype(np.int64) + MARGIN_PX
    # A negative rectangle is a positive one with left and right exchanged.
    positive = rectangles[:, 0] > 0
    left, right = np.where(positive, x0, x1), np.where(positive, x1, x0)
    corners = [(y1, right), (y1, left), (y0, right), (y0, left)]
    flat = [
        np.ravel_multi_index((y % STEP_PX, x % STEP_PX, y // STEP_PX, x // STEP_PX), phases.shape) for y, x in corners
    ]
    return np.stack(flat, axis=1).astype(np.uint64)


@kernel
def _corners_of(corners: NDArray[np.uint64], r: np.uint64, down: np.uint64) -> tuple[int, int, int, int]:
    return corners[r, 0] + down, corners[r, 1] + down, corners[r, 2] + down, corners[r, 3] + down


@kernel
def _add_rounds(flat, stride, corners, starts, rounds, thresholds, steps, out) -> None:  # type: ignore[no-untyped-def]
    """Indices are unsigned, which spares numba its check for negative ones: only then are the loops over x vector
    ones."""
    height, width = out.shape
    one, columns = np.uint64(1), np.uint64(width)
    row, nothing = np.empty(width, flat.dtype), np.int16(0)
    for i in range(height):
        response, down = out[i], np.uint64(i) * np.uint64(stride)
        for k in range(len(rounds)):
            r, end = np.uint64(starts[rounds[k]]), np.uint64(starts[rounds[k] + 1])
            row[:] = 0
            while r + one < end:  # two rectangles at once: the sums are loaded and stored half as often
                a, b, c, d = _corners_of(corners, r, down)
                e, f, g, h = _corners_of(corners, r + one, down)
                r += one + one
                for x in range(columns):
                    row[x] += flat[a + x] - flat[b + x] - flat[c + x] + flat[d + x]
                    row[x] += flat[e + x] - flat[f + x] - flat[g + x] + flat[h + x]
            if r < end:
                a, b, c, d = _corners_of(corners, r, down)
                for x in range(columns):
                    row[x] += flat[a + x] - flat[b + x] - flat[c + x] + flat[d + x]
            threshold, step = thresholds[k], steps[k]
            for x in range(columns):
                response[x] += step if row[x] > threshold else nothing
