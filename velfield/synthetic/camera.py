"""The simulated camera, exact in both directions: raw pixel -> ground by lens, rolling shutter, pose and relief, and
back.

Axes: x right, y down (as the base image), z into the ground, all in base pixels; height above the ground is -z. A raw
pixel's row determines its exposure time, and thereby its pose and its vibration:

    raw -> undistort (Harris, closed form) -> minus shake(t) -> ray of the pose(t) -> intersection with the ground

No step is approximated, so these transforms are the ground truth of registration.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from schemas.arrays import FloatArray
from schemas.simulation import CameraSimulation, SimulationConfig
from velfield.compiled import kernel
from velfield.errors import InputError
from velfield.synthetic.city.relief import Relief, ground_height, ground_height_at

ROW_FIELDS = 14
"""Columns of a row table: rotation camera -> base (9, row-major), camera position (3), shake (2)."""

_BISECTIONS = 50

MAX_FIXED_POINT_ITERATIONS = 60
"""Iterations of the search for the row that images a point; each at least halves the error, see ``to_raw``."""


@dataclass(frozen=True)
class Waves:
    """A smooth function of time: a sum of sines for each channel.

    ``amplitude``, ``omega_rad_per_s``, ``phase_rad``: (channels, waves).
    """

    amplitude: FloatArray
    omega_rad_per_s: FloatArray
    phase_rad: FloatArray

    def __call__(self, time_s: FloatArray) -> FloatArray:
        """Values (channels, n) at times (n,)."""
        angle = self.omega_rad_per_s[:, :, None] * time_s[None, None, :] + self.phase_rad[:, :, None]
        value: FloatArray = (self.amplitude[:, :, None] * np.sin(angle)).sum(axis=1)
        return value


def motion_waves(amplitudes: FloatArray, *, period_s: float, rng: np.random.Generator) -> Waves:
    """Slow waves, three a channel, of periods about ``period_s``, whose sums never exceed ``amplitudes``."""
    channels = len(amplitudes)
    weight = rng.dirichlet(np.full(3, 2.0), size=channels)
    omega = 2 * np.pi / (period_s * rng.uniform(0.6, 2.0, size=(channels, 3)))
    return Waves(amplitudes[:, None] * weight, omega, rng.uniform(0, 2 * np.pi, size=(channels, 3)))


def shake_waves(camera: CameraSimulation, rng: np.random.Generator) -> Waves:
    """Vibration in x and y: one sine if ``vibration_cycles`` is given, otherwise three within the band."""
    phase = rng.uniform(0, 2 * np.pi, size=(2, 3))
    if camera.vibration_cycles is not None:
        omega = np.full((2, 1), 2 * np.pi * camera.vibration_cycles / max(camera.readout_s, 1e-9))
        return Waves(np.full((2, 1), camera.vibration_px), omega, phase[:, :1])
    weight = rng.dirichlet(np.full(3, 2.0), size=2)
    omega = 2 * np.pi * rng.uniform(camera.vibration_low_hz, camera.vibration_high_hz, size=(2, 3))
    return Waves(camera.vibration_px * weight, omega, phase)


@dataclass(frozen=True)
class Camera:
    """The camera of one flight."""

    width: int
    height: int
    """Frame size, px."""
    focal_px: float
    """Focal length, px."""
    lens_a: float
    lens_x_px: float
    lens_y_px: float
    """Harris' distortion and its centre; radius in half-diagonals."""
    position_px: FloatArray
    """(3,) mean position of the camera, base px; z negative (above the ground)."""
    heading_rad: float
    """Mean rotation about the vertical, from +x towards +y."""
    motion: Waves
    """Waves of x, y, z (base px), rotation about z, tilt about x, tilt about y (rad)."""
    shake: Waves
    """Waves of the image's vibration in x and y, undistorted px."""
    readout_s: float
    """Time from the first row to the last."""
    times_s: FloatArray
    """(frames,) exposure time of each frame's first row."""
    relief: Relief
    """Height of the ground."""
    mean_tilt_rad: float = 0.0
    """Mean tilt from the vertical, about x."""
    lens_terms: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(terms,) coefficients of the polynomial model in place of ``lens_a``; none: Harris' model."""

    @property
    def half_diagonal_px(self) -> float:
        """Unit of the lens's radius, px."""
        return float(np.hypot(self.width, self.height) / 2)

    def row_time_s(self, frame: int, rows: FloatArray) -> FloatArray:
        """Exposure times of rows (n,), s; also of fractional ones and beyond the frame."""
        return np.asarray(self.times_s[frame] + self.readout_s * rows / max(self.height - 1, 1))

    def row_table(self, frame: int, rows: FloatArray) -> FloatArray:
        """Pose and shake at rows (n,): (n, ROW_FIELDS)."""
        time_s = self.row_time_s(frame, rows)
        dx, dy, dz, yaw, tilt_x, tilt_y = self.motion(time_s)
        table = np.empty((len(rows), ROW_FIELDS))
        table[:, :9] = _rotation(self.heading_rad + yaw, tilt_x + self.mean_tilt_rad, tilt_y).reshape(-1, 9)
        table[:, 9:12] = self.position_px + np.stack([dx, dy, dz], axis=1)
        table[:, 12:14] = self.shake(time_s).T
        return table

    def undistort(self, xy: FloatArray) -> FloatArray:
        """Raw pixels (n, 2) -> undistorted pixels (n, 2); NaN where the lens model has none."""
        if len(self.lens_terms):
            return _polynomial(xy, (self.lens_x_px, self.lens_y_px), self.lens_terms, self.half_diagonal_px)
        return _radial(xy, (self.lens_x_px, self.lens_y_px), -self.lens_a, self.half_diagonal_px)

    def distort(self, xy: FloatArray) -> FloatArray:
        """Undistorted pixels (n, 2) -> raw pixels (n, 2); NaN where the lens model has none."""
        if len(self.lens_terms):
            return _inverse_polynomial(xy, (self.lens_x_px, self.lens_y_px), self.lens_terms, self.half_diagonal_px)
        return _radial(xy, (self.lens_x_px, self.lens_y_px), self.lens_a, self.half_diagonal_px)

    @property
    def lens_array(self) -> FloatArray:
        """The lens for the renderer: Harris' a, the centre, the half-diagonal, then the terms of the polynomial."""
        return np.array([self.lens_a, self.lens_x_px, self.lens_y_px, self.half_diagonal_px, *self.lens_terms])

    def to_base(self, frame: int, xy_raw: FloatArray) -> FloatArray:
        """Raw pixels (n, 2) of a frame -> the ground that they show, base pixels (n, 2)."""
        xy_raw = np.asarray(xy_raw, dtype=np.float64).reshape(-1, 2)
        table = self.row_table(frame, xy_raw[:, 1])
        rays = self.undistort(xy_raw)
        return np.asarray(_intersect_ground(rays, table, self.pinhole, self.relief.grid, self.relief.frame))

    def to_raw(self, frame: int, xy_base: FloatArray, *, above_px: float | FloatArray = 0.0) -> FloatArray:
        """Base pixels (n, 2) -> raw pixels (n, 2) of a frame, also beyond its border; NaN where there are none.

        ``above_px`` is the height of the points above the ground. The pose depends on the row that images a point, and
        that on the pose: a fixed-point iteration, which converges since vibration moves by less than a row a row.
        """
        xy_base = np.asarray(xy_base, dtype=np.float64).reshape(-1, 2)
        height = self.relief_at(xy_base) + above_px
        points = np.column_stack([xy_base, -height])
        rows = np.full(len(points), self.height / 2)
        xy = np.full((len(points), 2), np.nan)
        for _ in range(MAX_FIXED_POINT_ITERATIONS):
            xy = self.distort(_project(points, self.row_table(frame, rows), self.pinhole))
            step = np.nan_to_num(xy[:, 1] - rows)
            rows = rows + step
            if len(step) == 0 or np.abs(step).max() < 1e-9:
                break
        return xy

    def relief_at(self, xy_base: FloatArray) -> FloatArray:
        """Height of the ground at base pixels (n, 2), base px."""
        height: FloatArray = ground_height(
            np.ascontiguousarray(xy_base[:, 0]),
            np.ascontiguousarray(xy_base[:, 1]),
            self.relief.grid,
            self.relief.frame,
        )
        return height

    @property
    def pinhole(self) -> FloatArray:
        """Focal length and principal point x, y, px."""
        return np.array([self.focal_px, (self.width - 1) / 2, (self.height - 1) / 2])


