"""Scale, north and place of the base image from the camera's telemetry at frames that are registered to it.

For a camera that looks straight down from the height H with the focal length f in pixels, a pixel shows H / f of
the ground; tilted by t from the vertical, H / (f cos(t)^1.5) in the geometric mean of the two directions at the middle
of the frame. Errors that all frames share (barometer, compass, satellites, focal length) do not average out: they
rule the intervals.
"""

from dataclasses import dataclass

import numpy as np
from rasterio.crs import CRS
from rasterio.warp import transform

from schemas.arrays import FloatArray, Points
from schemas.scale import ScaleEstimate
from velfield.errors import Failure
from velfield.sources.geo import WGS84_A_M, WGS84_E2, utm_crs
from velfield.sources.telemetry.attitude import DIAGONAL_35MM
from velfield.sources.telemetry.telemetry import Telemetry

_PHOTO_ASPECT = 1.55
"""Up to this ratio of width to height a frame shows the whole sensor (4:3, 3:2); a wider one is cropped in height."""
_CROPPED_DIAGONAL = 1.25
"""Diagonal of a 4:3 sensor over its width; of a 3:2 sensor it is 1.2."""
_CROP_SD = 0.02
_FOCAL_SD, _CALIBRATED_FOCAL_SD, _ANGLE_OF_VIEW_SD = 0.007, 0.003, 0.01
_HEIGHT_SD = 0.007
"""A fraction of the height, beside what its source is off by in metres."""
_TILT_SD_DEG, _UNKNOWN_TILT_SD_DEG = 1.0, 4.0
MAX_TILT_DEG = 25.0
"""Tilted further, a frame has no one scale."""
_VIEW_DEG = 0.5, 140.0
"""Angles of view that cameras of drones have, of the width: telephoto lenses with zoom to action cameras."""
_COMPASS_SD_DEG = 1.5
_SATELLITES_SD_M = 2.5
_Z90 = 1.645


@dataclass(frozen=True)
class FramePoses:
    """Frames on the base image, (n,) each, and the telemetry at their times."""

    telemetry: Telemetry
    """At the frames' times."""
    width: int
    height: int
    """Of a raw frame, px."""
    centre_xy: Points
    """(n, 2) base pixels at the middle of the frame."""
    jacobian: FloatArray
    """(n, 2, 2) of raw -> base pixels there."""

    @property
    def scale(self) -> FloatArray:
        """Base pixels a raw pixel at the middle of the frame, (n,)."""
        return np.asarray(np.sqrt(np.abs(np.linalg.det(self.jacobian))))

    @property
    def rotation_rad(self) -> FloatArray:
        """Rotation of the frame in the base image, from +x towards +y, (n,)."""
        j = self.jacobian
        return np.arctan2(j[:, 1, 0] - j[:, 0, 1], j[:, 0, 0] + j[:, 1, 1])

    @property
    def tilt_deg(self) -> FloatArray:
        """Angle between the optical axis and the vertical, (n,); 0 where it is not known."""
        return np.nan_to_num(90.0 + self.telemetry.pitch_deg)

    @property
    def knows_tilt(self) -> bool:
        """Whether the telemetry has the camera's pitch."""
        return bool(np.isfinite(self.telemetry.pitch_deg).any())

    @property
    def focal_px(self) -> FloatArray:
        """Focal length, px of the raw frame, (n,); the maker's calibration before angles of view and the equivalent."""
        whole = self.width <= _PHOTO_ASPECT * self.height
        diagonal = np.hypot(self.width, self.height) if whole else _CROPPED_DIAGONAL * self.width
        equivalent = self.telemetry.focal_35mm / DIAGONAL_35MM * diagonal
        focal = np.where(np.isfinite(self.telemetry.focal_px), self.telemetry.focal_px, equivalent)
        zoomed = focal * np.where(np.isfinite(self.telemetry.zoom), np.maximum(self.telemetry.zoom, 1.0), 1.0)
        by_width = self.width / 2 / np.tan(np.radians(self.telemetry.hfov_deg / 2))
        by_height = self.height / 2 / np.tan(np.radians(self.telemetry.vfov_deg / 2))
        by_view = np.where(np.isfinite(by_width), by_width, by_height)
        found = np.where(np.isfinite(zoomed), zoomed, by_view)
        with np.errstate(invalid="ignore", divide="ignore"):
            view_deg = np.degrees(2 * np.arctan(self.width / 2 / found))
        return np.where((view_deg >= _VIEW_DEG[0]) & (view_deg <= _VIEW_DEG[1]), found, np.nan)

    @property
    def focal_sd(self) -> float:
        """Standard deviation of the focal length, as a fraction of it."""
        if np.isfinite(self.telemetry.focal_px).any():
            return _CALIBRATED_FOCAL_SD
        if not np.isfinite(self.telemetry.focal_35mm).any():
            return _ANGLE_OF_VIEW_SD
        rounding = 0.29 / float(np.nanmedian(self.telemetry.focal_35mm))
        crop = 0.0 if self.width <= _PHOTO_ASPECT * self.height else _CROP_SD
        return float(np.sqrt(_FOCAL_SD**2 + rounding**2 + crop**2))


