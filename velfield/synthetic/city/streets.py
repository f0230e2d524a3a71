"""Paints the plan: roads, then what lies beside them, then what stands there."""

import numpy as np

from schemas.arrays import FloatArray
from schemas.simulation import SceneSimulation
from velfield.synthetic.city import city_plan as p
from velfield.synthetic.city.blocks import Free, box, paint_fields, put_buildings, put_tree, put_trees, turned_box
from velfield.synthetic.city.ground import (
    ASPHALT,
    GRASS,
    KERB,
    MARKING,
    OLD_ASPHALT,
    PAVEMENT,
    Canvas,
    toned,
)
from velfield.synthetic.city.road_network import STEP_M

FAR = 260.0
"""Avenues are painted this far beyond the plan's rectangle, m."""

PATH_KINDS = ("turn", "ring", "street", "aisle")


def paint_city(canvas: Canvas, plan: p.Plan, scene: SceneSimulation, rng: np.random.Generator) -> FloatArray:
    """Paint all of the plan; returns the parking places (n, 3): x, y m and direction rad."""
    free = _free_ground(plan)
    paint_fields(canvas, plan.rect, rng)
    _pavements(canvas, plan)
    _roads(canvas, plan, rng)
    places = [*_car_parks(canvas, plan, scene, rng), *_kerb_parking(canvas, plan, free)]
    for crossing_x in plan.avenues_x:
        for crossing_y in plan.avenues_y:
            _crossing(canvas, crossing_x, crossing_y)
    _circles(canvas, plan, scene, rng)
    put_buildings(canvas, plan.rect, free, scene, rng)
    put_trees(canvas, plan, free, scene, rng)
    return np.array(places, dtype=np.float64).reshape(-1, 3)


def _free_ground(plan: p.Plan) -> Free:
    x0, y0, x1, y1 = plan.rect
    free = Free((x0 - 40, y0 - 40, x1 + 40, y1 + 40))
    for y in plan.avenues_y:
        free.take(box(x0 - FAR, y - p.CURB_A - 9, x1 + FAR, y + p.CURB_A + 9))
    for x in plan.avenues_x:
        free.take(box(x - p.CURB_B - 12, y0 - FAR, x + p.CURB_B + 12, y1 + FAR))
    for edge in plan.network.edges:
        free.take_path(edge.path, 19)
    for x, y in plan.circles:
        free.take(box(x - 22, y - 22, x + 22, y + 22))
    for x, first in plan.car_parks:
        free.take(box(x + 16, first - 12, x + 86, first + 28))
    return free


def _pavements(canvas: Canvas, plan: p.Plan) -> None:
    x0, y0, x1, y1 = plan.rect
    for y in plan.avenues_y:
        for sign in (-1, 1):
            canvas.rect(x0 - FAR, y, x1 + FAR, y + sign * (p.CURB_A + 6.0), PAVEMENT)
            for x in np.arange(x0 - 30, x1 + 30, 3.0):
                canvas.rect(x, y, x + 0.12, y + sign * (p.CURB_A + 6.0), toned(PAVEMENT, -16))
    for x in plan.avenues_x:
        for sign in (-1, 1):
            canvas.rect(x, y0 - FAR, x + sign * (p.CURB_B + 8.5), y1 + FAR, toned(PAVEMENT, -6))
            for y in np.arange(y0 - 30, y1 + 30, 3.0):
                canvas.rect(x, y, x + sign * (p.CURB_B + 8.5), y + 0.12, toned(PAVEMENT, -22))
    for edge in plan.network.edges:
        if edge.kind in ("street", "ring"):
            canvas.stroke(edge.path, 11.0, toned(PAVEMENT, -4))


def _roads(canvas: Canvas, plan: p.Plan, rng: np.random.Generator) -> None:
    x0, y0, x1, y1 = plan.rect
    side, median = p.CURB_A + 2.0, p.MEDIAN_M / 2
    for y in plan.avenues_y:
        canvas.rect(x0 - FAR, y - side - 0.25, x1 + FAR, y + side + 0.25, KERB)
    for x in plan.avenues_x:
        canvas.rect(x - p.CURB_B - 2.25, y0 - FAR, x + p.CURB_B + 2.25, y1 + FAR, KERB)
    for y in plan.avenues_y:
        canvas.rect(x0 - FAR, y - side, x1 + FAR, y + side, ASPHALT)
        canvas.rect(x0 - FAR, y - median + 0.3, x1 + FAR, y + median - 0.3, KERB)
        canvas.rect(x0 - FAR, y - median + 0.55, x1 + FAR, y + median - 0.55, toned(GRASS, 6))
    for edge in plan.network.edges:
        if edge.kind in PATH_KINDS:
            canvas.stroke(edge.path, 5.7, KERB)
    for edge in plan.network.edges:
        if edge.kind in PATH_KINDS:
            canvas.stroke(edge.path, 5.2, toned(ASPHALT, 8 if edge.kind in ("street", "ring", "aisle") else 0))
    for y in plan.avenues_y:
        for sign in (-1, 1):
            canvas.rect(x0 - FAR, y + sign * (median - 0.1), x1 + FAR, y + sign * side, ASPHALT)
    for x in plan.avenues_x:
        canvas.rect(x - p.CURB_B - 2, y0 - FAR, x + p.CURB_B + 2, y1 + FAR, ASPHALT)
        for y in plan.avenues_y:
            canvas.rect(x - p.STOP_A + 1, y - side, x + p.STOP_A - 1, y + side, ASPHALT)
    _wear(canvas, plan, rng)
    _lane_lines(canvas, plan)