def make_camera(config: SimulationConfig, times_s: FloatArray, relief: Relief, rng: np.random.Generator) -> Camera:
    """The camera of a configuration, its mean position above base pixel (0, 0)."""
    c = config.camera
    focal = c.focal_widths * config.width
    _check_lens(config)
    height_px = focal / c.scale
    drift = c.drift_m / config.gsd_m
    amplitudes = np.array(
        [
            drift,
            drift,
            c.climb_share * height_px,
            np.radians(c.turn_deg),
            np.radians(c.tilt_deg),
            np.radians(c.tilt_deg),
        ]
    )
    return Camera(
        width=config.width,
        height=config.height,
        focal_px=focal,
        lens_a=c.lens_a,
        lens_x_px=(config.width - 1) / 2 + c.lens_offset_x_px,
        lens_y_px=(config.height - 1) / 2 + c.lens_offset_y_px,
        position_px=_position(c, height_px),
        heading_rad=float(np.radians(c.heading_deg)),
        motion=motion_waves(amplitudes, period_s=c.motion_period_s, rng=rng),
        shake=shake_waves(c, rng),
        readout_s=c.readout_s,
        times_s=times_s,
        relief=relief,
        mean_tilt_rad=float(np.radians(c.mean_tilt_deg)),
        lens_terms=np.array(c.lens_terms, dtype=np.float64),
    )


