"""The base image: an orthographic view of the same ground, by another sensor, on another day, without traffic."""

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from schemas.simulation import OtherSensorSimulation
from velfield.synthetic.city.ground import apply_light, light_map
from velfield.synthetic.render import MOSAIC_SCALE, SceneMaps, VehicleSprites, draw_vehicles
from velfield.synthetic.traffic.traffic import draw_dimensions
from velfield.synthetic.traffic.vehicles import draw_tones

FAR_PX = 1e8
"""Height of a camera whose rays are vertical to within rounding, base px."""


def other_sensor_image(
    static: SceneMaps,
    config: OtherSensorSimulation,
    *,
    shape: tuple[int, int],
    sun: FloatArray,
    parked: FloatArray,
    gsd_m: float,
    rng: np.random.Generator,
) -> GreyImage:
    """Image (shape) with its own illumination, blur, tone curve and noise, and cars at ``parked`` (n, 3) x, y,
    direction; the scene's mosaic is of tones, without light."""
    light = light_map(static.height, static.reach, step_px=static.height_step_px, direction=sun)
    lit = apply_light(static.mosaic, light)
    blurred = cv2.GaussianBlur(lit, (0, 0), MOSAIC_SCALE * float(np.hypot(config.blur_px, 0.29)))
    first = -int(static.origin[0]) * MOSAIC_SCALE  # the border is as wide on all sides
    last_y, last_x = (first + n * MOSAIC_SCALE for n in shape)
    tones = np.ascontiguousarray(blurred[first:last_y:MOSAIC_SCALE, first:last_x:MOSAIC_SCALE], dtype=np.float32)
    _draw_parked(tones, parked, sun=sun, gsd_m=gsd_m, rng=rng)
    curved = 255 * (tones / 255) ** np.float32(1.0 if config.same_sensor else config.gamma)
    curved += np.float32(config.noise_grey) * rng.standard_normal(tones.shape, dtype=np.float32)
    return np.clip(np.rint(curved), 0, 255).astype(np.uint8)


def _draw_parked(
    out: NDArray[np.float32], parked: FloatArray, *, sun: FloatArray, gsd_m: float, rng: np.random.Generator
) -> None:
    """Draw cars seen vertically from above."""
    h, w = out.shape
    n = len(parked)
    dimensions = draw_dimensions(np.zeros(n, bool), rng)
    sizes = np.column_stack([dimensions.length_m, dimensions.width_m, dimensions.height_m]) / gsd_m
    zero = np.zeros(n)
    pose = np.column_stack([parked, zero, zero, zero, sizes, zero])
    reach = sizes[:, :1] * (0.6 + float(np.hypot(*sun))) + 3
    limit = [w - 1, h - 1]
    box = np.column_stack([np.clip(parked[:, :2] - reach, 0, limit), np.clip(parked[:, :2] + reach, -1, limit)])
    vertical = np.array([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, -FAR_PX, 0, 0])
    draw_vehicles(
        out,
        np.zeros(out.shape, np.uint8),
        VehicleSprites(pose, dimensions.shape, draw_tones(n, rng), box.astype(np.int64)),
        table=np.tile(vertical, (h, 1)),
        pinhole=np.array([FAR_PX, 0.0, 0.0]),
        lens=np.array([0.0, 0.0, 0.0, 1.0]),
        sun=sun,
    )
