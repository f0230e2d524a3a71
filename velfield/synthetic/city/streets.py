"""Painting of the plan: roads, markings, parking, roundabouts; then the blocks between them."""

import numpy as np

from schemas.arrays import FloatArray
from schemas.simulation import SceneSimulation
from velfield.synthetic.city import city_plan as p
from velfield.synthetic.city.blocks import (
    OccupancyGrid,
    box,
    paint_fields,
    place_buildings,
    place_street_trees,
    place_tree,
    place_trees,
    rotated_box,
)
from velfield.synthetic.city.ground import ASPHALT, GRASS, KERB, MARKING, OLD_ASPHALT, PAVEMENT, Canvas, lighten
from velfield.synthetic.city.road_network import STEP_M

OVERRUN_M = 260.0
"""Length of avenues painted beyond the plan's rectangle, m."""

PATH_KINDS = ("turn", "ring", "street", "aisle")


def paint_city(canvas: Canvas, plan: p.CityPlan, scene: SceneSimulation, rng: np.random.Generator) -> FloatArray:
    """Paint the whole plan; returns the parking spaces (n, 3): x, y m and direction rad."""
    occupancy = _occupied_by_roads(plan)
    paint_fields(canvas, plan.rect, rng)
    _pavements(canvas, plan)
    _roads(canvas, plan, rng)
    spaces = [*_car_parks(canvas, plan, scene, rng), *_kerb_parking(canvas, plan, occupancy)]
    for x in plan.avenues_x:
        for y in plan.avenues_y:
            _intersection(canvas, x, y)
    _roundabouts(canvas, plan, scene, rng)
    place_buildings(canvas, plan.rect, occupancy, scene, rng)
    place_trees(canvas, plan, occupancy, scene, rng)
    place_street_trees(canvas, plan, scene, rng)  # last, so that without them all else is as it was
    return np.array(spaces, dtype=np.float64).reshape(-1, 3)


def _occupied_by_roads(plan: p.CityPlan) -> OccupancyGrid:
    x0, y0, x1, y1 = plan.rect
    occupancy = OccupancyGrid((x0 - 40, y0 - 40, x1 + 40, y1 + 40))
    for y in plan.avenues_y:
        occupancy.occupy(box(x0 - OVERRUN_M, y - p.CURB_A - 9, x1 + OVERRUN_M, y + p.CURB_A + 9))
    for x in plan.avenues_x:
        occupancy.occupy(box(x - p.CURB_B - 12, y0 - OVERRUN_M, x + p.CURB_B + 12, y1 + OVERRUN_M))
    for edge in plan.road_network.edges:
        occupancy.occupy_path(edge.path, 19)
    for x, y in plan.roundabouts:
        occupancy.occupy(box(x - 22, y - 22, x + 22, y + 22))
    for x, first in plan.car_parks:
        occupancy.occupy(box(x + 16, first - 12, x + 86, first + 28))
    return occupancy


def _pavements(canvas: Canvas, plan: p.CityPlan) -> None:
    x0, y0, x1, y1 = plan.rect
    for y in plan.avenues_y:
        for sign in (-1, 1):
            canvas.rect(x0 - OVERRUN_M, y, x1 + OVERRUN_M, y + sign * (p.CURB_A + 6.0), PAVEMENT)
            for x in np.arange(x0 - 30, x1 + 30, 3.0):
                canvas.rect(x, y, x + 0.12, y + sign * (p.CURB_A + 6.0), lighten(PAVEMENT, -16))
    for x in plan.avenues_x:
        for sign in (-1, 1):
            canvas.rect(x, y0 - OVERRUN_M, x + sign * (p.CURB_B + 8.5), y1 + OVERRUN_M, lighten(PAVEMENT, -6))
            for y in np.arange(y0 - 30, y1 + 30, 3.0):
                canvas.rect(x, y, x + sign * (p.CURB_B + 8.5), y + 0.12, lighten(PAVEMENT, -22))
    for edge in plan.road_network.edges:
        if edge.kind in ("street", "ring"):
            canvas.stroke(edge.path, 11.0, lighten(PAVEMENT, -4))


