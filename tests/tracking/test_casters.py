"""Shadows that are tracked in place of their casters, drawn: a white bus that is not detected, and what is like it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import pandas as pd
import pytest

from schemas.arrays import Float32Array, FloatArray
from velfield.tracking.casters import HALF_WINDOW_M, Caster, find_caster, find_casters, keeps_direction
from velfield.tracking.dimensions import may_be_shadows, shade_moments, shadow_direction

PIXEL_M = 0.5
"""A pixel of the drawn frames, which is a base pixel too."""
SIZE, FINE, FRAMES, INTERVAL_S = 240, 4, 24, 0.2
ASPHALT, WHITE, BLACK, SHADOW_LIGHT = 160.0, 245.0, 24.0, 0.12
EAST, SOUTH, SOUTH_WEST = (1.0, 0.0), (0.0, 1.0), (-np.sqrt(0.5), np.sqrt(0.5))


@dataclass(frozen=True)
class Body:
    """A vehicle: its centre (2,) m by time, heading (2,), length and width m, grey level, length of its shadow m."""

    centre: Callable[[float], FloatArray]
    heading: FloatArray
    length: float
    width: float
    grey: float
    shadow_m: float

    def corners(self, time_s: float) -> FloatArray:
        """(4, 2) m."""
        along = np.array([0.5, 0.5, -0.5, -0.5])[:, None] * self.length * self.heading
        across = np.array([0.5, -0.5, -0.5, 0.5])[:, None] * self.width * np.array([-self.heading[1], self.heading[0]])
        return np.asarray(self.centre(time_s) + along + across)


def body(
    start: tuple[float, float],
    speed: float,
    *,
    heading: tuple[float, float] = EAST,
    size: tuple[float, float] = (12.0, 2.5),
    grey: float = WHITE,
    shadow_m: float = 4.5,
) -> Body:
    way = np.array(heading)
    return Body(lambda t: np.array(start) + speed * t * way, way, *size, grey, shadow_m)


@dataclass
class Scene:
    """Vehicles in the sun over a road with lane lines, and what stands beside it: (4, 2) m each."""

    vehicles: Sequence[Body]
    sun: tuple[float, float]
    buildings: Sequence[FloatArray] = ()
    asked: list[int] = field(default_factory=list)

    def frame(self, number: int) -> FloatArray:
        """(240, 240) grey levels."""
        rng, fine = np.random.default_rng(3), SIZE * FINE
        image = cv2.resize(rng.normal(ASPHALT, 8, (60, 60)), (fine, fine), interpolation=cv2.INTER_CUBIC)
        for y in range(0, fine, 56):  # every 7 m
            image[y : y + 4] = 235.0
        time_s = number * INTERVAL_S
        for vehicle in self.vehicles:
            corners = vehicle.corners(time_s)
            swept = np.concatenate([corners, corners + vehicle.shadow_m * np.array(self.sun)])
            shade = np.zeros((fine, fine), np.uint8)
            _fill(shade, cv2.convexHull(swept.astype(np.float32))[:, 0], 1)
            image[shade == 1] *= SHADOW_LIGHT
        for corners in self.buildings:
            _fill(image, corners, WHITE)
        for vehicle in self.vehicles:
            _fill(image, vehicle.corners(time_s), vehicle.grey)
        small = cv2.resize(image, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
        return np.clip(small + np.random.default_rng(number).normal(0, 3, small.shape), 0, 255)

    def look(self, frame: int, xy_px: FloatArray) -> Float32Array:
        """As of `velfield.tracking.casters.Look`."""
        self.asked.append(frame)
        image, half = self.frame(frame).astype(np.float32), int(HALF_WINDOW_M / PIXEL_M)
        wide = cv2.copyMakeBorder(image, 90, 90, 90, 90, cv2.BORDER_CONSTANT, value=np.nan)
        return np.stack([cv2.getRectSubPix(wide, (2 * half + 1,) * 2, (x + 90, y + 90)) for x, y in xy_px.tolist()])


def _fill(image: np.ndarray, corners_m: FloatArray, value: float) -> None:
    points = (np.asarray(corners_m) / PIXEL_M + 0.5) * FINE - 0.5
    cv2.fillConvexPoly(image, np.rint(points * 16).astype(np.int32), value, cv2.LINE_8, 4)


def track(number: int, place: Callable[[float], FloatArray], frames: range = range(FRAMES)) -> pd.DataFrame:
    """Positions as of a detector, 0.1 m."""
    rng = np.random.default_rng(number)
    xy = np.stack([place(frame * INTERVAL_S) for frame in frames]) + rng.normal(0, 0.1, (len(frames), 2))
    columns = {"track_id": number, "frame": frames, "x_px": xy[:, 0] / PIXEL_M, "y_px": xy[:, 1] / PIXEL_M}
    return pd.DataFrame({**columns, "source": 0})


def of_shadow(vehicle: Body, sun: tuple[float, float]) -> Callable[[float], FloatArray]:
    """The middle of what is seen of a vehicle's shadow: beyond the side that it leaves."""
    across = np.array([-vehicle.heading[1], vehicle.heading[0]])
    s, light = vehicle.shadow_m, np.array(sun)
    along_light = [abs(float(light @ axis)) for axis in (vehicle.heading, across)]
    behind = min(size / 2 / c for size, c in zip((vehicle.length, vehicle.width), along_light, strict=True) if c > 0.1)
    return lambda t: vehicle.centre(t) + (behind + s / 2) * light


