"""The dense response: every round's rectangle sums at every second pixel, whole rows at a time, in 16 bits.

Blurred by 3 px afterwards, the response between those pixels is theirs. Four phases of the integral picture, one for
each parity of a corner, keep a row's values side by side.
"""

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from velfield.detection.boosting import BoostedSums

MARGIN_PX = 64
"""The picture is continued by so much at its edges: no rectangle reaches farther."""
STEP_PX = 2
GREY_BITS = 5
"""Of a new detector: five to eight find cars alike, and with five all but the widest sums fit 16 bits."""
_FULL = 32767
MAX_AREA_PX = _FULL // (2**GREY_BITS - 1)
"""A sum whose rectangles of one sign cover no more fits 16 bits."""


def continued(image: NDArray[np.uint8], grey_bits: int) -> NDArray[np.uint8]:
    """The picture with ``grey_bits`` of its grey, continued by the margin."""
    coarse = image >> np.uint8(8 - grey_bits)
    return np.pad(coarse, MARGIN_PX, mode="reflect" if min(image.shape) > MARGIN_PX else "edge")


def dense_response(image: NDArray[np.uint8], sums: BoostedSums, *, grey_bits: int = GREY_BITS) -> NDArray[np.float32]:
    """The classifier's response C at every pixel, (h, w) float32 (paper: car detection).

    At every second pixel of every second row all rounds are summed, exactly but for what each says, which is rounded to
    1/32767 of what all say together; between them it is linear.
    """
    sampled = sampled_response(image, sums, grey_bits=grey_bits)
    height, width = image.shape
    to_sampled = np.array([[1 / STEP_PX, 0, 0], [0, 1 / STEP_PX, 0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    full = cv2.warpAffine(sampled, to_sampled, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(full, np.float32)


def sampled_response(image: NDArray[np.uint8], sums: BoostedSums, *, grey_bits: int) -> NDArray[np.float32]:
    """The response at the pixels (2 i, 2 j)."""
    shape = tuple((side + STEP_PX - 1) // STEP_PX for side in image.shape)
    if not len(sums):
        return np.zeros(shape, np.float32)
    integral = cv2.integral(continued(image, grey_bits), sdepth=cv2.CV_32S)
    rises = (sums.leaves[:, 1] - sums.leaves[:, 0]).astype(np.float64)
    unit = max(float(np.abs(rises).sum()), 1e-12) / (_FULL - len(sums))
    said = np.zeros(shape, np.int16)
    short = _fit_16_bits(sums, grey_bits)
    for chosen, kind in ((short, np.int16), (~short, np.int32)):
        rounds = np.flatnonzero(chosen)
        if len(rounds):
            limits = np.iinfo(kind)
            least = np.clip(np.floor(sums.thresholds[rounds]), limits.min, limits.max).astype(kind)
            steps = np.rint(rises[rounds] / unit).astype(np.int16)
            phases = _phases(integral.astype(kind, copy=False))
            corners = _corners(phases, sums.rectangles)
            _add_rounds(phases.reshape(-1), phases.shape[-1], corners, sums.starts, rounds, least, steps, said)
    return (said * np.float32(unit) + np.float32(sums.leaves[:, 0].sum())).astype(np.float32)


def _fit_16_bits(sums: BoostedSums, grey_bits: int) -> NDArray[np.bool_]:
    """Whether a round's sum cannot leave 16 bits: then what wraps on the way comes back."""
    sign, x0, y0, x1, y1 = sums.rectangles.T.astype(np.int64)
    area = (x1 - x0) * (y1 - y0) * (2**grey_bits - 1)
    most = [np.add.reduceat(np.where(sign == s, area, 0), sums.starts[:-1]) for s in (1, -1)]
    return np.asarray(np.maximum(*most) <= _FULL)


def _phases(integral: NDArray[np.signedinteger]) -> NDArray[np.signedinteger]:
    """(2, 2, rows, columns): the integral picture from each parity of row and column on, every second one."""
    rows, columns = ((side + 1) // STEP_PX for side in integral.shape)
    out = np.zeros((STEP_PX, STEP_PX, rows, columns), integral.dtype)
    for p in range(STEP_PX):
        for q in range(STEP_PX):
            part = integral[p::STEP_PX, q::STEP_PX]
            out[p, q, : part.shape[0], : part.shape[1]] = part
    return out


def _corners(phases: NDArray[np.signedinteger], rectangles: NDArray[np.int32]) -> NDArray[np.uint64]:
    """(r, 4): where in the flat phases each rectangle's corners lie for the first pixel; the first and last count."""
    x0, y0, x1, y1 = rectangles[:, 1:].T.astype(np.int64) + MARGIN_PX
    # One that is taken off is one whose left and right are changed about.
    counts = rectangles[:, 0] > 0
    left, right = np.where(counts, x0, x1), np.where(counts, x1, x0)
    places = [(y1, right), (y1, left), (y0, right), (y0, left)]
    flat = [
        np.ravel_multi_index((y % STEP_PX, x % STEP_PX, y // STEP_PX, x // STEP_PX), phases.shape) for y, x in places
    ]
    return np.stack(flat, axis=1).astype(np.uint64)


@njit(cache=True, nogil=True)
def _corners_of(corners, r, down):  # type: ignore[no-untyped-def]
    return corners[r, 0] + down, corners[r, 1] + down, corners[r, 2] + down, corners[r, 3] + down


@njit(cache=True, nogil=True)
def _add_rounds(flat, stride, corners, starts, rounds, least, steps, out):  # type: ignore[no-untyped-def]
    """Indices are unsigned, which spares numba its check for negative ones: only so are loops over x vector ones."""
    height, width = out.shape
    one, columns = np.uint64(1), np.uint64(width)
    row, nothing = np.empty(width, flat.dtype), np.int16(0)
    for i in range(height):
        said, down = out[i], np.uint64(i) * np.uint64(stride)
        for k in range(len(rounds)):
            r, end = np.uint64(starts[rounds[k]]), np.uint64(starts[rounds[k] + 1])
            row[:] = 0
            while r + one < end:  # two at once: what is summed is fetched and put back half as often
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
            threshold, step = least[k], steps[k]
            for x in range(columns):
                said[x] += step if row[x] > threshold else nothing