def _roads(canvas: Canvas, plan: p.CityPlan, rng: np.random.Generator) -> None:
    x0, y0, x1, y1 = plan.rect
    side, median = p.CURB_A + 2.0, p.MEDIAN_M / 2
    for y in plan.avenues_y:
        canvas.rect(x0 - OVERRUN_M, y - side - 0.25, x1 + OVERRUN_M, y + side + 0.25, KERB)
    for x in plan.avenues_x:
        canvas.rect(x - p.CURB_B - 2.25, y0 - OVERRUN_M, x + p.CURB_B + 2.25, y1 + OVERRUN_M, KERB)
    for y in plan.avenues_y:
        canvas.rect(x0 - OVERRUN_M, y - side, x1 + OVERRUN_M, y + side, ASPHALT)
        canvas.rect(x0 - OVERRUN_M, y - median + 0.3, x1 + OVERRUN_M, y + median - 0.3, KERB)
        canvas.rect(x0 - OVERRUN_M, y - median + 0.55, x1 + OVERRUN_M, y + median - 0.55, lighten(GRASS, 6))
    for edge in plan.road_network.edges:
        if edge.kind in PATH_KINDS:
            canvas.stroke(edge.path, 5.7, KERB)
    for edge in plan.road_network.edges:
        if edge.kind in PATH_KINDS:
            canvas.stroke(edge.path, 5.2, lighten(ASPHALT, 8 if edge.kind in ("street", "ring", "aisle") else 0))
    for y in plan.avenues_y:
        for sign in (-1, 1):
            canvas.rect(x0 - OVERRUN_M, y + sign * (median - 0.1), x1 + OVERRUN_M, y + sign * side, ASPHALT)
    for x in plan.avenues_x:
        canvas.rect(x - p.CURB_B - 2, y0 - OVERRUN_M, x + p.CURB_B + 2, y1 + OVERRUN_M, ASPHALT)
        for y in plan.avenues_y:
            canvas.rect(x - p.STOP_A + 1, y - side, x + p.STOP_A - 1, y + side, ASPHALT)
    _wear(canvas, plan, rng)
    _lane_lines(canvas, plan)


def _wear(canvas: Canvas, plan: p.CityPlan, rng: np.random.Generator) -> None:
    """Wear of the asphalt: oil in the middle of lanes, patches, cracks, manholes."""
    for edge in plan.road_network.edges:
        canvas.stroke(edge.path, 1.1, lighten(ASPHALT, -9 if edge.kind in ("avenue", "box") else 0))
    for edge in plan.road_network.edges:
        for _ in range(rng.poisson(edge.length_m / 9)):
            k = int(rng.integers(0, len(edge.path) - 1))
            x, y = edge.path[k] + rng.normal(0, 0.9, 2)
            d = edge.path[k + 1] - edge.path[k]
            angle = float(np.arctan2(d[1], d[0]))
            draw = rng.uniform()
            if draw < 0.5:
                corners = rotated_box(x, y, rng.uniform(0.8, 7), rng.uniform(0.5, 2.8), angle)
                canvas.polygon(corners, lighten(ASPHALT, rng.normal(0, 17)))
            elif draw < 0.65:
                canvas.circle(x, y, 0.38, lighten(ASPHALT, rng.choice([-40, 35])))
            else:
                wander = np.cumsum(rng.normal(0, 0.5, (7, 2)), axis=0) + np.linspace(0, rng.uniform(2, 9), 7)[
                    :, None
                ] * (d / STEP_M)
                canvas.stroke(wander + np.array([x, y]), 0.14, lighten(ASPHALT, -34))


