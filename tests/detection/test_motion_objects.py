"""Background subtraction, blobs, links, boxes and shadows on constructed scenes, with exact expectations."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from schemas.arrays import FloatArray, GreyImage
from velfield.detection.motion.blobs import BlobPixels, Blobs, extract_blobs, foreground_masks, merge_blobs
from velfield.detection.motion.boxes import (
    MovingObjects,
    fit_boxes,
    fit_shadow_vector,
    has_car_size,
    moves_along_axis,
    remove_shadow,
    sample_shadows,
)
from velfield.detection.motion.difference import (
    MotionFrame,
    absolute_difference,
    background_from_median,
    estimate_noise,
    motion_background,
    signed_difference,
)
from velfield.detection.motion.links import MAX_LENGTHS_PER_S, BlobGroups, Links, group_blobs, link_blobs
from velfield.detection.motion.triplets import count_false_links, interior_frames, link_triplet, select_cars
from velfield.errors import InputError

LENGTH = 16.0
SIZE = (120, 160)
EVERYWHERE = np.ones(SIZE, np.bool_)


# ---- background subtraction


def road(seed: int = 0) -> GreyImage:
    rough = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 60, SIZE), (0, 0), 3)
    return np.clip(130 + rough, 60, 200).astype(np.uint8)


def with_box(image: GreyImage, grey: int, x: int = 60, y: int = 40) -> GreyImage:
    out = image.copy()
    out[y : y + 8, x : x + 18] = grey
    return out


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 3), st.integers(0, 1000))
def test_the_background_range_is_that_of_the_window(reach: int, seed: int) -> None:
    median = np.random.default_rng(seed).integers(0, 256, (9, 12)).astype(np.uint8)
    background = background_from_median(median, reach_px=reach)
    np.testing.assert_array_equal(background.low, ndimage.minimum_filter(median, 2 * reach + 1, mode="reflect"))
    np.testing.assert_array_equal(background.high, ndimage.maximum_filter(median, 2 * reach + 1, mode="reflect"))
    assert background.valid.all()


@pytest.mark.parametrize(("grey", "sign"), [(250, 1), (5, -1)])
def test_the_sign_of_the_difference_is_that_of_the_contrast(grey: int, sign: int) -> None:
    image = with_box(road(), grey)
    signed = signed_difference(image, EVERYWHERE, background_from_median(road()))
    assert (sign * signed[42:46, 62:76] > 30).all()
    outside = np.ones(SIZE, bool)
    outside[34:54, 54:84] = False
    assert not signed[outside].any()
    np.testing.assert_array_equal(absolute_difference(image, EVERYWHERE, background_from_median(road())), abs(signed))


def test_shifts_within_the_reach_and_changes_of_exposure_are_no_difference() -> None:
    background = background_from_median(road())
    shifted = np.roll(road(), (1, -1), axis=(0, 1))[2:-2, 2:-2]
    inner = background_from_median(road()[1:-1, 1:-1])
    assert signed_difference(np.pad(shifted, 1, mode="edge"), np.ones((118, 158), bool), inner)[3:-3, 3:-3].max() < 0.01
    assert absolute_difference(road() + np.uint8(25), EVERYWHERE, background).max() < 0.01
    ramp = np.linspace(0, 8, SIZE[1])[None]
    assert absolute_difference((road() + ramp).astype(np.uint8), EVERYWHERE, background).max() < 4


def test_unknown_pixels_have_no_difference() -> None:
    valid = EVERYWHERE.copy()
    valid[:, :70] = False
    known = background_from_median(road(), EVERYWHERE & (np.arange(SIZE[0])[:, None] > 44))
    signed = signed_difference(with_box(road(), 250), valid, known)
    assert not signed[:, :70].any()
    assert not signed[:45].any()
    assert signed[46, 72] > 30


@pytest.mark.parametrize("sigma", [1.0, 3.0, 8.0])
def test_noise_is_estimated_despite_vehicles(sigma: float) -> None:
    base = np.full(SIZE, 128, np.uint8)
    noisy = np.clip(np.rint(base + np.random.default_rng(0).normal(0, sigma, SIZE)), 0, 255).astype(np.uint8)
    estimate = estimate_noise(with_box(with_box(noisy, 250), 0, x=20), EVERYWHERE, background_from_median(base))
    assert estimate == pytest.approx(sigma, rel=0.4, abs=0.5)
    assert estimate_noise(noisy, ~EVERYWHERE, background_from_median(base)) == 0


def test_vehicles_are_not_in_the_median_of_a_flight() -> None:
    frames = [MotionFrame(with_box(road(), 250, x=10 + 15 * k), EVERYWHERE, 0.2 * k) for k in range(8)]
    background = motion_background(frames)
    np.testing.assert_array_equal(background.median, road())
    few = [replace(frame, valid=EVERYWHERE & (k < 2)) for k, frame in enumerate(frames)]
    assert not motion_background(few).valid.any()
    with pytest.raises(InputError, match="found 2"):
        motion_background(frames[:2])


# ---- blobs


def painted(*boxes: tuple[int, int, int, int, float]) -> np.ndarray:
    """A signed difference with rectangles: x, y, width, height, value."""
    signed = np.zeros(SIZE, np.float32)
    for x, y, width, height, value in boxes:
        signed[y : y + height, x : x + width] = value
    return signed


def test_a_rectangle_of_pixels_has_its_own_sides_centre_and_contrast() -> None:
    blobs, pixels = extract_blobs(painted((30, 40, 18, 6, 50.0), (90, 40, 5, 21, -70)), noise=0.0, car_length_px=LENGTH)
    assert blobs.area.tolist() == [108, 105]
    assert blobs.contrast.tolist() == [50, -70]
    np.testing.assert_allclose(np.stack([blobs.x, blobs.y], 1), [[38.5, 42.5], [92, 50]])
    np.testing.assert_allclose(blobs.length, [18, 21])
    np.testing.assert_allclose(blobs.width, [6, 5])
    np.testing.assert_allclose(np.cos(2 * blobs.axis_rad), [1, -1])
    np.testing.assert_allclose(blobs.extent_along(np.zeros(2)), [18, 5])
    np.testing.assert_allclose(blobs.extent_along(np.full(2, np.pi / 2)), [6, 21])
    assert np.bincount(pixels.blob).tolist() == [108, 105]
    assert pixels.x[pixels.blob == 1].min() == 90
    assert pixels.y[pixels.blob == 1].max() == 60


def test_blobs_connect_by_their_corners_and_small_ones_are_dropped() -> None:
    signed = painted((30, 40, 4, 4, 50.0), (34, 44, 4, 4, 50), (80, 40, 7, 1, 50), (100, 40, 8, 1, 50))
    blobs, pixels = extract_blobs(signed, noise=0.0, car_length_px=LENGTH)
    assert sorted(blobs.area.tolist()) == [8, 32]
    assert pixels.blob.max() == 1


@pytest.mark.parametrize(("value", "noise", "found"), [(7.9, 0.0, 0), (8.1, 0.0, 1), (19.0, 5.0, 0), (21.0, 5.0, 1)])
def test_the_foreground_is_above_the_noise(value: float, noise: float, found: int) -> None:
    blobs, _ = extract_blobs(painted((30, 40, 10, 6, value)), noise=noise, car_length_px=LENGTH)
    assert len(blobs) == found


def test_the_skirt_of_something_stronger_is_no_foreground() -> None:
    signed = painted((30, 40, 10, 6, 100.0), (40, 40, 6, 6, 20), (100, 40, 6, 6, 20), (100, 80, 6, 6, -20))
    bright, dark = foreground_masks(signed, noise=0.0, car_length_px=LENGTH)
    assert bright[42, 35]
    assert not bright[42, 41]
    assert bright[42, 102]
    assert dark[82, 102]
    assert not (bright & dark).any()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 4))
def test_merged_blobs_have_the_moments_of_all_their_pixels(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    boxes = [
        (40 * k + 2, int(rng.integers(5, 80)), int(rng.integers(3, 20)), int(rng.integers(3, 20)), 50.0)
        for k in range(4)
    ]
    blobs, pixels = extract_blobs(painted(*boxes), noise=0.0, car_length_px=LENGTH)
    group = rng.integers(-1, count, len(blobs))
    merged = merge_blobs(blobs, group, count)
    for k in range(count):
        inside = group[pixels.blob] == k
        assert merged.area[k] == inside.sum()
        if inside.any():
            x, y = pixels.x[inside], pixels.y[inside]
            assert merged.x[k] == pytest.approx(x.mean())
            assert merged.cxx[k] == pytest.approx(x.var() + 1 / 12)
            assert merged.cyy[k] == pytest.approx(y.var() + 1 / 12)
            assert merged.cxy[k] == pytest.approx(np.mean((x - x.mean()) * (y - y.mean())), abs=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.floats(0, np.pi))
def test_the_sides_of_a_blob_do_not_depend_on_its_rotation(angle: float) -> None:
    blob = box_blob(0, 0, angle, length=18, width=6)
    assert blob.length[0] == pytest.approx(18)
    assert blob.width[0] == pytest.approx(6)
    assert np.cos(2 * (blob.axis_rad[0] - angle)) == pytest.approx(1)
    assert blob.extent_along(np.array([angle]))[0] == pytest.approx(18)


def test_blobs_are_selected_and_replaced() -> None:
    blobs = Blobs(*(np.arange(3.0) + 10 * k for k in range(7)))
    assert blobs.select(np.array([True, False, True])).area.tolist() == [50, 52]
    assert blobs.select(np.array([2, 0])).x.tolist() == [2, 0]
    other = Blobs(*(-np.arange(3.0) for _ in range(7)))
    assert blobs.replace_where(np.array([False, True, True]), other).y.tolist() == [10, -1, -2]


# ---- links


def box_blob(
    x: float, y: float, angle: float = 0.0, length: float = 16, width: float = 7, contrast: float = 50
) -> Blobs:
    c, s, along, across = np.cos(angle), np.sin(angle), length**2 / 12, width**2 / 12
    cxx, cxy, cyy = c * c * along + s * s * across, c * s * (along - across), s * s * along + c * c * across
    return Blobs(*(np.array([float(value)]) for value in (x, y, cxx, cxy, cyy, length * width, contrast)))


def together(*blobs: Blobs) -> Blobs:
    return Blobs(*(np.concatenate([getattr(blob, name) for blob in blobs]) for name in vars(blobs[0])))


def link(before: Blobs, middle: Blobs, after: Blobs, first: float = 0.2, second: float = 0.2) -> Links:
    return link_blobs(before, middle, after, interval_before_s=first, interval_after_s=second, car_length_px=LENGTH)


@settings(max_examples=30, deadline=None)
@given(st.floats(-100, 100), st.floats(-80, 80), st.floats(0.1, 0.4), st.floats(0.1, 0.4))
def test_constant_velocity_is_linked_whatever_the_intervals(vx: float, vy: float, first: float, second: float) -> None:
    if np.hypot(vx, vy) * (first + second) < 0.36 * LENGTH:
        return
    steps = [-first, 0, second]
    links = link(*(box_blob(60 + vx * t, 60 + vy * t) for t in steps), first, second)
    assert links.linked.tolist() == [True]
    np.testing.assert_allclose(links.velocity[0], [vx, vy], atol=1e-6)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (box_blob(50, 60, contrast=-50), box_blob(70, 60)),  # of the other sign
        (box_blob(50, 60, length=30), box_blob(70, 60)),  # of another area
        (box_blob(50, 60), box_blob(64, 60)),  # decelerating
        (box_blob(50, 60), box_blob(66, 68)),  # turning
        (box_blob(58, 60), box_blob(62, 60)),  # hardly moving
        (box_blob(60 - 0.21 * MAX_LENGTHS_PER_S * LENGTH, 60), box_blob(60 + 0.21 * MAX_LENGTHS_PER_S * LENGTH, 60)),
    ],
)
def test_what_no_vehicle_does_is_not_linked(before: Blobs, after: Blobs) -> None:
    links = link(before, box_blob(60, 60), after)
    assert links.linked.tolist() == [False]
    assert np.isnan(links.velocity).all()


def test_the_match_of_lowest_cost_is_taken() -> None:
    before, after = together(box_blob(50, 61), box_blob(50, 60)), together(box_blob(70, 60), box_blob(71.5, 60))
    links = link(before, together(box_blob(60, 60), box_blob(100, 60)), after)
    assert links.linked.tolist() == [True, False]
    np.testing.assert_allclose(links.velocity[0], [50, 0])


def test_without_blobs_there_are_no_links() -> None:
    empty = box_blob(0, 0).select(np.zeros(1, bool))
    assert not link(empty, box_blob(60, 60), box_blob(70, 60)).linked.any()
    assert len(link(box_blob(50, 60), empty, box_blob(70, 60)).linked) == 0


def grouped(blobs: Blobs, velocity: FloatArray, linked: list[bool] | None = None) -> BlobGroups:
    kept = np.ones(len(blobs), bool) if linked is None else np.array(linked)
    links = Links(kept, np.where(kept[:, None], velocity, np.nan))
    pixels = BlobPixels(blobs.x, blobs.y, np.arange(len(blobs)))
    return group_blobs(blobs, pixels, links, interval_s=0.2, car_length_px=LENGTH)


def test_parts_of_a_car_are_grouped_and_other_cars_are_not() -> None:
    roof, bonnet = box_blob(60, 60, length=8), box_blob(71, 60, length=4)
    shadow, follower = box_blob(62, 66, length=16, contrast=-40), box_blob(34, 60)
    neighbour, unlinked = box_blob(60, 80), box_blob(66, 60, length=3)
    velocity = np.tile([50.0, 0], (6, 1))
    blobs = together(roof, bonnet, shadow, follower, neighbour, unlinked)
    groups = grouped(blobs, velocity, [True] * 5 + [False])
    assert groups.count == 3
    assert groups.group[0] == groups.group[1] == groups.group[2]
    assert len(set(groups.group[[0, 3, 4]])) == 3
    assert groups.group[5] == -1
    assert (groups.bright == -1).tolist() == [False, False, True, False, False, True]
    assert (groups.dark == -1).tolist() == [True, True, False, True, True, True]


def test_blobs_of_other_velocity_are_not_grouped() -> None:
    roof, bonnet = box_blob(60, 60, length=8), box_blob(71, 60, length=4)
    assert grouped(together(roof, bonnet), np.array([[50.0, 0], [50, 3]])).count == 1
    assert grouped(together(roof, bonnet), np.array([[50.0, 0], [50, 25]])).count == 2
    assert grouped(roof, np.zeros((1, 2)), [False]).count == 0


def test_the_velocity_of_a_group_is_weighted_by_area() -> None:
    groups = grouped(together(box_blob(60, 60, length=12), box_blob(70, 60, length=4)), np.array([[50.0, 0], [54, 4]]))
    np.testing.assert_allclose(groups.velocity, [[51, 1]])


# ---- boxes


def moving(length: int, width: int, velocity: tuple[float, float], dark: tuple[int, int] | None = None) -> BlobGroups:
    """One group of a bright rectangle at (60, 50), and optionally a dark one of the same size off it by so much."""
    boxes = [(60, 50, length, width, 60.0)]
    if dark is not None:
        boxes.append((60 + dark[0], 50 + dark[1], length, width, -60.0))
    blobs, pixels = extract_blobs(painted(*boxes[::-1]), noise=0.0, car_length_px=LENGTH)
    links = Links(np.ones(len(blobs), bool), np.tile(np.array(velocity, float), (len(blobs), 1)))
    return BlobGroups(blobs, pixels, links, np.zeros(len(blobs), np.int64), 1)


def test_a_box_has_the_extent_of_its_pixels_along_and_across_the_heading() -> None:
    objects = fit_boxes(moving(18, 8, (50, 0)), car_length_px=LENGTH)
    assert len(objects) == 1
    assert (objects.x[0], objects.y[0]) == pytest.approx((68.5, 53.5))
    assert (objects.length[0], objects.width[0]) == pytest.approx((17, 7))  # between pixel centres
    assert (objects.heading_rad[0], objects.speed[0]) == pytest.approx((0, 50))
    assert objects.fill[0] == pytest.approx(18 * 8 / (17 * 7))
    assert objects.bright[0]
    across = fit_boxes(moving(18, 8, (0, -50)), car_length_px=LENGTH)
    assert (across.length[0], across.width[0]) == pytest.approx((7, 17))
    assert (across.x[0], across.y[0]) == pytest.approx((68.5, 53.5))
    assert across.axis_offset_rad[0] == pytest.approx(np.pi / 2)


def test_a_shadow_is_measured_and_removed() -> None:
    groups = moving(18, 8, (50, 0), dark=(3, 4))
    sample = sample_shadows(groups, car_length_px=LENGTH)
    np.testing.assert_allclose(sample[0, :3], [0, 3, 4])
    assert sample[0, 3] > 0
    assert sample[0, 4] > 0
    whole = fit_boxes(groups, car_length_px=LENGTH)
    assert (whole.length[0], whole.width[0]) == pytest.approx((20, 11))
    car = remove_shadow(whole, np.array([3.0, 4.0]))
    assert (car.length[0], car.width[0]) == pytest.approx((17, 7))
    assert (car.x[0], car.y[0]) == pytest.approx((68.5, 53.5))
    assert len(sample_shadows(moving(18, 8, (50, 0)), car_length_px=LENGTH)) == 0


def objects(n: int = 1, **values: float | FloatArray) -> MovingObjects:
    usual = {
        "x": 50,
        "y": 40,
        "heading_rad": 0,
        "length": 16,
        "width": 7,
        "speed": 50,
        "fill": 0.9,
        "cxx": 21,
        "cxy": 0,
        "cyy": 4,
    }
    parts = {
        name: np.broadcast_to(np.asarray(values.get(name, value), float), n).copy() for name, value in usual.items()
    }
    return MovingObjects(**parts, bright=np.ones(n, bool))


@settings(max_examples=50, deadline=None)
@given(st.floats(-np.pi, np.pi), st.floats(-30, 30), st.floats(-30, 30))
def test_no_box_loses_more_than_half_a_side_to_its_shadow(heading: float, dx: float, dy: float) -> None:
    before = objects(heading_rad=heading)
    after = remove_shadow(before, np.array([dx, dy]))
    assert before.length[0] / 2 - 1e-9 <= after.length[0] <= before.length[0]
    assert before.width[0] / 2 - 1e-9 <= after.width[0] <= before.width[0]
    towards_sun = (before.x - after.x) * dx + (before.y - after.y) * dy
    assert towards_sun[0] >= -1e-9
    same = remove_shadow(before, np.zeros(2))
    assert (same.x[0], same.length[0], same.cxx[0]) == (before.x[0], before.length[0], before.cxx[0])


def shadow_samples(shadow: FloatArray, n: int, seed: int) -> FloatArray:
    """What cars of random headings show of a shadow; along the heading the bonnet adds 4 px."""
    heading = np.random.default_rng(seed).uniform(0, 2 * np.pi, n)
    c, s = np.cos(heading), np.sin(heading)
    along, across = c * shadow[0] + s * shadow[1], c * shadow[1] - s * shadow[0]
    return np.column_stack([heading, along + 4 * np.sign(along), across, np.tile(shadow, (n, 1))])


@settings(max_examples=15, deadline=None)
@given(st.floats(-6, 6), st.floats(2, 6), st.integers(0, 100))
def test_the_shadow_vector_is_fitted_robustly(dx: float, dy: float, seed: int) -> None:
    samples = shadow_samples(np.array([dx, dy]), 60, seed)
    samples[:6, 2] += 20  # two cars side by side
    np.testing.assert_allclose(fit_shadow_vector(samples), [dx, dy], atol=0.6)


def test_few_samples_or_ones_that_disagree_give_no_shadow() -> None:
    samples = shadow_samples(np.array([4.0, 3.0]), 40, 0)
    assert not fit_shadow_vector(samples[:7]).any()
    assert fit_shadow_vector(samples[:8]).any()
    samples[::2, 3:] *= -1
    assert not fit_shadow_vector(samples).any()
    assert not fit_shadow_vector(np.empty((0, 5))).any()


@pytest.mark.parametrize(
    ("sides", "fits"),
    [((16, 7), True), ((7, 16), True), ((8, 5), False), ((25, 7), False), ((16, 3), False), ((16, 13), False)],
)
def test_a_car_has_a_cars_sides_whichever_way_it_moves(sides: tuple[float, float], fits: bool) -> None:
    box = objects(length=sides[0], width=sides[1])
    assert has_car_size(box, car_length_px=LENGTH).tolist() == [fits]
    assert has_car_size(box, car_length_px=None).all()
    assert not has_car_size(replace(box, fill=np.array([0.3])), car_length_px=None).any()


def test_cars_move_along_their_axis() -> None:
    tilt = np.radians([0, 20, 30, 90])
    c, s = np.cos(tilt), np.sin(tilt)
    boxes = objects(4, cxx=c * c * 21 + s * s * 4, cxy=c * s * 17, cyy=s * s * 21 + c * c * 4)
    np.testing.assert_allclose(boxes.axis_offset_rad, tilt)
    assert moves_along_axis(boxes).tolist() == [True, True, False, False]
    round_one = objects(cxx=20, cyy=20)
    assert not round_one.has_axis.any()
    assert moves_along_axis(round_one).all()
    assert not moves_along_axis(objects(length=7, width=16)).any()
    assert not moves_along_axis(objects(length=40, width=7)).any()


# ---- triplets


def frames_of(cars: FloatArray, count: int = 3) -> list[tuple[Blobs, BlobPixels]]:
    """Blobs of cars (x, y, vx) of 16 x 7 px in frames 0.2 s apart."""
    made = []
    for k in range(count):
        signed = np.zeros((400, 600), np.float32)
        for x, y, vx in cars:
            left = round(x + vx * 0.2 * k)
            signed[round(y) : round(y) + 7, max(left, 0) : left + 16] = 60
        made.append(extract_blobs(signed, noise=0.0, car_length_px=LENGTH))
    return made


def test_a_triplet_has_the_boxes_of_the_moving_cars() -> None:
    cars = np.array([[50.0, 50, 60], [300, 100, -90], [100, 200, 0]])
    triplet = link_triplet(frames_of(cars), np.array([0, 0.2, 0.4]), (0, 1, 2), LENGTH)
    assert triplet.middle == 1
    assert triplet.links.linked.sum() == 2
    found = select_cars(triplet.objects, LENGTH)
    order = np.argsort(found.x)
    np.testing.assert_allclose(found.x[order], [50 + 12 + 7.5, 300 - 18 + 7.5])
    np.testing.assert_allclose(found.speed[order], [60, 90], rtol=0.01)
    np.testing.assert_allclose(np.cos(found.heading_rad[order]), [1, -1])
    assert triplet.shadows.shape == (0, 5)


def test_false_links_are_few_among_cars_and_many_among_clutter() -> None:
    times = np.arange(3) * 0.2
    lanes = np.array([[60.0 * k, 40 + 30 * lane, 70] for k in range(5) for lane in range(8)])
    sparse = frames_of(lanes)
    assert len(select_cars(link_triplet(sparse, times, (0, 1, 2), LENGTH).objects, LENGTH)) >= 30
    assert count_false_links(sparse, times, np.array([1]), np.zeros(2), LENGTH) <= 1
    rng = np.random.default_rng(0)
    cells = np.stack(np.meshgrid(np.arange(20, 560, 26), np.arange(10, 380, 14)), -1).reshape(-1, 2)
    clutter = []
    for _ in range(3):  # in each frame other boxes at half of the cells
        chosen = cells[rng.random(len(cells)) < 0.5] + rng.integers(-3, 4, 2)
        clutter += frames_of(np.column_stack([chosen + rng.integers(-2, 3, chosen.shape), np.zeros(len(chosen))]), 1)
    assert count_false_links(clutter, times, np.array([1]), np.zeros(2), LENGTH) >= 3


def test_interior_frames_have_neighbours_in_time_on_both_sides() -> None:
    assert interior_frames(np.array([0, 0.2, 0.4, 2.0, 2.2, 2.4, 2.6]), 0.45).tolist() == [1, 4, 5]
    assert interior_frames(np.array([0, 0.2]), 0.45).tolist() == []
