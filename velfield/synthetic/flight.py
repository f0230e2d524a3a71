"""A simulated flight in memory: city and camera from one seed, frames rendered on demand."""

from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from schemas.simulation import SimulationConfig, TimesSimulation
from velfield.synthetic.camera import Camera, make_camera
from velfield.synthetic.city.city import PAD_PX, City
from velfield.synthetic.city.city_plan import view_centre_m
from velfield.synthetic.city.relief import make_relief
from velfield.synthetic.random_streams import RandomStream, random_generator
from velfield.synthetic.render import VehicleSprites, draw_vehicles, occluded, render_ground


def frame_times(times: TimesSimulation, frames: int, rng: np.random.Generator) -> FloatArray:
    """Times of the frames from 0, s: strictly ascending, some late by half a frame or a whole one."""
    nominal = 1 / times.fps
    draw = rng.uniform(size=max(frames - 1, 0))
    step = np.full(len(draw), nominal)
    step[draw < times.late_half_share] += 0.5 * nominal
    whole = (draw >= times.late_half_share) & (draw < times.late_half_share + times.late_whole_share)
    step[whole] += nominal
    step += np.clip(rng.standard_normal(len(step)), -3, 3) * min(times.jitter_s, nominal / 8)
    return np.concatenate([[0.0], np.cumsum(step)])