def _lane_lines(canvas: Canvas, plan: p.CityPlan) -> None:
    x0, y0, x1, y1 = plan.rect
    for y in plan.avenues_y:
        for sign in (-1, 1):
            for a, b in _between(x0 - 60, x1 + 60, plan.avenues_x, p.STOP_A + 1):
                lane = y + sign * (p.MEDIAN_M / 2 + p.LANE_M)
                canvas.dashes(np.array([a, lane]), np.array([b, lane]), 0.16, MARKING, 3.0, 5.0)
                for edge in (p.MEDIAN_M / 2 + 0.2, p.CURB_A + 1.7):
                    line = np.array([[a, y + sign * edge], [b, y + sign * edge]])
                    canvas.stroke(line, 0.14, lighten(MARKING, -25))
    for x in plan.avenues_x:
        for a, b in _between(y0 - 60, y1 + 60, plan.avenues_y, p.STOP_B + 1):
            for at in (-p.LANE_M, p.LANE_M):
                canvas.dashes(np.array([x + at, a]), np.array([x + at, b]), 0.16, MARKING, 3.0, 5.0)
            for at in (-0.18, 0.18):
                canvas.stroke(np.array([[x + at, a], [x + at, b]]), 0.14, MARKING)
    for left, top, right, bottom in plan.streets:
        if right - left < bottom - top:
            middle = (left + right) / 2
            canvas.dashes(np.array([middle, top + 12]), np.array([middle, bottom - 12]), 0.14, MARKING, 2.0, 3.0)
        else:
            middle = (top + bottom) / 2
            canvas.dashes(np.array([left + 12, middle]), np.array([right - 12, middle]), 0.14, MARKING, 2.0, 3.0)


def _between(start: float, end: float, cuts: list[float], margin: float) -> list[tuple[float, float]]:
    """The parts of [start, end] that are farther than ``margin`` from each cut."""
    pieces, at = [], start
    for cut in sorted(cuts):
        pieces.append((at, cut - margin))
        at = cut + margin
    pieces.append((at, end))
    return [(a, b) for a, b in pieces if b > a]


def _intersection(canvas: Canvas, x: float, y: float) -> None:
    """Stop lines, zebra crossings and arrows of a signalised intersection."""
    for sign in (-1, 1):
        near, far = (p.MEDIAN_M / 2 + 0.3), p.CURB_A + 1.6
        # eastbound traffic stops west of it, on the south side
        canvas.rect(x - sign * (p.STOP_A + 0.1), y + sign * near, x - sign * (p.STOP_A - 0.35), y + sign * far, MARKING)
        canvas.rect(
            x - sign * 0.3,
            y - sign * (p.STOP_B + 0.1),
            x - sign * (p.CURB_B + 1.6),
            y - sign * (p.STOP_B - 0.35),
            MARKING,
        )
        for lane in (p.INNER_A, p.CURB_A):
            _arrow(canvas, x - sign * (p.STOP_A + 7), y + sign * lane, 0.0 if sign > 0 else np.pi)
        for lane in (p.INNER_B, p.CURB_B):
            _arrow(canvas, x - sign * lane, y - sign * (p.STOP_B + 7), sign * np.pi / 2)
        for k in np.arange(-p.CURB_A - 1.3, p.CURB_A + 1.3, 1.0):
            canvas.rect(
                x + sign * (p.STOP_A - 3.8), y + k, x + sign * (p.STOP_A - 1.0), y + k + 0.5, lighten(MARKING, -10)
            )
        for k in np.arange(-p.CURB_B - 1.3, p.CURB_B + 1.3, 1.0):
            canvas.rect(
                x + k, y + sign * (p.STOP_B - 3.8), x + k + 0.5, y + sign * (p.STOP_B - 1.0), lighten(MARKING, -10)
            )


def _arrow(canvas: Canvas, x: float, y: float, angle: float) -> None:
    c, s = np.cos(angle), np.sin(angle)
    shape = np.array([[-2.0, -0.1], [0.6, -0.1], [0.6, -0.45], [2.0, 0.0], [0.6, 0.45], [0.6, 0.1], [-2.0, 0.1]])
    canvas.polygon(shape @ np.array([[c, s], [-s, c]]) + [x, y], MARKING)


def _roundabouts(canvas: Canvas, plan: p.CityPlan, scene: SceneSimulation, rng: np.random.Generator) -> None:
    for x, y in plan.roundabouts:
        canvas.circle(x, y, p.RING_M - 2.4, KERB)
        canvas.circle(x, y, p.RING_M - 2.7, lighten(PAVEMENT, -20))
        canvas.circle(x, y, p.RING_M - 4.2, KERB)
        canvas.circle(x, y, p.RING_M - 4.5, lighten(GRASS, 10))
        for angle in (0.0, np.pi / 2, -np.pi / 2):
            u, v = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
            base = np.array([x, y])
            island = np.array([base + 17 * u + 1.1 * v, base + 17 * u - 1.1 * v, base + 26 * u])
            canvas.polygon(island, KERB)
            canvas.polygon(base + 19.5 * u + (island - base - 19.5 * u) * 0.72, lighten(GRASS, 0))
        for _ in range(5):
            r, t = rng.uniform(0, 6), rng.uniform(0, 2 * np.pi)
            place_tree(canvas, x + r * np.cos(t), y + r * np.sin(t), rng.uniform(0.9, 1.9), scene, rng)