def fold_radius(terms: Sequence[float] | FloatArray) -> float:
    """Raw radius, half-diagonals, beyond which a polynomial lens no longer maps outwards; infinity within two of them.

    Independent of `velfield.camera`, as all of the truth: it judges that.
    """
    radius = np.linspace(0.0, 2.0, 2001)
    growing = np.diff(radius * _radial_scale(radius**2, terms)) > 0
    return float("inf") if growing.all() else float(radius[np.argmin(growing)])


def _radial_scale(radius2: FloatArray, terms: Sequence[float] | FloatArray) -> FloatArray:
    """1 + k_1 r^2 + k_2 r^4 + ..."""
    return 1.0 + sum((k * radius2 ** (n + 1) for n, k in enumerate(terms)), start=np.zeros_like(radius2))


def _polynomial(xy: FloatArray, centre: tuple[float, float], terms: FloatArray, unit: float) -> FloatArray:
    offset = np.asarray(xy, dtype=np.float64) - centre
    return np.asarray(offset * _radial_scale((offset**2).sum(axis=1) / unit**2, terms)[:, None] + centre)


def _inverse_polynomial(xy: FloatArray, centre: tuple[float, float], terms: FloatArray, unit: float) -> FloatArray:
    """By bisection up to the radius where the model folds, or twice the half-diagonal; NaN beyond."""
    offset = np.asarray(xy, dtype=np.float64) - centre
    radius = np.hypot(*offset.T) / unit
    last = min(fold_radius(terms), 2.0)
    low, high = np.zeros_like(radius), np.full_like(radius, last)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        outside = middle * _radial_scale(middle**2, terms) > radius
        low, high = np.where(outside, low, middle), np.where(outside, middle, high)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(radius > 0, low / radius, 1.0)
    beyond = ~(radius < last * float(_radial_scale(np.array([last**2]), terms)[0]))
    return np.asarray(np.where(beyond[:, None], np.nan, offset * scale[:, None]) + centre)


