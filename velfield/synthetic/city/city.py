"""The city of a flight: its plan, its traffic and its parked cars, its picture from above for either sensor."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from schemas.simulation import SimulationConfig
from velfield.synthetic.city.city_plan import Plan, make_plan
from velfield.synthetic.city.ground import Canvas, light_map, reach_map, shade, texture
from velfield.synthetic.city.streets import paint_city
from velfield.synthetic.other_sensor import Standing, other_sensor_image
from velfield.synthetic.render import MOSAIC_SCALE, Scene
from velfield.synthetic.seeds import Matter, stream
from velfield.synthetic.traffic.traffic import Traffic, VehicleKinds, draw_kinds, simulate_traffic
from velfield.synthetic.traffic.vehicles import draw_tones

WORLD_MARGIN_M = 45.0
"""Traffic starts this far outside of what any frame shows."""
PAD_PX = 8
"""The mosaic reaches this far beyond the base image."""
HEIGHT_STEP_M = 0.1


@dataclass(frozen=True)
class Vehicles:
    """All vehicles of a flight: those that drive (numbered as in ``Traffic``), then those that are parked.

    ``parked_pose`` (n, 3): x, y base px and direction.
    """

    kinds: VehicleKinds
    tones: FloatArray
    driving: int
    parked_pose: FloatArray


class City:
    """A city under a base image of ``base_shape`` (height, width) that begins at ``origin_m`` of the plan.

    ``lean`` is the steepest ray that any camera sees it by, px sideways a px of height.
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
        self.plan: Plan = make_plan((x0, y0, x1, y1), self._rng(Matter.PLAN), turn_share=turn, cycle_s=cycle)

    def _rng(self, matter: Matter) -> np.random.Generator:
        return stream(self.config.seed, matter)

    def to_px(self, xy_m: FloatArray) -> FloatArray:
        """Plan metres (n, 2) -> base pixels."""
        return np.asarray((xy_m - self._origin_m) / self.config.gsd_m)

    @cached_property
    def traffic(self) -> Traffic:
        """Everybody's drive."""
        rng = self._rng(Matter.TRAFFIC)
        return simulate_traffic(self.plan.network, self.config.traffic, duration_s=self._duration_s, rng=rng)

    @cached_property
    def vehicles(self) -> Vehicles:
        """Sizes and looks of all vehicles."""
        parked = self._parked(self._rng(Matter.PARKED))
        driving = len(self.traffic)
        rng = self._rng(Matter.LOOKS)
        still, moving = draw_kinds(np.zeros(len(parked), bool), rng), self.traffic.kinds
        kinds = VehicleKinds(
            np.concatenate([moving.length_m, still.length_m]),
            np.concatenate([moving.width_m, still.width_m]),
            np.concatenate([moving.height_m, still.height_m]),
            np.concatenate([moving.shape, still.shape]),
        )
        return Vehicles(kinds, draw_tones(driving + len(parked), rng), driving, parked)

    @cached_property
    def sun(self) -> FloatArray:
        """Where shadows reach, px a px of height (2,)."""
        return sun_vector(self.config.scene.sun_azimuth_deg, self.config.scene.sun_length)

    @cached_property
    def light(self) -> NDArray[np.float32]:
        """Share of the light that reaches the ground, base resolution, PAD_PX wider than the base image."""
        height, reach = self._heights
        return light_map(height, reach, step_px=self._step_px, direction=self.sun)

    @cached_property
    def scene(self) -> Scene:
        """What stands still, in the camera's tones and light, blurred as its optics blur."""
        camera = self.config.camera
        sigma = MOSAIC_SCALE * float(np.hypot(camera.optics_blur_px, 0.29)) / camera.scale
        mosaic = cv2.GaussianBlur(shade(self._tones[0], self.light), (0, 0), sigma)
        return Scene(mosaic, *self._heights, np.array([-float(PAD_PX)] * 2), self._step_px)

    @cached_property
    def base_image(self) -> GreyImage:
        """The base image, uint8 (base_shape): orthographic, by the other sensor, without the traffic."""
        c = self.config
        same = c.base.same_sensor
        rng = self._rng(Matter.OTHER_SENSOR)
        return other_sensor_image(
            Standing(self._tones[0 if same else 1], *self._heights, self._step_px, PAD_PX),
            c.base,
            shape=self.base_shape,
            sun=self.sun if same else sun_vector(c.base.sun_azimuth_deg, c.base.sun_length),
            parked=self._parked(rng),
            gsd_m=c.gsd_m,
            rng=rng,
        )

    def _parked(self, rng: np.random.Generator) -> FloatArray:
        places = self._painted[1]
        taken = places[rng.uniform(size=len(places)) < self.config.scene.parked_share]
        xy = taken[:, :2] + rng.normal(0, 0.2, (len(taken), 2))
        turned = taken[:, 2] + rng.normal(0, 0.03, len(taken)) + np.pi * (rng.uniform(size=len(taken)) < 0.3)
        return np.column_stack([self.to_px(xy), turned])

    @cached_property
    def _painted(self) -> tuple[Canvas, FloatArray]:
        h, w = self.base_shape
        size = ((w + 2 * PAD_PX) * MOSAIC_SCALE, (h + 2 * PAD_PX) * MOSAIC_SCALE)
        x, y = self._origin_m - PAD_PX * self.config.gsd_m
        canvas = Canvas(size, origin_m=(float(x), float(y)), pixel_m=self.config.gsd_m / MOSAIC_SCALE)
        return canvas, paint_city(canvas, self.plan, self.config.scene, self._rng(Matter.PAINT))

    @cached_property
    def _tones(self) -> tuple[GreyImage, GreyImage]:
        shift = self.config.base.vegetation_shift_grey
        paint, rng = self._painted[0].paint, self._rng(Matter.GRAIN)
        return texture(paint, strength=self.config.scene.texture, vegetation_shift=shift, rng=rng)

    @property
    def _step_px(self) -> float:
        return HEIGHT_STEP_M / self.config.gsd_m

    @cached_property
    def _heights(self) -> tuple[GreyImage, GreyImage]:
        """Height map in steps of HEIGHT_STEP_M, and its reach map."""
        height = np.clip(np.rint(self._painted[0].height_m / HEIGHT_STEP_M), 0, 255).astype(np.uint8)
        lean = max(self._lean, self.config.scene.sun_length, self.config.base.sun_length)
        return height, reach_map(height, lean, self._step_px)


def sun_vector(azimuth_deg: float, length: float) -> FloatArray:
    """Shadow (x, y) of a height of one."""
    return length * np.array([np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg))])
