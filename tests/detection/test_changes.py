"""Searching a frame only where it differs from one that was searched whole."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from schemas.arrays import GreyImage, Mask, Points
from velfield.detection.boxes import split_into_boxes
from velfield.detection.changes import CELL_PX
from velfield.detection.cnn.detector import CnnDetector
from velfield.detection.cnn.network import ALIGNMENT
from velfield.detection.crops import oriented_strips
from velfield.detection.detect import SearchedFrame, changed_cells, search_frame
from velfield.detection.frame import ComparableFrame, half_resolution
from velfield.detection.interface import Detections, Detector, concatenate
from velfield.detection.mosaic import CROP_UNIT_PX, Mosaic, assemble, find_in_boxes, find_owners, pack_boxes
from velfield.detection.registry import shipped_detector

_SHAPE = 300, 420


def ground(seed: int = 0) -> GreyImage:
    """Smooth ground with noise of its own."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: _SHAPE[0], : _SHAPE[1]]
    return np.clip(110 + 20 * np.sin(x / 40) + 15 * np.cos(y / 30) + rng.normal(0, 2, _SHAPE), 0, 255).astype(np.uint8)


def with_cars(image: GreyImage, xy: list[tuple[int, int]], level: int = 220) -> GreyImage:
    """Bright cars of 16 x 8 px along x, with a dark windscreen."""
    image = image.copy()
    for x, y in xy:
        image[y - 4 : y + 4, x - 8 : x + 8] = level
        image[y - 3 : y + 3, x + 2 : x + 5] = 40
    return image


def frame(image: GreyImage, valid: Mask | None = None) -> ComparableFrame:
    return ComparableFrame(image, np.ones(image.shape, bool) if valid is None else valid)


def flight_detector() -> Detector:
    """The shipped detector as a flight of this ground has it."""
    return shipped_detector().in_light_of([ground(1)])


def near(found: Points, x: float, y: float) -> bool:
    return bool(len(found)) and bool((np.hypot(found[:, 0] - x, found[:, 1] - y) < 4).any())