def casters(scene: Scene, *tracks: pd.DataFrame) -> dict[int, Caster]:
    positions = pd.concat(tracks, ignore_index=True)
    return find_casters(positions, np.array([1]), np.array(scene.sun), scene.look, PIXEL_M, PIXEL_M)


@pytest.mark.parametrize("heading", [EAST, (-1.0, 0.0), (0.8, 0.6)])
@pytest.mark.parametrize("sun", [EAST, SOUTH, SOUTH_WEST])
def test_the_track_of_a_shadow_is_moved_onto_its_bus(heading: tuple[float, float], sun: tuple[float, float]) -> None:
    start = (30.0, 60.0) if heading[0] > 0 else (90.0, 60.0)
    start = (start[0], 35.0) if heading[1] else start
    bus = body(start, 9.0, heading=heading)
    scene = Scene([bus], sun)
    shadow = of_shadow(bus, sun)
    found = casters(scene, track(1, shadow))
    assert found.keys() == {1}
    assert np.hypot(*(shadow(0.0) + found[1].offset_m - bus.centre(0.0))) < 0.7
    assert found[1].length_m == pytest.approx(12.0, abs=1.2)
    assert found[1].width_m == pytest.approx(2.5, abs=0.8)
    assert scene.asked == sorted(set(scene.asked)), "each frame is read once"


@pytest.mark.parametrize("sun", [EAST, SOUTH, SOUTH_WEST])
def test_the_road_and_its_lines_are_no_part_of_the_bus(sun: tuple[float, float]) -> None:
    bus = body((30.0, 61.8), 9.0)  # along the line at 63 m
    shadow = of_shadow(bus, sun)
    found = casters(Scene([bus], sun), track(1, shadow))
    assert found.keys() == {1}
    assert np.hypot(*(shadow(0.0) + found[1].offset_m - bus.centre(0.0))) < 0.7


def test_it_is_told_whether_a_bus_has_a_track_of_its_own() -> None:
    bus = body((30.0, 60.0), 9.0)
    shadow, other = track(1, of_shadow(bus, EAST)), body((30.0, 75.0), 9.0)
    assert casters(Scene([bus], EAST), shadow, track(2, bus.centre))[1].tracked
    assert not casters(Scene([bus], EAST), shadow, track(2, other.centre))[1].tracked


@pytest.mark.parametrize(("gap_px", "touches"), [(0, True), (1, True), (2, True), (3, False)])
def test_a_metre_may_lie_between_a_bus_and_its_shadow(gap_px: int, touches: bool) -> None:
    changes = np.zeros((8, 89, 89), np.float32)  # 0.5 m a pixel
    changes[:, 42:47, 40:50] = -100
    changes[:, 42:47, 40 - gap_px - 24 : 40 - gap_px] = 80
    found = find_caster(changes, 150.0, np.array(EAST), np.array(EAST), 0.5)
    assert (found is not None) == touches


def test_a_track_that_is_too_short_to_be_judged_stays() -> None:
    bus = body((30.0, 60.0), 9.0)
    assert casters(Scene([bus], EAST), track(1, of_shadow(bus, EAST), range(6))) == {}
    slow = body((30.0, 60.0), 1.0)
    assert casters(Scene([slow], EAST), track(1, of_shadow(slow, EAST))) == {}


def black_car(start: tuple[float, float] = (30.0, 60.0), speed: float = 9.0) -> Body:
    return body(start, speed, size=(4.5, 1.8), grey=BLACK, shadow_m=1.5)


@pytest.mark.parametrize("sun", [EAST, SOUTH, SOUTH_WEST])
def test_a_black_car_alone_is_a_car(sun: tuple[float, float]) -> None:
    car = black_car()
    assert casters(Scene([car], sun), track(1, lambda t: car.centre(t) + np.array(sun) * 0.5)) == {}


@pytest.mark.parametrize(("start", "speed"), [((22.0, 57.0), 13.0), ((38.0, 57.0), 6.0)])
def test_a_black_car_beside_a_white_van_for_part_of_the_way_is_a_car(start: tuple[float, float], speed: float) -> None:
    car, van = black_car(), body(start, speed, size=(6.0, 2.1), shadow_m=2.0)
    assert casters(Scene([car, van], SOUTH), track(1, lambda t: car.centre(t) + np.array([0.0, 0.4]))) == {}


@pytest.mark.parametrize("behind_m", [-8.5, 8.5])
def test_a_black_car_that_keeps_its_distance_to_a_white_van_is_a_car(behind_m: float) -> None:
    car, van = black_car(), body((30.0 - behind_m, 60.0), 9.0, size=(6.0, 2.1), shadow_m=1.0)
    assert casters(Scene([car, van], EAST), track(1, car.centre)) == {}


