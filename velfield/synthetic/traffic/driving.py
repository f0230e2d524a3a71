"""One time step of the traffic simulation: car following, signals and gap acceptance.

Each car takes the minimum of several accelerations by the intelligent driver model (IDM; Treiber 2000): behind the
leader along the route; before a red light; before the give-way line of a turn, until a gap is accepted; behind a car
that merges from another edge; and before an edge with a lower speed limit. A car's position is the distance of its
centre along its edge; ``leg`` is the index of that edge in its route.
"""

from typing import NamedTuple

import numpy as np

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.compiled import kernel

ACCELERATION, BRAKING, MIN_GAP = 2.2, 2.4, 1.8
"""Parameters a, b, s0 of the IDM: m/s^2, m/s^2, m."""
MAX_BRAKING = 8.0
LOOK_AHEAD_M = 110.0
MERGE_AHEAD_M = 70.0
PATIENCE_S = 18.0
FAR = 1e9


class RoadArrays(NamedTuple):
    """The road network as arrays, one row an edge; lists of lists are values and their offsets ``*_first``
    (rows + 1)."""

    length: FloatArray
    limit: FloatArray
    end: IntArray  # node
    signal: IntArray  # signal group at the end, -1: none
    yields: IntArray  # 1: gives way at its end
    clear_end: FloatArray  # how far along it is still clear of the paths it joins
    sibling_first: IntArray
    sibling: IntArray  # edges that leave the same node
    sibling_clear: FloatArray  # how far along the sibling a vehicle's rear no longer blocks this edge
    merges: IntArray  # 1: several edges reach this edge's end
    boxes_first: IntArray  # signal groups + 1
    boxes: IntArray  # the edges behind each group's stop line
    offsets: FloatArray  # of the signals, one an intersection
    cycle_s: float
    all_red_s: float


class CarStates(NamedTuple):
    """The state of all cars; ``route[route_first[i] + leg[i]]`` is the edge of car i."""

    s: FloatArray
    v: FloatArray
    leg: IntArray
    accepted_node: IntArray  # the node whose gap has been accepted, -1: none
    waiting_s: FloatArray  # time since it stopped
    length: FloatArray
    desired_speed: FloatArray
    headway: FloatArray
    route: IntArray
    route_first: IntArray


@kernel
def idm_acceleration(v: float, desired_speed: float, gap: float, approach: float, headway: float) -> float:
    """Acceleration of the IDM at speed ``v``, ``gap`` to the leader, and closing speed ``approach``; m, m/s, s."""
    free = 1.0 - (v / desired_speed) ** 4
    if gap >= FAR:
        return ACCELERATION * free
    desired_gap = MIN_GAP + max(0.0, v * headway + v * approach / (2.0 * np.sqrt(ACCELERATION * BRAKING)))
    return float(ACCELERATION * (free - (desired_gap / max(gap, 0.1)) ** 2))


