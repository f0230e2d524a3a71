"""Subpixel alignment: patches at corners of the base image, located in the full-resolution raw frame (Lucas-Kanade).

The template stays in base pixels; the raw frame is sampled through the Jacobian of the frame's own map, so that no
image is resampled twice and a patch follows rotation, scale and rolling shutter. The shift of each patch is estimated
by inverse compositional Gauss-Newton steps with free gain and offset of the grey levels, which makes it invariant to
exposure and vignetting.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray, Mask
from velfield.registration.joint import ControlPoints
from velfield.registration.transforms import FrameTransform, invert_2x2

N_PATCHES_SAME_SENSOR, N_PATCHES_CROSS_SENSOR = 3000, 6000
"""Patches of a base image of the frames' own camera, and of another sensor's: about half of those fail to align."""
_CELL_PX = (10.0, 40.0)
HALF_PATCH = 7
_FINE_SIGMA_PX = 0.8
"""Gaussian blur of both images: bilinear sampling of the raw frame is accurate enough after it."""
_COARSE_SPACING_PX = 2
_NOISE_GREY = 3.0
_MAX_SIGMA_PX = 0.35
"""Corners whose position has a larger standard deviation under noise of three grey levels are rejected."""
_MIN_SIGMA_PX = 0.06
_MAX_ITERATIONS = 12
_MIN_CORRELATION = 0.7
_MIN_VISIBLE_FRACTION = 0.6
"""Fraction of a patch that must lie in the frame: patches of the first and last rows are cut in half."""
_CONVERGED_PX = 0.01


@dataclass(frozen=True, eq=False)
class Templates:
    """Patches at corners of the base image.

    Attributes
    ----------
    xy : (n, 2) base px, integers.
    sigma_px : (n,) standard deviation of the position under image noise.
    fine, coarse : (n, side * side) float32 grey levels about the corner, sampled at every and every second pixel.
    """

    xy: FloatArray
    sigma_px: FloatArray
    fine: Float32Array
    coarse: Float32Array

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, selection: Mask | IntArray) -> "Templates":
        """The templates of a mask (n,) or of indices."""
        return Templates(self.xy[selection], self.sigma_px[selection], self.fine[selection], self.coarse[selection])


def extract_templates(base: GreyImage, xy: FloatArray, sigma_px: FloatArray, half_patch: int = HALF_PATCH) -> Templates:
    """Cut patches out of a base image (h, w) at corners (n, 2), integers; each must lie in the image completely."""
    fine = smooth_fine(base)
    return _cut_patches(fine, smooth_coarse(fine), xy, sigma_px, half_patch)


def _cut_patches(
    fine: Float32Array, coarse: Float32Array, xy: FloatArray, sigma_px: FloatArray, half_patch: int
) -> Templates:
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
    base: GreyImage,
    mask: Mask | None = None,
    *,
    count: int = N_PATCHES_SAME_SENSOR,
    exclude: FloatArray | None = None,
    half_patch: int = HALF_PATCH,
) -> Templates:
    """Detect the strongest corner (Shi-Tomasi) of each of about ``count`` cells of a base image (h, w).

    Parameters
    ----------
    base
        (h, w) uint8.
    mask
        (h, w) bool: where the base image is valid; None: everywhere.
    count
        Number of cells.
    exclude
        (n, 2) px: no corner lies within `HALF_PATCH` of these.
    half_patch
        px from a corner to its patch's edge. Larger patches are less sensitive to noise, but span more relief.
    """
    return make_template_sets(base, mask, counts=(count,), exclude=exclude, half_patch=half_patch)[0]


def make_template_sets(
    base: GreyImage,
    mask: Mask | None = None,
    *,
    counts: Sequence[int],
    exclude: FloatArray | None = None,
    half_patch: int = HALF_PATCH,
) -> list[Templates]:
    """`make_templates` for several numbers of cells; what they have in common is computed once."""
    height, width = base.shape
    side = 2 * half_patch + 1
    gradient = cv2.cornerMinEigenVal(cv2.GaussianBlur(base, (0, 0), _FINE_SIGMA_PX), side, ksize=3)
    reach = half_patch * _COARSE_SPACING_PX + 2
    usable = np.zeros(base.shape, np.uint8)
    usable[reach : height - reach, reach : width - reach] = 1
    if mask is not None:
        usable &= cv2.erode(mask.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8), borderValue=0)
    if exclude is not None:
        usable &= _mask_away_from(exclude, base.shape)
    gradient *= usable
    fine = smooth_fine(base)
    coarse = smooth_coarse(fine)
    sets = []
    for count in counts:
        cell = max(1, round(float(np.clip(np.sqrt(base.size / count), *_CELL_PX))))
        xy, mean = _find_cell_maxima(gradient, cell)
        # OpenCV gives the mean over the block of gradients in (grey / 255) per pixel, Sobel's factor of 4 divided out
        strength = mean.astype(np.float64) * 255.0**2 * side**2
        strong = strength > (_NOISE_GREY / _MAX_SIGMA_PX) ** 2
        sigma = np.sqrt(_MIN_SIGMA_PX**2 + _NOISE_GREY**2 / strength[strong])
        sets.append(_cut_patches(fine, coarse, xy[strong].astype(np.float64), sigma, half_patch))
    return sets


def _mask_away_from(xy: FloatArray, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    free = np.ones(shape, np.uint8)
    at = np.rint(xy).astype(np.int64)
    free[at[:, 1], at[:, 0]] = 0
    return np.asarray(cv2.distanceTransform(free, cv2.DIST_C, 3) > HALF_PATCH, np.uint8)


@njit(cache=True, nogil=True)
def _find_cell_maxima(strength, cell):  # type: ignore[no-untyped-def]
    """Position (n, 2) and value (n,) of each cell's first maximum, in rows of cells."""
    height, width = strength.shape
    columns = -(-width // cell)
    count = -(-height // cell) * columns
    xy, best = np.zeros((count, 2), np.int64), np.zeros(count, np.float32)
    for y in range(height):
        for column in range(columns):
            k = (y // cell) * columns + column
            for x in range(column * cell, min((column + 1) * cell, width)):
                if strength[y, x] > best[k]:
                    best[k] = strength[y, x]
                    xy[k, 0], xy[k, 1] = x, y
    return xy, best


def smooth_fine(grey: GreyImage) -> Float32Array:
    """The fine blur level of an image at which patches are aligned, float32."""
    return np.asarray(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _FINE_SIGMA_PX), np.float32)


def smooth_coarse(fine: Float32Array) -> Float32Array:
    """The coarse blur level, from the fine one."""
    return np.asarray(cv2.GaussianBlur(fine, (0, 0), float(_COARSE_SPACING_PX)), np.float32)


def align_patches(
    image: Float32Array,
    transform: FrameTransform,
    templates: Templates,
    *,
    coarse: bool,
    max_shift_px: float,
) -> tuple[ControlPoints, int]:
    """Locate the patches of the base image in a raw frame, starting from where ``transform`` maps them.

    Parameters
    ----------
    image
        (h, w) float32, the raw frame blurred by `smooth_fine` or, if ``coarse``, by `smooth_coarse` after it.
    transform
        The frame's map so far, accurate to about ``max_shift_px``.
    templates
        Patches of the base image.
    coarse
        Whether ``image`` is the coarse level.
    max_shift_px
        Patches that move farther are rejected, base px.

    Returns
    -------
    Control points, and the number of patches that lie in the frame.
    """
    start = transform.to_raw(templates.xy)
    derivative = invert_2x2(transform.jacobian(start))
    spacing = _COARSE_SPACING_PX if coarse else 1
    patches = templates.coarse if coarse else templates.fine
    shift, correlation = _align_patches_kernel(
        image, patches, start, derivative, spacing, max_shift_px, _MAX_ITERATIONS
    )
    in_frame = np.isfinite(correlation)
    good = in_frame & (np.nan_to_num(correlation) > _MIN_CORRELATION)
    raw = start[good] + np.einsum("nij,nj->ni", derivative[good], shift[good])
    decorrelation = np.sqrt(np.maximum(1.0 - correlation[good] ** 2, 0.0))
    sigma = templates.sigma_px[good] * (1.0 + 4.0 * decorrelation) * (spacing if coarse else 1)
    return ControlPoints(raw, templates.xy[good], sigma), int(in_frame.sum())


@njit(cache=True, nogil=True)
def _sample_patch(image, patch, start, derivative, shift, spacing, sample, visible):  # type: ignore[no-untyped-def]
    """Sample the frame under a patch shifted by ``shift``; the number of pixels in the frame, their mean in both."""
    side = patch.shape[0]
    half = side // 2
    height, width = image.shape
    count, frame_mean, patch_mean = 0, 0.0, 0.0
    for r in range(side):
        for c in range(side):
            ox, oy = (c - half) * spacing + shift[0], (r - half) * spacing + shift[1]
            x = start[0] + derivative[0, 0] * ox + derivative[0, 1] * oy
            y = start[1] + derivative[1, 0] * ox + derivative[1, 1] * oy
            visible[r, c] = x >= 0.0 and y >= 0.0 and x < width - 1.0 and y < height - 1.0
            if visible[r, c]:
                j, k = int(x), int(y)
                fx, fy = x - j, y - k
                top = image[k, j] + fx * (image[k, j + 1] - image[k, j])
                bottom = image[k + 1, j] + fx * (image[k + 1, j + 1] - image[k + 1, j])
                sample[r, c] = top + fy * (bottom - top)
                frame_mean += sample[r, c]
                patch_mean += patch[r, c]
                count += 1
    return count, frame_mean / max(count, 1), patch_mean / max(count, 1)


@njit(cache=True, nogil=True)
def _gauss_newton_step(patch, sample, visible, frame_mean, patch_mean, spacing):  # type: ignore[no-untyped-def]
    """Gauss-Newton step (2) of a patch and its correlation over the visible pixels; correlation -1: no texture."""
    side = patch.shape[0]
    frame_square, patch_square, product = 0.0, 0.0, 0.0
    for r in range(side):
        for c in range(side):
            if visible[r, c]:
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
            if visible[r, c]:
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
def _gradients(patch, spacing, centred, gx, gy):  # type: ignore[no-untyped-def]
    """Fill in a patch less its mean and its gradients, zero in the border; sums that every step of it needs."""
    side = patch.shape[0]
    mean = 0.0
    for r in range(side):
        for c in range(side):
            mean += patch[r, c]
    mean /= side * side
    square, hxx, hxy, hyy, sum_x, sum_y, own_x, own_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(side):
        for c in range(side):
            value = patch[r, c] - mean
            centred[r, c] = value
            square += value * value
            gx[r, c], gy[r, c] = 0.0, 0.0
    for r in range(1, side - 1):
        for c in range(1, side - 1):
            x = (patch[r, c + 1] - patch[r, c - 1]) / (2.0 * spacing)
            y = (patch[r + 1, c] - patch[r - 1, c]) / (2.0 * spacing)
            gx[r, c], gy[r, c] = x, y
            hxx += x * x
            hxy += x * y
            hyy += y * y
            sum_x += x
            sum_y += y
            own_x += x * centred[r, c]
            own_y += y * centred[r, c]
    return square, hxx, hxy, hyy, sum_x, sum_y, own_x, own_y


@njit(cache=True, nogil=True)
def _is_inside(image, start, derivative, shift, reach):  # type: ignore[no-untyped-def]
    """Whether a whole patch, shifted by ``shift``, lies in the frame."""
    height, width = image.shape
    x = start[0] + derivative[0, 0] * shift[0] + derivative[0, 1] * shift[1]
    y = start[1] + derivative[1, 0] * shift[0] + derivative[1, 1] * shift[1]
    dx = reach * (abs(derivative[0, 0]) + abs(derivative[0, 1]))
    dy = reach * (abs(derivative[1, 0]) + abs(derivative[1, 1]))
    return x - dx >= 0.0 and y - dy >= 0.0 and x + dx < width - 1.0 and y + dy < height - 1.0


@njit(cache=True, nogil=True)
def _step_inside(image, start, derivative, shift, spacing, centred, gx, gy, sums):  # type: ignore[no-untyped-def]
    """Gauss-Newton step and correlation of a patch that lies in the frame as a whole, in one pass over its pixels.

    Equal to `_sample_patch` and `_gauss_newton_step`: their sums over differences to the means are expanded. Without
    numba's fastmath: with it, code just compiled and the same code from the cache differed in the last bits.
    """
    side = centred.shape[0]
    half = side // 2
    square, hxx, hxy, hyy, sum_x, sum_y, own_x, own_y = sums
    total, total_square, product, with_x, with_y = 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(side):
        oy = (r - half) * spacing + shift[1]
        ox = shift[0] - half * spacing
        x = start[0] + derivative[0, 0] * ox + derivative[0, 1] * oy
        y = start[1] + derivative[1, 0] * ox + derivative[1, 1] * oy
        for c in range(side):
            px, py = x + derivative[0, 0] * (c * spacing), y + derivative[1, 0] * (c * spacing)
            fx, fy = np.float32(px - int(px)), np.float32(py - int(py))
            j, k = np.uint64(int(px)), np.uint64(int(py))  # unsigned: numba checks no index for its sign
            after, below = j + np.uint64(1), k + np.uint64(1)
            top = image[k, j] + fx * (image[k, after] - image[k, j])
            bottom = image[below, j] + fx * (image[below, after] - image[below, j])
            value = float(top + fy * (bottom - top))
            total += value
            total_square += value * value
            product += value * centred[r, c]
            with_x += value * gx[r, c]
            with_y += value * gy[r, c]
    mean = total / (side * side)
    frame_square = total_square - mean * total
    determinant = hxx * hyy - hxy * hxy
    if frame_square <= 1e-3 or square <= 1e-3 or determinant <= 1e-6 * (hxx + hyy) ** 2:
        return 0.0, 0.0, -1.0
    gain = np.sqrt(square / frame_square)
    bx, by = gain * (with_x - mean * sum_x) - own_x, gain * (with_y - mean * sum_y) - own_y
    return (
        (hyy * bx - hxy * by) / determinant,
        (hxx * by - hxy * bx) / determinant,
        product / np.sqrt(frame_square * square),
    )


@njit(cache=True, nogil=True)
def _align_patches_kernel(image, patches, start, derivative, spacing, max_shift, iterations):  # type: ignore[no-untyped-def]
    """Shift (n, 2) in base px and correlation (n,) of each patch.

    The correlation is NaN where the patch is not in the frame, 0 where the iteration did not converge.
    """
    n = patches.shape[0]
    side = int(np.sqrt(patches.shape[1]) + 0.5)
    shift = np.zeros((n, 2))
    correlation = np.full(n, np.nan)
    sample = np.empty((side, side), np.float32)
    visible = np.empty((side, side), np.bool_)
    centred, gx, gy = np.empty((side, side)), np.empty((side, side)), np.empty((side, side))
    reach = (side // 2) * spacing
    for i in range(n):
        if not np.isfinite(start[i, 0] + derivative[i, 0, 0] + derivative[i, 0, 1]):
            continue
        patch = patches[i].reshape(side, side)
        sums = _gradients(patch, spacing, centred, gx, gy)
        score, converged, in_frame = 0.0, False, True
        for _ in range(iterations):
            if _is_inside(image, start[i], derivative[i], shift[i], reach):
                x, y, score = _step_inside(image, start[i], derivative[i], shift[i], spacing, centred, gx, gy, sums)
            else:
                count, frame_mean, patch_mean = _sample_patch(
                    image, patch, start[i], derivative[i], shift[i], spacing, sample, visible
                )
                in_frame = count >= _MIN_VISIBLE_FRACTION * side * side
                if not in_frame:
                    break
                x, y, score = _gauss_newton_step(patch, sample, visible, frame_mean, patch_mean, spacing)
            length = np.sqrt(x * x + y * y)
            factor = min(1.0, 2.0 * spacing / max(length, 1e-9))
            shift[i, 0] -= x * factor
            shift[i, 1] -= y * factor
            converged = length < _CONVERGED_PX * spacing
            if converged or score < 0.0 or shift[i, 0] ** 2 + shift[i, 1] ** 2 > max_shift**2:
                break
        if in_frame:
            correlation[i] = score if converged else 0.0
    return shift, correlation
