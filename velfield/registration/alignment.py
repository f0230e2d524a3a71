"""Subpixel alignment: patches at corners of the base image, located in the full-resolution raw frame (Lucas-Kanade).

The template stays in base pixels; the raw frame is sampled through the Jacobian of the frame's own map, so that no
image is resampled twice and a patch follows rotation, scale and rolling shutter. The shift of each patch is estimated
by inverse compositional Gauss-Newton steps with free gain and offset of the grey levels, which makes it invariant to
exposure and vignetting.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from schemas.arrays import ByteArray, Float32Array, FloatArray, GreyImage, IntArray, Mask
from velfield.compiled import kernel
from velfield.registration.joint import ControlPoints
from velfield.registration.transforms import FrameTransform
from velfield.vectors import LONG, REAL, WORD, Vectors

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
_GREY_STEPS = 256
"""Steps in one grey level of the blurred frame, which is sampled from 16 bits: a step is far below its noise."""
_LANES, _BLOCK = 8, 16
"""Values of float32 in a vector of the processor; values of one pass of a loop over a patch: two vectors."""
_MAX_REACH_PX = 256.0
"""A patch that spreads over more of the frame than this to any side is magnified beyond sense, and does not align."""


@dataclass(frozen=True, eq=False)
class Templates:
    """Patches at corners of the base image.

    Attributes
    ----------
    xy : (n, 2) base px, integers.
    sigma_px : (n,) standard deviation of the position under image noise.
    fine, coarse : (m, side * side) float32 grey levels about corners, sampled at every and every second pixel.
    rows : (n,) of each in ``fine`` and ``coarse``: a selection shares these.
    """

    xy: FloatArray
    sigma_px: FloatArray
    fine: Float32Array
    coarse: Float32Array
    rows: IntArray

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, selection: Mask | IntArray) -> "Templates":
        """The templates of a mask (n,) or of indices."""
        return Templates(self.xy[selection], self.sigma_px[selection], self.fine, self.coarse, self.rows[selection])


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


@kernel
def _find_cell_maxima(strength: Float32Array, cell: int) -> tuple[IntArray, Float32Array]:
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
    image: GreyImage | Float32Array,
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
        (h, w) uint8, the raw frame, which is blurred as by `smooth_fine` about each patch; or float32, the raw frame
        blurred by `smooth_fine` or, if ``coarse``, by `smooth_coarse` after it.
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
    taps = cv2.getGaussianKernel(_FINE_TAPS, _FINE_SIGMA_PX, cv2.CV_32F).ravel()[_FINE_TAPS // 2 :]
    shift, correlation = _align_patches_kernel(
        np.ascontiguousarray(image),
        taps if image.dtype == np.uint8 else taps[:0],
        patches,
        templates.rows,
        start,
        derivative,
        spacing,
        max_shift_px,
        _MAX_ITERATIONS,
    )
    in_frame = np.isfinite(correlation)
    good = in_frame & (np.nan_to_num(correlation) > _MIN_CORRELATION)
    raw = start[good] + np.einsum("nij,nj->ni", derivative[good], shift[good])
    decorrelation = np.sqrt(np.maximum(1.0 - correlation[good] ** 2, 0.0))
    sigma = templates.sigma_px[good] * (1.0 + 4.0 * decorrelation) * (spacing if coarse else 1)
    return ControlPoints(raw, templates.xy[good], sigma), int(in_frame.sum())


@kernel
def _reflect(at: int, size: int) -> int:
    """Index within an axis of this size of a position beyond its ends, as OpenCV's default border: 2 1 0 1 2."""
    at = abs(at)
    at = 2 * (size - 1) - at if at >= size else at
    return min(max(at, 0), size - 1)


def _blurred(vectors: Vectors, factors: list[Any], values: list[Any]) -> Any:
    """Sum of seven vectors by the centre's and the following three of seven symmetric factors."""
    build, total = vectors.build, vectors.build.fmul(factors[0], values[3])
    for k in (1, 2, 3):
        total = build.fadd(total, build.fmul(factors[k], build.fadd(values[3 - k], values[3 + k])))
    return total


@intrinsic
def _blur_across(_context, source, first, taps, out, place):  # type: ignore[no-untyped-def]
    """Blur 8 pixels along a row of bytes, ``source[first]`` the third before the first of them."""

    def generate(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, build, signature, arguments, _LANES)
        source, first, taps, out, place = v.arguments
        factors = [v.spread(v.load(taps, k, kind=REAL)) for k in range(4)]
        values = [build.uitofp(v.load(source, first, k), v.kind(REAL)) for k in range(7)]
        v.store(_blurred(v, factors, values), out, place)
        return context.get_dummy_value()

    return types.void(source, first, taps, out, place), generate


