"""Alignment below the pixel: patches about corners of the base image, found in the raw frame at full size.

The reference patch stays in base pixels; the raw frame is sampled through the frame's own map (its local derivative),
so nothing is resampled twice and a patch follows turn, scale and rolling shutter. Each patch is moved by Gauss-Newton
steps in the inverse compositional form, gain and offset of the grey levels free: exposure and vignetting do not pull.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.registration.joint import ControlPoints
from velfield.registration.transforms import FrameTransform

Float32Array = NDArray[np.float32]

FEW, MANY = 3000, 6000
"""Patches of a base image: where the frames' own camera made it, and where half of them will not be found."""
_CELL_PX = (10.0, 40.0)
HALF_PATCH = 7
_FINE_SIGMA_PX = 0.8
"""Blur of both pictures before they are compared; the bilinear sampling of the raw frame is exact enough then."""
_COARSE_SPACING_PX = 2
_NOISE_GREY = 3.0
_MAX_SIGMA_PX = 0.35
"""A corner that noise of three grey levels would move by more than this is no corner."""
_FLOOR_PX = 0.06
_ITERATIONS = 12
_MIN_CORRELATION = 0.7
_HELD_SHARE = 0.6
"""Share of a patch that the frame must hold: the first and last rows have half patches only."""
_SETTLED_PX = 0.01
_DERIVATIVE_PX = 5.0


@dataclass(frozen=True, eq=False)
class Templates:
    """Patches of the base image about its corners.

    Attributes
    ----------
    xy : (n, 2) base px, whole numbers.
    sigma_px : (n,) how far noise would move each.
    fine, coarse : (n, side * side) float32 grey levels about the corner, at every pixel and at every second.
    """

    xy: FloatArray
    sigma_px: FloatArray
    fine: Float32Array
    coarse: Float32Array

    def __len__(self) -> int:
        return len(self.xy)

    def where(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> "Templates":
        """Those that a mask (n,) or indices choose."""
        return Templates(self.xy[chosen], self.sigma_px[chosen], self.fine[chosen], self.coarse[chosen])


def cut_templates(
    base: NDArray[np.uint8], xy: FloatArray, sigma_px: FloatArray, half_patch: int = HALF_PATCH
) -> Templates:
    """Patches of a base image (h, w) about corners (n, 2), whole numbers; all of each must lie in it."""
    fine, coarse = blurred(base)
    at = xy.astype(np.int64)
    offsets = np.arange(-half_patch, half_patch + 1)
    dy, dx = (grid.ravel() for grid in np.meshgrid(offsets, offsets, indexing="ij"))
    return Templates(
        xy=xy,
        sigma_px=sigma_px,
        fine=fine[at[:, 1:] + dy, at[:, :1] + dx],
        coarse=coarse[at[:, 1:] + _COARSE_SPACING_PX * dy, at[:, :1] + _COARSE_SPACING_PX * dx],
    )


def make_templates(
    base: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None = None,
    *,
    count: int = FEW,
    apart_from: FloatArray | None = None,
    half_patch: int = HALF_PATCH,
) -> Templates:
    """The best corner of each of ``count`` cells of a base image (h, w), with its patches.

    ``mask`` (h, w) is where the image is known; no corner lies within `HALF_PATCH` of ``apart_from`` (n, 2).
    ``half_patch``: px from a corner to its patch's edge; a larger patch is less moved by noise, and sees more depth.
    """
    height, width = base.shape
    side = 2 * half_patch + 1
    gradient = cv2.cornerMinEigenVal(cv2.GaussianBlur(base, (0, 0), _FINE_SIGMA_PX), side, ksize=3)
    # OpenCV gives the mean over the block of gradients in units of (grey / 255) a pixel, Sobel's 4 taken out
    least = np.maximum(np.asarray(gradient, dtype=np.float64), 0.0) * 255.0**2 * side**2
    reach = half_patch * _COARSE_SPACING_PX + 2
    usable = np.zeros(base.shape, np.uint8)
    usable[reach : height - reach, reach : width - reach] = 1
    if mask is not None:
        usable &= cv2.erode(mask.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8), borderValue=0)
    least *= usable
    if apart_from is not None:
        least *= _far_from(apart_from, base.shape)
    cell = float(np.clip(np.sqrt(base.size / count), *_CELL_PX))
    xy, strength = _best_of_cells(least, max(1, round(cell)), (_NOISE_GREY / _MAX_SIGMA_PX) ** 2)
    sigma = np.sqrt(_FLOOR_PX**2 + _NOISE_GREY**2 / np.maximum(strength, 1e-9))
    return cut_templates(base, xy, sigma, half_patch)


