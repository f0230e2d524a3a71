"""Appearance differences: kernels equal their definitions; an axis is known up to 180 degrees."""

import numpy as np
import pytest
from numpy.typing import NDArray

from velfield.tracking.appearance import (
    CAR_LENGTH_PX,
    CAR_WIDTH_PX,
    MAX_CROP_SHIFT_PX,
    appearance_differences,
    crop_differences,
    patch_differences,
    prepare_crops,
)

RNG = np.random.default_rng(5)
PATCHES = RNG.integers(0, 256, (6, 16, 8), np.uint8)
CROPS = RNG.integers(0, 256, (5, 32, 32), np.uint8)
AXES = np.array([0.0, 0.4, 1.6, 2.9, np.nan])
FIRST, SECOND = (g.ravel() for g in np.meshgrid(np.arange(5), np.arange(5), indexing="ij"))


def plain_patch_difference(p: NDArray[np.uint8], q: NDArray[np.uint8], shift: int) -> float:
    inner = p[shift : 16 - shift, shift : 8 - shift].astype(float)
    return min(
        float(np.abs(inner - r[shift + dy : 16 - shift + dy, shift + dx : 8 - shift + dx]).mean())
        for r in (q.astype(float), q[::-1, ::-1].astype(float))
        for dy in range(-shift, shift + 1)
        for dx in range(-shift, shift + 1)
    )


def plain_crop_difference(i: int, j: int) -> float:
    """Birchfield and Tomasi's difference over every second pixel of the car, minimum over the shifts."""

    def ranges(crop: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        near = [0.5 * (crop + np.roll(crop, s, axis)) for axis in (0, 1) for s in (1, -1)]
        return np.floor(np.min([crop, *near], axis=0)), np.ceil(np.max([crop, *near], axis=0))

    def car(axis: float) -> NDArray[np.bool_]:
        y, x = np.mgrid[-16:16, -16:16]
        if np.isnan(axis):
            return np.asarray(np.hypot(x, y) <= CAR_WIDTH_PX)
        along, across = x * np.cos(axis) + y * np.sin(axis), y * np.cos(axis) - x * np.sin(axis)
        return np.asarray((abs(along) <= CAR_LENGTH_PX / 2) & (abs(across) <= CAR_WIDTH_PX / 2))

    p, q = CROPS[i].astype(float), CROPS[j].astype(float)
    (p_low, p_high), (q_low, q_high) = ranges(p), ranges(q)
    every_second = np.zeros((32, 32), bool)
    every_second[MAX_CROP_SHIFT_PX : 32 - MAX_CROP_SHIFT_PX : 2, MAX_CROP_SHIFT_PX : 32 - MAX_CROP_SHIFT_PX : 2] = True
    mine = car(AXES[i]) & every_second
    best = 255.0
    steps = range(-MAX_CROP_SHIFT_PX, MAX_CROP_SHIFT_PX + 1)
    for dy, dx in ((dy, dx) for dy in steps for dx in steps):
        moved, low, high, on = (np.roll(a, (-dy, -dx), (0, 1)) for a in (q, q_low, q_high, car(AXES[j])))
        both = mine & on
        if both.sum() and 2 * both.sum() >= mine.sum():
            outside = np.maximum.reduce([p - high, low - p, moved - p_high, p_low - moved, np.zeros_like(p)])
            best = min(best, float(outside[both].mean()))
    return best


def test_patch_differences_equal_their_definition() -> None:
    for shift in (0, 1, 2):
        got = patch_differences(PATCHES, PATCHES, FIRST, SECOND, max_shift_px=shift)
        plain = [plain_patch_difference(PATCHES[i], PATCHES[j], shift) for i, j in zip(FIRST, SECOND, strict=True)]
        assert np.allclose(got, plain)


def test_a_patch_rotated_by_180_degrees_is_the_same_car() -> None:
    rotated = np.ascontiguousarray(PATCHES[:, ::-1, ::-1])
    assert np.all(patch_differences(PATCHES, rotated, np.arange(6), np.arange(6)) == 0)


def test_crop_differences_equal_their_definition() -> None:
    prepared = prepare_crops(CROPS, AXES)
    got = crop_differences(prepared, prepared, FIRST, SECOND)
    assert np.allclose(got, [plain_crop_difference(i, j) for i, j in zip(FIRST, SECOND, strict=True)])


def test_crops_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match=r"crops of \(30, 32\) px, expected 32 x 32"):
        prepare_crops(CROPS[:, 1:31], AXES)


def test_patches_of_any_size_are_compared() -> None:
    """Chunks of pixels reach beyond small patches and divide large ones."""
    for length, width in ((6, 5), (20, 12)):
        one, other = RNG.integers(0, 256, (2, 1, length, width), np.uint8)
        inner = one[0, 1:-1, 1:-1].astype(int)
        plain = min(
            np.abs(inner - r[1 + dy : length - 1 + dy, 1 + dx : width - 1 + dx].astype(int)).mean()
            for r in (other[0], other[0, ::-1, ::-1])
            for dy in (-1, 0, 1)
            for dx in (-1, 0, 1)
        )
        first = np.zeros(1, np.int64)
        assert np.allclose(patch_differences(one, other, first, first, max_shift_px=1), plain)


def test_the_difference_to_an_unknown_appearance_is_unknown() -> None:
    one = np.zeros(1, np.int64)
    for known in (PATCHES, prepare_crops(CROPS, AXES)):
        assert np.isnan(appearance_differences(None, known, one, one)).all()
        assert appearance_differences(known, known, one, one) == 0