def test_a_black_car_with_a_white_caravan_away_from_the_sun_is_a_car() -> None:
    car, caravan = black_car(), body((24.5, 60.0), 9.0, size=(5.0, 2.1), shadow_m=2.0)
    assert casters(Scene([car, caravan], (-1.0, 0.0)), track(1, car.centre)) == {}


def test_a_black_car_whose_boot_shines_is_a_car() -> None:
    car = black_car()
    boot = body((30.0 - 2.25 - 0.6, 60.0), 9.0, size=(1.2, 1.8), shadow_m=0.0)
    assert casters(Scene([car, boot], EAST), track(1, car.centre)) == {}


def test_what_is_much_shorter_than_a_lorry_beside_it_is_not_its_shadow() -> None:
    car, lorry = black_car(), body((30.0, 60.0 - 0.9 - 0.9 - 1.25), 9.0, shadow_m=0.0)
    assert casters(Scene([car, lorry], SOUTH), track(1, car.centre)) == {}


@pytest.mark.parametrize("gap_m", [0.2, 1.5])
def test_a_black_car_beside_a_white_building_is_a_car(gap_m: float) -> None:
    car, edge = black_car(), 60.0 - 0.9 - gap_m

    def wall(begin: float, end: float) -> FloatArray:
        return np.array([[begin, edge - 2.5], [end, edge - 2.5], [end, edge], [begin, edge]])

    assert casters(Scene([car], SOUTH, [wall(5.0, 110.0)]), track(1, car.centre)) == {}
    assert casters(Scene([car], SOUTH, [wall(32.7, 68.7)]), track(1, car.centre)) == {}  # beside it most of the way
    assert (
        casters(Scene([car], SOUTH, [wall(x, x + 6) for x in np.arange(5.0, 100.0, 9.0)]), track(1, car.centre)) == {}
    )


def chips(rng: np.random.Generator, bright: float, shade: tuple[int, int] | None, n: int = 4) -> np.ndarray:
    """(n, 32, 32) uint8 of a vehicle, 16 by 8, with a shadow (dx, dy) px."""
    image = np.full((32, 32), ASPHALT)
    for dx, dy, grey in ([(*shade, ASPHALT * SHADOW_LIGHT)] if shade else []) + [(0, 0, bright)]:
        image[12 + dy : 20 + dy, 8 + dx : 24 + dx] = grey
    return np.clip(image + rng.normal(0, 4, (n, 32, 32)), 0, 255).astype(np.uint8)


def sunlit(shades: Sequence[tuple[int, int] | None], bright: float = WHITE) -> FloatArray | None:
    rng = np.random.default_rng(1)
    moments = np.stack([shade_moments(chips(rng, bright, shade)).sum(axis=0) for shade in shades])
    strips = np.full((len(shades), 32, 10), ASPHALT)
    strips[:, 12:20, 3:7] = bright
    return shadow_direction(moments, np.full(len(shades), 4), strips)


def test_the_vehicles_agree_on_the_direction_of_shadows() -> None:
    found = sunlit([(6, 2), (6, 2), (5, 3), None] * 4)
    assert found is not None
    assert np.degrees(np.arctan2(found[1], found[0])) == pytest.approx(24, abs=12)


def test_without_shadows_or_where_they_disagree_no_direction_is_known() -> None:
    assert sunlit([None] * 20) is None
    assert sunlit([(6, 0), (-6, 0), (0, 6), (0, -6)] * 5) is None
    assert sunlit([(6, 2)] * 5) is None, "too few"
    assert sunlit([(6, 2)] * 20, bright=BLACK) is None, "of a black vehicle they are not told apart"
    assert shadow_direction(np.empty((0, 3)), np.empty(0, np.int64), np.empty((0, 32, 10))) is None
    assert shade_moments(np.empty((0, 32, 32), np.uint8)).shape == (0, 3)


def test_what_is_black_with_something_bright_beside_it_may_be_a_shadow() -> None:
    strips = np.full((4, 32, 10), ASPHALT)
    strips[:3, 13:19, 3:7] = BLACK
    strips[0, 19:, 3:8] = WHITE
    strips[1, :, 8] = 200.0  # a lane line, half a pixel wide
    strips[3, 13:19, 3:7] = 90.0  # dark, not black
    strips[3, 19:, 3:8] = WHITE
    assert may_be_shadows(strips).tolist() == [True, False, False, False]
    assert may_be_shadows(np.empty((0, 32, 10))).tolist() == []


def test_a_track_goes_straight_on_or_turns() -> None:
    angle = np.linspace(0, np.pi / 2, 15)
    bend = pd.DataFrame({"frame": range(15), "x_px": 80 * np.sin(angle), "y_px": 80 * (1 - np.cos(angle))})
    assert keeps_direction(track(1, lambda t: np.array([9.0, 1.0]) * t), PIXEL_M)
    assert not keeps_direction(bend, PIXEL_M)
    assert not keeps_direction(bend.assign(x_px=1.0, y_px=1.0), PIXEL_M)
