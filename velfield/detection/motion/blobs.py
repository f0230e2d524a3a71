"""Foreground blobs: connected components of the thresholded difference image, with area, moments and contrast."""

from dataclasses import dataclass, fields

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, IntArray, Mask

_MIN_FRACTION_OF_MAXIMUM = 0.25
"""Of the largest difference within half a car's length: less is the blurred skirt of something stronger."""
_NOISE_SIGMAS = 4.0
_MIN_DIFFERENCE_GREY = 8.0
_MIN_AREA_PX = 8


@dataclass(frozen=True)
class Blobs:
    """Blobs of one frame, one value a blob.

    Attributes
    ----------
    x, y : float64 (n,)
        Centroid, working px.
    cxx, cxy, cyy : float64 (n,)
        Covariance of the pixels (second central moments), px^2.
    area : float64 (n,)
        Number of pixels.
    contrast : float64 (n,)
        Mean difference to the background, grey levels; positive where brighter.
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

    def select(self, chosen: Mask | IntArray) -> "Blobs":
        """The chosen blobs, by mask or index."""
        return Blobs(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def replace_where(self, where: Mask, other: "Blobs") -> "Blobs":
        """The other set's blobs where the mask (n,) is set, these elsewhere."""
        names = [field.name for field in fields(self)]
        return Blobs(*(np.where(where, getattr(other, name), getattr(self, name)) for name in names))

    @property
    def axis_rad(self) -> FloatArray:
        """Principal axis, axial, from +x towards +y, [0, pi)."""
        return np.mod(0.5 * np.arctan2(2 * self.cxy, self.cxx - self.cyy), np.pi)

    @property
    def length(self) -> FloatArray:
        """Length of the rectangle with the blob's covariance, px."""
        return self._side(+1.0)

    @property
    def width(self) -> FloatArray:
        """Width of the rectangle with the blob's covariance, px."""
        return self._side(-1.0)

    def _side(self, sign: float) -> FloatArray:
        spread = np.hypot(self.cxx - self.cyy, 2 * self.cxy)
        return np.sqrt(np.maximum(6 * (self.cxx + self.cyy + sign * spread), 0))

    def extent_along(self, angle_rad: FloatArray) -> FloatArray:
        """Extent along a direction (n,) of a rectangle with the blob's variance in that direction, px."""
        c, s = np.cos(angle_rad), np.sin(angle_rad)
        return np.sqrt(np.maximum(12 * (c * c * self.cxx + 2 * c * s * self.cxy + s * s * self.cyy), 0))


@dataclass(frozen=True)
class BlobPixels:
    """Pixels of a frame's blobs.

    Attributes
    ----------
    x, y : float64 (m,)
        Whole working px.
    blob : int64 (m,)
        Index into the frame's `Blobs`.
    """

    x: FloatArray
    y: FloatArray
    blob: IntArray


def foreground_masks(signed: Float32Array, *, noise: float, car_length_px: float) -> tuple[Mask, Mask]:
    """Pixels significantly brighter, and those significantly darker, than the background.

    The threshold is the larger of the noise level and a fraction of the local maximum.

    Parameters
    ----------
    signed : float32 (h, w)
        From `signed_difference`, grey levels.
    noise : float
        Standard deviation of frame minus background, grey levels.
    car_length_px : float
        A car's typical length, working px: side of the window of the local maximum.
    """
    magnitude = np.abs(signed)
    window = 2 * max(1, round(0.5 * car_length_px)) + 1
    maximum = cv2.dilate(magnitude, np.ones((window, window), np.uint8))
    threshold = max(_NOISE_SIGMAS * noise, _MIN_DIFFERENCE_GREY)
    foreground = (magnitude > threshold) & (magnitude > _MIN_FRACTION_OF_MAXIMUM * maximum)
    return np.asarray(foreground & (signed > 0), np.bool_), np.asarray(foreground & (signed < 0), np.bool_)


def extract_blobs(signed: Float32Array, *, noise: float, car_length_px: float) -> tuple[Blobs, BlobPixels]:
    """Bright and dark blobs of one frame's difference to the background.

    Parameters
    ----------
    signed : float32 (h, w)
        From `signed_difference`, grey levels.
    noise : float
        Standard deviation of frame minus background, grey levels.
    car_length_px : float
        A car's typical length, working px.
    """
    bright, dark = foreground_masks(signed, noise=noise, car_length_px=car_length_px)
    brighter, brighter_px = _connected_components(bright, signed)
    darker, darker_px = _connected_components(dark, signed)
    names = [field.name for field in fields(Blobs)]
    blobs = Blobs(*(np.concatenate([getattr(brighter, name), getattr(darker, name)]) for name in names))
    x, y = np.concatenate([brighter_px.x, darker_px.x]), np.concatenate([brighter_px.y, darker_px.y])
    return blobs, BlobPixels(x, y, np.concatenate([brighter_px.blob, darker_px.blob + len(brighter)]))


def merge_blobs(blobs: Blobs, group: IntArray, count: int) -> Blobs:
    """One blob for each group, with the moments of the members' pixels together.

    Parameters
    ----------
    blobs : Blobs
    group : int64 (n,)
        Group of each blob, 0 .. count - 1, or -1 for none.
    count : int
        Number of groups; one without members has area 0.
    """
    members = blobs.select(group >= 0)
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


def _connected_components(mask: Mask, signed: Float32Array) -> tuple[Blobs, BlobPixels]:
    """Components (8-connected) of a mask, with the moments of their pixels; small ones are dropped."""
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
    positions = xs[kept_pixel].astype(np.float64), ys[kept_pixel].astype(np.float64)
    return blobs.select(kept), BlobPixels(*positions, number[which[kept_pixel]])