@intrinsic
def _blur_down(_context, source, first, stride, taps, out, place):  # type: ignore[no-untyped-def]
    """Blur 8 pixels down rows ``stride`` values apart, ``source[first]`` three rows above; in steps of grey levels."""

    def generate(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, build, signature, arguments, _LANES)
        source, first, stride, taps, out, place = v.arguments
        factors = [v.spread(v.load(taps, k, kind=REAL)) for k in range(4)]
        values = [v.load(source, first, build.mul(stride, LONG(k))) for k in range(7)]
        steps = build.fmul(_blurred(v, factors, values), v.constant(REAL, float(_GREY_STEPS)))
        v.store(build.fptosi(build.fadd(steps, v.constant(REAL, 0.5)), v.kind(WORD)), out, place)
        return context.get_dummy_value()

    return types.void(source, first, stride, taps, out, place), generate


@intrinsic
def _pack_four(_context, levels, first, stride, out, place):  # type: ignore[no-untyped-def]
    """Pack 8 pixels of an int32 image, from ``levels[first]`` on, each with those right of and below it and between."""

    def generate(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, build, signature, arguments, _LANES)
        levels, first, stride, out, place = v.arguments
        shift, far = v.constant(WORD, 16), v.constant(LONG, 32)
        upper = build.or_(v.load(levels, first), build.shl(v.load(levels, first, 1), shift))
        lower = build.or_(v.load(levels, first, stride), build.shl(v.load(levels, first, stride, 1), shift))
        upper, lower = (build.zext(pair, v.kind(LONG)) for pair in (upper, lower))
        v.store(build.or_(upper, build.shl(lower, far)), out, place)
        return context.get_dummy_value()

    return types.void(levels, first, stride, out, place), generate


@intrinsic
def _add_samples(_context, window, stride, last, x, y, step_x, step_y, templates, first, count, near, sums):  # type: ignore[no-untyped-def]
    """Interpolate 16 pixels of a packed window from (x, y) on, and add what a Gauss-Newton step needs to ``sums``.

    ``templates`` holds, ``count`` values apart, where the patch is, its grey levels less their mean, and its gradients;
    ``sums`` (5 x 16) those of the samples less ``near``, their squares, and their products with the last three.
    """

    def generate(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, build, signature, arguments, _BLOCK)
        window, stride, last, x, y, step_x, step_y, templates, first, count, near, sums = v.arguments
        lanes = v.constant(REAL, np.arange(_BLOCK, dtype=float))
        fractions, pixels = [], []
        for start, step in ((x, step_x), (y, step_y)):
            position = build.fadd(v.spread(start), build.fmul(lanes, v.spread(step)))
            pixels.append(build.fptosi(position, v.kind(WORD)))
            fractions.append(build.fsub(position, build.sitofp(pixels[-1], v.kind(REAL))))
        at = build.add(build.mul(pixels[1], v.spread(stride)), pixels[0])
        for limit, order in ((v.constant(WORD, 0), ">"), (v.spread(last), "<")):  # lanes beyond the patch
            at = build.select(build.icmp_signed(order, at, limit), at, limit)
        four = ir.Constant(v.kind(LONG), ir.Undefined)
        for k in range(_BLOCK):
            number = build.zext(build.extract_element(at, WORD(k)), LONG)
            four = build.insert_element(four, v.load(window, number, kind=LONG), WORD(k))
        low, shift = v.constant(WORD, 0xFFFF), v.constant(WORD, 16)
        rows = []
        for pair in (four, build.lshr(four, v.constant(LONG, 32))):
            word = build.trunc(pair, v.kind(WORD))
            left, right = build.and_(word, low), build.lshr(word, shift)
            left, right = (build.sitofp(value, v.kind(REAL)) for value in (left, right))
            rows.append(build.fadd(left, build.fmul(fractions[0], build.fsub(right, left))))
        value = build.fadd(rows[0], build.fmul(fractions[1], build.fsub(rows[1], rows[0])))
        value = build.fsub(build.fmul(value, v.constant(REAL, 1.0 / _GREY_STEPS)), v.spread(near))
        value = build.fmul(value, v.load(templates, first))
        v.add(value, sums)
        v.add(build.fmul(value, value), sums, _BLOCK)
        for k in (1, 2, 3):
            v.add(build.fmul(value, v.load(templates, first, build.mul(count, LONG(k)))), sums, (k + 1) * _BLOCK)
        return context.get_dummy_value()

    arguments = (window, stride, last, x, y, step_x, step_y, templates, first, count, near, sums)
    return types.void(*arguments), generate


