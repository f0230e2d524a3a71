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
from velfield.registration.transforms import FrameTransform

N_PATCHES_SAME_SENSOR, N_PATCHES_CROSS_SENSOR = 3000, 6000
"""Patches of a base image of the frames' own camera, and of another sensor's: about half of those fail to align."""
_CELL_PX = (10.0, 40.0)
HALF_PATCH = 7
_FINE_SIGMA_PX = 0.8
"""Gaussian blur of both images: bilinear sampling of the raw frame is accurate enough after it."""
_FINE_TAPS = 7
_COARSE_SPACING_PX = 2
_NOISE_GREY = 3.0
_MAX_SIGMA_PX = 0.35
"""Corners whose position has a larger standard deviation under noise of three grey levels are rejected."""
_MIN_SIGMA_PX = 0.06
_MAX_ITERATIONS = 12
_MIN_CORRELATION = 0.7
_MIN_VISIBLE_FRACTION = 0.6
"""Fraction of a patch that must lie in the frame: patches of the first and last rows are cut in half."""
_CONVERGED_PX = 0.02
_FRACTION_BITS = 24
"""Of positions at which the frame is sampled: as many as a float32 holds."""
_LANES = 8
"""Values of float32 in a vector of the processor."""


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
    taps = cv2.getGaussianKernel(_FINE_TAPS, _FINE_SIGMA_PX)
    return np.asarray(cv2.sepFilter2D(grey, cv2.CV_32F, taps, taps), np.float32)


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
    start, derivative = transform.to_raw_in_frame(templates.xy)
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
def _gradients(patch, spacing, centred, gx, gy, sums):  # type: ignore[no-untyped-def]
    """Fill in a patch less its mean and its gradients, zero in the border and beyond; sums that every step needs.

    ``centred``, ``gx``, ``gy`` (side, columns) and the scratch ``sums`` (7, columns) have whole vectors of columns. A
    sum for each column leaves no order of additions to the compiler.
    """
    side, inner = patch.shape[0], np.uint64(patch.shape[0] - 1)
    gx[0], gy[0], gx[side - 1], gy[side - 1], sums[:] = 0.0, 0.0, 0.0, 0.0, 0.0
    a0, a1, a2, a3, a4, a5, a6 = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6]
    total = 0.0
    for r in range(side):
        line = patch[r]
        for c in range(np.uint64(side)):
            a6[c] += line[c]
    for c in range(side):
        total += a6[c]
    mean, factor, one = np.float32(total / (side * side)), np.float32(0.5 / spacing), np.uint64(1)
    for r in range(side):
        line, out = patch[r], centred[r]
        for c in range(np.uint64(side)):
            out[c] = line[c] - mean
    for r in range(1, side - 1):
        line, above, below, along, across = patch[r], patch[r - 1], patch[r + 1], gx[r], gy[r]
        for c in range(one, inner):
            along[c] = factor * (line[c + one] - line[c - one])
            across[c] = factor * (below[c] - above[c])
    for r in range(side):
        value, along, across = centred[r], gx[r], gy[r]
        for c in range(np.uint64(side)):
            a0[c] += value[c] * value[c]
            a1[c] += along[c] * along[c]
            a2[c] += along[c] * across[c]
        for c in range(np.uint64(side)):
            a3[c] += across[c] * across[c]
            a4[c] += along[c] * value[c]
            a5[c] += across[c] * value[c]
    square, hxx, hxy, hyy, own_x, own_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(side):
        square += a0[c]
        hxx += a1[c]
        hxy += a2[c]
        hyy += a3[c]
        own_x += a4[c]
        own_y += a5[c]
    return square, hxx, hxy, hyy, own_x, own_y


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
def _step_inside(image, start, derivative, shift, spacing, centred, gx, gy, of_patch, sample, sums):  # type: ignore[no-untyped-def]
    """Gauss-Newton step and correlation of a patch that lies in the frame as a whole.

    Equal to `_sample_patch` and `_gauss_newton_step` but for the rounding of float32. The frame is sampled at positions
    in whole multiples of 2^-24 px, of which integers alone give pixel and fraction: twice as fast as converting floats.
    The scratch ``sample`` (side, columns) and ``sums`` (7, columns) have whole vectors of columns. Without numba's
    fastmath: with it, code just compiled and the same code from the cache differed in the last bits.
    """
    side = centred.shape[0]
    half = side // 2
    square, hxx, hxy, hyy, own_x, own_y = of_patch
    flat, width = image.ravel(), image.shape[1]
    one, under = np.uint64(1), np.uint64(width)
    unit, part = float(1 << _FRACTION_BITS), np.float32(1.0 / (1 << _FRACTION_BITS))
    fraction = (1 << _FRACTION_BITS) - 1
    ox, oy = shift[0] - half * spacing, shift[1] - half * spacing
    left = start[0] + derivative[0, 0] * ox + derivative[0, 1] * oy
    top = start[1] + derivative[1, 0] * ox + derivative[1, 1] * oy
    step_x, step_y = int(derivative[0, 0] * spacing * unit), int(derivative[1, 0] * spacing * unit)
    sums[:] = 0.0
    a0, a1, a2, a3, a4 = sums[0], sums[1], sums[2], sums[3], sums[4]
    for r in range(side):
        x = int((left + derivative[0, 1] * (r * spacing)) * unit)
        y = int((top + derivative[1, 1] * (r * spacing)) * unit)
        out = sample[r]
        for c in range(np.uint64(side)):
            at = np.uint64((y >> _FRACTION_BITS) * width + (x >> _FRACTION_BITS))
            fx, fy = np.float32(x & fraction) * part, np.float32(y & fraction) * part
            upper = flat[at] + fx * (flat[at + one] - flat[at])
            lower = flat[at + under] + fx * (flat[at + under + one] - flat[at + under])
            out[c] = upper + fy * (lower - upper)
            x += step_x
            y += step_y
        for c in range(np.uint64(side)):
            a4[c] += out[c]
    total = 0.0
    for c in range(side):
        total += a4[c]
    mean = np.float32(total / (side * side))
    for r in range(side):
        out, value, along, across = sample[r], centred[r], gx[r], gy[r]
        for c in range(np.uint64(side)):
            e = out[c] - mean
            a0[c] += e * e
            a1[c] += e * value[c]
            a2[c] += e * along[c]
            a3[c] += e * across[c]
    frame_square, product, with_x, with_y = 0.0, 0.0, 0.0, 0.0
    for c in range(side):
        frame_square += a0[c]
        product += a1[c]
        with_x += a2[c]
        with_y += a3[c]
    determinant = hxx * hyy - hxy * hxy
    if frame_square <= 1e-3 or square <= 1e-3 or determinant <= 1e-6 * (hxx + hyy) ** 2:
        return 0.0, 0.0, -1.0
    gain = np.sqrt(square / frame_square)
    bx, by = gain * with_x - own_x, gain * with_y - own_y
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
    visible = np.empty((side, side), np.bool_)
    columns = (side + _LANES - 1) // _LANES * _LANES
    sample, centred = np.zeros((side, columns), np.float32), np.zeros((side, columns), np.float32)
    gx, gy = np.zeros((side, columns), np.float32), np.zeros((side, columns), np.float32)
    sums = np.zeros((7, columns), np.float32)
    reach = (side // 2) * spacing
    height, width = image.shape
    for i in range(n):
        if not np.isfinite(start[i, 0] + derivative[i, 0, 0] + derivative[i, 0, 1]):
            continue
        if not (0.0 <= start[i, 0] < width and 0.0 <= start[i, 1] < height):
            continue  # less than half of it is visible
        patch = patches[i].reshape(side, side)
        of_patch = _gradients(patch, spacing, centred, gx, gy, sums)
        score, converged, in_frame = 0.0, False, True
        for _ in range(iterations):
            if _is_inside(image, start[i], derivative[i], shift[i], reach):
                x, y, score = _step_inside(
                    image, start[i], derivative[i], shift[i], spacing, centred, gx, gy, of_patch, sample, sums
                )
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
