"""The city of a flight: its plan, traffic and parked cars, and its orthographic images for both sensors."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from schemas.simulation import SimulationConfig
from velfield.synthetic.city.city_plan import CityPlan, make_city_plan
from velfield.synthetic.city.ground import Canvas, add_texture, apply_light, light_map, reach_map
from velfield.synthetic.city.streets import paint_city
from velfield.synthetic.other_sensor import other_sensor_image
from velfield.synthetic.random_streams import RandomStream, random_generator
from velfield.synthetic.render import MOSAIC_SCALE, SceneMaps
from velfield.synthetic.traffic.traffic import Traffic, VehicleDimensions, draw_dimensions, simulate_traffic
from velfield.synthetic.traffic.vehicles import draw_tones

WORLD_MARGIN_M = 45.0
"""Distance outside the base image at which traffic starts."""
PAD_PX = 8
"""Margin of the mosaic around the base image, base px."""
HEIGHT_STEP_M = 0.1


@dataclass(frozen=True)
class Vehicles:
    """All vehicles of a flight: the driving ones (numbered as in ``Traffic``), then the parked ones.

    ``parked_pose`` (n, 3): x, y base px and direction.
    """

    dimensions: VehicleDimensions
    tones: FloatArray
    driving: int
    parked_pose: FloatArray


class City:
    """A city under a base image of ``base_shape`` (height, width) with its origin at ``origin_m`` of the plan.

    ``lean`` is the largest slope of a camera ray, px sideways a px of height.
    """

    def __init__(
        self,
        config: SimulationConfig,
        *,
        base_shape: tuple[int, int],
        origin_m: FloatArray,
        duration_s: float,
        lean: float,
    ) -> None:
        self.config, self.base_shape = config, base_shape
        self._origin_m, self._duration_s, self._lean = origin_m, duration_s, lean
        x0, y0 = origin_m - WORLD_MARGIN_M
        x1, y1 = origin_m + np.array(base_shape[::-1]) * config.gsd_m + WORLD_MARGIN_M
        turn, cycle = config.traffic.turn_share, config.traffic.cycle_s
        self.plan: CityPlan = make_city_plan(
            (x0, y0, x1, y1), self._rng(RandomStream.PLAN), turn_share=turn, cycle_s=cycle
        )

    def _rng(self, stream: RandomStream) -> np.random.Generator:
        return random_generator(self.config.seed, stream)

    def to_px(self, xy_m: FloatArray) -> FloatArray:
        """Plan metres (n, 2) -> base pixels."""
        return np.asarray((xy_m - self._origin_m) / self.config.gsd_m)

    @cached_property
    def traffic(self) -> Traffic:
        """The trajectories of all vehicles."""
        rng = self._rng(RandomStream.TRAFFIC)
        return simulate_traffic(self.plan.road_network, self.config.traffic, duration_s=self._duration_s, rng=rng)

    @cached_property
    def vehicles(self) -> Vehicles:
        """Dimensions and tones of all vehicles."""
        parked = self._park_cars(self._rng(RandomStream.PARKED))
        driving = len(self.traffic)
        rng = self._rng(RandomStream.APPEARANCE)
        still, moving = (
            draw_dimensions(np.zeros(len(parked), bool), rng, self.config.traffic.car_length_m),
            self.traffic.dimensions,
        )
        dimensions = VehicleDimensions._make(map(np.concatenate, zip(moving, still, strict=True)))
        return Vehicles(dimensions, draw_tones(driving + len(parked), rng), driving, parked)

    @cached_property
    def sun(self) -> FloatArray:
        """Shadow vector, px a px of height (2,)."""
        return shadow_vector(self.config.scene.sun_azimuth_deg, self.config.scene.sun_length)

    @cached_property
    def light(self) -> NDArray[np.float32]:
        """Fraction of the light that reaches the ground, base resolution, PAD_PX wider than the base image."""
        height, reach = self._heights
        return light_map(height, reach, step_px=self._step_px, direction=self.sun)

    @cached_property
    def scene(self) -> SceneMaps:
        """The scene without vehicles in the camera's tones and light, blurred as by its optics."""
        camera = self.config.camera
        sigma = MOSAIC_SCALE * float(np.hypot(camera.optics_blur_px, 0.29)) / camera.scale
        mosaic = cv2.GaussianBlur(apply_light(self._tones[0], self.light), (0, 0), sigma)
        return self._with_heights(mosaic)

    def _with_heights(self, mosaic: GreyImage) -> SceneMaps:
        return SceneMaps(mosaic, *self._heights, np.array([-float(PAD_PX)] * 2), self._step_px)

    @cached_property
    def base_image(self) -> GreyImage:
        """The base image, uint8 (base_shape): orthographic, by the other sensor, without traffic."""
        c = self.config
        same = c.base.same_sensor
        rng = self._rng(RandomStream.OTHER_SENSOR)
        return other_sensor_image(
            self._with_heights(self._tones[0 if same else 1]),
            c.base,
            shape=self.base_shape,
            sun=self.sun if same else shadow_vector(c.base.sun_azimuth_deg, c.base.sun_length),
            parked=self._park_cars(rng),
            gsd_m=c.gsd_m,
            rng=rng,
        )

    def _park_cars(self, rng: np.random.Generator) -> FloatArray:
        spaces = self._painted[1]
        occupied = spaces[rng.uniform(size=len(spaces)) < self.config.scene.parked_share]
        xy = occupied[:, :2] + rng.normal(0, 0.2, (len(occupied), 2))
        direction = occupied[:, 2] + rng.normal(0, 0.03, len(occupied))
        direction = direction + np.pi * (rng.uniform(size=len(occupied)) < 0.3)
        return np.column_stack([self.to_px(xy), direction])

    @cached_property
    def _painted(self) -> tuple[Canvas, FloatArray]:
        h, w = self.base_shape
        size = ((w + 2 * PAD_PX) * MOSAIC_SCALE, (h + 2 * PAD_PX) * MOSAIC_SCALE)
        x, y = self._origin_m - PAD_PX * self.config.gsd_m
        canvas = Canvas(size, origin_m=(float(x), float(y)), pixel_m=self.config.gsd_m / MOSAIC_SCALE)
        return canvas, paint_city(canvas, self.plan, self.config.scene, self._rng(RandomStream.PAINT))

    @cached_property
    def _tones(self) -> tuple[GreyImage, GreyImage]:
        shift = self.config.base.vegetation_shift_grey
        paint, rng = self._painted[0].paint, self._rng(RandomStream.GRAIN)
        return add_texture(paint, strength=self.config.scene.texture, vegetation_shift=shift, rng=rng)

    @property
    def _step_px(self) -> float:
        return HEIGHT_STEP_M / self.config.gsd_m

    @cached_property
    def _heights(self) -> tuple[GreyImage, GreyImage]:
        """Height map in units of HEIGHT_STEP_M, and its reach map."""
        height = np.clip(np.rint(self._painted[0].height_m / HEIGHT_STEP_M), 0, 255).astype(np.uint8)
        lean = max(self._lean, self.config.scene.sun_length, self.config.base.sun_length)
        return height, reach_map(height, lean, self._step_px)


def shadow_vector(azimuth_deg: float, length: float) -> FloatArray:
    """Shadow (x, y) of a height of one."""
    return length * np.array([np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg))])
