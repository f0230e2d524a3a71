"""Edge points and arcs on drawn lines and circles, anti-aliased, whose place is known."""

import cv2
import numpy as np
import pytest

from velfield.camera.edges import Arcs, detect_arcs, pool_arcs

SHAPE = (200, 260)
OPTIONS = {"min_length_px": 40.0, "max_curvature_per_px": 0.002}


def half_plane(angle_deg: float, offset: float) -> np.ndarray:
    """A straight edge between 60 and 180 grey levels, anti-aliased exactly along its normal."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    angle = np.radians(angle_deg)
    distance = (x - SHAPE[1] / 2) * np.cos(angle) + (y - SHAPE[0] / 2) * np.sin(angle) - offset
    return np.rint(60 + 120 * np.clip(distance + 0.5, 0, 1)).astype(np.uint8)


def disk(radius_px: float) -> np.ndarray:
    """A bright disk whose edge crosses the image; its centre lies below."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    distance = radius_px - np.hypot(x - SHAPE[1] / 2, y - SHAPE[0] / 2 - radius_px)
    return np.rint(60 + 120 * np.clip(distance + 0.5, 0, 1)).astype(np.uint8)


@pytest.mark.parametrize("angle_deg", [0.0, 17.0, 45.0, 90.0, 133.0])
@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_a_straight_edge_is_found_to_a_tenth_of_a_pixel(angle_deg: float, offset: float) -> None:
    arcs = detect_arcs(half_plane(angle_deg, offset), frame=0, **OPTIONS)
    angle = np.radians(angle_deg)
    normal = np.array([np.cos(angle), np.sin(angle)])
    distance = (arcs.xy - [SHAPE[1] / 2, SHAPE[0] / 2]) @ normal - offset
    assert len(distance) > 80
    assert np.abs(distance).max() < 0.2
    assert np.sqrt((distance**2).mean()) < 0.1
    assert np.abs(arcs.tangents @ normal).max() < np.sin(np.radians(0.5))
    np.testing.assert_allclose(np.linalg.norm(arcs.tangents, axis=1), 1.0, atol=1e-9)


def test_an_edge_is_one_arc_as_long_as_it_is() -> None:
    arcs = detect_arcs(half_plane(90.0, 0.0), frame=3, **OPTIONS)
    assert arcs.frame.tolist() == [3]
    assert arcs.length_px[0] == pytest.approx(SHAPE[1], abs=8.0)
    assert set(arcs.arc.tolist()) == {0}


@pytest.mark.parametrize(("radius_px", "kept"), [(2000.0, True), (100.0, False)])
def test_arcs_more_curved_than_a_lens_makes_a_line_are_dropped(radius_px: float, kept: bool) -> None:
    arcs = detect_arcs(disk(radius_px), frame=0, **OPTIONS)
    assert (len(arcs.xy) > 0) == kept


def test_the_tangents_of_a_curved_arc_are_those_of_its_circle() -> None:
    radius = 1500.0
    arcs = detect_arcs(disk(radius), frame=0, **OPTIONS)
    outward = arcs.xy - [SHAPE[1] / 2, SHAPE[0] / 2 + radius]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert len(arcs.xy) > 100
    assert np.abs(np.sum(outward * arcs.tangents, axis=1)).max() < np.sin(np.radians(0.5))


def test_a_corner_splits_its_edge_into_two_arcs() -> None:
    square = np.full(SHAPE, 60, np.uint8)
    cv2.fillPoly(square, [np.array([[40, 40], [200, 50], [190, 160], [50, 150]], np.int32)], (180,), cv2.LINE_AA)
    arcs = detect_arcs(square, frame=0, **OPTIONS)
    assert len(arcs.length_px) == 4
    assert sorted(arcs.length_px) == pytest.approx([100.0, 110.0, 140.0, 160.0], abs=8.0)
    for arc in range(4):
        own = arcs.tangents[arcs.arc == arc]
        assert np.abs(own @ own[0]).min() > np.cos(np.radians(3.0))


def test_flat_images_and_faint_texture_have_no_arcs() -> None:
    assert len(detect_arcs(np.full(SHAPE, 90, np.uint8), frame=0, **OPTIONS).xy) == 0
    noise = np.random.default_rng(0).normal(90, 1.0, SHAPE).astype(np.uint8)
    assert len(detect_arcs(noise, frame=0, **OPTIONS).xy) == 0


def straight_arcs(lengths: list[int], frame: int) -> Arcs:
    """Horizontal arcs, a point a pixel, one below the other."""
    xy = np.concatenate([np.stack([np.arange(n, dtype=float), np.full(n, 10.0 * k)], 1) for k, n in enumerate(lengths)])
    return Arcs(
        xy=xy,
        tangents=np.tile([1.0, 0.0], (len(xy), 1)),
        arc=np.repeat(np.arange(len(lengths)), lengths),
        frame=np.full(len(lengths), frame),
        length_px=np.array(lengths, dtype=float),
    )


def test_selected_arcs_are_renumbered_with_their_points() -> None:
    arcs = straight_arcs([30, 40, 50], 0).select(np.array([True, False, True]))
    assert np.bincount(arcs.arc).tolist() == [30, 50]
    assert arcs.length_px.tolist() == [30.0, 50.0]
    assert set(arcs.xy[arcs.arc == 1, 1]) == {20.0}


def test_subsampling_keeps_every_so_many_points() -> None:
    arcs = straight_arcs([30], 0).subsample(7)
    np.testing.assert_array_equal(arcs.xy[:, 0], [0, 7, 14, 21, 28])


def test_pooled_points_are_means_of_equal_pieces() -> None:
    pooled = pool_arcs([straight_arcs([48, 96], 0), straight_arcs([240], 1)], max_points=10_000)
    assert np.bincount(pooled.arc).tolist() == [24, 24, 24]
    assert pooled.frame.tolist() == [0, 0, 1]
    np.testing.assert_allclose(pooled.xy[pooled.arc == 0, 0], np.arange(24) * 2 + 0.5)
    np.testing.assert_allclose(pooled.xy[pooled.arc == 2, 0], np.arange(24) * 10 + 4.5)


def test_too_many_arcs_are_pooled_to_ten_points_each_of_the_longest() -> None:
    lengths = [40 + 7 * (k * 37 % 50) for k in range(50)]
    pooled = pool_arcs([straight_arcs(lengths, 0)], max_points=200)
    assert np.bincount(pooled.arc).tolist() == [10] * 20
    assert sorted(pooled.length_px) == sorted(sorted(lengths)[-20:])
