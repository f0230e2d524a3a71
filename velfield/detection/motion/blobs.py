"""Blobs of what moved: connected regions of the difference picture, with their size and axis."""

from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray

_SHARE_OF_MAXIMUM = 0.25
_NOISE_SIGMAS = 4.0  # of what already lies outside the range of the background
_MIN_STEP_GREY = 8.0
_MIN_AREA_PX = 8


@dataclass(frozen=True)
class Blobs:
    """Regions of one frame, one value a region.

    Attributes
    ----------
    x, y : float64 (n,)
        Mean of the region, working px.
    cxx, cxy, cyy : float64 (n,)
        Covariance of the region's pixels, px^2.
    area : float64 (n,)
        Pixels.
    contrast : float64 (n,)
        Mean difference to the background, grey levels; positive: brighter.
    """

    x: FloatArray
    y: FloatArray
    cxx: FloatArray
    cxy: FloatArray
    cyy: FloatArray
    area: FloatArray
    contrast: FloatArray

    def __len__(self) -> int:
        return len(self.x)

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> "Blobs":
        """The chosen regions."""
        return Blobs(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def choose(self, where: NDArray[np.bool_], other: "Blobs") -> "Blobs":
        """The other set's regions where told, these elsewhere."""
        names = [field.name for field in fields(self)]
        return Blobs(*(np.where(where, getattr(other, name), getattr(self, name)) for name in names))

    @property
    def axis_rad(self) -> FloatArray:
        """Long axis, axial, from +x towards +y, [0, pi)."""
        return np.mod(0.5 * np.arctan2(2 * self.cxy, self.cxx - self.cyy), np.pi)

    @property
    def length(self) -> FloatArray:
        """Length of the rectangle that has the region's covariance, px."""
        return self._side(+1.0)

    @property
    def width(self) -> FloatArray:
        """Width of the rectangle that has the region's covariance, px."""
        return self._side(-1.0)

    def _side(self, sign: float) -> FloatArray:
        spread = np.hypot(self.cxx - self.cyy, 2 * self.cxy)
        return np.sqrt(np.maximum(6 * (self.cxx + self.cyy + sign * spread), 0))

    def extent_along(self, angle_rad: FloatArray) -> FloatArray:
        """Side of the rectangle of the region's covariance along a direction, px."""
        c, s = np.cos(angle_rad), np.sin(angle_rad)
        return np.sqrt(np.maximum(12 * (c * c * self.cxx + 2 * c * s * self.cxy + s * s * self.cyy), 0))


@dataclass(frozen=True)
class Pixels:
    """The pixels of a frame's regions: whole pixel places, and each one's region.

    Attributes
    ----------
    x, y : float64 (m,)
        Working px.
    region : int64 (m,)
        Index into the frame's `Blobs`.
    """

    x: FloatArray
    y: FloatArray
    region: NDArray[np.int64]


def motion_masks(
    signed: NDArray[np.float32], *, noise: float, car_length_px: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels that are brighter, and those that are darker: beyond the noise, and not the skirt of something stronger.

    Parameters
    ----------
    signed : float32 (h, w)
        From `signed_motion`, grey levels.
    noise : float
        Standard deviation of frame minus background, grey levels.
    car_length_px : float
        A car's usual length, working px: the reach of the local maximum.
    """
    size = np.abs(signed)
    reach = 2 * max(1, round(0.5 * car_length_px)) + 1
    maximum = cv2.dilate(size, np.ones((reach, reach), np.uint8))
    step = max(_NOISE_SIGMAS * noise, _MIN_STEP_GREY)
    moved = (size > step) & (size > _SHARE_OF_MAXIMUM * maximum)
    return np.asarray(moved & (signed > 0), np.bool_), np.asarray(moved & (signed < 0), np.bool_)


def find_blobs(signed: NDArray[np.float32], *, noise: float, car_length_px: float) -> tuple[Blobs, Pixels]:
    """Bright and dark regions of one frame's difference to the background.

    Parameters
    ----------
    signed : float32 (h, w)
        From `signed_motion`, grey levels.
    noise : float
        Standard deviation of frame minus background, grey levels.
    car_length_px : float
        A car's usual length, working px.
    """
    bright, dark = motion_masks(signed, noise=noise, car_length_px=car_length_px)
    (light, light_px), (black, black_px) = _regions(bright, signed), _regions(dark, signed)
    names = [field.name for field in fields(Blobs)]
    blobs = Blobs(*(np.concatenate([getattr(light, name), getattr(black, name)]) for name in names))
    x, y = np.concatenate([light_px.x, black_px.x]), np.concatenate([light_px.y, black_px.y])
    return blobs, Pixels(x, y, np.concatenate([light_px.region, black_px.region + len(light)]))


def merged(blobs: Blobs, group: NDArray[np.int64], count: int) -> Blobs:
    """One region for each group, of the members' pixels together.

    Parameters
    ----------
    blobs : Blobs
    group : int64 (n,)
        The group of each region, 0 .. count - 1; -1: in none.
    count : int
        Number of groups; one without members has area 0.
    """
    members = blobs.take(group >= 0)
    which = group[group >= 0]

    def total(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(which, weights=values, minlength=count), np.float64)

    area = total(members.area)
    divisor = np.maximum(area, 1)
    x, y = total(members.area * members.x) / divisor, total(members.area * members.y) / divisor
    dx, dy = members.x - x[which], members.y - y[which]
    cxx = total(members.area * (members.cxx + dx * dx)) / divisor
    cxy = total(members.area * (members.cxy + dx * dy)) / divisor
    cyy = total(members.area * (members.cyy + dy * dy)) / divisor
    return Blobs(x, y, cxx, cxy, cyy, area, total(members.area * members.contrast) / divisor)


def _regions(mask: NDArray[np.bool_], signed: NDArray[np.float32]) -> tuple[Blobs, Pixels]:
    """Connected regions (8 neighbours) of a mask, with their moments."""
    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8)
    ys, xs = np.nonzero(mask)
    which = labels[ys, xs]
    area = np.bincount(which, minlength=count).astype(np.float64)
    divisor = np.maximum(area, 1)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(which, weights=values, minlength=count) / divisor)

    x, y = mean(xs.astype(np.float64)), mean(ys.astype(np.float64))
    dx, dy = xs - x[which], ys - y[which]
    contrast = mean(signed[ys, xs].astype(np.float64))
    # A pixel is a square, not a point: its own covariance is 1/12.
    blobs = Blobs(x, y, mean(dx * dx) + 1 / 12, mean(dx * dy), mean(dy * dy) + 1 / 12, area, contrast)
    kept = area >= _MIN_AREA_PX
    kept_pixel = kept[which]
    number = np.cumsum(kept) - 1
    places = xs[kept_pixel].astype(np.float64), ys[kept_pixel].astype(np.float64)
    return blobs.take(kept), Pixels(*places, number[which[kept_pixel]])
