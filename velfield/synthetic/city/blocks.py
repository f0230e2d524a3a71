"""The blocks between the roads: fields, buildings with their roofs, trees."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import ByteArray, FloatArray
from schemas.simulation import SceneSimulation
from velfield.synthetic.city import city_plan as p
from velfield.synthetic.city.ground import GRASS, GRAVEL, OLD_ASPHALT, PAVEMENT, SOIL, Canvas, Tone, lighten


@dataclass
class OccupancyGrid:
    """Ground that is occupied: a raster of one metre."""

    rect: p.Rect
    occupied: ByteArray = field(init=False)

    def __post_init__(self) -> None:
        x0, y0, x1, y1 = self.rect
        self.occupied = np.zeros((int(y1 - y0) + 1, int(x1 - x0) + 1), np.uint8)

    def _cells(self, points: FloatArray) -> NDArray[np.int32]:
        return np.rint(np.asarray(points) - self.rect[:2]).astype(np.int32)

    def occupy_path(self, path: FloatArray, width_m: float) -> None:
        """Mark the strip along a path."""
        cv2.polylines(self.occupied, [self._cells(path)], False, 1, max(round(width_m), 1))

    def occupy(self, corners: FloatArray) -> None:
        """Mark a polygon."""
        cv2.fillPoly(self.occupied, [self._cells(corners)], 1)

    def is_free(self, corners: FloatArray) -> bool:
        """Whether no cell of a polygon is occupied; a polygon outside the raster is not free."""
        cells = self._cells(corners)
        low, high = cells.min(axis=0), cells.max(axis=0) + 1
        window = self.occupied[max(low[1], 0) : max(high[1], 0), max(low[0], 0) : max(high[0], 0)]
        if window.size == 0:
            return False
        mask = np.zeros_like(window)
        cv2.fillPoly(mask, [cells - np.maximum(low, 0)], 1)
        return not (mask & window).any()


def box(x0: float, y0: float, x1: float, y1: float) -> FloatArray:
    """Corners (4, 2) of an axis-aligned rectangle."""
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def rotated_box(x: float, y: float, length: float, width: float, angle: float) -> FloatArray:
    """Corners (4, 2) of a rectangle about (x, y), its length along ``angle``, rad."""
    c, s = np.cos(angle), np.sin(angle)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length / 2, width / 2]
    return np.asarray(corners @ np.array([[c, s], [-s, c]]) + [x, y])


def paint_fields(canvas: Canvas, rect: p.Rect, rng: np.random.Generator) -> None:
    """Large surfaces below everything else: lawns, gravel, yards, soil."""
    x0, y0, x1, y1 = rect
    kinds: list[Tone] = [GRASS, lighten(GRASS, 16), lighten(GRASS, -14), GRAVEL, OLD_ASPHALT, SOIL, PAVEMENT]
    for _ in range(int((x1 - x0) * (y1 - y0) / 500)):
        x, y = rng.uniform(x0 - 30, x1 + 30), rng.uniform(y0 - 30, y1 + 30)
        kind = kinds[int(rng.choice(len(kinds), p=[0.18, 0.18, 0.18, 0.12, 0.16, 0.08, 0.1]))]
        canvas.polygon(rotated_box(x, y, rng.uniform(8, 45), rng.uniform(8, 30), 0.0), lighten(kind, rng.normal(0, 8)))
    for _ in range(int((x1 - x0) * (y1 - y0) / 900)):
        x, y, angle = rng.uniform(x0, x1), rng.uniform(y0, y1), rng.uniform(0, np.pi)
        t = np.linspace(-1, 1, 9)
        bend = rng.normal(0, 6)
        along = np.column_stack([t * rng.uniform(8, 25), bend * t**2])
        c, s = np.cos(angle), np.sin(angle)
        path = along @ np.array([[c, s], [-s, c]]) + [x, y]
        canvas.stroke(path, rng.uniform(0.5, 2.0), lighten(PAVEMENT, rng.normal(0, 18)))


def place_buildings(
    canvas: Canvas, rect: p.Rect, occupancy: OccupancyGrid, scene: SceneSimulation, rng: np.random.Generator
) -> None:
    """Place buildings at random where the ground is free."""
    x0, y0, x1, y1 = rect
    for _ in range(int((x1 - x0) * (y1 - y0) / 110)):
        x, y = rng.uniform(x0 - 20, x1 + 20), rng.uniform(y0 - 20, y1 + 20)
        length, width = rng.uniform(11, 34), rng.uniform(8, 16)
        angle = float(rng.choice([0.0, np.pi / 2])) + float(rng.choice([0.0, 0.0, 0.0, rng.normal(0, 0.1)]))
        if not occupancy.is_free(rotated_box(x, y, length + 6, width + 6, angle)):
            continue
        occupancy.occupy(rotated_box(x, y, length + 2, width + 2, angle))
        height = scene.building_height_m * float(rng.choice([0.25, 0.4, 0.6, 1.0], p=[0.3, 0.35, 0.25, 0.1]))
        yard = [OLD_ASPHALT, GRAVEL, PAVEMENT, GRASS][int(rng.integers(0, 4))]
        canvas.polygon(rotated_box(x, y, length + 5, width + 5, angle), lighten(yard, rng.normal(0, 6)))
        _building(canvas, (x, y, length, width, angle), height, rng)


def _building(
    canvas: Canvas, place: tuple[float, float, float, float, float], height: float, rng: np.random.Generator
) -> None:
    """One building with a flat or gabled roof, and structures on it."""
    x, y, length, width, angle = place
    outline = rotated_box(x, y, length, width, angle)
    first = rng.uniform(60, 200)
    roof: Tone = (int(first), int(np.clip(first + rng.normal(0, 28), 45, 225)), 50, 45)
    if height > 0:
        canvas.raise_polygon(outline, height)
    c, s = np.cos(angle), np.sin(angle)

    def at(u: float, v: float) -> tuple[float, float]:
        return (float(x + c * u - s * v), float(y + s * u + c * v))

    if rng.uniform() < 0.4:
        shift = rng.uniform(14, 34) * rng.choice([-1, 1])
        canvas.polygon(outline, lighten(roof, shift / 2))
        canvas.polygon(rotated_box(*at(0, width / 4), length, width / 2, angle), lighten(roof, -shift / 2))
        for u in np.arange(-length / 2, length / 2, 0.9):
            canvas.stroke(np.array([at(u, -width / 2), at(u, width / 2)]), 0.12, lighten(roof, -12))
        canvas.stroke(np.array([at(-length / 2, 0), at(length / 2, 0)]), 0.3, lighten(roof, 26))
        return
    canvas.polygon(outline, lighten(roof, 28))
    canvas.polygon(rotated_box(x, y, length - 0.9, width - 0.9, angle), roof)
    for _ in range(int(rng.integers(3, 12))):
        u, v = rng.uniform(-0.42, 0.42) * length, rng.uniform(-0.4, 0.4) * width
        size = rng.uniform(0.6, 3.0), rng.uniform(0.6, 2.2)
        corners = rotated_box(*at(u, v), *size, angle)
        canvas.polygon(corners, lighten(roof, rng.choice([-55, -35, 35, 55])))
        if height > 0 and rng.uniform() < 0.5:
            canvas.raise_polygon(corners, height + rng.uniform(0.5, 1.5))
    for v in rng.uniform(-0.45, 0.45, int(rng.integers(0, 4))) * width:
        canvas.stroke(np.array([at(-0.46 * length, v), at(0.46 * length, v)]), 0.15, lighten(roof, rng.normal(0, 18)))


def place_trees(
    canvas: Canvas, plan: p.CityPlan, occupancy: OccupancyGrid, scene: SceneSimulation, rng: np.random.Generator
) -> None:
    """Place trees on medians, in groves and singly, where the ground is free."""
    x0, y0, x1, y1 = plan.rect
    for y in plan.avenues_y:
        for x in np.arange(x0 - 20, x1 + 20, 11.0):
            at = x + rng.normal(0, 1.5)
            crossing = any(abs(at - cx) < p.UTURN_M + 12 for cx in plan.avenues_x)
            if not crossing and rng.uniform() < 0.8:
                place_tree(canvas, at, y + rng.normal(0, 0.4), rng.uniform(1.2, 2.2), scene, rng)
    groves = rng.uniform([x0, y0], [x1, y1], (max(int((x1 - x0) * (y1 - y0) / 2500), 1), 2))
    for _ in range(int((x1 - x0) * (y1 - y0) / 90)):
        x, y = rng.uniform(x0 - 20, x1 + 20), rng.uniform(y0 - 20, y1 + 20)
        if rng.uniform() < 0.6:
            x, y = groves[int(rng.integers(len(groves)))] + rng.normal(0, 9, 2)
        radius = float(np.clip(rng.gamma(6, 0.42), 0.8, 5.0))
        if occupancy.is_free(rotated_box(x, y, 1.6 * radius, 1.6 * radius, 0.0)):
            occupancy.occupy(rotated_box(x, y, radius, radius, 0.0))
            place_tree(canvas, x, y, radius, scene, rng)


_ROW_M, _TREE_GAP_M, _NO_TREE_M = (25.0, 60.0), (7.0, 11.0), 12.0
"""Lengths of rows of street trees and of the gaps between their stems; how far they keep from an intersection."""


def place_street_trees(canvas: Canvas, plan: p.CityPlan, scene: SceneSimulation, rng: np.random.Generator) -> None:
    """Rows of trees along the kerbs of avenues and streets, their crowns over the lanes."""
    if not scene.street_tree_share:
        return
    x0, y0, x1, y1 = plan.rect
    roads = [(False, (x0, x1), y, plan.avenues_x, p.STOP_A, p.CURB_A, (3.0, 4.5)) for y in plan.avenues_y]
    roads += [(True, (y0, y1), x, plan.avenues_y, p.STOP_B, p.CURB_B, (3.5, 5.0)) for x in plan.avenues_x]
    for left, top, right, bottom in plan.streets:
        vertical = right - left < bottom - top
        along, across = ((top, bottom), (left, right)) if vertical else ((left, right), (top, bottom))
        roads.append((vertical, along, sum(across) / 2, [], 0.0, 0.0, (4.5, 6.0)))
    for vertical, along, middle, crossings, stop_m, curb_m, verge_m in roads:
        for sign in (-1, 1):
            for at in _stems(along, crossings, stop_m, scene.street_tree_share, rng):
                off = middle + sign * (curb_m + rng.uniform(*verge_m))
                place_tree(canvas, *((off, at) if vertical else (at, off)), rng.uniform(4.0, 6.0), scene, rng)


def _stems(
    span: tuple[float, float], crossings: list[float], stop_m: float, share: float, rng: np.random.Generator
) -> list[float]:
    """Positions of trees along a kerb: rows that take a share of it, none near a crossing."""
    found, at = [], span[0] - rng.uniform(0, _ROW_M[1])
    while at < span[1]:
        row = rng.uniform(*_ROW_M)
        end = at + row
        while at < end:
            if all(abs(at - crossing) > stop_m + _NO_TREE_M for crossing in crossings):
                found.append(float(at))
            at += rng.uniform(*_TREE_GAP_M)
        at += row * (1 - share) / share * rng.uniform(0.6, 1.4)
    return found


def place_tree(
    canvas: Canvas, x: float, y: float, radius: float, scene: SceneSimulation, rng: np.random.Generator
) -> None:
    """A crown of discs, lighter towards the sun and higher in the middle, at random."""
    tone = rng.normal(66, 9)
    height = scene.tree_height_m * float(np.clip(radius / 4.0, 0.25, 1.0)) * rng.uniform(0.8, 1.0)
    sun = np.radians(scene.sun_azimuth_deg + 180)
    for k in range(int(6 + 4 * radius)):
        r, t = radius * 0.72 * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        if k < 3:
            r *= 0.3
        size = radius * rng.uniform(0.22, 0.42) * (1.3 if k < 3 else 1.0)
        cx, cy = x + r * np.cos(t), y + r * np.sin(t)
        lit = 20 * r / radius * np.cos(t - sun) + rng.normal(0, 9)
        grey = int(np.clip(tone + lit, 18, 130))
        canvas.circle(cx, cy, size, (grey, int(np.clip(grey - 6 + rng.normal(0, 4), 15, 140)), 160, 145))
        if height > 0:
            canvas.raise_disc(cx, cy, size, height * (1 - 0.45 * (r / radius) ** 2))
