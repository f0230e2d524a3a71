"""Blocks, streets, ground and relief: what is painted where, heights, light and shadows."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray
from schemas.simulation import SceneSimulation
from tests.synthetic.test_traffic import boxes_overlap
from velfield.synthetic.city import city_plan as p
from velfield.synthetic.city.blocks import OccupancyGrid, box, place_buildings, place_tree
from velfield.synthetic.city.city_plan import make_city_plan
from velfield.synthetic.city.ground import (
    ASPHALT,
    GRASS,
    MARKING,
    NOON,
    Canvas,
    add_texture,
    light_map,
    reach_map,
)
from velfield.synthetic.city.relief import GRID_PX, ground_height, ground_height_at, make_relief
from velfield.synthetic.city.streets import paint_city
from velfield.synthetic.render import REACH_CELL, SHADOW_LIGHT

RECT = (0.0, 0.0, 120.0, 90.0)


def canvas(width: int = 240, height: int = 200, pixel_m: float = 0.5) -> Canvas:
    return Canvas((width, height), origin_m=(10.0, 20.0), pixel_m=pixel_m)


def test_occupied_ground_is_not_free_and_the_rest_is() -> None:
    grid = OccupancyGrid(RECT)
    grid.occupy(box(20, 20, 40, 30))
    grid.occupy_path(np.array([[0.0, 60.0], [120.0, 60.0]]), 8.0)
    assert not grid.is_free(box(35, 25, 60, 40))
    assert not grid.is_free(box(50, 55, 60, 57))
    assert grid.is_free(box(50, 25, 70, 45))
    assert grid.is_free(box(42, 20, 50, 30))
    assert not grid.is_free(box(500, 500, 510, 510))  # outside the raster


class Recorder(Canvas):
    """A canvas that keeps the outlines it raises."""

    def __init__(self) -> None:
        super().__init__((40, 40), origin_m=(0.0, 0.0), pixel_m=3.0)
        self.outlines: list[FloatArray] = []

    def raise_polygon(self, points_m: FloatArray, height_m: float) -> None:
        self.outlines.append(points_m)
        super().raise_polygon(points_m, height_m)


def as_rectangle(corners: FloatArray) -> FloatArray:
    """x, y, direction, length, width of a rectangle's corners."""
    along, across = corners[1] - corners[0], corners[2] - corners[1]
    return np.array([*corners.mean(axis=0), np.arctan2(along[1], along[0]), np.hypot(*along), np.hypot(*across)])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_buildings_overlap_neither_each_other_nor_a_road(seed: int) -> None:
    recorder, grid = Recorder(), OccupancyGrid((-40.0, -40.0, 160.0, 130.0))
    road = box(-50, 40, 200, 52)
    grid.occupy(road)
    place_buildings(recorder, RECT, grid, SceneSimulation(), np.random.default_rng(seed))
    rectangles = [as_rectangle(corners) for corners in recorder.outlines]
    buildings = [r for r in rectangles if r[3] >= 11 and r[4] >= 8]  # what is smaller stands on a roof
    assert len(buildings) >= 4
    for i, a in enumerate(buildings):
        assert not boxes_overlap(a, as_rectangle(road))
        assert not any(boxes_overlap(a, b) for b in buildings[:i])


def test_heights_of_buildings_are_bounded_and_zero_turns_them_off() -> None:
    for height in (14.0, 0.0):
        painted = canvas()
        place_buildings(
            painted, RECT, OccupancyGrid(RECT), SceneSimulation(building_height_m=height), np.random.default_rng(1)
        )
        assert painted.height_m.max() <= height + 1.5  # structures on the roof
        assert (painted.height_m.max() > 0) == (height > 0)
        assert (painted.paint != GRASS).any()  # roofs and yards are painted in either case


def test_a_tree_is_highest_at_its_centre_and_within_its_radius() -> None:
    painted = canvas(pixel_m=0.25)
    place_tree(painted, 40.0, 45.0, 4.0, SceneSimulation(tree_height_m=8.0), np.random.default_rng(0))
    y, x = np.nonzero(painted.height_m)
    at = np.column_stack([x, y]) * 0.5 + [10.0, 20.0]
    distance = np.hypot(*(at - [40.0, 45.0]).T)
    assert distance.max() < 1.35 * 4.0
    height = painted.height_m[y, x]
    assert 0.8 * 8.0 * 0.9 < height.max() <= 8.0
    assert height[distance < 1].mean() > height[distance > 3].mean()