def _wear(canvas: Canvas, plan: p.Plan, rng: np.random.Generator) -> None:
    """Oil in the middle of lanes, mended patches, seams, manholes: what makes asphalt a texture."""
    for edge in plan.network.edges:
        canvas.stroke(edge.path, 1.1, toned(ASPHALT, -9 if edge.kind in ("avenue", "box") else 0))
    for edge in plan.network.edges:
        for _ in range(rng.poisson(edge.length_m / 9)):
            k = int(rng.integers(0, len(edge.path) - 1))
            x, y = edge.path[k] + rng.normal(0, 0.9, 2)
            d = edge.path[k + 1] - edge.path[k]
            angle = float(np.arctan2(d[1], d[0]))
            pick = rng.uniform()
            if pick < 0.5:
                corners = turned_box(x, y, rng.uniform(0.8, 7), rng.uniform(0.5, 2.8), angle)
                canvas.polygon(corners, toned(ASPHALT, rng.normal(0, 17)))
            elif pick < 0.65:
                canvas.circle(x, y, 0.38, toned(ASPHALT, rng.choice([-40, 35])))
            else:
                wander = np.cumsum(rng.normal(0, 0.5, (7, 2)), axis=0) + np.linspace(0, rng.uniform(2, 9), 7)[
                    :, None
                ] * (d / STEP_M)
                canvas.stroke(wander + np.array([x, y]), 0.14, toned(ASPHALT, -34))


def _lane_lines(canvas: Canvas, plan: p.Plan) -> None:
    x0, y0, x1, y1 = plan.rect
    for y in plan.avenues_y:
        for sign in (-1, 1):
            for a, b in _between(x0 - 60, x1 + 60, plan.avenues_x, p.STOP_A + 1):
                lane = y + sign * (p.MEDIAN_M / 2 + p.LANE_M)
                canvas.dashes(np.array([a, lane]), np.array([b, lane]), 0.16, MARKING, 3.0, 5.0)
                for edge in (p.MEDIAN_M / 2 + 0.2, p.CURB_A + 1.7):
                    line = np.array([[a, y + sign * edge], [b, y + sign * edge]])
                    canvas.stroke(line, 0.14, toned(MARKING, -25))
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
    """The pieces of [start, end] that are farther than ``margin`` from each cut."""
    pieces, at = [], start
    for cut in sorted(cuts):
        pieces.append((at, cut - margin))
        at = cut + margin
    pieces.append((at, end))
    return [(a, b) for a, b in pieces if b > a]


def _crossing(canvas: Canvas, x: float, y: float) -> None:
    """Stop lines, zebras and arrows of a signalled crossing."""
    for sign in (-1, 1):
        near, far = (p.MEDIAN_M / 2 + 0.3), p.CURB_A + 1.6
        # those who come eastward stop west of it, on the south side
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
                x + sign * (p.STOP_A - 3.8), y + k, x + sign * (p.STOP_A - 1.0), y + k + 0.5, toned(MARKING, -10)
            )
        for k in np.arange(-p.CURB_B - 1.3, p.CURB_B + 1.3, 1.0):
            canvas.rect(
                x + k, y + sign * (p.STOP_B - 3.8), x + k + 0.5, y + sign * (p.STOP_B - 1.0), toned(MARKING, -10)
            )


def _arrow(canvas: Canvas, x: float, y: float, angle: float) -> None:
    c, s = np.cos(angle), np.sin(angle)
    shape = np.array([[-2.0, -0.1], [0.6, -0.1], [0.6, -0.45], [2.0, 0.0], [0.6, 0.45], [0.6, 0.1], [-2.0, 0.1]])
    canvas.polygon(shape @ np.array([[c, s], [-s, c]]) + [x, y], MARKING)


