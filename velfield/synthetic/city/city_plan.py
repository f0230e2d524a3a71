"""The city's plan: avenues with signalised intersections, roundabouts, car parks and U-turns, on a lattice of any size.

One cell of the lattice, in metres from its intersection: avenue A runs west-east with a median, avenue B north-south; a
roundabout is to the north-east, its arms lead to the avenues around, the western one through a car park to avenue A.
"""

from dataclasses import dataclass, field

import numpy as np

from velfield.synthetic.city.road_network import Lane, RoadNetwork

Rect = tuple[float, float, float, float]

PITCH_X_M, PITCH_Y_M = 300.0, 230.0
INTERSECTION_X_M, INTERSECTION_Y_M = -50.0, 25.0
"""The intersection nearest to the plan's origin."""

LANE_M = 3.5
MEDIAN_M = 10.0
CORNER_M = 7.75
"""Radius of the path of a right turn."""

ROUNDABOUT_X_M, ROUNDABOUT_Y_M, RING_M, LEG_M = 120.0, -75.0, 13.0, 27.0
"""A roundabout's centre from its intersection, the radius of its lane's centre line, and where its arms begin."""

INNER_A, CURB_A = MEDIAN_M / 2 + 0.5 * LANE_M, MEDIAN_M / 2 + 1.5 * LANE_M
INNER_B, CURB_B = 0.5 * LANE_M, 1.5 * LANE_M
STOP_A, STOP_B = CURB_B + CORNER_M, CURB_A + CORNER_M
UTURN_M, POCKET_M = 62.0, 30.0
RING_ANGLE = np.radians(38.0)

STREET_SPEED, RING_SPEED, AISLE_SPEED = 9.5, 5.6, 4.2
AVENUE_LIMIT = 22.0


@dataclass
class CityPlan:
    """Lanes and positions of everything that is painted, metres."""

    rect: Rect
    road_network: RoadNetwork
    avenues_y: list[float] = field(default_factory=list)
    avenues_x: list[float] = field(default_factory=list)
    roundabouts: list[tuple[float, float]] = field(default_factory=list)
    car_parks: list[tuple[float, float]] = field(default_factory=list)
    streets: list[Rect] = field(default_factory=list)


def view_centre_m(width_m: float) -> tuple[float, float]:
    """Centre of the view: of a whole cell if it fits, otherwise nearer to the intersection and its U-turn."""
    fraction = float(np.clip((width_m - 150) / 140, 0, 1))
    return (-28 + fraction * 33, 20 - fraction * 28)


def make_city_plan(rect: Rect, rng: np.random.Generator, *, turn_share: float, cycle_s: float) -> CityPlan:
    """Plan of all lattice cells that meet ``rect`` (x0, y0, x1, y1), m."""
    net = RoadNetwork()
    plan = CityPlan(rect, net)
    columns = range(
        int(np.floor((rect[0] - INTERSECTION_X_M) / PITCH_X_M)),
        int(np.ceil((rect[2] - INTERSECTION_X_M) / PITCH_X_M)) + 1,
    )
    rows = range(
        int(np.floor((rect[1] - INTERSECTION_Y_M) / PITCH_Y_M)),
        int(np.ceil((rect[3] - INTERSECTION_Y_M) / PITCH_Y_M)) + 1,
    )
    xs = {i: INTERSECTION_X_M + i * PITCH_X_M for i in columns}
    ys = {j: INTERSECTION_Y_M + j * PITCH_Y_M for j in rows}
    xs = {i: x for i, x in xs.items() if rect[0] + 20 < x < rect[2] - 20}
    ys = {j: y for j, y in ys.items() if rect[1] + 25 < y < rect[3] - 25}
    plan.avenues_x, plan.avenues_y = list(xs.values()), list(ys.values())
    a = {j: _avenue_a(net, y, rect) for j, y in ys.items()}
    b = {i: _avenue_b(net, x, rect) for i, x in xs.items()}
    for i, x in xs.items():
        for j, y in ys.items():
            net.signal_offsets_s.append(float(rng.uniform(0, cycle_s)))
            _intersection(net, a[j], b[i], x, y, 2 * (len(net.signal_offsets_s) - 1), turn_share)
            _uturns(net, a[j], x, y, rect, turn_share)
    for i in columns:
        for j in rows:
            _cell(plan, a, b, (i, j), turn_share)
    for lanes in (*a.values(), *b.values()):
        for lane in lanes.values():
            net.sources.append((lane.at(0.0), 1.0))
            lane.finish()
    return plan


Lanes = dict[str, Lane]


def _avenue_a(net: RoadNetwork, y: float, rect: Rect) -> Lanes:
    x0, x1 = rect[0], rect[2]
    return {
        "E0": Lane(net, (x0, y + INNER_A), (x1, y + INNER_A), "avenue", AVENUE_LIMIT),
        "E1": Lane(net, (x0, y + CURB_A), (x1, y + CURB_A), "avenue", AVENUE_LIMIT),
        "W0": Lane(net, (x1, y - INNER_A), (x0, y - INNER_A), "avenue", AVENUE_LIMIT),
        "W1": Lane(net, (x1, y - CURB_A), (x0, y - CURB_A), "avenue", AVENUE_LIMIT),
    }


