"""One step of traffic: who follows whom, who waits, how fast everybody is a tenth of a second later.

Each car keeps the least of several accelerations, all by the intelligent driver model (Treiber 2000): towards the car
in front, wherever the route leads; towards a red light; towards the place where a turn gives way, until a gap is
accepted; towards a car that comes in from the side; and towards the lower speed limit of an edge ahead. A car's place
is the distance of its middle along its edge; ``hop`` tells which edge of its route that is.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from schemas.arrays import FloatArray, IntArray

ACCELERATION, BRAKING, LEAST_GAP = 2.2, 2.4, 1.8
"""m/s^2, m/s^2, m: the driver model's a, b, s0."""
HARDEST_BRAKING = 8.0
LOOK_AHEAD_M = 110.0
MERGE_AHEAD_M = 70.0
PATIENCE_S = 18.0
FAR = 1e9


class Roads(NamedTuple):
    """The network as arrays, one row an edge; lists of lists are ``*_first`` (rows + 1) and the values between."""

    length: FloatArray
    limit: FloatArray
    end: IntArray  # node
    signal: IntArray  # group of lights at the end, -1: none
    yields: IntArray  # 1: gives way at its end
    clear_end: FloatArray  # how far along it is still clear of the paths it joins
    sibling_first: IntArray
    sibling: IntArray  # edges that leave the same node
    sibling_clear: FloatArray  # how far along the sibling a tail no longer stands in this edge's way
    merges: IntArray  # 1: several edges reach this edge's end
    boxes_first: IntArray  # groups of lights + 1
    boxes: IntArray  # the edges each group lets cars onto
    offsets: FloatArray  # of the signals, one a crossing
    cycle_s: float
    all_red_s: float


class Cars(NamedTuple):
    """The state of all cars that ever drive; ``route[route_first[i] + hop[i]]`` is the edge of car i."""

    s: FloatArray
    v: FloatArray
    hop: IntArray
    commit: IntArray  # the node whose gap has been accepted, -1: none
    wait: FloatArray  # how long it has stood, s
    length: FloatArray
    wanted: FloatArray
    headway: FloatArray
    route: IntArray
    route_first: IntArray


@njit(cache=True, nogil=True)
def follow(v, wanted, gap, approach, headway):  # type: ignore[no-untyped-def]
    """The driver model's acceleration: speed ``v``, gap to what is in front, closing speed ``approach``."""
    free = 1.0 - (v / wanted) ** 4
    if gap >= FAR:
        return ACCELERATION * free
    reach = LEAST_GAP + max(0.0, v * headway + v * approach / (2.0 * np.sqrt(ACCELERATION * BRAKING)))
    return ACCELERATION * (free - (reach / max(gap, 0.1)) ** 2)