@intrinsic
def _add_gradients(_context, padded, row, mean, factor, templates, inner, first, count, sums):  # type: ignore[no-untyped-def]
    """Fill in 16 values of a patch less its mean and of its gradients in ``templates``, as `_add_samples` takes them.

    ``padded`` holds the patch in rows of ``row`` values after one row of zeros, ``inner`` is one within its border.
    ``sums`` (8 x 16) are those of the squares, the products of gradients (xx, xy, yy), of gradients and grey levels
    (x, y), and of the gradients (x, y).
    """

    def generate(context: Any, build: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, build, signature, arguments, _BLOCK)
        padded, row, mean, factor, templates, inner, first, count, sums = v.arguments
        value = build.fsub(v.load(padded, first, row), v.spread(mean))
        value = build.fmul(value, v.load(templates, first))
        scale = build.fmul(v.spread(factor), v.load(inner, first))
        x = build.fmul(scale, build.fsub(v.load(padded, first, row, 1), v.load(padded, first, row, -1)))
        y = build.fmul(scale, build.fsub(v.load(padded, first, row, row), v.load(padded, first)))
        for k, part in enumerate((value, x, y)):
            v.store(part, templates, first, build.mul(count, LONG(k + 1)))
        products = ((value, value), (x, x), (x, y), (y, y), (x, value), (y, value))
        for k, part in enumerate([*(build.fmul(one, other) for one, other in products), x, y]):
            v.add(part, sums, k * _BLOCK)
        return context.get_dummy_value()

    return types.void(padded, row, mean, factor, templates, inner, first, count, sums), generate


