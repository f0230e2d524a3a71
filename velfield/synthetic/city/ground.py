"""The ground as a mosaic: surfaces, markings, texture and shadows, in the tones of two sensors.

Everything is painted in four channels: the camera's tone, the other sensor's tone, the contrast of fine grain, the
contrast of patches. Texture and shadows are applied at the end.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import ByteArray, Float32Array, FloatArray, GreyImage
from velfield.compiled import kernel
from velfield.synthetic.render import MOSAIC_SCALE, REACH_CELL, SHADOW_LIGHT

Tone = tuple[int, int, int, int]

NOON = 1.22
"""Grey level of sunlit ground per grey level of its tone."""

ASPHALT: Tone = (96, 112, 60, 50)
OLD_ASPHALT: Tone = (116, 124, 80, 80)
PAVEMENT: Tone = (150, 150, 60, 50)
GRASS: Tone = (94, 84, 90, 150)
MARKING: Tone = (188, 178, 60, 30)
KERB: Tone = (168, 168, 40, 30)
GRAVEL: Tone = (138, 128, 150, 90)
SOIL: Tone = (112, 124, 130, 90)


def lighten(tone: Tone, change: float) -> Tone:
    """A tone lighter (or darker) by ``change`` grey levels for both sensors."""
    first, second = (int(np.clip(t + change, 8, 245)) for t in tone[:2])
    return (first, second, tone[2], tone[3])


class Canvas:
    """Drawing in metres on a mosaic of four channels and a height map."""

    def __init__(self, size: tuple[int, int], *, origin_m: tuple[float, float], pixel_m: float) -> None:
        self.paint = np.empty((size[1], size[0], 4), dtype=np.uint8)
        self.paint[:] = GRASS
        self.height_m = np.zeros((-(-size[1] // MOSAIC_SCALE), -(-size[0] // MOSAIC_SCALE)), dtype=np.float32)
        self.origin_m, self.pixel_m = np.array(origin_m), pixel_m

    def _to_fixed_point(self, points_m: FloatArray, pixel_m: float) -> NDArray[np.int32]:
        sixteenths = (np.asarray(points_m, dtype=np.float64) - self.origin_m) / pixel_m * 16
        return np.asarray(np.rint(sixteenths), dtype=np.int32)

    def polygon(self, points_m: FloatArray, tone: Tone) -> None:
        """Fill a polygon (n, 2) m."""
        cv2.fillPoly(self.paint, [self._to_fixed_point(points_m, self.pixel_m)], tone, cv2.LINE_AA, 4)

    def rect(self, x0: float, y0: float, x1: float, y1: float, tone: Tone) -> None:
        """Fill an axis-aligned rectangle, m."""
        self.polygon(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), tone)

    def stroke(self, points_m: FloatArray, width_m: float, tone: Tone) -> None:
        """Draw a line of a width, m, round at its corners."""
        thickness = max(round(width_m / self.pixel_m), 1)
        points = [self._to_fixed_point(points_m, self.pixel_m)]
        cv2.polylines(self.paint, points, False, tone, thickness, cv2.LINE_AA, 4)

    def dashes(self, start: FloatArray, end: FloatArray, width_m: float, tone: Tone, on_m: float, off_m: float) -> None:
        """Draw a dashed straight line with square ends, m."""
        start, along = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64) - start
        length = float(np.hypot(*along))
        u = along / max(length, 1e-9)
        side = np.array([-u[1], u[0]]) * width_m / 2
        for s in np.arange(0.0, length, on_m + off_m):
            a, b = start + s * u, start + min(s + on_m, length) * u
            self.polygon(np.array([a + side, b + side, b - side, a - side]), tone)

    def circle(self, x: float, y: float, radius_m: float, tone: Tone) -> None:
        """Fill a circle, m."""
        centre = self._to_fixed_point(np.array([x, y]), self.pixel_m).tolist()
        cv2.circle(self.paint, centre, round(radius_m / self.pixel_m * 16), tone, -1, cv2.LINE_AA, 4)

    def raise_disc(self, x: float, y: float, radius_m: float, height_m: float) -> None:
        """Raise a disc to at least a height, m."""
        pixel = self.pixel_m * MOSAIC_SCALE
        cx, cy = (np.array([x, y]) - self.origin_m) / pixel
        r = radius_m / pixel
        i0, i1 = max(int(cy - r), 0), min(int(cy + r) + 2, self.height_m.shape[0])
        j0, j1 = max(int(cx - r), 0), min(int(cx + r) + 2, self.height_m.shape[1])
        if i0 < i1 and j0 < j1:
            i, j = np.ogrid[i0:i1, j0:j1]
            window = self.height_m[i0:i1, j0:j1]
            np.maximum(window, np.where((i - cy) ** 2 + (j - cx) ** 2 <= r * r, np.float32(height_m), 0), out=window)

    def raise_polygon(self, points_m: FloatArray, height_m: float) -> None:
        """Set the height of a polygon (n, 2), m."""
        mask = self._to_fixed_point(points_m, self.pixel_m * MOSAIC_SCALE)
        cv2.fillPoly(self.height_m, [mask], float(height_m), cv2.LINE_8, 4)


def add_texture(
    paint: ByteArray, *, strength: float, vegetation_shift: float, rng: np.random.Generator
) -> tuple[GreyImage, GreyImage]:
    """Tones of the two sensors: paint plus grain and patches with each surface's contrast (in strips, to save memory).

    ``vegetation_shift``: grey levels by which vegetation, known by its patches, is lighter for the other sensor.
    """
    h, w = paint.shape[:2]
    coarse = [
        (rng.standard_normal((h // cell + 3, w // cell + 3)).astype(np.float32), cell, gain)
        for cell, gain in ((256, 0.5), (96, 0.5), (40, 0.5), (16, 0.45))
    ]
    fine_cells = [
        (rng.standard_normal((h // cell + 3, w // cell + 3)).astype(np.float32), cell, gain)
        for cell, gain in ((7, 0.55), (3, 0.6))
    ]
    tones = (np.empty((h, w), np.uint8), np.empty((h, w), np.uint8))
    for y0 in range(0, h, 512):
        y1 = min(y0 + 512, h)
        patches = sum(gain * _octave(noise, cell, y0, y1, w) for noise, cell, gain in coarse)
        grain = sum(gain * _octave(noise, cell, y0, y1, w) for noise, cell, gain in fine_cells)
        grain = grain + 0.5 * rng.standard_normal((y1 - y0, w), dtype=np.float32)
        strip = paint[y0:y1].astype(np.float32)
        both = strength * (grain * strip[..., 2] / 8.0 + patches * strip[..., 3] / 9.0)
        tones[0][y0:y1] = np.clip(strip[..., 0] + both, 4, 250)
        green = np.clip((strip[..., 3] - 100) / 45, 0, 1)
        tones[1][y0:y1] = np.clip(strip[..., 1] + vegetation_shift * green + 0.85 * both, 4, 250)
    return tones


def _octave(noise: Float32Array, cell: int, y0: int, y1: int, width: int) -> Float32Array:
    """Rows y0..y1 of smooth noise: ``noise`` (one value a cell) upsampled by cubic interpolation."""
    matrix = np.array([[1 / cell, 0, 0.5], [0, 1 / cell, y0 / cell + 0.5]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    out: Float32Array = cv2.warpAffine(noise, matrix, (width, y1 - y0), flags=flags, borderMode=cv2.BORDER_REFLECT)
    return out


def reach_map(height: GreyImage, lean: float, step_px: float) -> GreyImage:
    """Maximum height that a ray through a cell of REACH_CELL base px may meet; ``lean``: its largest slope, px a px."""
    h, w = height.shape
    ny, nx = -(-h // REACH_CELL), -(-w // REACH_CELL)
    padded = np.zeros((ny * REACH_CELL, nx * REACH_CELL), np.uint8)
    padded[:h, :w] = height
    cells = padded.reshape(ny, REACH_CELL, nx, REACH_CELL).max(axis=(1, 3))
    reach = np.zeros_like(cells)
    # lower heights have a shorter reach: in classes of height
    for low, high in ((0, 30), (30, 60), (60, 100), (100, 255)):
        these = np.where((cells > low) & (cells <= high), cells, 0).astype(np.uint8)
        radius = int(np.ceil((float(these.max()) * step_px * lean + 2) / REACH_CELL))
        reach = np.maximum(reach, cv2.dilate(these, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)))
    return np.asarray(reach)


def light_map(height: GreyImage, reach: GreyImage, *, step_px: float, direction: FloatArray) -> Float32Array:
    """Fraction of the light that reaches the ground (base resolution); ``direction`` (2,): shadow px a px of height."""
    sunny = np.ones(height.shape, np.float32)
    if direction.any() and height.any():
        _shadows(height, reach, step_px, direction, sunny)
        sunny = cv2.GaussianBlur(sunny, (0, 0), 0.8)
    return np.asarray(NOON * (SHADOW_LIGHT + (1 - SHADOW_LIGHT) * sunny), dtype=np.float32)


def apply_light(tone: GreyImage, light: Float32Array) -> GreyImage:
    """``tone`` multiplied by a light map."""
    enlarged = cv2.resize(light, (tone.shape[1], tone.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.multiply(tone, enlarged, dtype=cv2.CV_8U))


@kernel
def _shadows(height: ByteArray, reach: ByteArray, step: float, direction: FloatArray, light: Float32Array) -> None:
    reach_px = np.sqrt(direction[0] ** 2 + direction[1] ** 2)
    ux, uy = direction[0] / reach_px, direction[1] / reach_px
    for i in range(height.shape[0]):
        for j in range(height.shape[1]):
            top = reach[i // 16, j // 16]
            if top == 0:
                continue
            here = height[i, j] * step
            for k in range(1, int((top * step - here) * reach_px) + 1):
                a, b = int(i - k * uy + 0.5), int(j - k * ux + 0.5)
                if not (0 <= a < height.shape[0] and 0 <= b < height.shape[1]):
                    break
                if height[a, b] * step - here > k / reach_px + 1.0:
                    light[i, j] = 0.0
                    break