def estimate_scale(poses: FramePoses) -> ScaleEstimate | Failure:
    """The base image's ground sample distance from height and focal length."""
    height_m, focal_px, tilt = poses.telemetry.height_m, poses.focal_px, np.abs(poses.tilt_deg)
    for values, what in ((height_m, "height above the ground"), (focal_px, "focal length")):
        if not np.isfinite(values).any():
            return Failure(f"{poses.telemetry.origin} has no {what} that can be")
    down = tilt <= MAX_TILT_DEG
    if not down.any():
        return Failure(f"the camera is tilted by {np.median(tilt):.0f}° from straight down, {MAX_TILT_DEG:g}° at most")
    with np.errstate(divide="ignore", invalid="ignore"):
        gsd_m = height_m / focal_px / np.cos(np.radians(tilt)) ** 1.5 / poses.scale
    usable = down & np.isfinite(gsd_m) & (height_m > 0)
    if not usable.any():
        return Failure(f"{poses.telemetry.origin} has no height above 0 m while the frames were taken")
    middle_m, above_m = float(np.exp(np.mean(np.log(gsd_m[usable])))), float(np.median(height_m[usable]))
    spread = float(np.std(np.log(gsd_m[usable]))) / np.sqrt(min(int(usable.sum()), 10))
    lean_deg = float(np.hypot(np.median(tilt[usable]), _TILT_SD_DEG if poses.knows_tilt else _UNKNOWN_TILT_SD_DEG))
    lean = 1.5 * np.radians(lean_deg) * np.radians(_TILT_SD_DEG if poses.knows_tilt else _UNKNOWN_TILT_SD_DEG)
    errors = (_HEIGHT_SD, poses.telemetry.height.sd_m / above_m, poses.focal_sd, spread, lean)
    factor = float(np.exp(_Z90 * np.linalg.norm(errors)))
    return ScaleEstimate(
        gsd_m=middle_m,
        low_m=middle_m / factor,
        high_m=middle_m * factor,
        source="metadata",
        note=f"{poses.telemetry.origin}: {above_m:.1f} m {poses.telemetry.height.above}, "
        f"focal length {float(np.nanmedian(focal_px)):.0f} px",
    )


@dataclass(frozen=True)
class North:
    """Direction of true north in the base image, from +x towards +y (down), and its standard deviation, deg."""

    direction_rad: float
    sd_deg: float


def estimate_north(poses: FramePoses) -> North | Failure:
    """True north in the base image by the camera's yaw."""
    yaw = np.radians(poses.telemetry.yaw_deg + np.where(np.abs(poses.telemetry.roll_deg) > 90, 180.0, 0.0))
    usable = np.isfinite(yaw) & (np.abs(poses.tilt_deg) <= 60)
    if not usable.any():
        return Failure(f"{poses.telemetry.origin} has no heading of the camera: north is not known")
    # The picture's top points where yaw says; north is that much anticlockwise of it.
    north = np.exp(1j * (-np.pi / 2 - yaw + poses.rotation_rad))[usable]
    mean = np.mean(north)
    spread_deg = np.degrees(np.sqrt(max(-2 * np.log(min(abs(mean), 1.0)), 0.0))) / np.sqrt(min(len(north), 10))
    return North(float(np.angle(mean)), float(np.hypot(_COMPASS_SD_DEG, spread_deg)))


@dataclass(frozen=True)
class Place:
    """Where the base image lies."""

    crs_wkt: str
    affine: tuple[float, float, float, float, float, float]
    """The UTM zone, and (column, row) of pixel corners to its coordinates, as `velfield.sources.geo.BaseRaster`."""
    sd_m: float
    """Standard deviation of a position in either direction, m."""


