"""Kernels of the cascade: rotated patches, their integral images, rectangle sums over them.

Sixteen patches are interleaved as the innermost axis of every array (structure of arrays), so that the corner of a
rectangle is one vector load in place of a gather: four times as fast a pixel, and twenty times a rectangle, as patch
after patch.
"""

import numpy as np
from numba import njit

LANES = 16
CHANNELS = 4
"""Grey, |gradient along|, |gradient across|, |frame - background|."""
GRADIENT_ZERO = 512
"""Gradients are packed as unsigned ten-bit numbers, with this standing for zero."""


@njit(cache=True, nogil=True)
def _pixel_indices(index, stride, x, y, dx, dy):  # type: ignore[no-untyped-def]
    half = np.float32((index.shape[0] - 1) / 2)
    for j in range(index.shape[0]):
        u = np.float32(j) - half
        for lane in range(LANES):
            index[j, lane] = np.int32(y[lane] + u * dy[lane]) * stride + np.int32(x[lane] + u * dx[lane])


@njit(cache=True, nogil=True)
def _unpack(words, c, s, grey, along, across):  # type: ignore[no-untyped-def]
    zero, ten_bits = np.int32(GRADIENT_ZERO), np.uint32(1023)
    for j in range(words.shape[0]):
        for lane in range(LANES):
            word = words[j, lane]
            gx = np.float32(np.int32((word >> np.uint32(8)) & ten_bits) - zero)
            gy = np.float32(np.int32((word >> np.uint32(18)) & ten_bits) - zero)
            grey[j, lane] = np.int32(word & np.uint32(255))
            along[j, lane] = np.int32(abs(gx * c[lane] + gy * s[lane]))
            across[j, lane] = np.int32(abs(gy * c[lane] - gx * s[lane]))


@njit(cache=True, nogil=True)
def _accumulate(values, above, out):  # type: ignore[no-untyped-def]
    run = np.zeros(LANES, np.int32)
    for j in range(values.shape[0]):
        for lane in range(LANES):
            run[lane] += values[j, lane]
        for lane in range(LANES):
            out[j + 1, lane] = above[j + 1, lane] + run[lane]


@njit(cache=True, nogil=True)
def fill_integrals(packed, difference, stride, poses, channels, out):  # type: ignore[no-untyped-def]
    """Integral images of ``LANES`` rotated patches, sampled at the nearest pixel (as accurate as interpolated).

    ``packed`` (h * w,) uint32: grey, and the gradient in x and y. ``poses`` (8, LANES) float32: x, y of the centre plus
    a half; the step in x and y along the patch, and across it; cosine and sine of the axis. ``out`` (channels,
    across + 1, along + 1, LANES) int32 with zeros in its first row and column.
    """
    across, along = out.shape[1] - 1, out.shape[2] - 1
    index = np.empty((along, LANES), np.uint32)
    words = np.empty((along, LANES), np.uint32)
    grey = np.empty((along, LANES), np.int32)
    ga = np.empty((along, LANES), np.int32)
    gb = np.empty((along, LANES), np.int32)
    x, y = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    flat_index, flat_words, flat_grey = index.reshape(-1), words.reshape(-1), grey.reshape(-1)
    half = np.float32((across - 1) / 2)
    for i in range(across):
        v = np.float32(i) - half
        for lane in range(LANES):
            x[lane] = poses[0, lane] + v * poses[4, lane]
            y[lane] = poses[1, lane] + v * poses[5, lane]
        _pixel_indices(index, np.int32(stride), x, y, poses[2], poses[3])
        for k in range(flat_index.size):
            flat_words[k] = packed[flat_index[k]]
        _unpack(words, poses[6], poses[7], grey, ga, gb)
        _accumulate(grey, out[0, i], out[0, i + 1])
        _accumulate(ga, out[1, i], out[1, i + 1])
        _accumulate(gb, out[2, i], out[2, i + 1])
        if channels > 3:
            for k in range(flat_index.size):
                flat_grey[k] = difference[flat_index[k]]
            _accumulate(grey, out[3, i], out[3, i + 1])