def test_street_trees_hide_parts_of_lanes_and_change_nothing_else() -> None:
    rect = (-120.0, -60.0, 40.0, 100.0)
    plan = make_city_plan(rect, np.random.default_rng(1), turn_share=0.1, cycle_s=60)
    heights, paints = [], []
    for share in (0.0, 0.4):
        painted = Canvas((640, 640), origin_m=(-120.0, -60.0), pixel_m=0.25)
        paint_city(painted, plan, SceneSimulation(street_tree_share=share), np.random.default_rng(2))
        heights.append(painted.height_m)
        paints.append(painted.paint)
    lanes = np.concatenate([edge.path for edge in plan.road_network.edges if edge.kind == "avenue"])
    cells = np.rint((lanes - [-120.0, -60.0]) / 0.5).astype(int)
    cells = cells[((cells >= 0) & (cells < 320)).all(axis=1)]
    hidden = [float((height[cells[:, 1], cells[:, 0]] > 2).mean()) for height in heights]
    assert hidden[0] < 0.01
    assert 0.03 < hidden[1] < 0.4
    assert (heights[1] >= heights[0]).all()
    changed = (paints[0] != paints[1]).any(axis=2)[::2, ::2]
    raised = cv2.dilate((heights[1] > 0).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert not (changed & ~raised).any()


def test_roads_and_parking_spaces_are_free_of_buildings_and_apart_from_lanes() -> None:
    plan = make_city_plan((-120.0, -150.0, 160.0, 90.0), np.random.default_rng(0), turn_share=0.15, cycle_s=60.0)
    painted = Canvas((1120, 960), origin_m=(-120.0, -150.0), pixel_m=0.25)
    spaces = paint_city(painted, plan, SceneSimulation(tree_height_m=0.0), np.random.default_rng(0))
    lanes = np.concatenate([edge.path for edge in plan.road_network.edges])
    pixel = np.floor((lanes - painted.origin_m) / 0.5).astype(int)
    inside = (pixel >= 0).all(axis=1) & (pixel < painted.height_m.shape[::-1]).all(axis=1)
    assert inside.sum() > 1000
    assert (painted.height_m[pixel[inside, 1], pixel[inside, 0]] == 0).all()
    distance, _ = cKDTree(lanes).query(spaces[:, :2])
    assert len(spaces) > 50
    assert distance.min() > 2.5
    y = plan.avenues_y[0] + p.CURB_A
    tones = painted.paint[int((y + 150.0) / 0.25), :, 0]
    assert abs(float(np.median(tones)) - ASPHALT[0]) < 15


def test_shapes_are_painted_at_their_metres() -> None:
    painted = canvas()
    painted.rect(20.0, 30.0, 30.0, 50.0, MARKING)
    mask = (painted.paint == MARKING).all(axis=2)
    y, x = np.nonzero(mask)
    assert mask.sum() == pytest.approx(10 * 20 / 0.25, rel=0.12)
    assert (x.min() * 0.5 + 10, y.min() * 0.5 + 20) == pytest.approx((20.0, 30.0), abs=0.5)
    round_ = canvas()
    round_.circle(60.0, 60.0, 10.0, MARKING)
    assert (round_.paint == MARKING).all(axis=2).sum() == pytest.approx(np.pi * 100 / 0.25, rel=0.03)


def test_texture_scales_with_its_strength_and_vegetation_is_lighter_for_the_other_sensor() -> None:
    paint = np.empty((256, 256, 4), np.uint8)
    paint[:, :128], paint[:, 128:] = ASPHALT, GRASS
    tones = {
        strength: add_texture(paint, strength=strength, vegetation_shift=35.0, rng=np.random.default_rng(0))
        for strength in (0.5, 1.0)
    }
    deviation = {strength: both[0][:, :128].astype(float).std() for strength, both in tones.items()}
    assert deviation[1.0] == pytest.approx(2 * deviation[0.5], rel=0.05)
    camera, other = tones[1.0]
    assert camera[:, :128].mean() == pytest.approx(ASPHALT[0], abs=6)
    road, grass = (other[:, part].mean() - camera[:, part].mean() for part in (np.s_[:128], np.s_[128:]))
    assert road == pytest.approx(ASPHALT[1] - ASPHALT[0], abs=3)
    assert grass == pytest.approx(GRASS[1] - GRASS[0] + 35.0, abs=4)
    assert np.corrcoef(camera[:, :128].ravel(), other[:, :128].ravel())[0, 1] > 0.9  # one ground, two sensors


@settings(max_examples=15)
@given(seed=st.integers(0, 1000), lean=st.floats(0.1, 1.5))
def test_the_reach_map_bounds_all_heights_that_a_ray_may_meet(seed: int, lean: float) -> None:
    rng = np.random.default_rng(seed)
    height = np.zeros((6 * REACH_CELL, 7 * REACH_CELL), np.uint8)
    for _ in range(3):
        y, x = rng.integers(0, 90, 2)
        height[y : y + 5, x : x + 5] = rng.integers(1, 255)
    reach = reach_map(height, lean, step_px=0.43)
    for y, x in np.argwhere(height):
        radius = height[y, x] * 0.43 * lean
        for i in range(reach.shape[0]):
            for j in range(reach.shape[1]):
                dy = max(i * REACH_CELL - y, y - (i + 1) * REACH_CELL + 1, 0)
                dx = max(j * REACH_CELL - x, x - (j + 1) * REACH_CELL + 1, 0)
                if np.hypot(dx, dy) <= radius:
                    assert reach[i, j] >= height[y, x]


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, -0.7), (-0.5, 0.5)])
def test_a_shadow_is_as_long_as_height_times_the_sun_vector(direction: tuple[float, float]) -> None:
    sun = np.array(direction)
    height = np.zeros((128, 128), np.uint8)
    height[62:66, 62:66] = 200  # 20 px high
    light = light_map(height, reach_map(height, 1.5, 0.1), step_px=0.1, direction=sun)
    sunlit, shadow = NOON, NOON * SHADOW_LIGHT
    for fraction, expected in ((0.3, shadow), (0.7, shadow), (1.5, sunlit), (-0.5, sunlit)):
        x, y = np.rint(63.5 + 20.0 * fraction * sun).astype(int)
        assert light[y, x] == pytest.approx(expected, abs=0.06), fraction
    assert light_map(height, reach_map(height, 1.5, 0.1), step_px=0.1, direction=np.zeros(2)).min() == pytest.approx(
        NOON
    )


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), height=st.floats(0, 20))
def test_relief_is_bounded_by_its_height_and_zero_gives_a_plane(seed: int, height: float) -> None:
    relief = make_relief((-64, -64, 500, 400), height_px=height, length_px=300.0, rng=np.random.default_rng(seed))
    assert np.abs(relief.grid).max() <= height
    assert (make_relief((0, 0, 64, 64), height_px=0.0, length_px=9.0, rng=np.random.default_rng(seed)).grid == 0).all()


