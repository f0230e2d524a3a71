"""Named traffic scenes for tests of tracking: cars drawn on a road, and a detector with jitter, misses and false
alarms.

Images are drawn in working pixels (one a base pixel), a car 16 x 8 px. Every scene is a list of `Car`; `watch`
turns it into frame tables and the truth: which car each detection shows (-1: none).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.tracking.association import FrameTable
from velfield.tracking.join_costs import TrackEnds

OVERSAMPLING = 4
CROP_PX = 32


@dataclass(frozen=True)
class Car:
    """A car: its position (x, y) px at a time s, and its appearance (greys of body, glass, bonnet line; length, width
    px)."""

    position: Callable[[float], tuple[float, float]]
    heading: Callable[[float], float]
    body: float
    glass: float
    mark: float
    length: float = 16.0
    width: float = 7.5


@dataclass(frozen=True)
class Detector:
    """Errors of the detector; the defaults are those of the real one."""

    jitter_px: float = 0.7
    axis_sd_rad: float = 0.07
    recall: float = 0.9
    false_alarms: float = 6.0
    noise_grey: float = 3.0


@dataclass
class Watched:
    """Frame tables of a scene, and the truth of each detection."""

    tables: list[FrameTable]
    car_of: dict[int, int] = field(default_factory=dict)
    position_of: dict[int, tuple[float, float]] = field(default_factory=dict)


def car(
    rng: np.random.Generator, start: tuple[float, float], velocity: tuple[float, float], *, similarity: float = 0.0
) -> Car:
    """A car at constant velocity, its appearance random; ``similarity`` = 1: all cars are identical."""
    heading = float(np.arctan2(velocity[1], velocity[0])) if np.hypot(*velocity) else float(rng.choice([0.0, np.pi]))
    return Car(
        lambda t: (start[0] + velocity[0] * t, start[1] + velocity[1] * t),
        lambda t: heading,
        *appearance(rng, similarity),
    )


def appearance(rng: np.random.Generator, similarity: float = 0.0) -> tuple[float, float, float, float, float]:
    """Greys and size of a car: most are white, grey or black."""
    body = float(rng.choice([225.0, 190.0, 140.0, 60.0, 35.0]) + rng.normal(0, 12))
    mine = (body, float(rng.uniform(20, 70)), float(rng.normal(0, 25)), rng.uniform(14, 18), rng.uniform(6.8, 8.2))
    same = (190.0, 45.0, 10.0, 16.0, 7.5)
    return tuple(similarity * s + (1 - similarity) * m for s, m in zip(same, mine, strict=True))


def road(rng: np.random.Generator, shape: tuple[int, int]) -> FloatArray:
    """Asphalt with patches and lane marks, oversampled."""
    h, w = shape[0] * OVERSAMPLING, shape[1] * OVERSAMPLING
    ground = cv2.resize(rng.normal(105, 12, (h // 40 + 1, w // 40 + 1)), (w, h), interpolation=cv2.INTER_CUBIC)
    ground[:: 12 * OVERSAMPLING] = 170
    return ground.astype(np.float32)


def draw(ground: FloatArray, cars: Sequence[Car], time_s: float) -> FloatArray:
    """The image at a time, at base resolution."""
    image = ground.copy()
    o = OVERSAMPLING
    for c in cars:
        (x, y), heading = c.position(time_s), c.heading(time_s)
        for begin, end, width, grey in (
            (-0.5, 0.5, 1.0, c.body),
            (-0.32, -0.2, 0.8, c.glass),
            (0.08, 0.25, 0.85, c.glass),
            (0.25, 0.5, 0.3, c.body + c.mark),
        ):
            along = np.array([begin, end, end, begin]) * c.length
            across = np.array([-0.5, -0.5, 0.5, 0.5]) * c.width * width
            corners_x = x + along * np.cos(heading) - across * np.sin(heading)
            corners_y = y + along * np.sin(heading) + across * np.cos(heading)
            corners = np.stack([(corners_x + 0.5) * o - 0.5, (corners_y + 0.5) * o - 0.5], axis=1)
            cv2.fillConvexPoly(image, np.rint(corners * 16).astype(np.int32), grey, cv2.LINE_8, 4)
    return cv2.resize(image, (image.shape[1] // o, image.shape[0] // o), interpolation=cv2.INTER_AREA)


def crops_of(image: FloatArray, xy: FloatArray) -> NDArray[np.uint8]:
    """Upright crops centred on the rounded positions."""
    padded = np.pad(np.clip(np.rint(image), 0, 255).astype(np.uint8), CROP_PX, mode="edge")
    corner = np.rint(xy).astype(np.int64) + CROP_PX - CROP_PX // 2
    return np.array([padded[y : y + CROP_PX, x : x + CROP_PX] for x, y in corner], np.uint8).reshape(
        -1, CROP_PX, CROP_PX
    )


def watch(
    cars: Sequence[Car],
    times_s: Sequence[float],
    *,
    rng: np.random.Generator,
    detector: Detector = Detector(),
    shape: tuple[int, int] = (160, 480),
    dropped: Sequence[int] = (),
) -> Watched:
    """The detections of a scene, frame by frame; ``dropped`` frames are there but not registered."""
    ground = road(rng, shape)
    seen = Watched([])
    for frame, time_s in enumerate(times_s):
        image = draw(ground, cars, time_s)
        image = image + rng.normal(0, detector.noise_grey, image.shape).astype(np.float32)
        truth = np.array([(*c.position(time_s), c.heading(time_s)) for c in cars]).reshape(-1, 3)
        inside = (truth[:, 0] > 4) & (truth[:, 0] < shape[1] - 4) & (truth[:, 1] > 4) & (truth[:, 1] < shape[0] - 4)
        who = np.flatnonzero(inside & (rng.random(len(cars)) < detector.recall))
        false = rng.poisson(detector.false_alarms)
        xy = truth[who, :2] + rng.normal(0, detector.jitter_px, (who.size, 2))
        xy = np.concatenate([xy, rng.uniform((4, 4), (shape[1] - 4, shape[0] - 4), (false, 2))])
        true_axis = truth[who, 2] + rng.normal(0, detector.axis_sd_rad, who.size)
        axis = np.concatenate([true_axis, rng.uniform(0, np.pi, false)]) % np.pi
        ids = frame * 2**20 + np.arange(len(xy), dtype=np.int64)
        seen.car_of.update(zip(ids.tolist(), [*who.tolist(), *[-1] * false], strict=True))
        seen.position_of.update(zip(ids[: who.size].tolist(), map(tuple, truth[who, :2].tolist()), strict=True))
        seen.tables.append(
            FrameTable(
                frame=frame,
                time_s=float(time_s),
                registered=frame not in dropped,
                residual_px=0.3,
                detection_id=ids,
                x_px=xy[:, 0],
                y_px=xy[:, 1],
                orientation_rad=axis,
                orientation_sd_rad=np.full(len(xy), detector.axis_sd_rad),
                score=np.ones(len(xy)),
                crops=crops_of(image, xy),
                x_work=xy[:, 0],
                y_work=xy[:, 1],
            )
        )
    return seen


@dataclass(frozen=True)
class Score:
    """Precision, recall and speed error of tracklets.

    ``precision``: fraction of tracklets whose three detections show one car. ``recall``: fraction of cars detected in
    three consecutive frames of a window that have their tracklet. ``moving_...``: of those that move by the truth or by
    the tracklet.
    Errors are of the mean velocity, right and moving tracklets, px/s.
    """

    tracklets: int
    precision: float
    recall: float
    moving_precision: float
    moving_recall: float
    speed_rms_px_per_s: float


def score(
    seen: Watched, tracklets: pd.DataFrame, *, max_interval_s: float = 0.45, min_speed_px_per_s: float = 15.0
) -> Score:
    """Tracklets against the truth of their detections."""
    possible = _possible(seen, max_interval_s)
    ids = tracklets[["detection_id_0", "detection_id_1", "detection_id_2"]].to_numpy(np.int64)
    who = np.vectorize(seen.car_of.__getitem__, otypes=[np.int64])(ids) if ids.size else np.zeros((0, 3), np.int64)
    right = (who[:, 0] == who[:, 1]) & (who[:, 1] == who[:, 2]) & (who[:, 0] >= 0)
    span = (tracklets["time_2_s"] - tracklets["time_0_s"]).to_numpy()
    apart = (tracklets[["x_2_px", "y_2_px"]].to_numpy() - tracklets[["x_0_px", "y_0_px"]].to_numpy()) / span[:, None]
    moves = np.hypot(*apart.T) > min_speed_px_per_s
    fast = {key: speed > min_speed_px_per_s for key, (speed, _) in possible.items()}
    found = {tuple(row) for row in ids[right].tolist()}
    moving = [key for key, value in fast.items() if value]
    errors = []
    for row, time in zip(np.flatnonzero(right & moves), span[right & moves], strict=True):
        truth = possible[tuple(ids[row].tolist())][1]
        t = tracklets.iloc[row]
        dx = t.vx_01_px_per_s * (t.time_1_s - t.time_0_s) + t.vx_12_px_per_s * (t.time_2_s - t.time_1_s)
        dy = t.vy_01_px_per_s * (t.time_1_s - t.time_0_s) + t.vy_12_px_per_s * (t.time_2_s - t.time_1_s)
        errors.append(np.hypot(dx, dy) / time - np.hypot(*truth))
    return Score(
        tracklets=len(ids),
        precision=float(right.mean()) if right.size else 1.0,
        recall=len(found) / max(len(possible), 1),
        moving_precision=float(right[moves].mean()) if moves.any() else 1.0,
        moving_recall=sum(key in found for key in moving) / max(len(moving), 1),
        speed_rms_px_per_s=float(np.sqrt(np.mean(np.square(errors)))) if errors else 0.0,
    )


def _possible(seen: Watched, max_interval_s: float) -> dict[tuple[int, ...], tuple[float, FloatArray]]:
    """Every tracklet that the detections allow: its ids, true speed and velocity."""
    good = [t for t in seen.tables if t.registered]
    out = {}
    for a, b, c in zip(good, good[1:], good[2:], strict=False):
        if max(b.time_s - a.time_s, c.time_s - b.time_s) > max_interval_s:
            continue
        maps = [{seen.car_of[i]: i for i in t.detection_id.tolist() if seen.car_of[i] >= 0} for t in (a, b, c)]
        for who in maps[0].keys() & maps[1].keys() & maps[2].keys():
            ids = tuple(m[who] for m in maps)
            moved = np.subtract(seen.position_of[ids[2]], seen.position_of[ids[0]]) / (c.time_s - a.time_s)
            out[ids] = (float(np.hypot(*moved)), moved)
    return out


def two_lanes_opposed(rng: np.random.Generator) -> list[Car]:
    """Cars meet at 100 km/h of closing speed in lanes 11 px apart: at any moment a car of the other lane is nearest."""
    there = [car(rng, (x, 60.0), (60.0, 0.0)) for x in np.cumsum(rng.uniform(24, 60, 30)) - 600]
    back = [car(rng, (x, 71.0), (-60.0, 0.0)) for x in np.cumsum(rng.uniform(24, 60, 30)) - 100]
    return there + back


def dense_car_park(rng: np.random.Generator) -> list[Car]:
    """Rows of parked cars 11 px apart, and two that drive between the rows."""
    parked = [car(rng, (30.0 + 11 * k, y), (0.0, 0.0)) for k in range(38) for y in (30.0, 47.0, 90.0, 107.0)]
    turned = [Car(c.position, lambda t: np.pi / 2, c.body, c.glass, c.mark, c.length, c.width) for c in parked]
    return [*turned, car(rng, (20.0, 68.0), (30.0, 0.0)), car(rng, (460.0, 68.0), (-40.0, 0.0))]


def queue_at_red(rng: np.random.Generator) -> list[Car]:
    """A queue 24 px apart that stands, then starts one car after the other; the oncoming lane flows past it."""

    def starter(k: int) -> Car:
        begin, x0 = 0.8 + 0.5 * k, 300.0 - 24.0 * k

        def position(t: float) -> tuple[float, float]:
            s = max(t - begin, 0.0)
            up = min(s, 6.0)
            return x0 + 0.5 * 9.0 * up**2 + 54.0 * (s - up), 60.0

        return Car(position, lambda t: 0.0, *appearance(rng))

    flow = [car(rng, (x, 72.0), (-60.0, 0.0)) for x in np.cumsum(rng.uniform(26, 90, 20)) - 50]
    return [starter(k) for k in range(12)] + flow


def platoon(
    rng: np.random.Generator, *, speed_px_per_s: float = 60.0, spacing_px: float = 25.0, similarity: float = 0.0
) -> list[Car]:
    """Cars at one spacing and one speed: each linked to the one behind is as smooth a motion as the true one."""
    return [
        car(rng, (x, 60.0), (speed_px_per_s, 0.0), similarity=similarity)
        for x in spacing_px * np.arange(40) - 25.0 * 25
    ]


def crossing(rng: np.random.Generator) -> list[Car]:
    """Two streams that cross, and cars that turn from one into the other on a circle of 30 px."""
    across = [car(rng, (x, 60.0), (55.0, 0.0)) for x in np.cumsum(rng.uniform(25, 70, 20)) - 500]
    down = [car(rng, (240.0, y), (0.0, 55.0)) for y in np.cumsum(rng.uniform(25, 70, 20)) - 500]

    def turner(delay: float) -> Car:
        def phase(t: float) -> float:
            return float(np.clip((t - delay) * 30.0 / 30.0, 0.0, np.pi / 2))

        def position(t: float) -> tuple[float, float]:
            a, before, after = phase(t), min(t - delay, 0.0) * 30, max(t - delay - np.pi / 2, 0.0) * 30
            return 260 + before + 30 * np.sin(a), 84 + 30 * (1 - np.cos(a)) + after

        return Car(position, phase, *appearance(rng))

    return across + down + [turner(d) for d in (0.5, 1.6, 2.7)]


SCENES: dict[str, Callable[[np.random.Generator], list[Car]]] = {
    "two lanes opposed": two_lanes_opposed,
    "dense car park": dense_car_park,
    "queue at red": queue_at_red,
    "platoon": platoon,
    "crossing": crossing,
}


def together(*ends: TrackEnds) -> TrackEnds:
    """The ends of several tracks in one table."""
    names = ("frame", "time_s", "position_m", "velocity_m_per_s")
    return TrackEnds(*(np.concatenate([getattr(one, name) for one in ends]) for name in names))
