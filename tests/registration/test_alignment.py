"""Subpixel alignment of patches: accuracy, invariances, and where patches come from."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.scenes import city, frame_map
from velfield.registration.alignment import (
    HALF_PATCH,
    align_patches,
    make_template_sets,
    make_templates,
    smooth_coarse,
    smooth_fine,
)
from velfield.registration.transforms import FrameTransform

SHAPE = HEIGHT, WIDTH = 240, 320


@pytest.fixture(scope="module")
def base() -> np.ndarray:
    return city(21, 360, blocks=120)[:HEIGHT, :WIDTH].copy()


def transform(matrix: np.ndarray) -> FrameTransform:
    return frame_map(matrix, SHAPE)


def shift(x: float, y: float) -> np.ndarray:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def frame_of(base: np.ndarray, to_base: np.ndarray) -> np.ndarray:
    """The base image as seen by a camera with a homography from raw to base px."""
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(base, to_base, (WIDTH, HEIGHT), flags=flags, borderMode=cv2.BORDER_REPLICATE)


def errors_px(
    base: np.ndarray, frame: np.ndarray, true: np.ndarray, start: np.ndarray, **options: object
) -> np.ndarray:
    """Distance (n,), base px, of each aligned patch from the truth, the search starting at ``start``."""
    coarse = bool(options.get("coarse", False))
    image = smooth_coarse(smooth_fine(frame)) if coarse else smooth_fine(frame)
    arguments = {"coarse": coarse, "max_shift_px": 2.5} | options
    aligned, in_frame = align_patches(image, transform(start), make_templates(base), **arguments)
    assert len(aligned) > 0.5 * in_frame
    return np.linalg.norm(transform(true).to_base(aligned.xy_raw) - aligned.xy_base, axis=1)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.3, -0.45), (1.3, 0.8)])
def test_patches_are_located_to_a_twentieth_of_a_pixel(base: np.ndarray, offset: tuple[float, float]) -> None:
    true = shift(4.0, -3.0)
    errors = errors_px(base, frame_of(base, true), true, shift(4.0 + offset[0], -3.0 + offset[1]))
    assert np.median(errors) < 0.05
    assert np.percentile(errors, 95) < 0.2


def test_a_patch_follows_rotation_and_scale_of_the_map(base: np.ndarray) -> None:
    angle, scale = np.radians(25.0), 1.2
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    true = np.array([[c, -s, 60.0], [s, c, -70.0], [0.0, 0.0, 1.0]])
    start = shift(0.6, -0.5) @ true
    assert np.median(errors_px(base, frame_of(base, true), true, start)) < 0.2


def test_gain_offset_and_vignetting_do_not_matter(base: np.ndarray) -> None:
    true = shift(2.0, 1.0)
    frame = frame_of(base, true).astype(float)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    vignetted = frame * (0.75 - 0.2 * ((x - WIDTH / 2) ** 2 + (y - HEIGHT / 2) ** 2) / WIDTH**2) + 20.0
    start = shift(2.4, 0.7)
    plain, changed = (np.median(errors_px(base, image.astype(np.uint8), true, start)) for image in (frame, vignetted))
    assert changed < plain + 0.02


def test_a_map_that_spreads_a_patch_over_the_frame_aligns_none(base: np.ndarray) -> None:
    squeezed, templates = np.diag([1 / 12.0, 1 / 12.0, 1.0]), make_templates(base)
    squeezed[:2, 2] = templates.xy[len(templates) // 2] - 3.0
    aligned, in_frame = align_patches(smooth_fine(base), transform(squeezed), templates, coarse=False, max_shift_px=2.5)
    assert in_frame > 0
    assert not len(aligned)


def test_the_coarse_level_reaches_farther(base: np.ndarray) -> None:
    true, start = shift(0.0, 0.0), shift(3.5, -3.0)
    frame = frame_of(base, true)
    fine = smooth_fine(frame)
    coarse = smooth_coarse(fine)
    templates = make_templates(base)
    near, in_frame = align_patches(fine, transform(start), templates, coarse=False, max_shift_px=7.0)
    far, _ = align_patches(coarse, transform(start), templates, coarse=True, max_shift_px=7.0)
    assert len(far) > 1.1 * len(near)
    assert len(far) > 0.8 * in_frame
    assert np.median(errors_px(base, frame, true, start, coarse=True, max_shift_px=7.0)) < 0.15


def test_shifts_beyond_the_limit_are_rejected(base: np.ndarray) -> None:
    frame = frame_of(base, shift(0.0, 0.0))
    aligned, in_frame = align_patches(
        smooth_fine(frame), transform(shift(1.5, 0.0)), make_templates(base), coarse=False, max_shift_px=1.0
    )
    assert in_frame > 100
    moved = np.linalg.norm(transform(shift(1.5, 0.0)).to_base(aligned.xy_raw) - aligned.xy_base, axis=1)
    assert (moved <= 1.0 + 1e-6).all()
    assert len(aligned) < 0.2 * in_frame


def test_noise_moves_a_corner_as_far_as_its_sigma_predicts(base: np.ndarray) -> None:
    """The scatter of corners over noisy frames is about their sigma, if that lies well above the floor."""
    templates = make_templates(base)
    templates = templates.select(templates.sigma_px > 0.12)
    rng, errors = np.random.default_rng(0), []
    for _ in range(8):
        noisy = np.clip(base + rng.normal(0, 3.0, base.shape), 0, 255).astype(np.uint8)
        aligned, _ = align_patches(smooth_fine(noisy), transform(np.eye(3)), templates, coarse=False, max_shift_px=2.5)
        kept = {(x, y): k for k, (x, y) in enumerate(templates.xy.tolist())}
        sigma = templates.sigma_px[[kept[x, y] for x, y in aligned.xy_base.tolist()]]
        errors.append((aligned.xy_raw - aligned.xy_base) / sigma[:, None])
    ratio = 1.4826 * np.median(np.abs(np.concatenate(errors)))
    assert 0.6 < ratio < 1.6


def test_patches_outside_the_frame_are_not_counted(base: np.ndarray) -> None:
    half_outside = shift(WIDTH / 2, 0.0)
    frame = frame_of(base, half_outside)
    templates = make_templates(base)
    aligned, in_frame = align_patches(
        smooth_fine(frame), transform(half_outside), templates, coarse=False, max_shift_px=2.5
    )
    inside = int((templates.xy[:, 0] > WIDTH / 2).sum())
    assert abs(in_frame - inside) < 0.1 * inside
    assert aligned.xy_base[:, 0].min() > WIDTH / 2 - HALF_PATCH


def test_a_frame_without_texture_aligns_nothing(base: np.ndarray) -> None:
    flat = np.full(SHAPE, 100, np.uint8)
    aligned, in_frame = align_patches(
        smooth_fine(flat), transform(np.eye(3)), make_templates(base), coarse=False, max_shift_px=2.5
    )
    assert in_frame > 100
    assert len(aligned) == 0


def test_another_image_aligns_next_to_nothing(base: np.ndarray) -> None:
    other = city(99, 360, blocks=120)[:HEIGHT, :WIDTH].copy()
    aligned, in_frame = align_patches(
        smooth_fine(other), transform(np.eye(3)), make_templates(base), coarse=False, max_shift_px=2.5
    )
    assert len(aligned) < 0.1 * in_frame


def test_templates_lie_on_corners_one_a_cell_and_keep_to_the_mask(base: np.ndarray) -> None:
    squares = np.full(SHAPE, 60, np.uint8)
    corners = [(80, 60), (200, 60), (80, 160), (200, 160)]
    for x, y in corners:
        squares[y : y + 40, x : x + 40] = 200
    found = make_templates(squares, count=400)
    expected = np.array([(x + dx, y + dy) for x, y in corners for dx in (0, 39) for dy in (0, 39)], float)
    nearest = np.linalg.norm(found.xy[:, None] - expected[None], axis=2)
    assert (nearest.min(axis=0) < np.sqrt(2) * HALF_PATCH).all()  # every corner is on a patch
    mask = np.zeros(SHAPE, bool)
    mask[:, : WIDTH // 2] = True
    assert make_templates(base, mask).xy[:, 0].max() < WIDTH // 2 - HALF_PATCH


def test_a_template_is_the_strongest_corner_of_its_cell(base: np.ndarray) -> None:
    reach, side = 2 * HALF_PATCH + 2, 2 * HALF_PATCH + 1
    gradient = cv2.cornerMinEigenVal(cv2.GaussianBlur(base, (0, 0), 0.8), side, ksize=3)
    inside = np.zeros_like(gradient)
    inside[reach:-reach, reach:-reach] = gradient[reach:-reach, reach:-reach]
    coarsely, finely = make_template_sets(base, counts=(48, 300))
    assert len(finely) > len(coarsely) > 20
    for found, cell in ((coarsely, 40), (finely, 16)):
        corners = found.xy.astype(int)
        for x, y in corners:
            left, top = x // cell * cell, y // cell * cell
            assert inside[y, x] == inside[top : top + cell, left : left + cell].max()
        assert len(np.unique(corners // cell, axis=0)) == len(corners)


def test_sets_of_templates_are_those_made_one_by_one(base: np.ndarray) -> None:
    mask = np.ones(SHAPE, bool)
    mask[:60] = False
    for found, count in zip(make_template_sets(base, mask, counts=(100, 500)), (100, 500), strict=True):
        alone = make_templates(base, mask, count=count)
        for name in ("xy", "sigma_px", "fine", "coarse"):
            np.testing.assert_array_equal(getattr(found, name), getattr(alone, name))


def test_excluded_positions_have_no_template_near(base: np.ndarray) -> None:
    first = make_templates(base, count=300)
    second = make_templates(base, count=300, exclude=first.xy)
    assert len(second) > 20
    apart = np.abs(first.xy[:, None] - second.xy[None]).max(axis=2).min(axis=0)
    assert apart.min() > HALF_PATCH


def test_patches_hold_the_blurred_grey_levels_about_their_corner(base: np.ndarray) -> None:
    templates = make_templates(base, count=200, half_patch=5)
    fine = smooth_fine(base)
    coarse = smooth_coarse(fine)
    x, y = templates.xy[7].astype(int)
    np.testing.assert_array_equal(templates.fine[7].reshape(11, 11), fine[y - 5 : y + 6, x - 5 : x + 6])
    np.testing.assert_array_equal(templates.coarse[7].reshape(11, 11), coarse[y - 10 : y + 11 : 2, x - 10 : x + 11 : 2])
    one = templates.select(np.array([7]))
    assert len(one) == 1
    np.testing.assert_array_equal(one.fine[one.rows[0]], templates.fine[7])


def test_a_map_without_a_value_is_no_patch_in_the_frame(base: np.ndarray) -> None:
    templates = make_templates(base, count=200)
    nowhere = replace(templates, xy=np.where(np.arange(len(templates))[:, None] < 5, np.nan, templates.xy))
    _, all_of_them = align_patches(smooth_fine(base), transform(np.eye(3)), templates, coarse=False, max_shift_px=2.5)
    _, fewer = align_patches(smooth_fine(base), transform(np.eye(3)), nowhere, coarse=False, max_shift_px=2.5)
    assert fewer == all_of_them - 5
