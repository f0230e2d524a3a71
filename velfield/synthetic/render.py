"""Rendering of raw frames by ray casting: each pixel by the pose of its own row, without intermediate resampling.

The ground is an orthographic mosaic at twice the base image's resolution, blurred as by the optics. A raw pixel's ray
is intersected with a height map (roofs, walls, crowns) and the ground, and the mosaic sampled there. Vehicles are drawn
over it by supersampling, each at its position when its row was exposed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import ByteArray, FloatArray, GreyImage, IntArray, Mask
from velfield.compiled import compiled, kernel
from velfield.synthetic.city.relief import ground_height_at
from velfield.synthetic.traffic.vehicles import LAYERS

MOSAIC_SCALE = 2
"""Mosaic pixels a base pixel."""
REACH_CELL = 16
"""Cell of the coarse map of heights that rays may meet, base px."""
SAMPLES = 4
"""Samples along each axis of a pixel of a vehicle."""
SAMPLED_SIDE_PX = 1.6
"""Side of the square that those samples cover, px: a box filter of this width is about as wide as the optics' blur."""
MIN_OCCLUDER_PX = 6.0
"""Heights above this occlude vehicles, base px."""
SHADOW_LIGHT = 0.52
"""Fraction of the light in a shadow."""


@dataclass(frozen=True)
class SceneMaps:
    """The scene without vehicles, for the renderer.

    ``mosaic`` uint8 at MOSAIC_SCALE, ``height`` uint8 (base resolution, ``height_step_px`` base px a count), ``reach``
    uint8 (cells of REACH_CELL: maximum height that a ray through the cell may meet); all start at base pixel
    ``origin``.
    """

    mosaic: GreyImage
    height: GreyImage
    reach: GreyImage
    origin: FloatArray
    height_step_px: float


@dataclass(frozen=True)
class VehicleSprites:
    """Vehicles of one frame. ``pose`` (n, 10): x, y base px at its own row, direction rad, velocity x, y in base px a
    row, that row, length, width, height base px, ground height; ``shape`` (n,); ``tones`` (n, 5); ``box`` (n, 4)
    bounding box in raw pixels x0, y0, x1, y1 (inclusive)."""

    pose: FloatArray
    shape: IntArray
    tones: FloatArray
    box: IntArray


@compiled(fastmath=True)
def render_ground(  # type: ignore[no-untyped-def]
    und_x, und_y, table, pinhole, relief, relief_frame, mosaic, height, reach, origin, step, out, occluder
) -> None:
    """Fill ``out`` (h, w) float32 with the scene without vehicles, ``occluder`` with 1 where vehicles are hidden."""
    f, cx, cy = pinhole[0], pinhole[1], pinhole[2]
    mh, mw = mosaic.shape
    for i in range(out.shape[0]):
        r0, r1, r2 = table[i, 0], table[i, 1], table[i, 2]
        r3, r4, r5 = table[i, 3], table[i, 4], table[i, 5]
        r6, r7, r8 = table[i, 6], table[i, 7], table[i, 8]
        px, py, pz = table[i, 9], table[i, 10], table[i, 11]
        z = 0.0
        for j in range(out.shape[1]):
            u = und_x[i, j] - table[i, 12] - cx
            v = und_y[i, j] - table[i, 13] - cy
            inv = 1.0 / (r6 * u + r7 * v + r8 * f)
            sx, sy = (r0 * u + r1 * v + r2 * f) * inv, (r3 * u + r4 * v + r5 * f) * inv
            x0, y0 = px - pz * sx, py - pz * sy
            # the neighbour's height is a good initial value: the relief is smooth
            for _ in range(2):
                z = -ground_height_at(x0 + z * sx, y0 + z * sy, relief, relief_frame)
            x, y = x0 + z * sx, y0 + z * sy
            ci, cj = int((y - origin[1]) / 16.0), int((x - origin[0]) / 16.0)
            occluder[i, j] = 0
            shade = 1.0
            if 0 <= ci < reach.shape[0] and 0 <= cj < reach.shape[1] and reach[ci, cj] > 0:
                x, y, above, wall = _first_hit(x, y, sx, sy, reach[ci, cj] * step, height, origin, step)
                occluder[i, j] = 1 if above > MIN_OCCLUDER_PX else 0
                if wall:
                    shade = 0.62 + 0.12 * (int(above / 7.0) & 1)
            gx, gy = (x - origin[0]) * 2.0, (y - origin[1]) * 2.0
            gx, gy = min(max(gx, 0.0), mw - 1.001), min(max(gy, 0.0), mh - 1.001)
            a, b = int(gy), int(gx)
            fy, fx = gy - a, gx - b
            top = mosaic[a, b] * (1 - fx) + mosaic[a, b + 1] * fx
            low = mosaic[a + 1, b] * (1 - fx) + mosaic[a + 1, b + 1] * fx
            out[i, j] = shade * (top * (1 - fy) + low * fy)


