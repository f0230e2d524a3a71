"""The renderer against its definitions: ray geometry, occlusion, shadows, antialiasing, rolling shutter, noise."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.arrays import Float32Array, FloatArray
from schemas.simulation import OtherSensorSimulation, SceneSimulation, TrafficSimulation
from velfield.synthetic.camera import Camera, Waves
from velfield.synthetic.cases import FLAT, PINHOLE, small_flight
from velfield.synthetic.city.ground import NOON, reach_map
from velfield.synthetic.city.relief import Relief, make_relief
from velfield.synthetic.flight import Flight, _motion_kernel
from velfield.synthetic.other_sensor import FAR_PX, other_sensor_image
from velfield.synthetic.render import (
    MIN_OCCLUDER_PX,
    MOSAIC_SCALE,
    SHADOW_LIGHT,
    SceneMaps,
    VehicleSprites,
    draw_vehicles,
    occluded,
    render_ground,
)

GROUND, TONE = 100.0, 200.0
NO_WAVES = Waves(np.zeros((6, 1)), np.zeros((6, 1)), np.zeros((6, 1)))
NO_SHAKE = Waves(np.zeros((2, 1)), np.zeros((2, 1)), np.zeros((2, 1)))
EMPTY = TrafficSimulation(flow_veh_per_h=0, warm_up_s=0)
CLEAN = PINHOLE.model_copy(
    update={"noise_grey": 0.0, "vignetting": 0.0, "exposure_share": 0.0, "motion_blur_px": 0.0, "drift_m": 0.0}
)
STILL = CLEAN.model_copy(update={"climb_share": 0.0, "turn_deg": 0.0, "tilt_deg": 0.0})


def camera(
    width: int = 96, height: int = 80, *, focal_px: float = 120.0, relief: Relief | None = None, **changes: object
) -> Camera:
    """A camera at (60, 50), one raw pixel a base pixel, looking down."""
    flat = Relief(np.zeros((2, 2)), np.array([0.0, 0.0, 200.0]))
    made = Camera(
        width, height, focal_px, 0.0, (width - 1) / 2, (height - 1) / 2,
        np.array([60.0, 50.0, -focal_px]), 0.0, NO_WAVES, NO_SHAKE, 0.0, np.array([0.0]), relief or flat,
    )  # fmt: skip
    return replace(made, **changes)


def render(of: Camera, scene: SceneMaps) -> tuple[Float32Array, FloatArray]:
    """The ground as the camera sees it, and the occluder mask."""
    y, x = np.mgrid[0 : of.height, 0 : of.width]
    xy = of.undistort(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)).astype(np.float32)
    out, mask = np.empty((of.height, of.width), np.float32), np.empty((of.height, of.width), np.uint8)
    table = of.row_table(0, np.arange(of.height, dtype=np.float64))
    render_ground(
        xy[:, 0].reshape(y.shape), xy[:, 1].reshape(y.shape), table, of.pinhole, of.relief.grid, of.relief.frame,
        scene.mosaic, scene.height, scene.reach, scene.origin, scene.height_step_px, out, mask,
    )  # fmt: skip
    return out, mask


def ramp(axis: int, *, height: FloatArray | None = None, step_px: float = 0.5) -> SceneMaps:
    """A scene of 128 x 128 base px whose grey is twice its own coordinate less 10: 10 to 246 between 10 and 128."""
    fine = np.arange(256) / MOSAIC_SCALE
    value = np.clip(2 * fine - 10, 0, 255)
    mosaic = (
        np.broadcast_to(np.rint(value), (256, 256))
        if axis == 0
        else np.broadcast_to(np.rint(value)[:, None], (256, 256))
    )
    tall = np.zeros((128, 128), np.uint8) if height is None else np.rint(height / step_px).astype(np.uint8)
    return SceneMaps(np.ascontiguousarray(mosaic, np.uint8), tall, reach_map(tall, 1.0, step_px), np.zeros(2), step_px)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("effect", ["pinhole", "lens", "rolling shutter", "relief", "tilt"])
def test_every_pixel_shows_the_ground_that_the_truth_says(axis: int, effect: str) -> None:
    """A coordinate image: the rendered grey is the coordinate of `Camera.to_base`."""
    wobble = Waves(np.full((2, 1), 2.0), np.full((2, 1), 300.0), np.zeros((2, 1)))
    tilt = Waves(np.array([[0], [0], [0], [0.05], [0.06], [0.04]]), np.full((6, 1), 9.0), np.full((6, 1), 1.0))
    relief = make_relief((-64, -64, 256, 256), height_px=6.0, length_px=80.0, rng=np.random.default_rng(0))
    made = {
        "pinhole": camera(),
        "lens": camera(lens_a=0.2, lens_x_px=50.0, lens_y_px=36.0),
        "rolling shutter": camera(shake=wobble, readout_s=0.1),
        "relief": camera(relief=relief),
        "tilt": camera(motion=tilt, readout_s=0.1),
    }[effect]
    out, _ = render(made, ramp(axis))
    y, x = np.mgrid[0 : made.height, 0 : made.width]
    base = made.to_base(0, np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
    expected = (2 * base[:, axis] - 10).reshape(y.shape)
    inside = (np.abs(base - 64) < 50).all(axis=1).reshape(y.shape)
    assert inside.mean() > 0.8
    assert np.abs(out - expected)[inside].max() < 1.2  # half a base pixel; the mosaic is rounded to grey levels
    assert np.abs((out - expected)[inside].mean()) < 0.1


def tower(height_px: float) -> FloatArray:
    """A tower of 12 x 12 px at (90, 50)."""
    height = np.zeros((128, 128))
    height[44:57, 84:97] = height_px
    return height


def test_a_roof_is_displaced_by_its_height_away_from_the_nadir() -> None:
    made = camera(focal_px=240.0)
    out, mask = render(made, ramp(0, height=tower(30.0)))
    roof = made.to_raw(0, np.array([[90.0, 50.0]]), above_px=30.0)[0]
    x, y = np.rint(roof).astype(int)
    assert roof[0] - made.to_raw(0, np.array([[90.0, 50.0]]))[0, 0] == pytest.approx(30 * 30 / (240 - 30), rel=0.01)
    assert out[y, x] == pytest.approx(2 * 90 - 10, abs=4)  # the roof's own grey, not the ground's behind it
    assert mask[y, x] == 1
    assert mask[y, x - 30] == 0


def test_low_objects_do_not_hide_vehicles() -> None:
    _, mask = render(camera(), ramp(0, height=tower(MIN_OCCLUDER_PX - 1)))
    assert not mask.any()


def test_ground_behind_a_tower_is_occluded_and_ground_before_it_is_not() -> None:
    scene = ramp(0, height=tower(40.0))
    eye = np.array([60.0, 50.0, 120.0])
    ground = np.array([[70.0, 50.0], [105.0, 50.0], [105.0, 80.0], [60.0, 30.0]])
    slope = (ground - eye[:2]) / eye[2]
    hidden = occluded(ground, slope, scene.height, scene.origin, scene.height_step_px)
    assert hidden.tolist() == [False, True, False, False]


def draw(
    pose: tuple[float, ...], *, shape: int = 0, sun: tuple[float, float] = (0.0, 0.0), mask: FloatArray | None = None
) -> Float32Array:
    """One vehicle of one tone on uniform ground, seen vertically; pose: x, y, direction, vx, vy, row, l, w, h, z."""
    out = np.full((64, 64), GROUND, np.float32)
    sprites = VehicleSprites(np.array([pose]), np.array([shape]), np.full((1, 5), TONE), np.array([[0, 0, 63, 63]]))
    vertical = np.array([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, -FAR_PX, 0, 0])
    occluder = np.zeros((64, 64), np.uint8) if mask is None else mask.astype(np.uint8)
    draw_vehicles(
        out, occluder, sprites, table=np.tile(vertical, (64, 1)), pinhole=np.array([FAR_PX, 0.0, 0.0]),
        lens=np.array([0.0, 0.0, 0.0, 1.0]), sun=np.array(sun),
    )  # fmt: skip
    return out


def coverage(out: Float32Array) -> tuple[FloatArray, FloatArray]:
    """Coverage of each pixel in [0, 1], and its centroid (x, y)."""
    alpha = (out.astype(np.float64) - GROUND) / (TONE - GROUND)
    y, x = np.mgrid[0:64, 0:64]
    return alpha, np.array([(alpha * x).sum(), (alpha * y).sum()]) / alpha.sum()


CAR = (32.0, 30.0, 0.0, 0.0, 0.0, 30.0, 19.0, 8.0, 6.5, 0.0)


@pytest.mark.parametrize("direction", [0.0, 0.4, np.pi / 2, 2.5])
def test_the_coverage_of_a_vehicle_is_its_area(direction: float) -> None:
    alpha, _ = coverage(draw((*CAR[:2], direction, *CAR[3:])))
    assert alpha.min() >= -1e-6
    assert alpha.max() <= 1 + 1e-6
    assert alpha.sum() == pytest.approx(19.0 * 8.0, rel=0.06)  # less its rounded corners
    partial = (alpha > 0.02) & (alpha < 0.98)
    assert partial.sum() > 20  # an antialiased outline


@pytest.mark.parametrize("dx", [0.0, 0.25, 0.5, 0.8])
def test_a_vehicle_is_at_its_sub_pixel_position(dx: float) -> None:
    _, centroid = coverage(draw((32.0 + dx, 30.0 - dx, *CAR[2:])))
    assert centroid == pytest.approx([32.0 + dx, 30.0 - dx], abs=0.1)  # samples are 0.4 px apart


@pytest.mark.parametrize("direction", [0.0, 0.6, 1.9])
def test_a_vehicle_lies_along_its_direction(direction: float) -> None:
    alpha, centroid = coverage(draw((*CAR[:2], direction, *CAR[3:])))
    y, x = np.mgrid[0:64, 0:64]
    dx, dy = x - centroid[0], y - centroid[1]
    axis = 0.5 * np.arctan2(2 * (alpha * dx * dy).sum(), (alpha * (dx**2 - dy**2)).sum())
    assert abs(np.angle(np.exp(2j * (axis - direction)))) / 2 < np.radians(1.5)


def test_a_moving_vehicle_is_sheared_by_the_rolling_shutter() -> None:
    """0.25 px a row across its axis of 8 px: rows above its own see it earlier."""
    alpha, _ = coverage(draw((32.0, 30.0, 0.0, 0.25, 0.0, *CAR[5:])))
    x = np.arange(64)
    centre = [float((alpha[row] * x).sum() / alpha[row].sum()) for row in (28, 30, 32)]
    assert np.diff(centre) == pytest.approx([0.5, 0.5], abs=0.05)
    assert centre[1] == pytest.approx(32.0, abs=0.1)


def test_a_shadow_falls_along_the_sun_vector_beside_the_vehicle() -> None:
    out = draw(CAR, sun=(0.0, 1.5))
    assert out[30, 32] == pytest.approx(TONE)
    shadow = out[30 + 7, 32]
    assert shadow == pytest.approx(GROUND * SHADOW_LIGHT, rel=0.02)
    assert out[30 - 8, 32] == GROUND
    end = 30 + 4 + 1.5 * 6.5
    assert out[int(end) + 3, 32] == GROUND


def test_vehicles_are_not_drawn_over_occluders() -> None:
    mask = np.zeros((64, 64))
    mask[:, 32:] = 1
    out = draw(CAR, mask=mask)
    assert (out[:, 32:] == GROUND).all()
    assert (out[:, :32] > GROUND).any()


def test_kinds_of_vehicle_have_their_own_outlines() -> None:
    areas = [coverage(draw(CAR, shape=shape))[0].sum() for shape in range(4)]
    assert areas[2] < areas[3]  # a lorry has a gap behind its cab, a bus has none
    assert all(0.85 * 19 * 8 < area < 1.02 * 19 * 8 for area in areas)


def static_scene(tone: int) -> SceneMaps:
    size = 80
    return SceneMaps(
        np.full((MOSAIC_SCALE * size, MOSAIC_SCALE * size), tone, np.uint8),
        np.zeros((size, size), np.uint8),
        np.zeros((5, 5), np.uint8),
        np.array([-8.0, -8.0]),
        0.4,
    )


@pytest.mark.parametrize(("same", "noise"), [(False, 2.5), (False, 0.0), (True, 4.0)])
def test_the_other_sensor_has_its_tone_curve_and_noise(same: bool, noise: float) -> None:
    config = OtherSensorSimulation(same_sensor=same, noise_grey=noise, gamma=0.7)
    image = other_sensor_image(
        static_scene(90), config, shape=(64, 64), sun=np.zeros(2), parked=np.empty((0, 3)), gsd_m=0.23,
        rng=np.random.default_rng(0),
    )  # fmt: skip
    lit = np.rint(90 * NOON)
    assert image.mean() == pytest.approx(255 * (lit / 255) ** (1.0 if same else 0.7), abs=0.6)
    assert image.std() == pytest.approx(noise, abs=0.15 + 0.05 * noise)


def test_the_other_sensor_sees_its_own_parked_cars() -> None:
    images = [
        other_sensor_image(
            static_scene(90), OtherSensorSimulation(noise_grey=0), shape=(64, 64), sun=np.zeros(2), parked=parked,
            gsd_m=0.23, rng=np.random.default_rng(0),
        )
        for parked in (np.empty((0, 3)), np.array([[20.0, 40.0, 0.0]]))
    ]  # fmt: skip
    y, x = np.nonzero(images[0] != images[1])
    assert (x.mean(), y.mean()) == pytest.approx((20.0, 40.0), abs=1.0)
    assert np.ptp(x) == pytest.approx(4.35 / 0.23, abs=5)


def still_flight(frames: int = 2, scene: SceneSimulation = FLAT, **changes: object) -> Flight:
    return small_flight(
        frames=frames, width=160, height=120, camera=STILL.model_copy(update=changes), scene=scene, traffic=EMPTY
    )


def test_the_noise_has_its_standard_deviation_and_is_independent_between_frames() -> None:
    flight = still_flight(noise_grey=3.0)
    first, second = (flight.frame(k).astype(float) for k in range(2))
    difference = (second - first)[(first > 20) & (first < 235)]
    assert difference.std() == pytest.approx(3.0 * np.sqrt(2), rel=0.05)
    assert np.abs(difference).max() < 30
    neighbours = np.corrcoef((second - first)[:, :-1].ravel(), (second - first)[:, 1:].ravel())[0, 1]
    assert abs(neighbours) < 0.03


def test_without_noise_and_motion_all_frames_are_equal() -> None:
    flight = still_flight()
    assert np.array_equal(flight.frame(0), flight.frame(1))


def test_vignetting_darkens_the_corners_by_its_fraction() -> None:
    plain, dark = (still_flight(1, vignetting=v).frame(0).astype(float) for v in (0.0, 0.4))
    ratio = dark / np.maximum(plain, 1)
    assert np.median(ratio[55:65, 75:85]) == pytest.approx(1.0, abs=0.01)
    corners = np.concatenate([ratio[:6, :6].ravel(), ratio[-6:, -6:].ravel()])
    assert np.median(corners) == pytest.approx(0.6, abs=0.05)


def test_exposure_scales_whole_frames() -> None:
    flight, plain = still_flight(6, exposure_share=0.1), still_flight(1).frame(0).astype(float)
    bright = (plain > 40) & (plain < 180)
    ratios = [(flight.frame(k) / np.maximum(plain, 1))[bright] for k in range(6)]
    gains = np.array([np.median(r) for r in ratios])
    assert np.ptp(gains) > 0.05
    assert np.abs(gains - 1).max() <= 0.2 + 0.01
    assert max(float(np.percentile(np.abs(r - np.median(r)), 90)) for r in ratios) < 0.02


def test_parked_cars_are_drawn_and_cast_shadows_in_the_sun() -> None:
    def image(parked: float, sun: float) -> FloatArray:
        scene = FLAT.model_copy(update={"parked_share": parked, "sun_length": sun})
        made = small_flight(frames=1, width=400, height=300, camera=STILL, scene=scene, traffic=EMPTY)
        return made.frame(0).astype(np.float64)

    empty, parked, sunny = image(0.0, 0.0), image(1.0, 0.0), image(1.0, 1.0)
    cars, shadows = np.abs(parked - empty) > 8, parked - sunny > 15
    assert cars.sum() > 250
    assert shadows.sum() > 100
    assert (shadows & cars).sum() < 0.35 * shadows.sum()
    assert ((parked - sunny) > -2).mean() > 0.999  # a shadow only darkens


@pytest.mark.parametrize("angle", [0.0, 0.7, np.pi / 2])
def test_the_motion_kernel_is_normalised_and_along_its_direction(angle: float) -> None:
    kernel = _motion_kernel(1.5, angle)
    assert kernel.sum() == pytest.approx(1.0, abs=1e-5)
    y, x = np.mgrid[-3:4, -3:4]
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    assert (kernel * along**2).sum() > 5 * (kernel * across**2).sum()
    assert _motion_kernel(0.1, angle) is None