@njit(cache=True, nogil=True)
def is_green(group, time_s, offsets, cycle_s, all_red_s):  # type: ignore[no-untyped-def]
    """Whether a group of lights (2 * crossing + axis) is green."""
    t = (time_s + offsets[group // 2]) % cycle_s - (group % 2) * cycle_s / 2
    return 0.0 <= t < cycle_s / 2 - all_red_s


@njit(cache=True, nogil=True)
def sort_by_edge(active, roads, cars, first, order):  # type: ignore[no-untyped-def]
    """Active cars by edge, hindmost first: those of edge e are order[first[e]:first[e + 1]]."""
    n = len(active)
    key = np.empty(n)
    first[:] = 0
    for k in range(n):
        i = active[k]
        e = cars.route[cars.route_first[i] + cars.hop[i]]
        key[k] = e * 1e5 + cars.s[i]
        first[e + 1] += 1
    for e in range(len(roads.length)):
        first[e + 1] += first[e]
    by_key = np.argsort(key)
    for k in range(n):
        order[k] = active[by_key[k]]


@njit(cache=True, nogil=True)
def nearest_ahead(i, roads, cars, first, order):  # type: ignore[no-untyped-def]
    """Gap to and number of the next car on car ``i``'s route, or with its tail in the way; (FAR, -1): none near."""
    start = cars.route_first[i] + cars.hop[i]
    best, who = FAR, -1
    ahead = -cars.s[i]
    for h in range(start, cars.route_first[i + 1]):
        f = cars.route[h]
        for k in range(first[f], first[f + 1]):
            j = order[k]
            if j == i or (h == start and (cars.s[j] < cars.s[i] or (cars.s[j] == cars.s[i] and j > i))):
                continue
            best, who = ahead + cars.s[j] - 0.5 * (cars.length[i] + cars.length[j]), j
            break
        for q in range(roads.sibling_first[f], roads.sibling_first[f + 1]):
            g = roads.sibling[q]
            for k in range(first[g], first[g + 1]):
                j = order[k]
                if cars.s[j] - 0.5 * cars.length[j] > roads.sibling_clear[q]:
                    break
                gap = ahead + cars.s[j] - 0.5 * (cars.length[i] + cars.length[j])
                if (h > start or cars.s[j] > cars.s[i]) and gap < best:
                    best, who = gap, j
        ahead += roads.length[f]
        if who >= 0 or ahead > LOOK_AHEAD_M:
            break
    return best, who


@njit(cache=True, nogil=True)
def list_merges(active, roads, cars, head, chain, entry_car, entry_hop, entry_distance):  # type: ignore[no-untyped-def]
    """For each node where edges join: who is on the way to it, and how far (of the car's middle), as a chained list."""
    head[:] = -1
    n = 0
    for i in active:
        start = cars.route_first[i] + cars.hop[i]
        distance = -cars.s[i]
        for h in range(start, cars.route_first[i + 1]):
            e = cars.route[h]
            distance += roads.length[e]
            if distance > MERGE_AHEAD_M:
                break
            if roads.merges[e] == 1 and n < len(chain):
                entry_car[n], entry_hop[n], entry_distance[n] = i, h, distance
                chain[n] = head[roads.end[e]]
                head[roads.end[e]] = n
                n += 1
    return n


@njit(cache=True, nogil=True)
def gap_accepted(i, h, distance, roads, cars, lists, first, order):  # type: ignore[no-untyped-def]
    """Whether car ``i``, ``distance`` m from the node at the end of its route's edge ``h``, may go in."""
    head, chain, entry_car, entry_hop, entry_distance = lists
    e = cars.route[h]
    node = roads.end[e]
    if h + 1 < cars.route_first[i + 1]:
        after = cars.route[h + 1]
        if first[after] < first[after + 1]:
            j = order[first[after]]
            if cars.s[j] - 0.5 * cars.length[j] + cars.v[j] ** 2 / 4.0 < cars.length[i] + 6.0:
                return False
    need = (-cars.v[i] + np.sqrt(cars.v[i] ** 2 + 3.6 * distance)) / 1.8 + 2.2
    patient = cars.wait[i] < PATIENCE_S
    k = head[node]
    while k >= 0:
        j, f, d = entry_car[k], cars.route[entry_hop[k]], entry_distance[k]
        k = chain[k]
        if j == i or f == e:
            continue
        if roads.yields[f] == 1:
            if cars.commit[j] == node and d > distance - 2.0:
                return False
            continue
        if patient:
            arrival = (-cars.v[j] + np.sqrt(cars.v[j] ** 2 + 3.0 * max(d - 0.5 * cars.length[j], 0.0))) / 1.5
            # who comes fast must not have to brake hard behind a car that is still slow
            if arrival < need + max(cars.v[j] - 5.0, 0.0) / 5.0:
                return False
        elif d - 0.5 * cars.length[j] < roads.length[f] - roads.clear_end[f] + cars.v[j] ** 2 / 4.0:
            return False
    return True


@njit(cache=True, nogil=True)
def side_acceleration(i, h, distance, roads, cars, lists):  # type: ignore[no-untyped-def]
    """Acceleration towards those who are nearer to the same node on another edge, and have the right to go."""
    head, chain, entry_car, entry_hop, entry_distance = lists
    e = cars.route[h]
    node = roads.end[e]
    acceleration = FAR
    k = head[node]
    while k >= 0:
        j, f, d = entry_car[k], cars.route[entry_hop[k]], entry_distance[k]
        k = chain[k]
        if j == i or f == e:
            continue
        if roads.yields[f] == 1 and roads.yields[e] == 0 and cars.wait[j] > PATIENCE_S and d < roads.length[f] + 5.0:
            # somebody has waited long: stay clear of where the paths join, if that is easy
            stop = distance - roads.length[e] + roads.clear_end[e] - 0.5 * cars.length[i]
            if cars.commit[j] != node and cars.v[i] < 7.0 and stop > 0.0 and cars.v[i] ** 2 < 4.0 * stop:
                acceleration = min(acceleration, follow(cars.v[i], cars.wanted[i], stop + 1.2, cars.v[i], 0.4))
        if d > distance or (d == distance and j > i):
            continue
        inside = roads.length[f] - d + 0.5 * cars.length[j] > roads.clear_end[f]
        if (roads.yields[f] == 1 and cars.commit[j] == node) or (roads.yields[f] == 0 and inside):
            gap = distance - d - 0.5 * (cars.length[i] + cars.length[j])
            a = follow(cars.v[i], cars.wanted[i], gap, cars.v[i] - cars.v[j], cars.headway[i])
            acceleration = min(acceleration, a)
    return acceleration


@njit(cache=True, nogil=True)
def way_acceleration(i, time_s, roads, cars, lists, first, order):  # type: ignore[no-untyped-def]
    """Acceleration for what the way itself asks: limits, red lights, places to give way, cars from the side."""
    v, half = cars.v[i], 0.5 * cars.length[i]
    start = cars.route_first[i] + cars.hop[i]
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
            if cars.commit[i] != roads.end[e] and stop < 3.0 + v * v / 3.0:
                if stop < -1.0 or gap_accepted(i, h, begin + roads.length[e], roads, cars, lists, first, order):
                    cars.commit[i] = roads.end[e]
                else:
                    acceleration = min(acceleration, follow(v, cars.wanted[i], stop + 1.2, v, 0.4))
        if roads.yields[e] == 1 and cars.commit[i] == roads.end[e]:
            on_the_way = roads.end[e]
        if roads.merges[e] == 1 and (roads.yields[e] == 0 or cars.commit[i] == roads.end[e]):
            acceleration = min(acceleration, side_acceleration(i, h, begin + roads.length[e], roads, cars, lists))
        begin += roads.length[e]
        if roads.signal[e] >= 0 and begin - half > -0.3:
            stop = begin - half - 0.6
            green = is_green(roads.signal[e], time_s, roads.offsets, roads.cycle_s, roads.all_red_s)
            free = green and box_is_clear(roads.signal[e], roads, cars, first, order)
            if not (free and box_has_room(i, h, roads, cars, first, order)) and (
                v * v < 7.0 * max(stop, 0.0) or v < 1.0
            ):
                acceleration = min(acceleration, follow(v, cars.wanted[i], stop + 1.2, v, 0.4))
                # what lies beyond a red light is nobody's yet, whatever was accepted before
                if cars.commit[i] != on_the_way:
                    cars.commit[i] = -1
                break
        if begin > LOOK_AHEAD_M:
            break
    return acceleration


@njit(cache=True, nogil=True)
def box_has_room(i, h, roads, cars, first, order):  # type: ignore[no-untyped-def]
    """Whether car ``i`` will find a place beyond the box that follows edge ``h`` of its route."""
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
    return room > cars.length[i] + 2.0


@njit(cache=True, nogil=True)
def box_is_clear(group, roads, cars, first, order):  # type: ignore[no-untyped-def]
    """Whether the crossing traffic has left the box."""
    other = group ^ 1
    for q in range(roads.boxes_first[other], roads.boxes_first[other + 1]):
        e = roads.boxes[q]
        if first[e] < first[e + 1]:
            return False
    return True


@njit(cache=True, nogil=True)
def advance(active, time_s, dt, roads, cars, scratch):  # type: ignore[no-untyped-def]
    """Move all active cars on by ``dt``; returns which are still on their route (bool, like ``active``)."""
    first, order, head, chain, entry_car, entry_hop, entry_distance = scratch
    sort_by_edge(active, roads, cars, first, order)
    list_merges(active, roads, cars, head, chain, entry_car, entry_hop, entry_distance)
    lists = (head, chain, entry_car, entry_hop, entry_distance)
    change = np.empty(len(active))
    for k in range(len(active)):
        i = active[k]
        e = cars.route[cars.route_first[i] + cars.hop[i]]
        wanted = min(cars.wanted[i], roads.limit[e])
        gap, j = nearest_ahead(i, roads, cars, first, order)
        approach = cars.v[i] - cars.v[j] if j >= 0 else 0.0
        a = follow(cars.v[i], wanted, gap, approach, cars.headway[i])
        a = min(a, way_acceleration(i, time_s, roads, cars, lists, first, order))
        change[k] = min(max(a, -HARDEST_BRAKING), ACCELERATION)
    on_route = np.ones(len(active), dtype=np.bool_)
    for k in range(len(active)):
        i = active[k]
        v = max(cars.v[i] + change[k] * dt, 0.0)
        cars.s[i] += 0.5 * (v + cars.v[i]) * dt
        cars.v[i] = v
        cars.wait[i] = cars.wait[i] + dt if v < 0.5 else (0.0 if v > 3.0 else cars.wait[i])
        e = cars.route[cars.route_first[i] + cars.hop[i]]
        while cars.s[i] >= roads.length[e]:
            if cars.commit[i] == roads.end[e]:
                cars.commit[i] = -1
            cars.s[i] -= roads.length[e]
            cars.hop[i] += 1
            if cars.route_first[i] + cars.hop[i] >= cars.route_first[i + 1]:
                on_route[k] = False
                break
            e = cars.route[cars.route_first[i] + cars.hop[i]]
    return on_route


@njit(cache=True, nogil=True)
def enter(i, active, roads, cars, first, order):  # type: ignore[no-untyped-def]
    """Let car ``i`` in at the start of its route where there is room; sets its speed and returns whether it is in."""
    sort_by_edge(active, roads, cars, first, order)
    gap, j = nearest_ahead(i, roads, cars, first, order)
    ahead = cars.v[j] if j >= 0 else cars.wanted[i]
    limit = roads.limit[cars.route[cars.route_first[i]]]
    v = min(cars.wanted[i], limit, ahead + 0.15 * max(gap - 4.0, 0.0))
    if gap < 2.5 + 0.9 * v:
        return False
    cars.v[i] = v
    return True