@compiled(fastmath=True)
def _first_hit(
    x: float, y: float, sx: float, sy: float, highest: float, height: ByteArray, origin: FloatArray, step: float
) -> tuple[float, float, float, bool]:
    """First intersection of a ray, which meets the ground at (x, y), with the height map: position, height, whether on
    a wall.

    The ray is marched down from the height ``highest`` in steps of about half a pixel sideways.
    """
    lean = np.sqrt(sx * sx + sy * sy)
    n = int(highest * lean * 1.5) + 1
    drop = highest / n
    before = 1e9
    for k in range(n + 1):
        level = highest - k * drop
        qx, qy = x - level * sx, y - level * sy
        i, j = int(qy - origin[1] + 0.5), int(qx - origin[0] + 0.5)
        if not (0 <= i < height.shape[0] and 0 <= j < height.shape[1]):
            continue
        here = height[i, j] * step
        if here >= level and here > 0.0:
            # entered from the side below the top: a wall
            return qx, qy, level, here - level > 2.5 * drop + 3.0 and before < here - 3.0
        before = here
    return x, y, 0.0, False


@compiled(fastmath=True)
def _draw_vehicles(out, occluder, pose, shape, tones, box, table, pinhole, lens, sun, layers) -> None:  # type: ignore[no-untyped-def]
    """Draw vehicles and their shadows over ``out`` (h, w) float32; ``lens``: `Camera.lens_array`.

    The transform from the image to a vehicle's axes is linear within a pixel to a good approximation: three rays a
    pixel give all samples.
    """
    step = SAMPLED_SIDE_PX / SAMPLES
    for n in range(len(pose)):
        far = 0.5 * np.hypot(pose[n, 6], pose[n, 7]) + 1.5
        lean = pose[n, 8] * np.hypot(sun[0], sun[1])
        for i in range(box[n, 1], box[n, 3] + 1):
            for j in range(box[n, 0], box[n, 2] + 1):
                if occluder[i, j] == 1:
                    continue
                a, b, sa, sb = _ray(float(j), float(i), pose[n], table, pinhole, lens)
                if np.hypot(a, b) > far + max(lean, pose[n, 8] * np.hypot(sa, sb)):
                    continue
                ra, rb, _, _ = _ray(j + step, float(i), pose[n], table, pinhole, lens)
                da, db, _, _ = _ray(float(j), i + step, pose[n], table, pinhole, lens)
                c, s = np.cos(pose[n, 2]), np.sin(pose[n, 2])
                covered, light, grey = 0, 0.0, 0.0
                for p in range(SAMPLES):
                    for q in range(SAMPLES):
                        u, v = q - 0.5 * (SAMPLES - 1), p - 0.5 * (SAMPLES - 1)
                        x, y = a + u * (ra - a) + v * (da - a), b + u * (rb - b) + v * (db - b)
                        m = _layer(x, y, sa, sb, pose[n], layers[shape[n]])
                        if m >= 0:
                            covered += 1
                            grey += tones[n, int(layers[shape[n], m, 5])]
                            continue
                        m = _layer(x, y, c * sun[0] + s * sun[1], c * sun[1] - s * sun[0], pose[n], layers[shape[n]])
                        light += SHADOW_LIGHT if m >= 0 else 1.0
                if covered > 0 or light < SAMPLES * SAMPLES:
                    out[i, j] = (grey + light * out[i, j]) / (SAMPLES * SAMPLES)