def _avenue_b(net: RoadNetwork, x: float, rect: Rect) -> Lanes:
    y0, y1 = rect[1], rect[3]
    return {
        "S0": Lane(net, (x - INNER_B, y0), (x - INNER_B, y1), "avenue", AVENUE_LIMIT),
        "S1": Lane(net, (x - CURB_B, y0), (x - CURB_B, y1), "avenue", AVENUE_LIMIT),
        "N0": Lane(net, (x + INNER_B, y1), (x + INNER_B, y0), "avenue", AVENUE_LIMIT),
        "N1": Lane(net, (x + CURB_B, y1), (x + CURB_B, y0), "avenue", AVENUE_LIMIT),
    }


def _intersection(net: RoadNetwork, a: Lanes, b: Lanes, x: float, y: float, group: int, turn_share: float) -> None:
    for name, sign in (("E0", 1), ("E1", 1), ("W0", -1), ("W1", -1)):
        a[name].box(x - sign * STOP_A, y, group)
        a[name].at_point(x + sign * STOP_A, y)
    for name, sign in (("S0", 1), ("S1", 1), ("N0", -1), ("N1", -1)):
        b[name].box(x, y - sign * STOP_B, group + 1)
        b[name].at_point(x, y + sign * STOP_B)
    corners = (("E1", -1, "S1", 1), ("S1", -1, "W1", -1), ("W1", 1, "N1", -1), ("N1", 1, "E1", 1))
    for come, at, leave, to in corners:
        start = a[come].at_point(x + at * STOP_A, y) if come in a else b[come].at_point(x, y + at * STOP_B)
        end = a[leave].at_point(x + to * STOP_A, y) if leave in a else b[leave].at_point(x, y + to * STOP_B)
        net.turn(start, end, weight=_odds(turn_share))


def _uturns(net: RoadNetwork, a: Lanes, x: float, y: float, rect: Rect, turn_share: float) -> None:
    """East-west after the intersection, and west-east: a pocket in the median, then a half circle."""
    for come, back, sign in (("E0", "W0", 1), ("W0", "E0", -1)):
        if not rect[0] + 15 < x + sign * UTURN_M < rect[2] - 15:
            continue
        shift = y + sign * (INNER_A - 3.4)
        direction = a[come].direction
        pocket, end = (net.node(x + sign * at, shift, direction) for at in (POCKET_M + 16, UTURN_M))
        net.turn(a[come].at_point(x + sign * POCKET_M, y), pocket, weight=0.4 * _odds(turn_share), yields=False)
        net.straight(pocket, end, "street", 8.0)
        net.turn(end, a[back].at_point(x + sign * UTURN_M, y), weight=1.0)


def _cell(plan: CityPlan, a: dict[int, Lanes], b: dict[int, Lanes], cell: tuple[int, int], turn_share: float) -> None:
    """The roundabout of a lattice cell, its arms and its car park, if they fit into the rectangle."""
    net, rect, (i, j) = plan.road_network, plan.rect, cell
    x, y = INTERSECTION_X_M + i * PITCH_X_M, INTERSECTION_Y_M + j * PITCH_Y_M
    cx, cy = x + ROUNDABOUT_X_M, y + ROUNDABOUT_Y_M
    if not (rect[0] + LEG_M < cx < rect[2] - LEG_M and rect[1] + LEG_M < cy < rect[3] - LEG_M) or j not in a:
        return
    plan.roundabouts.append((cx, cy))
    enter, leave = _ring(net, cx, cy)
    odds = _odds(turn_share)
    half = LANE_M / 2
    # south: avenue A's westbound carriageway
    edge = y - CURB_A - CORNER_M
    end = net.node(cx - half, edge, np.pi / 2)
    net.straight(leave["S"], end, "street", STREET_SPEED)
    net.turn(end, a[j]["W1"].at_point(cx - half - CORNER_M, y), weight=1.0)
    start = net.node(cx + half, edge, -np.pi / 2)
    net.turn(a[j]["W1"].at_point(cx + half + CORNER_M, y), start, weight=1.5 * odds, yields=False)
    net.straight(start, enter["S"], "street", STREET_SPEED)
    plan.streets.append((cx - LANE_M, cy + RING_M, cx + LANE_M, y - CURB_A))
    _east_leg(plan, b.get(i + 1), (cx, cy), (enter["E"], leave["E"]), odds, x + PITCH_X_M)
    _north_leg(plan, a.get(j - 1), (cx, cy), (enter["N"], leave["N"]), odds, y - PITCH_Y_M)
    _car_park(plan, a[j], x, y, leave["W"])