@kernel
def is_green(group: int, time_s: float, offsets: FloatArray, cycle_s: float, all_red_s: float) -> bool:
    """Whether a signal group (2 * intersection + axis) is green."""
    t = (time_s + offsets[group // 2]) % cycle_s - (group % 2) * cycle_s / 2
    return bool(0.0 <= t < cycle_s / 2 - all_red_s)


@kernel
def sort_by_edge(active: IntArray, roads: RoadArrays, cars: CarStates, first: IntArray, order: IntArray) -> None:
    """Active cars by edge, rearmost first: those of edge e are order[first[e]:first[e + 1]]."""
    n = len(active)
    key = np.empty(n)
    first[:] = 0
    for k in range(n):
        i = active[k]
        e = cars.route[cars.route_first[i] + cars.leg[i]]
        key[k] = e * 1e5 + cars.s[i]
        first[e + 1] += 1
    for e in range(len(roads.length)):
        first[e + 1] += first[e]
    by_key = np.argsort(key)
    for k in range(n):
        order[k] = active[by_key[k]]


@kernel
def find_leader(i: int, roads: RoadArrays, cars: CarStates, first: IntArray, order: IntArray) -> tuple[float, int]:
    """Gap to and number of the leader on car ``i``'s route, or of a vehicle whose rear blocks it; (FAR, -1): none
    near."""
    start = cars.route_first[i] + cars.leg[i]
    best, leader = FAR, -1
    ahead = -cars.s[i]
    for h in range(start, cars.route_first[i + 1]):
        f = cars.route[h]
        for k in range(first[f], first[f + 1]):
            j = order[k]
            if j == i or (h == start and (cars.s[j] < cars.s[i] or (cars.s[j] == cars.s[i] and j > i))):
                continue
            best, leader = ahead + cars.s[j] - 0.5 * (cars.length[i] + cars.length[j]), j
            break
        for q in range(roads.sibling_first[f], roads.sibling_first[f + 1]):
            g = roads.sibling[q]
            for k in range(first[g], first[g + 1]):
                j = order[k]
                if cars.s[j] - 0.5 * cars.length[j] > roads.sibling_clear[q]:
                    break
                gap = ahead + cars.s[j] - 0.5 * (cars.length[i] + cars.length[j])
                if (h > start or cars.s[j] > cars.s[i]) and gap < best:
                    best, leader = gap, j
        ahead += roads.length[f]
        if leader >= 0 or ahead > LOOK_AHEAD_M:
            break
    return best, leader


@kernel
def list_conflicts(active, roads, cars, head, chain, entry_car, entry_leg, entry_distance) -> int:  # type: ignore[no-untyped-def]
    """For each node where edges merge, the cars on the way to it and their distances, as a linked list."""
    head[:] = -1
    n = 0
    for i in active:
        start = cars.route_first[i] + cars.leg[i]
        distance = -cars.s[i]
        for h in range(start, cars.route_first[i + 1]):
            e = cars.route[h]
            distance += roads.length[e]
            if distance > MERGE_AHEAD_M:
                break
            if roads.merges[e] == 1 and n < len(chain):
                entry_car[n], entry_leg[n], entry_distance[n] = i, h, distance
                chain[n] = head[roads.end[e]]
                head[roads.end[e]] = n
                n += 1
    return n


@kernel
def accepts_gap(i, h, distance, roads, cars, lists, first, order) -> bool:  # type: ignore[no-untyped-def]
    """Gap acceptance: whether car ``i``, ``distance`` m from the node at the end of its route's edge ``h``, may
    merge."""
    head, chain, entry_car, entry_leg, entry_distance = lists
    e = cars.route[h]
    node = roads.end[e]
    if h + 1 < cars.route_first[i + 1]:
        after = cars.route[h + 1]
        if first[after] < first[after + 1]:
            j = order[first[after]]
            if cars.s[j] - 0.5 * cars.length[j] + cars.v[j] ** 2 / 4.0 < cars.length[i] + 6.0:
                return False
    need = (-cars.v[i] + np.sqrt(cars.v[i] ** 2 + 3.6 * distance)) / 1.8 + 2.2
    patient = cars.waiting_s[i] < PATIENCE_S
    k = head[node]
    while k >= 0:
        j, f, d = entry_car[k], cars.route[entry_leg[k]], entry_distance[k]
        k = chain[k]
        if j == i or f == e:
            continue
        if roads.yields[f] == 1:
            if cars.accepted_node[j] == node and d > distance - 2.0:
                return False
            continue
        if patient:
            arrival = (-cars.v[j] + np.sqrt(cars.v[j] ** 2 + 3.0 * max(d - 0.5 * cars.length[j], 0.0))) / 1.5
            # a fast vehicle must not have to brake hard behind one that is still slow
            if arrival < need + max(cars.v[j] - 5.0, 0.0) / 5.0:
                return False
        elif d - 0.5 * cars.length[j] < roads.length[f] - roads.clear_end[f] + cars.v[j] ** 2 / 4.0:
            return False
    return True


@kernel
def conflict_acceleration(i, h, distance, roads, cars, lists) -> float:  # type: ignore[no-untyped-def]
    """Acceleration behind vehicles that are nearer to the same node on another edge and have priority or have
    merged."""
    head, chain, entry_car, entry_leg, entry_distance = lists
    e = cars.route[h]
    node = roads.end[e]
    acceleration = FAR
    k = head[node]
    while k >= 0:
        j, f, d = entry_car[k], cars.route[entry_leg[k]], entry_distance[k]
        k = chain[k]
        if j == i or f == e:
            continue
        if (
            roads.yields[f] == 1
            and roads.yields[e] == 0
            and cars.waiting_s[j] > PATIENCE_S
            and d < roads.length[f] + 5.0
        ):
            # a driver has waited long: let it merge if braking is easy
            stop = distance - roads.length[e] + roads.clear_end[e] - 0.5 * cars.length[i]
            if cars.accepted_node[j] != node and cars.v[i] < 7.0 and stop > 0.0 and cars.v[i] ** 2 < 4.0 * stop:
                acceleration = min(
                    acceleration,
                    idm_acceleration(cars.v[i], cars.desired_speed[i], stop + 1.2, cars.v[i], 0.4),
                )
        if d > distance or (d == distance and j > i):
            continue
        inside = roads.length[f] - d + 0.5 * cars.length[j] > roads.clear_end[f]
        if (roads.yields[f] == 1 and cars.accepted_node[j] == node) or (roads.yields[f] == 0 and inside):
            gap = distance - d - 0.5 * (cars.length[i] + cars.length[j])
            a = idm_acceleration(cars.v[i], cars.desired_speed[i], gap, cars.v[i] - cars.v[j], cars.headway[i])
            acceleration = min(acceleration, a)
    return acceleration


@kernel
def route_acceleration(i, time_s, roads, cars, lists, first, order) -> float:  # type: ignore[no-untyped-def]
    """Acceleration by the route: speed limits, red lights, give-way lines, merging vehicles."""
    v, half = cars.v[i], 0.5 * cars.length[i]
    start = cars.route_first[i] + cars.leg[i]
    acceleration = FAR
    begin = -cars.s[i]
    on_the_way = -1
    for h in range(start, cars.route_first[i + 1]):
        e = cars.route[h]
        if h > start:
            limit = np.sqrt(roads.limit[e] ** 2 + 2 * 1.7 * max(begin - half, 0.0))
            if v > limit:
                acceleration = min(acceleration, -1.7 - 2.0 * (v - limit))
        if roads.yields[e] == 1:
            stop = begin + roads.clear_end[e] - half
            if cars.accepted_node[i] != roads.end[e] and stop < 3.0 + v * v / 3.0:
                if stop < -1.0 or accepts_gap(i, h, begin + roads.length[e], roads, cars, lists, first, order):
                    cars.accepted_node[i] = roads.end[e]
                else:
                    acceleration = min(acceleration, idm_acceleration(v, cars.desired_speed[i], stop + 1.2, v, 0.4))
        if roads.yields[e] == 1 and cars.accepted_node[i] == roads.end[e]:
            on_the_way = roads.end[e]
        if roads.merges[e] == 1 and (roads.yields[e] == 0 or cars.accepted_node[i] == roads.end[e]):
            acceleration = min(acceleration, conflict_acceleration(i, h, begin + roads.length[e], roads, cars, lists))
        begin += roads.length[e]
        if roads.signal[e] >= 0 and begin - half > -0.3:
            stop = begin - half - 0.6
            green = is_green(roads.signal[e], time_s, roads.offsets, roads.cycle_s, roads.all_red_s)
            free = green and box_is_clear(roads.signal[e], roads, cars, first, order)
            if not (free and box_has_room(i, h, roads, cars, first, order)) and (
                v * v < 7.0 * max(stop, 0.0) or v < 1.0
            ):
                acceleration = min(acceleration, idm_acceleration(v, cars.desired_speed[i], stop + 1.2, v, 0.4))
                # gaps accepted beyond a red light no longer hold
                if cars.accepted_node[i] != on_the_way:
                    cars.accepted_node[i] = -1
                break
        if begin > LOOK_AHEAD_M:
            break
    return acceleration


@kernel
def box_has_room(i: int, h: int, roads: RoadArrays, cars: CarStates, first: IntArray, order: IntArray) -> bool:
    """Whether there is room for car ``i`` beyond the intersection box that follows edge ``h`` of its route."""
    if h + 2 >= cars.route_first[i + 1]:
        return True
    box, after = cars.route[h + 1], cars.route[h + 2]
    room = FAR
    if first[after] < first[after + 1]:
        j = order[first[after]]
        if cars.v[j] < 5.0:
            room = cars.s[j] - 0.5 * cars.length[j] + cars.v[j] ** 2
    for k in range(first[box], first[box + 1]):
        room -= cars.length[order[k]] + 3.0
    return bool(room > cars.length[i] + 2.0)


@kernel
def box_is_clear(group: int, roads: RoadArrays, cars: CarStates, first: IntArray, order: IntArray) -> bool:
    """Whether crossing traffic has left the intersection box."""
    other = group ^ 1
    for q in range(roads.boxes_first[other], roads.boxes_first[other + 1]):
        e = roads.boxes[q]
        if first[e] < first[e + 1]:
            return False
    return True


@kernel
def advance(active, time_s, dt, roads, cars, scratch) -> Mask:  # type: ignore[no-untyped-def]
    """Advance all active cars by ``dt``; returns which are still on their route (bool, like ``active``)."""
    first, order, head, chain, entry_car, entry_leg, entry_distance = scratch
    sort_by_edge(active, roads, cars, first, order)
    list_conflicts(active, roads, cars, head, chain, entry_car, entry_leg, entry_distance)
    lists = (head, chain, entry_car, entry_leg, entry_distance)
    change = np.empty(len(active))
    for k in range(len(active)):
        i = active[k]
        e = cars.route[cars.route_first[i] + cars.leg[i]]
        desired_speed = min(cars.desired_speed[i], roads.limit[e])
        gap, j = find_leader(i, roads, cars, first, order)
        approach = cars.v[i] - cars.v[j] if j >= 0 else 0.0
        a = idm_acceleration(cars.v[i], desired_speed, gap, approach, cars.headway[i])
        a = min(a, route_acceleration(i, time_s, roads, cars, lists, first, order))
        change[k] = min(max(a, -MAX_BRAKING), ACCELERATION)
    on_route = np.ones(len(active), dtype=np.bool_)
    for k in range(len(active)):
        i = active[k]
        v = max(cars.v[i] + change[k] * dt, 0.0)
        cars.s[i] += 0.5 * (v + cars.v[i]) * dt
        cars.v[i] = v
        cars.waiting_s[i] = cars.waiting_s[i] + dt if v < 0.5 else (0.0 if v > 3.0 else cars.waiting_s[i])
        e = cars.route[cars.route_first[i] + cars.leg[i]]
        while cars.s[i] >= roads.length[e]:
            if cars.accepted_node[i] == roads.end[e]:
                cars.accepted_node[i] = -1
            cars.s[i] -= roads.length[e]
            cars.leg[i] += 1
            if cars.route_first[i] + cars.leg[i] >= cars.route_first[i + 1]:
                on_route[k] = False
                break
            e = cars.route[cars.route_first[i] + cars.leg[i]]
    return on_route


@kernel
def try_enter(i: int, active: IntArray, roads: RoadArrays, cars: CarStates, first: IntArray, order: IntArray) -> bool:
    """Insert car ``i`` at the start of its route if there is room; sets its speed and returns whether it is in."""
    sort_by_edge(active, roads, cars, first, order)
    gap, j = find_leader(i, roads, cars, first, order)
    ahead = cars.v[j] if j >= 0 else cars.desired_speed[i]
    limit = roads.limit[cars.route[cars.route_first[i]]]
    v = min(cars.desired_speed[i], limit, ahead + 0.15 * max(gap - 4.0, 0.0))
    if gap < 2.5 + 0.9 * v:
        return False
    cars.v[i] = v
    return True