class Flight:
    """A simulated flight; its parts are computed at the first access.

    Attributes
    ----------
    config : SimulationConfig
    times_s : (frames,) times of the first rows, from 0.
    camera : Camera, the exact transforms between raw and base pixels.
    base_shape : (height, width) of the base image.
    city : City, everything but the camera.
    """

    def __init__(self, config: SimulationConfig) -> None:
        self.config = config
        self.times_s = frame_times(config.times, config.frames, random_generator(config.seed, RandomStream.TIMES))
        self.camera, self.base_shape, origin_m = _position_camera(config, self.times_s)
        half = 1.3 * np.hypot(config.width, config.height) / 2
        self.city = City(
            config,
            base_shape=self.base_shape,
            origin_m=origin_m,
            duration_s=float(self.times_s[-1]) + config.camera.readout_s + 1.0,
            lean=_largest_slope(config, half / self.camera.focal_px),
        )

    @property
    def base_image(self) -> GreyImage:
        """The base image, uint8 (base_shape): orthographic, by the other sensor, without traffic."""
        return self.city.base_image

    def cars(self, frame: int) -> pd.DataFrame:
        """The vehicles of a frame, each at the exposure time of its row; see ``truth.CAR_COLUMNS``."""
        moving = self.city.traffic.present(float(self.times_s[frame]) + self.camera.readout_s / 2)
        n_parked = len(self.city.vehicles.parked_pose)
        numbers = np.concatenate([moving, self.city.vehicles.driving + np.arange(n_parked)])
        time_s = np.full(len(moving), self.times_s[frame] + self.camera.readout_s / 2)
        for _ in range(4):
            position, direction, speed = self.city.traffic.at(moving, time_s)
            raw = self.camera.to_raw(frame, self.city.to_px(position))
            rows = np.clip(np.nan_to_num(raw[:, 1]), -self.camera.height, 2 * self.camera.height)
            time_s = self.camera.row_time_s(frame, rows)
        parked = self.city.vehicles.parked_pose
        base = np.concatenate([self.city.to_px(position), parked[:, :2]])
        raw = np.concatenate([raw, self.camera.to_raw(frame, parked[:, :2])])
        direction = np.concatenate([direction, parked[:, 2]])
        speed_px = np.concatenate([speed, np.zeros(n_parked)]) / self.config.gsd_m
        direction = np.angle(np.exp(1j * direction))
        dimensions = self.city.vehicles.dimensions
        seen = ~self._is_occluded(frame, base, raw)
        inside = (raw > -0.5).all(axis=1) & (raw < [self.camera.width - 0.5, self.camera.height - 0.5]).all(axis=1)
        return pd.DataFrame(
            {
                "frame": np.int32(frame),
                "vehicle_id": numbers.astype(np.int64),
                "time_s": self.camera.row_time_s(frame, raw[:, 1]),
                "x_raw_px": raw[:, 0],
                "y_raw_px": raw[:, 1],
                "x_base_px": base[:, 0],
                "y_base_px": base[:, 1],
                "orientation_rad": np.mod(direction, np.pi),
                "direction_rad": direction,
                "vx_px_per_s": speed_px * np.cos(direction),
                "vy_px_per_s": speed_px * np.sin(direction),
                "length_px": dimensions.length_m[numbers] / self.config.gsd_m,
                "width_px": dimensions.width_m[numbers] / self.config.gsd_m,
                "moving": speed_px * self.config.gsd_m > 0.5,
                "visible": inside & seen,
            }
        )

    def _is_occluded(self, frame: int, base: FloatArray, raw: FloatArray) -> NDArray[np.bool_]:
        """Whether a building or a tree occludes the centre of a car."""
        scene = self.city.scene
        camera = self.camera.row_table(frame, np.nan_to_num(raw[:, 1]))[:, 9:12]
        slope = (base - camera[:, :2]) / -camera[:, 2:]
        return np.asarray(occluded(base, slope, scene.height, scene.origin, scene.height_step_px))

    def labels(self, frame: int) -> pd.DataFrame:
        """Boxes as an annotator would draw them: x_px, y_px, orientation_rad, length_px, width_px of all visible cars,
        raw px."""
        cars = self.cars(frame)
        cars = cars[cars["visible"]].reset_index(drop=True)
        number = cars["vehicle_id"].to_numpy()
        base = cars[["x_base_px", "y_base_px"]].to_numpy()
        middle = 0.5 * self.city.vehicles.dimensions.height_m[number] / self.config.gsd_m
        u = np.column_stack([np.cos(cars["direction_rad"]), np.sin(cars["direction_rad"])])
        side = np.column_stack([-u[:, 1], u[:, 0]])
        centre = self.camera.to_raw(frame, base, above_px=middle)
        half = 0.5 * cars["length_px"].to_numpy()[:, None] * u, 0.5 * cars["width_px"].to_numpy()[:, None] * side
        along, across = (
            self.camera.to_raw(frame, base + h, above_px=middle) - self.camera.to_raw(frame, base - h, above_px=middle)
            for h in half
        )
        table = pd.DataFrame(
            {
                "x_px": centre[:, 0],
                "y_px": centre[:, 1],
                "orientation_rad": np.mod(np.arctan2(along[:, 1], along[:, 0]), np.pi),
                "length_px": np.hypot(along[:, 0], along[:, 1]),
                "width_px": np.hypot(across[:, 0], across[:, 1]),
            }
        )
        # No annotator marks a car whose centre is outside the image; high ones lean out of it at its border.
        inside = table["x_px"].between(0, self.config.width - 1) & table["y_px"].between(0, self.config.height - 1)
        return table[inside].reset_index(drop=True)

    @cached_property
    def _undistorted(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        c = self.config
        y, x = np.mgrid[0 : c.height, 0 : c.width]
        xy = self.camera.undistort(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)).astype(np.float32)
        return xy[:, 0].reshape(y.shape), xy[:, 1].reshape(y.shape)

    @cached_property
    def _light(self) -> NDArray[np.float32]:
        c = self.config
        y, x = np.mgrid[0 : c.height, 0 : c.width].astype(np.float32)
        r2 = ((x - (c.width - 1) / 2) ** 2 + (y - (c.height - 1) / 2) ** 2) / self.camera.half_diagonal_px**2
        return np.asarray(1 - c.camera.vignetting * r2, dtype=np.float32)

    def frame(self, index: int) -> GreyImage:
        """Render a raw frame: uint8 (height, width). Frames may be rendered in any order, and from several threads."""
        c, camera, scene = self.config.camera, self.camera, self.city.scene
        rng = random_generator(self.config.seed, RandomStream.FRAME, index)
        table = camera.row_table(index, np.arange(camera.height, dtype=np.float64))
        out = np.empty((camera.height, camera.width), np.float32)
        occluder = np.empty((camera.height, camera.width), np.uint8)
        relief = camera.relief
        render_ground(
            *self._undistorted, table, camera.pinhole, relief.grid, relief.frame,
            scene.mosaic, scene.height, scene.reach, scene.origin, scene.height_step_px, out, occluder,
        )  # fmt: skip
        sprites = self._vehicle_sprites(index)
        draw_vehicles(
            out, occluder, sprites, table=table, pinhole=camera.pinhole, lens=camera.lens_array, sun=self.city.sun
        )
        out *= self._light * np.float32(1 + c.exposure_share * float(np.clip(rng.standard_normal(), -2, 2)))
        kernel = _motion_kernel(c.motion_blur_px * rng.uniform(), rng.uniform(0, np.pi))
        if kernel is not None:
            out = np.asarray(cv2.filter2D(out, -1, kernel, borderType=cv2.BORDER_REFLECT), dtype=np.float32)
        if c.noise_grey:
            out += np.float32(c.noise_grey) * rng.standard_normal(out.shape, dtype=np.float32)
        return np.clip(np.rint(out), 0, 255).astype(np.uint8)

    def prepare(self) -> None:
        """Compute what all frames share; call it before frames are rendered from several threads."""
        _ = self.city.traffic, self.city.scene, self.city.vehicles, self._undistorted, self._light

    def _vehicle_sprites(self, frame: int) -> VehicleSprites:
        cars = self.cars(frame)
        near = cars["x_raw_px"].between(-80, self.camera.width + 80) & cars["y_raw_px"].between(
            -80, self.camera.height + 80
        )
        cars = cars[near]
        number = cars["vehicle_id"].to_numpy()
        base = cars[["x_base_px", "y_base_px"]].to_numpy()
        height = self.city.vehicles.dimensions.height_m[number] / self.config.gsd_m
        row_s = self.camera.readout_s / max(self.camera.height - 1, 1)
        pose = np.column_stack(
            [
                base,
                cars["direction_rad"],
                cars[["vx_px_per_s", "vy_px_per_s"]].to_numpy() * row_s,
                cars["y_raw_px"],
                cars["length_px"],
                cars["width_px"],
                height,
                self.camera.relief_at(base),
            ]
        )
        light = self.city.light
        at = np.clip(np.rint(base).astype(int) + PAD_PX, 0, np.array(light.shape[::-1]) - 1)
        tones = self.city.vehicles.tones[number] * light[at[:, 1], at[:, 0], None]
        shape = self.city.vehicles.dimensions.shape[number]
        return VehicleSprites(pose, shape, tones, self._boxes(frame, pose, self.city.sun))

    def _boxes(self, frame: int, pose: FloatArray, sun: FloatArray) -> NDArray[np.int64]:
        """Bounding boxes of vehicles and their shadows, raw px, clipped to the frame."""
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        corners = []
        for a, b in ((0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)):
            x = pose[:, 0] + a * pose[:, 6] * c - b * pose[:, 7] * s
            y = pose[:, 1] + a * pose[:, 6] * s + b * pose[:, 7] * c
            xy = np.column_stack([x, y])
            corners += [
                self.camera.to_raw(frame, xy),
                self.camera.to_raw(frame, xy, above_px=1.02 * pose[:, 8]),
                self.camera.to_raw(frame, xy + 1.02 * pose[:, 8:9] * sun),
            ]
        raw = np.nan_to_num(np.stack(corners), nan=-1e6)
        limit = [self.camera.width - 1, self.camera.height - 1]
        low = np.clip(np.floor(raw.min(axis=0)) - 2, 0, limit)
        high = np.clip(np.ceil(raw.max(axis=0)) + 2, -1, limit)
        return np.column_stack([low, high]).astype(np.int64)