@kernel
def _fill_window(image, taps, x0, y0, rows, columns, line, across, levels, window) -> float:  # type: ignore[no-untyped-def]
    """Fill in ``window`` (rows * columns) from pixel (x0, y0) of a frame on: each pixel of the blurred frame with those
    right of, below, and right below it, 16 bits each, one number to load where an interpolation needs four.

    A frame of bytes is blurred as by `smooth_fine`; one of float32, where there are no ``taps``, is taken as it is.
    The scratch is ``line`` (columns + 6) uint8, ``across`` ((rows + 6) * columns) float32 and ``levels`` ((rows + 1) *
    columns) int32, with whole vectors of columns. Returns the grey level in the middle.
    """
    height, width = image.shape
    stride, eight = np.uint64(columns), np.uint64(_LANES)
    if taps.size:
        left = x0 - 3
        inside = left >= 0 and left + columns + 6 <= width
        flat = image.ravel()
        for r in range(rows + 6):
            begin = _reflect(y0 - 3 + r, height) * width
            if inside:
                first = np.uint64(begin + left)
                for c in range(np.uint64(0), stride, eight):
                    _blur_across(flat, first + c, taps, across, np.uint64(r) * stride + c)
            else:
                for k in range(columns + 6):
                    line[k] = flat[begin + _reflect(left + k, width)]
                for c in range(np.uint64(0), stride, eight):
                    _blur_across(line, c, taps, across, np.uint64(r) * stride + c)
        for at in range(np.uint64(0), np.uint64(rows) * stride, eight):
            _blur_down(across, at, stride, taps, levels, at)
    else:
        for r in range(rows):
            for c in range(columns):
                grey = image[_reflect(y0 + r, height), _reflect(x0 + c, width)]
                levels[r * columns + c] = np.int32(grey * np.float32(_GREY_STEPS) + np.float32(0.5))
    for at in range(np.uint64(0), np.uint64(rows - 1) * stride, eight):
        _pack_four(levels, at, stride, window, at)
    return float(levels[(rows // 2) * columns + columns // 2] / _GREY_STEPS)


@kernel
def _sample_patch(  # type: ignore[no-untyped-def]
    window, columns, x0, y0, shape, patch, start, derivative, shift, spacing, sample, visible
) -> tuple[int, float, float]:
    """Sample the frame under a patch shifted by ``shift``; the number of pixels in the frame, their mean in both.

    ``window`` holds the frame of this shape from pixel (x0, y0) on, ``columns`` a row, as `_fill_window` makes it.
    """
    side = patch.shape[0]
    half = side // 2
    height, width = shape
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
                four = window[(k - y0) * columns + j - x0]
                a, b, below = four & 0xFFFF, (four >> 16) & 0xFFFF, (four >> 32) & 0xFFFF
                top = a + fx * (b - a)
                bottom = below + fx * (((four >> 48) & 0xFFFF) - below)
                sample[r, c] = (top + fy * (bottom - top)) / _GREY_STEPS
                frame_mean += sample[r, c]
                patch_mean += patch[r, c]
                count += 1
    return count, frame_mean / max(count, 1), patch_mean / max(count, 1)


@kernel
def _gauss_newton_step(
    patch: Float32Array, sample: Float32Array, visible: Mask, frame_mean: float, patch_mean: float, spacing: int
) -> tuple[float, float, float]:
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


@kernel
def _prepare_patch(patch, spacing, row, padded, templates, inner, sums) -> tuple[float, ...]:  # type: ignore[no-untyped-def]
    """Fill in a patch less its mean and its gradients, zero in the border and beyond; sums that every step needs.

    ``templates`` (4 * n) starts with ones in the patch, zeros beyond, in rows of ``row`` values, whole vectors. The
    scratch is ``padded``, n values and a row of zeros before and after these, and ``sums`` (8 * 16).
    """
    side, total = patch.shape[0], 0.0
    n = np.uint64(side * row)
    for r in range(side):
        line, begin = patch[r], np.uint64((r + 1) * row)
        for c in range(np.uint64(side)):
            padded[begin + c] = line[c]
        for c in range(np.uint64(side)):
            total += line[c]
    mean, factor = np.float32(total / (side * side)), np.float32(0.5 / spacing)
    sums[:] = 0.0
    for k in range(np.uint64(0), n, np.uint64(_BLOCK)):
        _add_gradients(padded, np.uint64(row), mean, factor, templates, inner, k, n, sums)
    out = np.zeros(8)
    for p in range(8):
        for k in range(_BLOCK):
            out[p] += sums[p * _BLOCK + k]
    return out[0], out[1], out[2], out[3], out[4], out[5], out[6], out[7]


@kernel
def _is_inside(
    image: ByteArray | Float32Array, start: FloatArray, derivative: FloatArray, shift: FloatArray, reach: int
) -> bool:
    """Whether a whole patch, shifted by ``shift``, lies in the frame."""
    height, width = image.shape
    x = start[0] + derivative[0, 0] * shift[0] + derivative[0, 1] * shift[1]
    y = start[1] + derivative[1, 0] * shift[0] + derivative[1, 1] * shift[1]
    dx = reach * (abs(derivative[0, 0]) + abs(derivative[0, 1]))
    dy = reach * (abs(derivative[1, 0]) + abs(derivative[1, 1]))
    return bool(x - dx >= 0.0 and y - dy >= 0.0 and x + dx < width - 1.0 and y + dy < height - 1.0)


@kernel
def _step_inside(  # type: ignore[no-untyped-def]
    window, columns, start, derivative, shift, spacing, side, templates, of_patch, near, sums
) -> tuple[float, ...]:
    """Gauss-Newton step of a patch that lies in the frame as a whole, its correlation, and the frame's mean under it.

    Equal to `_sample_patch` and `_gauss_newton_step` but for the rounding of float32. ``start`` is in px of the window
    that `_fill_window` makes, ``templates`` and ``of_patch`` are from `_prepare_patch`; ``near`` is about the mean,
    which keeps the sums small.
    """
    square, hxx, hxy, hyy, own_x, own_y, sum_x, sum_y = of_patch
    n, half = np.uint64(templates.size // 4), side // 2
    row, stride, last = templates.size // 4 // side, np.int32(columns), np.int32(window.size - 1)
    ox, oy = shift[0] - half * spacing, shift[1] - half * spacing
    left = start[0] + derivative[0, 0] * ox + derivative[0, 1] * oy
    top = start[1] + derivative[1, 0] * ox + derivative[1, 1] * oy
    step_x, step_y = np.float32(derivative[0, 0] * spacing), np.float32(derivative[1, 0] * spacing)
    offset = np.float32(near)
    sums[:] = 0.0
    for r in range(side):
        for c in range(0, row, _BLOCK):
            x = np.float32(left + derivative[0, 1] * (r * spacing) + derivative[0, 0] * (c * spacing))
            y = np.float32(top + derivative[1, 1] * (r * spacing) + derivative[1, 0] * (c * spacing))
            first = np.uint64(r * row + c)
            _add_samples(window, stride, last, x, y, step_x, step_y, templates, first, n, offset, sums)
    total, frame_square, product, with_x, with_y = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(_BLOCK):
        total += sums[k]
        frame_square += sums[k + _BLOCK]
        product += sums[k + 2 * _BLOCK]
        with_x += sums[k + 3 * _BLOCK]
        with_y += sums[k + 4 * _BLOCK]
    mean = total / (side * side)
    frame_square -= total * mean
    with_x, with_y = with_x - mean * sum_x, with_y - mean * sum_y
    determinant = hxx * hyy - hxy * hxy
    if frame_square <= 1e-3 or square <= 1e-3 or determinant <= 1e-6 * (hxx + hyy) ** 2:
        return 0.0, 0.0, -1.0, near
    gain = np.sqrt(square / frame_square)
    bx, by = gain * with_x - own_x, gain * with_y - own_y
    return (
        (hyy * bx - hxy * by) / determinant,
        (hxx * by - hxy * bx) / determinant,
        product / np.sqrt(frame_square * square),
        near + mean,
    )


@kernel
def _reach_in_frame(derivative: FloatArray, reach: int, max_shift: float) -> tuple[float, float]:
    """Largest distance from its start at which a patch is sampled in a frame, px along x and y, plus one pixel."""
    x = reach * (abs(derivative[0, 0]) + abs(derivative[0, 1])) + max_shift * np.hypot(
        derivative[0, 0], derivative[0, 1]
    )
    y = reach * (abs(derivative[1, 0]) + abs(derivative[1, 1])) + max_shift * np.hypot(
        derivative[1, 0], derivative[1, 1]
    )
    return x + 1.0, y + 1.0


@kernel
def _align_patches_kernel(  # type: ignore[no-untyped-def]
    image, taps, patches, chosen, start, derivative, spacing, max_shift, iterations
) -> tuple[FloatArray, FloatArray]:
    """Shift (n, 2) in base px and correlation (n,) of each of the ``chosen`` (n,) patches.

    The frame is blurred about each patch alone, where ``taps`` are given, in a window that the processor's caches hold.
    The correlation is NaN where the patch is not in the frame, 0 where the iteration did not converge.
    """
    n = chosen.size
    side = int(np.sqrt(patches.shape[1]) + 0.5)
    shift = np.zeros((n, 2))
    correlation = np.full(n, np.nan)
    height, width = image.shape
    reach = (side // 2) * spacing
    half_x, half_y = 0, 0
    usable = np.zeros(n, np.bool_)
    for i in range(n):
        if not np.isfinite(start[i, 0] + derivative[i, 0, 0] + derivative[i, 0, 1]):
            continue
        if not (0.0 <= start[i, 0] < width and 0.0 <= start[i, 1] < height):
            continue  # less than half of it is visible
        x, y = _reach_in_frame(derivative[i], reach, max_shift)
        if max(x, y) > _MAX_REACH_PX:
            correlation[i] = 0.0
            continue
        usable[i] = True
        half_x, half_y = max(half_x, int(np.ceil(x))), max(half_y, int(np.ceil(y)))
    rows, columns = 2 * half_y + 2, (2 * half_x + 2 + _LANES - 1) // _LANES * _LANES
    line, across = np.zeros(columns + 6, np.uint8), np.zeros((rows + 6) * columns, np.float32)
    levels, window = np.zeros((rows + 1) * columns, np.int32), np.zeros(rows * columns, np.int64)
    row = (side + _BLOCK - 1) // _BLOCK * _BLOCK
    padded, templates = np.zeros((side + 2) * row, np.float32), np.zeros(4 * side * row, np.float32)
    inner, sums = np.zeros(side * row, np.float32), np.zeros(8 * _BLOCK, np.float32)
    for r in range(side):
        templates[r * row : r * row + side] = 1.0
        if 0 < r < side - 1:
            inner[r * row + 1 : r * row + side - 1] = 1.0
    sample, visible = np.empty((side, side), np.float32), np.empty((side, side), np.bool_)
    in_window = np.empty(2)
    for i in range(n):
        if not usable[i]:
            continue
        patch = patches[chosen[i]].reshape(side, side)
        of_patch = _prepare_patch(patch, spacing, row, padded, templates, inner, sums)
        x0, y0 = int(np.floor(start[i, 0])) - half_x, int(np.floor(start[i, 1])) - half_y
        near = _fill_window(image, taps, x0, y0, rows, columns, line, across, levels, window)
        in_window[0], in_window[1] = start[i, 0] - x0, start[i, 1] - y0
        score, converged, in_frame = 0.0, False, True
        for _ in range(iterations):
            if _is_inside(image, start[i], derivative[i], shift[i], reach):
                x, y, score, near = _step_inside(
                    window, columns, in_window, derivative[i], shift[i], spacing, side, templates, of_patch, near, sums
                )
            else:
                count, frame_mean, patch_mean = _sample_patch(
                    window,
                    columns,
                    x0,
                    y0,
                    image.shape,
                    patch,
                    start[i],
                    derivative[i],
                    shift[i],
                    spacing,
                    sample,
                    visible,
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