def _check_lens(config: SimulationConfig) -> None:
    """Refuse a polynomial that folds within the frame: no raw pixel may be beyond."""
    c = config.camera
    reach = 1.0 + np.hypot(c.lens_offset_x_px, c.lens_offset_y_px) / (0.5 * np.hypot(config.width, config.height))
    folds = fold_radius(c.lens_terms)
    if folds <= reach:
        raise InputError(
            f"camera.lens_terms {list(c.lens_terms)}: found a lens that folds at {folds:.2f} half-diagonals from its "
            f"centre, expected one that reaches the corners at {reach:.2f}; take smaller terms"
        )


def _position(c: CameraSimulation, height_px: float) -> FloatArray:
    """Where the camera is: its axis meets the ground at base pixel (0, 0)."""
    axis = _rotation(np.radians([c.heading_deg]), np.radians([c.mean_tilt_deg]), np.zeros(1))[0] @ (0.0, 0.0, 1.0)
    return (
        np.append(-height_px * axis[:2] / axis[2], -height_px) if c.mean_tilt_deg else np.array([0.0, 0.0, -height_px])
    )


def _rotation(yaw: FloatArray, tilt_x: FloatArray, tilt_y: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) camera -> base: tilt about x, then about y, then yaw about z."""
    zero, one = np.zeros_like(yaw), np.ones_like(yaw)
    c, s = np.cos(yaw), np.sin(yaw)
    about_z = np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]])
    c, s = np.cos(tilt_y), np.sin(tilt_y)
    about_y = np.array([[c, zero, s], [zero, one, zero], [-s, zero, c]])
    c, s = np.cos(tilt_x), np.sin(tilt_x)
    about_x = np.array([[one, zero, zero], [zero, c, -s], [zero, s, c]])
    product: FloatArray = np.einsum("abn,bcn,cdn->nad", about_z, about_y, about_x)
    return product


def _radial(xy: FloatArray, centre: tuple[float, float], a: float, unit: float) -> FloatArray:
    """Harris' radial distortion: r -> r / sqrt(1 + a r^2); its inverse is the same with -a."""
    offset = np.asarray(xy, dtype=np.float64) - centre
    under_root = 1 + a * (offset**2).sum(axis=1) / unit**2
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(under_root > 0, 1 / np.sqrt(under_root), np.nan)
    return np.asarray(offset * scale[:, None] + centre)


@kernel
def _intersect_ground(
    undistorted: FloatArray, table: FloatArray, pinhole: FloatArray, relief: FloatArray, relief_frame: FloatArray
) -> FloatArray:
    out = np.empty((len(undistorted), 2))
    for i in range(len(undistorted)):
        r = table[i]
        u = undistorted[i, 0] - r[12] - pinhole[1]
        v = undistorted[i, 1] - r[13] - pinhole[2]
        dx = r[0] * u + r[1] * v + r[2] * pinhole[0]
        dy = r[3] * u + r[4] * v + r[5] * pinhole[0]
        dz = r[6] * u + r[7] * v + r[8] * pinhole[0]
        slope_x, slope_y = dx / dz, dy / dz
        x0, y0 = r[9] - r[11] * slope_x, r[10] - r[11] * slope_y
        x, y = x0, y0
        # the relief is smooth: each iteration gains three digits
        for _ in range(8):
            z = -ground_height_at(x, y, relief, relief_frame)
            x, y = x0 + z * slope_x, y0 + z * slope_y
        out[i, 0], out[i, 1] = x, y
    return out


def _project(points: FloatArray, table: FloatArray, pinhole: FloatArray) -> FloatArray:
    """Points (n, 3), each by its own pose -> undistorted pixels (n, 2), shake included; NaN behind the camera."""
    ray = np.einsum("nij,ni->nj", table[:, :9].reshape(-1, 3, 3), points - table[:, 9:12])
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(ray[:, 2] > 0, pinhole[0] / ray[:, 2], np.nan)
    return np.asarray(ray[:, :2] * scale[:, None] + pinhole[1:] + table[:, 12:14])