def boxes_of_px(*boxes: tuple[int, int, int, int]) -> np.ndarray:
    """Boxes of cells (n, 4) that cover boxes of px."""
    px = np.array(boxes)
    return np.column_stack([px[:, :2] // CELL_PX, -(-px[:, 2:] // CELL_PX)])


def test_noise_and_exposure_are_no_change_and_a_car_that_moved_is() -> None:
    before = frame(with_cars(ground(1), [(100, 100), (300, 200)]))
    after = frame(np.clip(with_cars(ground(2), [(100, 100), (312, 200)]).astype(np.int64) + 9, 0, 255).astype(np.uint8))
    changed = changed_cells(after, before)
    assert changed[200 // CELL_PX, 312 // CELL_PX]
    assert changed[200 // CELL_PX, 292 // CELL_PX]
    assert not changed[:8].any()
    assert changed.mean() < 0.05


def test_a_dark_car_on_asphalt_is_a_change_and_nothing_else() -> None:
    for rows, columns in (_SHAPE, (287, 401)):  # whole cells and not
        after, before = with_cars(ground(2), [(200, 150)], level=105)[:rows, :columns], ground(1)[:rows, :columns]
        changed = changed_cells(frame(after), frame(before))
        assert changed.shape == (-(-rows // CELL_PX), -(-columns // CELL_PX))
        assert changed[150 // CELL_PX, 200 // CELL_PX]
        assert changed.mean() < 0.02


def test_a_frame_that_changed_everywhere_is_searched_everywhere() -> None:
    rng = np.random.default_rng(5)
    texture = np.kron(rng.integers(0, 255, (30, 42)), np.ones((10, 10))).astype(np.uint8)
    other = np.kron(rng.integers(0, 255, (30, 42)), np.ones((10, 10))).astype(np.uint8)
    assert changed_cells(frame(texture), frame(other)).mean() > 0.9


def test_what_only_one_frame_covers_is_a_change() -> None:
    valid = np.ones(_SHAPE, bool)
    valid[:, :100] = False
    changed = changed_cells(frame(ground(1)), frame(ground(2), valid))
    assert changed[:, : 100 // CELL_PX].all()
    assert not changed[:, 100 // CELL_PX + 1 :].any()


def test_an_edge_that_is_registered_a_fraction_of_a_pixel_off_is_no_change_and_a_car_beside_it_is() -> None:
    bright = ground(1).astype(np.float64)
    bright[:, 200:] += 90
    shifted = ground(2).astype(np.float64)
    shifted[:, 200:] += 90
    shifted[:, 199] += 90 * 0.25  # a quarter of a pixel to the left
    before, after = (np.clip(image, 0, 255).astype(np.uint8) for image in (bright, shifted))
    assert not changed_cells(frame(after), frame(before)).any()
    changed = changed_cells(frame(with_cars(after, [(208, 150)], level=60)), frame(before))
    assert changed[150 // CELL_PX, 208 // CELL_PX]


def test_what_is_found_in_a_mosaic_of_boxes_is_what_is_found_in_each_box() -> None:
    image = with_cars(ground(3), [(30, 40), (100, 100), (300, 200), (215, 250), (410, 290)])
    searched = frame(image)
    boxes = boxes_of_px(
        (0, 0, 80, 64), (80, 80, 144, 128), (176, 256, 224, 336), (224, 176, 300, 256), (272, 384, 300, 420)
    )
    detector = flight_detector()
    mosaics = pack_boxes(boxes, detector.context_px)
    assert sorted(number for one in mosaics for number in one.numbers) == [0, 1, 2, 3, 4]
    taken = np.zeros(mosaics[0].shape, np.int64)
    for row, column, height, width in mosaics[0].crops:
        taken[row : row + height, column : column + width] += 1
    assert taken.max() == 1, "crops do not overlap"
    together = find_in_boxes(detector, searched, boxes, -0.2)
    alone = [find_in_boxes(detector, searched, box[None], -0.2) for box in boxes]
    assert [len(one) for one in alone] == [1, 1, 1, 1, 1]
    np.testing.assert_allclose(together.to_rows(), concatenate(alone).to_rows(), rtol=0, atol=1e-4)


def test_crops_of_many_boxes_overlap_nowhere_and_fill_half_of_their_mosaics() -> None:
    rng = np.random.default_rng(9)
    boxes = np.concatenate([np.zeros((80, 2), np.int64), rng.integers(1, 60, (80, 2))], axis=1)
    found = pack_boxes(boxes, 16)
    assert len(found) > 2
    assert sorted(number for one in found for number in one.numbers) == list(range(80))
    for one in found:
        taken = np.zeros(one.shape, np.int64)
        for number, (top, left, height, width) in zip(one.numbers, one.crops, strict=True):
            assert height % 16 == width % 16 == 0
            assert 0 <= height - (8 * boxes[number][2] + 32) < 16
            assert 0 <= width - (8 * boxes[number][3] + 32) < 16
            assert top + height <= one.shape[0]
            assert left + width <= one.shape[1]
            taken[top : top + height, left : left + width] += 1
        assert taken.max() == 1
        assert taken.mean() > 0.5
    assert pack_boxes(boxes[:0], 16) == []
    assert CROP_UNIT_PX == ALIGNMENT, "what the network needs"


@pytest.mark.parametrize(("border", "mode"), [(cv2.BORDER_REFLECT_101, "reflect"), (cv2.BORDER_CONSTANT, "constant")])
def test_windows_that_reach_beyond_the_image_go_on(border: int, mode: str) -> None:
    image = np.random.default_rng(7).integers(1, 256, (50, 60), dtype=np.uint8)
    corners = np.array([(-16, -16), (5, 7), (33, 43), (47, 10), (-23, 59), (-8, -8)])
    crops = np.array(
        [(0, 0, 40, 48), (0, 48, 40, 40), (40, 0, 40, 40), (40, 40, 24, 40), (0, 88, 24, 24), (80, 2, 80, 90)]
    )
    expected = np.zeros((160, 112), np.uint8)
    for (top, left), (y, x, rows, columns) in zip(corners, crops, strict=True):
        inside = image[max(0, top) : top + rows, max(0, left) : left + columns]
        beyond = (max(0, -top), max(0, top + rows - 50)), (max(0, -left), max(0, left + columns - 60))
        expected[y : y + rows, x : x + columns] = np.pad(inside, beyond, mode=mode)
    found = assemble(image, Mosaic((160, 112), np.arange(6), crops, corners), border)
    np.testing.assert_array_equal(found, expected)


def test_a_position_belongs_to_the_box_that_it_lies_in() -> None:
    boxes = np.array([(16, 16, 16, 24), (16, 72, 8, 32), (64, 16, 8, 8)])
    owner = np.full((88, 120), -1)
    for number, (top, left, rows, columns) in enumerate(boxes):
        owner[top : top + rows, left : left + columns] = number
    xy = np.random.default_rng(8).uniform(-5, 125, (500, 2))
    column, row = (np.clip(np.floor(xy[:, k] + 0.5).astype(int), 0, size - 1) for k, size in ((0, 120), (1, 88)))
    expected = owner[row, column]
    position, box = find_owners(xy, boxes, (88, 120))
    np.testing.assert_array_equal(position, np.flatnonzero(expected >= 0))
    np.testing.assert_array_equal(box, expected[position])


def test_a_detector_of_another_kind_searches_each_box_by_itself() -> None:
    seen = []

    class Recording(CnnDetector):
        find_in_crops = Detector.find_in_crops

        def find(self, image, valid=None, *, threshold=None):
            assert valid.shape == image.shape
            seen.append(image.shape)
            return super().find(image, valid, threshold=threshold)

    detector = Recording(flight_detector().record)
    image = with_cars(ground(3), [(30, 40), (100, 100), (300, 200)])
    boxes = boxes_of_px((0, 0, 80, 64), (80, 80, 144, 128), (176, 256, 224, 336))
    found = find_in_boxes(detector, frame(image), boxes, 0.0)
    assert sorted(seen) == [(80, 112), (96, 80), (112, 96)]
    assert all(near(found.xy, x, y) for x, y in [(30, 40), (100, 100), (300, 200)])


def test_frames_of_two_grids_are_refused() -> None:
    with pytest.raises(ValueError, match="expected one grid"):
        changed_cells(frame(ground()), frame(ground()[:-1]))


@pytest.mark.parametrize("share", [0.0, 0.002, 0.02, 0.2, 1.0])
def test_boxes_cover_the_marked_cells_once_and_cost_no_more_than_one_box(share: float) -> None:
    cells = np.random.default_rng(3).random((40, 56)) < share
    boxes = split_into_boxes(cells, 1.0, 16.0)
    count = np.zeros(cells.shape, int)
    for top, left, bottom, right in boxes:
        count[top:bottom, left:right] += 1
    assert count.max(initial=0) <= 1
    assert (count[cells] == 1).all()
    cost = sum((bottom - top + 2) * (right - left + 2) + 16 for top, left, bottom, right in boxes)
    assert cost <= (cells.shape[0] + 2) * (cells.shape[1] + 2) + 16
    if share == 0.002:
        assert cost < 0.25 * cells.size


def test_two_marks_far_apart_are_two_boxes() -> None:
    cells = np.zeros((20, 30), bool)
    cells[2, 3] = cells[17, 25] = True
    assert sorted(split_into_boxes(cells, 1.0, 16.0).tolist()) == [[2, 3, 3, 4], [17, 25, 18, 26]]


def test_detections_stay_where_nothing_changed_and_follow_what_moved() -> None:
    detector = flight_detector()
    still = [(60, 60), (60, 140), (60, 220), (120, 60), (120, 140)]
    first = search_frame(detector, frame(with_cars(ground(1), [*still, (330, 230)])))
    assert first.searched == 1
    assert all(near(first.detections.xy, x, y) for x, y in [*still, (330, 230)])
    second = search_frame(detector, frame(with_cars(ground(2), [*still, (350, 230), (210, 60)])), reference=first)
    found = second.detections.xy
    assert second.searched < 0.3
    assert all(near(found, x, y) for x, y in [*still, (350, 230), (210, 60)])  # the last one appeared
    assert not near(found, 330, 230)
    kept = {tuple(xy) for xy in found} & {tuple(xy) for xy in first.detections.xy}
    assert len(kept) >= len(still) - 1  # the least certain one is searched for again


def test_a_detection_is_not_kept_where_a_neighbour_changed() -> None:
    """The middle of a bus that moved looks the same; only its ends changed."""
    detector = flight_detector()
    before = search_frame(detector, frame(ground(1)))
    detections = Detections.from_rows(np.array([[200.0, 150.0, 0.0, 0.4, 0.1]]), np.array([128.0]))
    after = with_cars(ground(2), [(224, 150)])
    again = search_frame(detector, frame(after), reference=replace(before, detections=detections))
    assert not near(again.detections.xy, 200, 150)


def test_detections_are_dropped_where_the_frame_does_not_reach() -> None:
    detector = flight_detector()
    detections = Detections.from_rows(np.array([[60.0, 60.0, 0.0, 0.4, 0.1]]), np.array([128.0]))
    reference = SearchedFrame(frame(ground(1)), detections, 1.0)
    valid = np.ones(_SHAPE, bool)
    valid[:, :200] = False
    assert not near(search_frame(detector, frame(ground(2), valid), reference=reference).detections.xy, 60, 60)


def test_a_frame_searched_whole_gives_what_the_detector_gives() -> None:
    detector = flight_detector()
    image = with_cars(ground(4), [(60, 60), (330, 230), (150, 200)])
    whole = detector.detect(image)
    searched = search_frame(detector, frame(image)).detections
    assert len(whole) == len(searched) >= 3
    order, other = np.argsort(whole.xy[:, 0]), np.argsort(searched.xy[:, 0])
    assert np.abs(whole.xy[order] - searched.xy[other]).max() < 0.1


def test_weak_candidates_lie_below_the_threshold_and_on_no_car_and_leave_the_cars_as_they_are() -> None:
    image = with_cars(with_cars(ground(4), [(60, 60), (330, 230)]), [(150, 200), (250, 80)], level=126)  # two are faint
    at = flight_detector().threshold
    low = search_frame(flight_detector(), frame(image), threshold=at - 0.1).detections
    pick = float(np.sort(low.score)[len(low) // 2])  # a threshold with candidates on either side
    searched = search_frame(flight_detector(), frame(image), threshold=pick)
    margin = flight_detector().weak_margin
    assert len(searched.weak)
    assert ((searched.weak.score <= pick) & (searched.weak.score > pick - margin)).all()
    apart = np.hypot(*(searched.weak.xy[:, None] - searched.detections.xy[None]).transpose(2, 0, 1))
    assert apart.min() > 4
    again = search_frame(flight_detector(), frame(image), reference=replace(searched), threshold=pick)
    still = np.hypot(*(searched.weak.xy[:, None] - again.weak.xy[None]).transpose(2, 0, 1)).min(axis=1)
    assert still.max() < 1  # of what stayed as it was they are kept as well


def test_strips_show_a_bus_whole_along_its_axis() -> None:
    image = np.full(_SHAPE, 90, np.uint8)
    image[80:180, 196:204] = 200  # 100 px long, upright, 8 px wide
    strip = oriented_strips(half_resolution(image), np.array([[199.5, 129.5]]), np.array([np.pi / 2]))[0]
    assert strip.shape == (32, 10)
    assert (strip[:, 4:6] == 200).all()  # all 64 px of it
    assert (strip[:, [0, 1, 8, 9]] == 90).all()