def test_ground_height_is_bilinear_between_nodes_and_constant_outside() -> None:
    relief = make_relief((-64, -64, 300, 200), height_px=5.0, length_px=150.0, rng=np.random.default_rng(2))
    grid, frame = relief.grid, relief.frame
    node = (-64 + 3 * GRID_PX, -64 + 5 * GRID_PX)
    assert ground_height_at(*node, grid, frame) == pytest.approx(grid[5, 3])
    middle = ground_height_at(node[0] + GRID_PX / 2, node[1] + GRID_PX / 2, grid, frame)
    assert middle == pytest.approx(grid[5:7, 3:5].mean())
    assert ground_height_at(-900.0, -64.0, grid, frame) == pytest.approx(grid[0, 0])
    x, y = np.random.default_rng(0).uniform(-50, 250, (2, 40))
    assert ground_height(x, y, grid, frame) == pytest.approx(
        [ground_height_at(*at, grid, frame) for at in zip(x, y, strict=True)]
    )


def test_car_parks_and_streets_of_the_plan_have_spaces() -> None:
    plan = make_city_plan((-190.0, -160.0, 200.0, 140.0), np.random.default_rng(0), turn_share=0.1, cycle_s=60.0)
    painted = Canvas((400, 300), origin_m=(-190.0, -160.0), pixel_m=1.0)
    spaces = paint_city(painted, plan, SceneSimulation(), np.random.default_rng(1))
    x, first = plan.car_parks[0]
    in_car_park = (np.abs(spaces[:, 0] - x - 50) < 35) & (np.abs(spaces[:, 1] - first - 8) < 20)
    assert in_car_park.sum() >= 60
    assert (~in_car_park).sum() > 10
    assert np.abs(np.sin(spaces[in_car_park, 2])) == pytest.approx(1.0)  # at right angles to the aisles
    assert p.STREET_SPEED > p.AISLE_SPEED