def _largest_slope(config: SimulationConfig, half: float) -> float:
    """Largest slope of a ray, px sideways a px of height; ``half``: that of the frame's corner seen straight down."""
    slope = half + np.radians(2 * config.camera.tilt_deg)
    if not config.camera.mean_tilt_deg:
        return float(slope)
    return float(np.tan(min(np.arctan(slope) + np.radians(config.camera.mean_tilt_deg), np.radians(80.0))))


def _position_camera(c: SimulationConfig, times_s: FloatArray) -> tuple[Camera, tuple[int, int], FloatArray]:
    """The camera over a base image that covers all frames with a margin, and that image's origin in the plan, m."""
    flat = make_relief(
        (0.0, 0.0, 32.0, 32.0), height_px=0.0, length_px=1.0, rng=random_generator(c.seed, RandomStream.RELIEF)
    )
    camera = make_camera(c, times_s, flat, random_generator(c.seed, RandomStream.CAMERA))
    border = _border(c.width, c.height)
    frames = np.unique(np.linspace(0, c.frames - 1, min(c.frames, 400)).astype(int))
    seen = np.concatenate([camera.to_base(int(f), border) for f in frames])
    margin = c.base.margin_px + c.scene.relief_m / c.gsd_m
    low, high = np.floor(seen.min(axis=0) - margin), np.ceil(seen.max(axis=0) + margin)
    shape = (int(high[1] - low[1]), int(high[0] - low[0]))
    relief = make_relief(
        (-64.0, -64.0, shape[1] + 64.0, shape[0] + 64.0),
        height_px=c.scene.relief_m / c.gsd_m,
        length_px=c.scene.relief_length_m / c.gsd_m,
        rng=random_generator(c.seed, RandomStream.RELIEF),
    )
    placed = replace(camera, position_px=camera.position_px - np.append(low, 0.0), relief=relief)
    return placed, shape, np.array(view_centre_m(c.width * c.gsd_m)) + low * c.gsd_m


def _border(width: int, height: int) -> FloatArray:
    x, y = np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 33)
    zero_x, zero_y = np.zeros_like(x), np.zeros_like(y)
    sides = [(x, zero_x), (x, zero_x + height - 1), (zero_y, y), (zero_y + width - 1, y)]
    return np.concatenate([np.column_stack(side) for side in sides])


def _motion_kernel(sigma: float, angle: float) -> NDArray[np.float32] | None:
    """A Gaussian along one direction (7 x 7), or None where it is negligible."""
    if sigma < 0.15:
        return None
    y, x = np.mgrid[-3:4, -3:4].astype(np.float64)
    along, across = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    kernel = np.exp(-0.5 * (along / sigma) ** 2 - 0.5 * (across / 0.25) ** 2)
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)