def _far_from(xy: FloatArray, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    free = np.ones(shape, np.uint8)
    at = np.rint(xy).astype(np.int64)
    free[at[:, 1], at[:, 0]] = 0
    return np.asarray(cv2.distanceTransform(free, cv2.DIST_C, 3) > HALF_PATCH)


def _best_of_cells(strength: FloatArray, cell: int, least: float) -> tuple[FloatArray, FloatArray]:
    """Place (n, 2) and strength (n,) of each cell's maximum that is above ``least``."""
    height, width = strength.shape
    rows, columns = -(-height // cell), -(-width // cell)
    padded = np.zeros((rows * cell, columns * cell))
    padded[:height, :width] = strength
    cells = padded.reshape(rows, cell, columns, cell).transpose(0, 2, 1, 3).reshape(rows * columns, cell * cell)
    best = cells.argmax(axis=1)
    value = cells[np.arange(len(cells)), best]
    k = np.flatnonzero(value > least)
    y = (k // columns) * cell + best[k] // cell
    x = (k % columns) * cell + best[k] % cell
    return np.stack([x, y], axis=1).astype(np.float64), value[k]


def blurred(grey: NDArray[np.uint8]) -> tuple[Float32Array, Float32Array]:
    """A picture as it is compared, float32: finely, and coarsely."""
    fine = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _FINE_SIGMA_PX)
    coarse = cv2.GaussianBlur(fine, (0, 0), float(_COARSE_SPACING_PX))
    return np.asarray(fine, dtype=np.float32), np.asarray(coarse, dtype=np.float32)


def align(
    picture: Float32Array,
    transform: FrameTransform,
    templates: Templates,
    *,
    coarse: bool,
    max_shift_px: float,
) -> tuple[ControlPoints, int]:
    """Find the patches of the base image in a raw frame, starting from where ``transform`` has them.

    Parameters
    ----------
    picture
        (h, w) float32, the raw frame as `blurred` gives it, fine or coarse alike.
    transform
        The frame's map so far, right to within ``max_shift_px`` or so.
    max_shift_px
        A patch that moves farther than this is not believed.

    Returns
    -------
    Control points, and how many patches were looked for.
    """
    start = transform.to_raw(templates.xy)
    derivative = np.empty((len(templates), 2, 2))
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = _DERIVATIVE_PX
        ahead, behind = transform.to_raw(templates.xy + step), transform.to_raw(templates.xy - step)
        derivative[:, :, axis] = (ahead - behind) / (2 * _DERIVATIVE_PX)
    spacing = _COARSE_SPACING_PX if coarse else 1
    patches = templates.coarse if coarse else templates.fine
    shift, correlation = _align_patches(picture, patches, start, derivative, spacing, max_shift_px, _ITERATIONS)
    seen = np.isfinite(correlation)
    good = seen & (np.nan_to_num(correlation) > _MIN_CORRELATION)
    raw = start[good] + np.einsum("nij,nj->ni", derivative[good], shift[good])
    lack = np.sqrt(np.maximum(1.0 - correlation[good] ** 2, 0.0))
    sigma = templates.sigma_px[good] * (1.0 + 4.0 * lack) * (spacing if coarse else 1)
    return ControlPoints(raw, templates.xy[good], sigma), int(seen.sum())


@njit(cache=True, nogil=True)
def _sampled(picture, patch, start, derivative, shift, spacing, sample, held):  # type: ignore[no-untyped-def]
    """Sample the frame under a patch moved by ``shift``; returns pixels inside the frame, their means in both."""
    side = patch.shape[0]
    half = side // 2
    height, width = picture.shape
    count, frame_mean, patch_mean = 0, 0.0, 0.0
    for r in range(side):
        for c in range(side):
            ox, oy = (c - half) * spacing + shift[0], (r - half) * spacing + shift[1]
            x = start[0] + derivative[0, 0] * ox + derivative[0, 1] * oy
            y = start[1] + derivative[1, 0] * ox + derivative[1, 1] * oy
            held[r, c] = x >= 0.0 and y >= 0.0 and x < width - 1.0 and y < height - 1.0
            if held[r, c]:
                j, k = int(x), int(y)
                fx, fy = x - j, y - k
                top = picture[k, j] + fx * (picture[k, j + 1] - picture[k, j])
                bottom = picture[k + 1, j] + fx * (picture[k + 1, j + 1] - picture[k + 1, j])
                sample[r, c] = top + fy * (bottom - top)
                frame_mean += sample[r, c]
                patch_mean += patch[r, c]
                count += 1
    return count, frame_mean / max(count, 1), patch_mean / max(count, 1)


@njit(cache=True, nogil=True)
def _step_of(patch, sample, held, frame_mean, patch_mean, spacing):  # type: ignore[no-untyped-def]
    """Gauss-Newton step (2) of a patch and its correlation, over the pixels held; correlation -1: no texture."""
    side = patch.shape[0]
    frame_square, patch_square, product = 0.0, 0.0, 0.0
    for r in range(side):
        for c in range(side):
            if held[r, c]:
                a, b = sample[r, c] - frame_mean, patch[r, c] - patch_mean
                frame_square += a * a
                patch_square += b * b
                product += a * b
    if frame_square <= 1e-3 or patch_square <= 1e-3:
        return 0.0, 0.0, -1.0
    gain = np.sqrt(patch_square / frame_square)
    hxx, hxy, hyy, bx, by = 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(1, side - 1):
        for c in range(1, side - 1):
            if held[r, c]:
                gx = (patch[r, c + 1] - patch[r, c - 1]) / (2.0 * spacing)
                gy = (patch[r + 1, c] - patch[r - 1, c]) / (2.0 * spacing)
                e = gain * (sample[r, c] - frame_mean) - (patch[r, c] - patch_mean)
                hxx += gx * gx
                hxy += gx * gy
                hyy += gy * gy
                bx += gx * e
                by += gy * e
    determinant = hxx * hyy - hxy * hxy
    if determinant <= 1e-6 * (hxx + hyy) ** 2:
        return 0.0, 0.0, -1.0
    x, y = (hyy * bx - hxy * by) / determinant, (hxx * by - hxy * bx) / determinant
    return x, y, product / np.sqrt(frame_square * patch_square)


@njit(cache=True, nogil=True)
def _align_patches(picture, patches, start, derivative, spacing, max_shift, iterations):  # type: ignore[no-untyped-def]
    """Shift (n, 2) in base px and correlation (n,) of each patch.

    The correlation is NaN where the frame does not hold the patch, zero where the search did not settle.
    """
    n = patches.shape[0]
    side = int(np.sqrt(patches.shape[1]) + 0.5)
    shift = np.zeros((n, 2))
    correlation = np.full(n, np.nan)
    sample = np.empty((side, side), np.float32)
    held = np.empty((side, side), np.bool_)
    for i in range(n):
        if not np.isfinite(start[i, 0] + derivative[i, 0, 0] + derivative[i, 0, 1]):
            continue
        patch = patches[i].reshape(side, side)
        score, settled, seen = 0.0, False, True
        for _ in range(iterations):
            count, frame_mean, patch_mean = _sampled(
                picture, patch, start[i], derivative[i], shift[i], spacing, sample, held
            )
            seen = count >= _HELD_SHARE * side * side
            if not seen:
                break
            x, y, score = _step_of(patch, sample, held, frame_mean, patch_mean, spacing)
            length = np.sqrt(x * x + y * y)
            limited = min(1.0, 2.0 * spacing / max(length, 1e-9))
            shift[i, 0] -= x * limited
            shift[i, 1] -= y * limited
            settled = length < _SETTLED_PX * spacing
            if settled or score < 0.0 or shift[i, 0] ** 2 + shift[i, 1] ** 2 > max_shift**2:
                break
        if seen:
            correlation[i] = score if settled else 0.0
    return shift, correlation