def _circles(canvas: Canvas, plan: p.Plan, scene: SceneSimulation, rng: np.random.Generator) -> None:
    for x, y in plan.circles:
        canvas.circle(x, y, p.RING_M - 2.4, KERB)
        canvas.circle(x, y, p.RING_M - 2.7, toned(PAVEMENT, -20))
        canvas.circle(x, y, p.RING_M - 4.2, KERB)
        canvas.circle(x, y, p.RING_M - 4.5, toned(GRASS, 10))
        for angle in (0.0, np.pi / 2, -np.pi / 2):
            u, v = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
            base = np.array([x, y])
            island = np.array([base + 17 * u + 1.1 * v, base + 17 * u - 1.1 * v, base + 26 * u])
            canvas.polygon(island, KERB)
            canvas.polygon(base + 19.5 * u + (island - base - 19.5 * u) * 0.72, toned(GRASS, 0))
        for _ in range(5):
            r, t = rng.uniform(0, 6), rng.uniform(0, 2 * np.pi)
            put_tree(canvas, x + r * np.cos(t), y + r * np.sin(t), rng.uniform(0.9, 1.9), scene, rng)


def _car_parks(
    canvas: Canvas, plan: p.Plan, scene: SceneSimulation, rng: np.random.Generator
) -> list[tuple[float, float, float]]:
    places = []
    for x, first in plan.car_parks:
        canvas.rect(x + 17.5, first - 9.5, x + 84.5, first + 25.5, KERB)
        canvas.rect(x + 18, first - 9, x + 84, first + 25, OLD_ASPHALT)
        for _ in range(60):
            px, py = rng.uniform(x + 19, x + 83), rng.uniform(first - 8, first + 24)
            corners = turned_box(px, py, rng.uniform(0.6, 6), rng.uniform(0.5, 3), 0.0)
            canvas.polygon(corners, toned(OLD_ASPHALT, rng.normal(0, 10)))
        rows = ((-5.5, -np.pi / 2), (5.5, np.pi / 2), (10.5, -np.pi / 2), (21.5, np.pi / 2))
        for at, heading in rows:
            tip = first + at + 2.5 * np.sin(heading)
            root = first + at - 2.5 * np.sin(heading)
            for k in range(16):
                stall = x + 29 + 2.6 * k
                canvas.stroke(np.array([[stall - 1.3, tip], [stall - 1.3, root]]), 0.12, MARKING)
                if k < 15:
                    places.append((stall, first + at, heading))
            canvas.stroke(np.array([[x + 27.7, tip], [x + 27.7 + 2.6 * 15, tip]]), 0.12, MARKING)
        hedge = first + 8.0
        canvas.rect(x + 36, hedge - 0.35, x + 66, hedge + 0.35, toned(GRASS, -26))
        for k in range(5):
            if scene.tree_height_m > 0:
                put_tree(canvas, x + 36 + 7 * k, hedge, rng.uniform(0.8, 1.5), scene, rng)
    return places


def _kerb_parking(canvas: Canvas, plan: p.Plan, free: Free) -> list[tuple[float, float, float]]:
    """Places along the streets and along avenue B, outside of the lanes."""
    places = []
    for left, top, right, bottom in plan.streets:
        upright = right - left < bottom - top
        a, b = (top + 22, bottom - 24) if upright else (left + 22, right - 24)
        for at in np.arange(a, b, 6.3):
            for sign in (-1, 1):
                middle = (left + right) / 2 if upright else (top + bottom) / 2
                off = middle + sign * 5.6
                x, y = (off, at) if upright else (at, off)
                heading = np.pi / 2 if upright else 0.0
                canvas.polygon(turned_box(x, y, 6.3, 2.3, heading), OLD_ASPHALT)
                canvas.polygon(turned_box(x, y, 0.12, 2.3, heading), MARKING)
                places.append((x + (3.1 if not upright else 0), y + (3.1 if upright else 0), heading))
    for x in plan.avenues_x:
        for y0, y1 in _between(plan.rect[1], plan.rect[3], plan.avenues_y, p.STOP_B + 16):
            for sign in (-1, 1):
                off = x + sign * (p.CURB_B + 3.35)
                canvas.rect(off - 1.15, y0, off + 1.15, y1, OLD_ASPHALT)
                places += [
                    (off, at, np.pi / 2) for at in np.arange(y0 + 4, y1 - 4, 6.4) if not _street_mouth(plan, off, at)
                ]
    return places


def _street_mouth(plan: p.Plan, x: float, y: float) -> bool:
    return any(s[0] - 9 < x < s[2] + 9 and s[1] - 9 < y < s[3] + 9 for s in plan.streets)
