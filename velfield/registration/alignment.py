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
from numpy.typing import NDArray

from schemas.arrays import Float32Array, FloatArray, GreyImage, IntArray, Mask
from velfield.compiled import compiled
from velfield.registration.control_points import ControlPoints
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


@dataclass(frozen=True, eq=False)
class Templates:
    """Patches at corners of the base image."""

    xy: FloatArray
    """(n, 2) base px, integers."""
    sigma_px: FloatArray
    """(n,) standard deviation of the position under image noise."""
    fine: Float32Array
    coarse: Float32Array
    """(m, side * side) float32 grey levels about corners, sampled at every and every second pixel."""
    rows: IntArray
    """(n,) of each in ``fine`` and ``coarse``: a selection shares these."""

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, selection: Mask | IntArray) -> "Templates":
        """The templates of a mask (n,) or of indices."""
        return Templates(self.xy[selection], self.sigma_px[selection], self.fine, self.coarse, self.rows[selection])


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
        rows=np.arange(len(xy)),
    )


def make_templates(
    base: GreyImage,
    mask: Mask | None = None,
    *,
    count: int = N_PATCHES_SAME_SENSOR,
    exclude: FloatArray | None = None,
    half_patch: int = HALF_PATCH,
) -> Templates:
    """Detect the strongest corner (Shi-Tomasi) of each of about ``count`` cells of a base image (h, w) uint8.

    It is valid in ``mask`` (h, w) bool, None: everywhere. No corner lies within `HALF_PATCH` of the points ``exclude``
    (n, 2). Larger patches, ``half_patch`` px to every side, are less sensitive to noise, but span more relief.
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


def _find_cell_maxima(strength: Float32Array, cell: int) -> tuple[IntArray, Float32Array]:
    """Position (n, 2) and value (n,) of each cell's first maximum, in rows of cells."""
    height, width = strength.shape
    rows, columns = -(-height // cell), -(-width // cell)
    padded = np.zeros((rows * cell, columns * cell), np.float32)
    padded[:height, :width] = strength
    cells = padded.reshape(rows, cell, columns, cell).swapaxes(1, 2).reshape(rows * columns, -1)
    numbers, best = np.arange(len(cells)), cells.argmax(axis=1)
    xy = np.stack([numbers % columns * cell + best % cell, numbers // columns * cell + best // cell], axis=1)
    return xy, cells[numbers, best]


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

    The image (h, w) is the frame blurred by `smooth_fine` and, if ``coarse``, by `smooth_coarse` after it. Patches that
    move by more than ``max_shift_px``, base px, are rejected. Also the number of patches that lie in the frame.
    """
    start, derivative = transform.to_raw_in_frame(templates.xy)
    spacing = _COARSE_SPACING_PX if coarse else 1
    patches = templates.coarse if coarse else templates.fine
    shift, correlation = _align_patches(
        np.ascontiguousarray(image), patches, templates.rows, start, derivative, spacing, max_shift_px
    )
    in_frame = np.isfinite(correlation)
    good = in_frame & (np.nan_to_num(correlation) > _MIN_CORRELATION)
    raw = start[good] + np.einsum("nij,nj->ni", derivative[good], shift[good])
    decorrelation = np.sqrt(np.maximum(1.0 - correlation[good] ** 2, 0.0))
    sigma = templates.sigma_px[good] * (1.0 + 4.0 * decorrelation) * (spacing if coarse else 1)
    return ControlPoints(raw, templates.xy[good], sigma), int(in_frame.sum())


@compiled(error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _align_patches(
    image: Float32Array,
    patches: Float32Array,
    chosen: IntArray,
    start: FloatArray,
    derivative: FloatArray,
    spacing: int,
    max_shift: float,
) -> tuple[FloatArray, FloatArray]:
    """Shift (n, 2) in base px and correlation (n,) of each of the ``chosen`` (n,) patches.

    The correlation is NaN where the patch is not in the frame, 0 where the iteration did not converge.

    Each step is three plain loops over the patch, of float32 and without branches: they become vectors. Grey levels are
    less the patch's middle one, which keeps the sums small.
    """
    n, side = chosen.size, int(np.sqrt(patches.shape[1]) + 0.5)
    half, size = side // 2, np.uint64(side * side)
    shift, correlation = np.zeros((n, 2)), np.full(n, np.nan)
    height, width = image.shape
    last_x, last_y = np.float32(width - 1), np.float32(height - 1)
    flat, stride, next_one = image.ravel(), np.uint64(width), np.uint64(1)
    zero, one, step = np.float32(0), np.float32(1), np.float32(spacing)
    column, row, at = np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.int32)
    patch, slope_x, slope_y, visible, sample, fraction_x, fraction_y = np.zeros((7, side * side), np.float32)
    for k in range(side * side):
        column[k], row[k] = (k % side - half) * spacing, (k // side - half) * spacing
    for i in range(n):
        dxx, dxy = np.float32(derivative[i, 0, 0]), np.float32(derivative[i, 0, 1])
        dyx, dyy = np.float32(derivative[i, 1, 0]), np.float32(derivative[i, 1, 1])
        if not (0.0 <= start[i, 0] < width and 0.0 <= start[i, 1] < height and np.isfinite(derivative[i]).all()):
            continue  # less than half of it is visible
        middle = patches[chosen[i], size // np.uint64(2)]
        for k in range(size):
            patch[k] = patches[chosen[i], k] - middle
        for r in range(1, side - 1):
            for k in range(r * side + 1, (r + 1) * side - 1):
                slope_x[k] = (patch[k + 1] - patch[k - 1]) / (2 * step)
                slope_y[k] = (patch[k + side] - patch[k - side]) / (2 * step)
        score, converged, in_frame = 0.0, False, True
        for _ in range(_MAX_ITERATIONS):
            x0 = np.float32(start[i, 0] + derivative[i, 0, 0] * shift[i, 0] + derivative[i, 0, 1] * shift[i, 1])
            y0 = np.float32(start[i, 1] + derivative[i, 1, 0] * shift[i, 0] + derivative[i, 1, 1] * shift[i, 1])
            count = zero
            for k in range(size):
                x, y = x0 + dxx * column[k] + dxy * row[k], y0 + dyx * column[k] + dyy * row[k]
                inside = (x >= zero) & (y >= zero) & (x < last_x) & (y < last_y)
                visible[k] = one if inside else zero
                count += visible[k]
                x, y = x if inside else zero, y if inside else zero
                left, top = np.int32(x), np.int32(y)
                fraction_x[k], fraction_y[k] = x - np.float32(left), y - np.float32(top)
                at[k] = top * np.int32(width) + left
            in_frame = bool(count >= _MIN_VISIBLE_FRACTION * side * side)
            if not in_frame:
                break
            for k in range(size):
                place = np.uint64(at[k])
                below = place + stride
                upper = flat[place] + fraction_x[k] * (flat[place + next_one] - flat[place])
                lower = flat[below] + fraction_x[k] * (flat[below + next_one] - flat[below])
                sample[k] = (upper + fraction_y[k] * (lower - upper) - middle) * visible[k]
            of_sample, of_patch, sample_square, patch_square, product = zero, zero, zero, zero, zero
            of_x, of_y, xx, xy, yy = zero, zero, zero, zero, zero
            sample_x, sample_y, patch_x, patch_y = zero, zero, zero, zero
            for k in range(size):
                s, p, x, y = sample[k], patch[k] * visible[k], slope_x[k] * visible[k], slope_y[k] * visible[k]
                of_sample, of_patch, of_x, of_y = of_sample + s, of_patch + p, of_x + x, of_y + y
                sample_square, patch_square, product = sample_square + s * s, patch_square + p * p, product + s * p
                xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
                sample_x, sample_y = sample_x + s * x, sample_y + s * y
                patch_x, patch_y = patch_x + p * x, patch_y + p * y
            sample_mean, patch_mean = of_sample / count, of_patch / count
            sample_square -= of_sample * sample_mean
            patch_square -= of_patch * patch_mean
            determinant = xx * yy - xy * xy
            if sample_square <= 1e-3 or patch_square <= 1e-3 or determinant <= 1e-6 * (xx + yy) ** 2:
                break  # no texture
            score = (product - of_sample * patch_mean) / np.sqrt(sample_square * patch_square)
            gain = np.sqrt(patch_square / sample_square)
            error_x = gain * (sample_x - sample_mean * of_x) - (patch_x - patch_mean * of_x)
            error_y = gain * (sample_y - sample_mean * of_y) - (patch_y - patch_mean * of_y)
            move_x, move_y = (yy * error_x - xy * error_y) / determinant, (xx * error_y - xy * error_x) / determinant
            length = np.sqrt(move_x * move_x + move_y * move_y)
            factor = min(1.0, 2.0 * spacing / max(length, 1e-9))
            shift[i, 0] -= move_x * factor
            shift[i, 1] -= move_y * factor
            converged = length < _CONVERGED_PX * spacing
            if converged or shift[i, 0] ** 2 + shift[i, 1] ** 2 > max_shift**2:
                break
        if in_frame:
            correlation[i] = score if converged else 0.0
    return shift, correlation