def estimate_place(poses: FramePoses, gsd_m: float, north: North) -> Place | Failure:
    """The base image's place by the camera's positions, with its scale and its north."""
    longitude, latitude = poses.telemetry.longitude_deg, poses.telemetry.latitude_deg
    usable = np.isfinite(longitude) & np.isfinite(latitude) & (np.abs(poses.tilt_deg) <= MAX_TILT_DEG)
    if not usable.any():
        return Failure(f"{poses.telemetry.origin} has no position")
    below = _below_camera(poses)[usable]
    longitude, latitude = longitude[usable], latitude[usable]
    middle = float(np.median(longitude)), float(np.median(latitude))
    crs = utm_crs(*middle)
    linear = _metres_to_crs(crs, *middle) @ north_to_metres(north.direction_rad, gsd_m)
    east, north_m = (np.asarray(values) for values in transform(CRS.from_epsg(4326), crs, longitude, latitude))
    residual = np.column_stack([east, north_m]) - below @ linear.T
    offset = np.median(residual, axis=0)
    spread_m = float(np.sqrt(np.mean((residual - offset) ** 2))) / np.sqrt(min(len(residual), 10))
    height_m = float(np.nanmedian(poses.telemetry.height_m)) if np.isfinite(poses.telemetry.height_m).any() else 0.0
    lean_m = height_m * np.radians(_TILT_SD_DEG if poses.knows_tilt else _UNKNOWN_TILT_SD_DEG)
    return Place(
        crs.to_wkt(),
        affine_of_pixels(linear, offset),
        sd_m=float(np.linalg.norm([_SATELLITES_SD_M, spread_m, lean_m])),
    )


def _below_camera(poses: FramePoses) -> Points:
    """Base pixels (n, 2) of the ground below the camera: the middle of the frame, shifted where it is tilted."""
    tilt, roll = np.radians(poses.tilt_deg), np.radians(np.nan_to_num(poses.telemetry.roll_deg))
    shift = np.column_stack([np.zeros(len(tilt)), np.tan(tilt)]) * np.nan_to_num(poses.focal_px)[:, None]
    sideways = np.where(np.abs(roll) < np.radians(MAX_TILT_DEG), np.tan(roll), 0.0) * np.nan_to_num(poses.focal_px)
    shift[:, 0] += sideways
    return np.asarray(poses.centre_xy + np.einsum("nij,nj->ni", poses.jacobian, shift))


def north_to_metres(north_rad: float, gsd_m: float) -> FloatArray:
    """The matrix (2, 2) from steps of base pixels (x, y) to metres (east, north).

    Examples
    --------
    >>> north_to_metres(-np.pi / 2, 0.5).round(6) + 0.0
    array([[ 0.5,  0. ],
           [ 0. , -0.5]])
    """
    c, s = np.cos(north_rad), np.sin(north_rad)
    return np.asarray(gsd_m * np.array([[-s, c], [c, s]]))


def _metres_to_crs(crs: CRS, longitude: float, latitude: float) -> FloatArray:
    """The matrix (2, 2) from steps of metres (east, north) to steps of a projected system's coordinates there."""
    step = 1e-4
    xs, ys = transform(
        CRS.from_epsg(4326),
        crs,
        [longitude - step, longitude + step, longitude, longitude],
        [latitude, latitude, latitude - step, latitude + step],
    )
    by_degree = np.array([[xs[1] - xs[0], xs[3] - xs[2]], [ys[1] - ys[0], ys[3] - ys[2]]]) / (2 * step)
    east_m, north_m = metres_per_degree(latitude)
    return np.asarray(by_degree / np.array([east_m, north_m]))


def metres_per_degree(latitude: float) -> tuple[float, float]:
    """Metres a degree of longitude and of latitude on the WGS 84 ellipsoid.

    Examples
    --------
    >>> [round(metres) for metres in metres_per_degree(50.0)]
    [71696, 111229]
    """
    phi = np.radians(latitude)
    flat = 1 - WGS84_E2 * np.sin(phi) ** 2
    east = np.pi / 180 * WGS84_A_M / np.sqrt(flat) * np.cos(phi)
    return float(east), float(np.pi / 180 * WGS84_A_M * (1 - WGS84_E2) / flat**1.5)


def affine_of_pixels(linear: FloatArray, offset: FloatArray) -> tuple[float, float, float, float, float, float]:
    """``linear @ xy + offset`` of base pixels as an affine of (column, row) of pixel corners."""
    (a, b), (d, e) = linear
    c, f = offset - linear @ (0.5, 0.5)
    return float(a), float(b), float(c), float(d), float(e), float(f)