@compiled(fastmath=True)
def _ray(
    u: float, v: float, pose: FloatArray, table: FloatArray, pinhole: FloatArray, lens: FloatArray
) -> tuple[float, ...]:
    """The ray of a raw position in a vehicle's axes: its intersection with the ground along and across, and its
    slopes."""
    ox, oy = u - lens[1], v - lens[2]
    radius2 = (ox * ox + oy * oy) / (lens[3] * lens[3])
    scale = 0.0
    if len(lens) > 4:
        for i in range(len(lens) - 1, 3, -1):
            scale = (scale + lens[i]) * radius2
        scale += 1.0
    else:
        scale = 1.0 / np.sqrt(1.0 - lens[0] * radius2)
    row = min(max(v, 0.0), table.shape[0] - 1.001)
    k = int(row)
    t = row - k
    d0 = lens[1] + ox * scale - (table[k, 12] * (1 - t) + table[k + 1, 12] * t + pinhole[1])
    d1 = lens[2] + oy * scale - (table[k, 13] * (1 - t) + table[k + 1, 13] * t + pinhole[2])
    # between two rows the pose is constant to a good approximation, the vibration is not
    r = table[k]
    inv = 1.0 / (r[6] * d0 + r[7] * d1 + r[8] * pinhole[0])
    sx = (r[0] * d0 + r[1] * d1 + r[2] * pinhole[0]) * inv
    sy = (r[3] * d0 + r[4] * d1 + r[5] * pinhole[0]) * inv
    depth = -pose[9]
    x = r[9] + (depth - r[11]) * sx - (pose[0] + (v - pose[5]) * pose[3])
    y = r[10] + (depth - r[11]) * sy - (pose[1] + (v - pose[5]) * pose[4])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return c * x + s * y, c * y - s * x, c * sx + s * sy, c * sy - s * sx


@compiled(fastmath=True)
def _layer(a: float, b: float, slope_a: float, slope_b: float, pose: FloatArray, layers: FloatArray) -> int:
    """The highest layer that a ray to the ground at (a, b) intersects; -1: none."""
    for m in range(layers.shape[0]):
        z = layers[m, 0] * pose[8]
        if _inside(a - z * slope_a, b - z * slope_b, layers[m], pose[6], pose[7]):
            return m
    return -1


@compiled(fastmath=True)
def _inside(a: float, b: float, layer: FloatArray, length: float, width: float) -> bool:
    """Whether (a along, b across) is in a layer's rectangle with rounded corners."""
    middle, half = 0.5 * (layer[1] + layer[2]) * length, 0.5 * (layer[2] - layer[1]) * length
    radius = layer[4] * width
    da, db = abs(a - middle) - (half - radius), abs(b) - (layer[3] * width - radius)
    if da > radius or db > radius:
        return False
    return bool(da <= 0 or db <= 0 or da * da + db * db <= radius * radius)


@kernel
def occluded(ground: FloatArray, slope: FloatArray, height: ByteArray, origin: FloatArray, step: float) -> Mask:
    """Whether the rays of ``slope`` (n, 2) to the ground at ``ground`` (n, 2) meet an occluder."""
    out = np.zeros(len(ground), dtype=np.bool_)
    highest = height.max() * step
    for i in range(len(ground)):
        if highest > 0:
            _, _, level, _ = _first_hit(
                ground[i, 0], ground[i, 1], slope[i, 0], slope[i, 1], highest, height, origin, step
            )
            out[i] = level > MIN_OCCLUDER_PX
    return out


def draw_vehicles(
    out: NDArray[np.float32],
    occluder: GreyImage,
    vehicles: VehicleSprites,
    *,
    table: FloatArray,
    pinhole: FloatArray,
    lens: FloatArray,
    sun: FloatArray,
) -> None:
    """Draw vehicles over ``out`` in place; see ``_draw_vehicles``."""
    if len(vehicles.pose):
        _draw_vehicles(
            out,
            occluder,
            np.ascontiguousarray(vehicles.pose),
            vehicles.shape,
            vehicles.tones,
            vehicles.box,
            table,
            pinhole,
            lens,
            sun,
            LAYERS,
        )