def _ring(net: RoadNetwork, cx: float, cy: float) -> tuple[dict[str, int], dict[str, int]]:
    """The ring and the mouths of its arms: nodes where lanes enter from, and leave to, each side."""
    enter: dict[str, int] = {}
    leave: dict[str, int] = {}
    stops: list[tuple[float, int]] = []
    for name, phi in (("S", np.pi / 2), ("E", 0.0), ("N", -np.pi / 2), ("W", -np.pi)):
        out = np.array([np.cos(phi), np.sin(phi)])
        right = np.array([-out[1], out[0]])
        for outward, theta in ((True, phi + RING_ANGLE), (False, phi - RING_ANGLE)):
            if name == "W" and not outward:
                continue
            ring = net.node(cx + RING_M * np.cos(theta), cy + RING_M * np.sin(theta), theta - np.pi / 2)
            stops.append((theta, ring))
            px, py = np.array([cx, cy]) + LEG_M * out + (1 if outward else -1) * right * LANE_M / 2
            mouth = net.node(float(px), float(py), phi if outward else phi + np.pi)
            if outward:
                net.turn(ring, mouth, weight=0.9, yields=False)
                leave[name] = mouth
            else:
                net.turn(mouth, ring, weight=1.0)
                enter[name] = mouth
    for (from_angle, p), (to_angle, q) in zip(stops, stops[1:] + stops[:1], strict=True):
        if to_angle > from_angle:
            to_angle -= 2 * np.pi
        net.arc(p, q, (cx, cy), (from_angle, to_angle), RING_SPEED)
    return enter, leave


def _east_leg(
    plan: CityPlan, b: Lanes | None, centre: tuple[float, float], mouths: tuple[int, int], odds: float, avenue_x: float
) -> None:
    net, (cx, cy), half = plan.road_network, centre, LANE_M / 2
    edge = plan.rect[2] if b is None else avenue_x - CURB_B - CORNER_M
    end, start = net.node(edge, cy + half, 0.0), net.node(edge, cy - half, np.pi)
    net.straight(mouths[1], end, "street", STREET_SPEED)
    net.straight(start, mouths[0], "street", STREET_SPEED)
    plan.streets.append((cx + RING_M, cy - LANE_M, edge + (0 if b is None else CORNER_M), cy + LANE_M))
    if b is None:
        net.sources.append((start, 0.15))
        return
    net.turn(end, b["S1"].at_point(avenue_x, cy + half + CORNER_M), weight=1.0)
    net.turn(b["S1"].at_point(avenue_x, cy - half - CORNER_M), start, weight=odds, yields=False)


def _north_leg(
    plan: CityPlan, a: Lanes | None, centre: tuple[float, float], mouths: tuple[int, int], odds: float, avenue_y: float
) -> None:
    net, (cx, cy), half = plan.road_network, centre, LANE_M / 2
    edge = plan.rect[1] if a is None else avenue_y + CURB_A + CORNER_M
    end, start = net.node(cx + half, edge, -np.pi / 2), net.node(cx - half, edge, np.pi / 2)
    net.straight(mouths[1], end, "street", STREET_SPEED)
    net.straight(start, mouths[0], "street", STREET_SPEED)
    plan.streets.append((cx - LANE_M, edge - (0 if a is None else CORNER_M), cx + LANE_M, cy - RING_M))
    if a is None:
        net.sources.append((start, 0.15))
        return
    net.turn(end, a["E1"].at_point(cx + half + CORNER_M, avenue_y), weight=1.0)
    net.turn(a["E1"].at_point(cx - half - CORNER_M, avenue_y), start, weight=odds, yields=False)


def _car_park(plan: CityPlan, a: Lanes, x: float, y: float, leave: int) -> None:
    """One way: west along the first aisle, back east along the second, south to the avenue."""
    net = plan.road_network
    first, second = net.nodes[leave].y, net.nodes[leave].y + 16
    west = net.node(x + 28, first, np.pi)
    net.straight(leave, west, "aisle", AISLE_SPEED)
    back = net.node(x + 28, second, 0.0)
    net.turn(west, back, weight=1.0, speed=AISLE_SPEED, yields=False)
    east, south = net.node(x + 70, second, 0.0), net.node(x + 76, second + 6, np.pi / 2)
    net.straight(back, east, "aisle", AISLE_SPEED)
    net.turn(east, south, weight=1.0, speed=AISLE_SPEED, yields=False)
    gate = net.node(x + 76, y - CURB_A - CORNER_M, np.pi / 2)
    net.straight(south, gate, "aisle", AISLE_SPEED)
    net.turn(gate, a["W1"].at_point(x + 76 - CORNER_M, y), weight=1.0)
    plan.car_parks.append((x, first))


def _odds(probability: float) -> float:
    """Weight of a turn, against 1 for straight on, of a given probability."""
    return probability / max(1 - probability, 1e-6)