def _car_parks(
    canvas: Canvas, plan: p.CityPlan, scene: SceneSimulation, rng: np.random.Generator
) -> list[tuple[float, float, float]]:
    spaces = []
    for x, first in plan.car_parks:
        canvas.rect(x + 17.5, first - 9.5, x + 84.5, first + 25.5, KERB)
        canvas.rect(x + 18, first - 9, x + 84, first + 25, OLD_ASPHALT)
        for _ in range(60):
            px, py = rng.uniform(x + 19, x + 83), rng.uniform(first - 8, first + 24)
            corners = rotated_box(px, py, rng.uniform(0.6, 6), rng.uniform(0.5, 3), 0.0)
            canvas.polygon(corners, lighten(OLD_ASPHALT, rng.normal(0, 10)))
        rows = ((-5.5, -np.pi / 2), (5.5, np.pi / 2), (10.5, -np.pi / 2), (21.5, np.pi / 2))
        for at, heading in rows:
            tip = first + at + 2.5 * np.sin(heading)
            root = first + at - 2.5 * np.sin(heading)
            for k in range(16):
                stall = x + 29 + 2.6 * k
                canvas.stroke(np.array([[stall - 1.3, tip], [stall - 1.3, root]]), 0.12, MARKING)
                if k < 15:
                    spaces.append((stall, first + at, heading))
            canvas.stroke(np.array([[x + 27.7, tip], [x + 27.7 + 2.6 * 15, tip]]), 0.12, MARKING)
        hedge = first + 8.0
        canvas.rect(x + 36, hedge - 0.35, x + 66, hedge + 0.35, lighten(GRASS, -26))
        for k in range(5):
            if scene.tree_height_m > 0:
                place_tree(canvas, x + 36 + 7 * k, hedge, rng.uniform(0.8, 1.5), scene, rng)
    return spaces


def _kerb_parking(canvas: Canvas, plan: p.CityPlan, occupancy: OccupancyGrid) -> list[tuple[float, float, float]]:
    """Parking spaces along the streets and along avenue B, beside the lanes."""
    spaces = []
    for left, top, right, bottom in plan.streets:
        vertical = right - left < bottom - top
        a, b = (top + 22, bottom - 24) if vertical else (left + 22, right - 24)
        for at in np.arange(a, b, 6.3):
            for sign in (-1, 1):
                middle = (left + right) / 2 if vertical else (top + bottom) / 2
                off = middle + sign * 5.6
                x, y = (off, at) if vertical else (at, off)
                heading = np.pi / 2 if vertical else 0.0
                canvas.polygon(rotated_box(x, y, 6.3, 2.3, heading), OLD_ASPHALT)
                canvas.polygon(rotated_box(x, y, 0.12, 2.3, heading), MARKING)
                spaces.append((x + (3.1 if not vertical else 0), y + (3.1 if vertical else 0), heading))
    for x in plan.avenues_x:
        for y0, y1 in _between(plan.rect[1], plan.rect[3], plan.avenues_y, p.STOP_B + 16):
            for sign in (-1, 1):
                off = x + sign * (p.CURB_B + 3.35)
                canvas.rect(off - 1.15, y0, off + 1.15, y1, OLD_ASPHALT)
                spaces += [
                    (off, at, np.pi / 2) for at in np.arange(y0 + 4, y1 - 4, 6.4) if not _street_mouth(plan, off, at)
                ]
    return spaces


def _street_mouth(plan: p.CityPlan, x: float, y: float) -> bool:
    return any(s[0] - 9 < x < s[2] + 9 and s[1] - 9 < y < s[3] + 9 for s in plan.streets)