@njit(cache=True, nogil=True)
def _rectangle_sums(flat, corners, signs, first, last, base, total):  # type: ignore[no-untyped-def]
    """Signed sums of rectangles, one a lane. Indices are unsigned, which spares numba its check for negative ones."""
    lanes = np.uint64(LANES)
    for lane in range(lanes):
        total[lane] = 0
    for r in range(first, last):
        p, q, s, t = base + corners[r, 0], base + corners[r, 1], base + corners[r, 2], base + corners[r, 3]
        if signs[r] > 0:
            for lane in range(lanes):
                total[lane] += flat[p + lane] - flat[q + lane] - flat[s + lane] + flat[t + lane]
        else:
            for lane in range(lanes):
                total[lane] -= flat[p + lane] - flat[q + lane] - flat[s + lane] + flat[t + lane]


@njit(cache=True, nogil=True)
def _normalisation(flat, window, window_area, plane, base, floor, total, mean, contrast):  # type: ignore[no-untyped-def]
    """Mean grey of the window about a position, and its mean gradient plus ``floor``."""
    ones = np.ones(1, np.int32)
    scale = np.float32(1 / window_area)
    _rectangle_sums(flat, window, ones, 0, 1, base, total)
    for lane in range(LANES):
        mean[lane] = np.float32(total[lane]) * scale
    _rectangle_sums(flat, window, ones, 0, 1, base + plane, total)
    for lane in range(LANES):
        contrast[lane] = np.float32(total[lane]) * scale + np.float32(floor)
    _rectangle_sums(flat, window, ones, 0, 1, base + plane + plane, total)
    for lane in range(LANES):
        contrast[lane] += np.float32(total[lane]) * scale


@njit(cache=True, nogil=True)
def score_offsets(  # type: ignore[no-untyped-def]
    flat,
    window,
    window_area,
    plane,
    floor,
    corners,
    signs,
    starts,
    planes,
    areas,
    thresholds,
    leaves,
    bases,
    rounds,
    out,
):
    """Sums of the leaves of the first ``rounds``, (offsets, LANES), at every offset of ``LANES`` patches."""
    total = np.zeros(LANES, np.int32)
    mean, contrast = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
    for m in range(len(bases)):
        _normalisation(flat, window, window_area, plane, bases[m], floor, total, mean, contrast)
        for lane in range(LANES):
            out[m, lane] = 0
        for f in range(rounds):
            _rectangle_sums(flat, corners, signs, starts[f], starts[f + 1], bases[m] + planes[f], total)
            threshold, area = thresholds[f], areas[f]
            low, high = leaves[f, 0], leaves[f, 1]
            for lane in range(LANES):
                split = threshold * contrast[lane] + area * mean[lane]
                out[m, lane] += high if np.float32(total[lane]) > split else low


@njit(cache=True, nogil=True)
def score_poses(  # type: ignore[no-untyped-def]
    packed, difference, stride, poses, floor, window, window_area, corners, signs, starts, planes, areas, thresholds,
    leaves, bases, rounds, integral, out,
):  # fmt: skip
    """Scores (groups, offsets, LANES) of poses (groups, 8, LANES); ``integral`` is scratch memory."""
    flat = integral.reshape(-1)
    plane = np.uint64(flat.size // integral.shape[0])
    for g in range(len(poses)):
        fill_integrals(packed, difference, stride, poses[g], integral.shape[0], integral)
        score_offsets(
            flat,
            window,
            window_area,
            plane,
            floor,
            corners,
            signs,
            starts,
            planes,
            areas,
            thresholds,
            leaves,
            bases,
            rounds,
            out[g],
        )


@njit(cache=True, nogil=True)
def feature_values(  # type: ignore[no-untyped-def]
    packed,
    difference,
    stride,
    poses,
    floor,
    window,
    window_area,
    corners,
    signs,
    starts,
    planes,
    areas,
    base,
    integral,
    out,
):
    """Values (features, groups, LANES) float32 of every feature at every pose, brightness and contrast normalised."""
    flat = integral.reshape(-1)
    plane = np.uint64(flat.size // integral.shape[0])
    total = np.zeros(LANES, np.int32)
    mean, contrast = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
    for g in range(len(poses)):
        fill_integrals(packed, difference, stride, poses[g], integral.shape[0], integral)
        _normalisation(flat, window, window_area, plane, base, floor, total, mean, contrast)
        for f in range(len(planes)):
            _rectangle_sums(flat, corners, signs, starts[f], starts[f + 1], base + planes[f], total)
            for lane in range(LANES):
                out[f, g, lane] = (np.float32(total[lane]) - areas[f] * mean[lane]) / contrast[lane]
