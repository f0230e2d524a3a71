"""Scores of a run against the ground truth of a simulated flight.

Without a given base image a run's base pixels are those of another image: ``fit_homography`` fits the homography to the
truth's, and each score takes it as ``to_truth``.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.detection.orientation import axial_difference
from velfield.synthetic.truth import Truth

ToBase = Callable[[int, FloatArray], FloatArray]

MATCH_PX = 8.0
"""Largest distance of a detection from the centre of the car it matches, base px. Paper: half a car's length."""
BORDER_PX = 14.0
"""Cars whose centre is nearer than this to the frame's border are not evaluated, raw px."""
CELL_PX = 64.0
"""Cells in which the constant error is separated from jitter, base px."""


@dataclass(frozen=True)
class RegistrationScore:
    """Errors of the raw-to-base transform, base px, over a grid of points in all registered frames.

    ``jitter_px``: root mean square of the error about its mean over the frames at each position.
    ``drift_px``: change of the mean error from the first tenth of the frames to the last.
    ``answered``: fraction of the points within the base image, of all frames of the flight, for which the run gives a
    position: a frame that is not registered answers nothing.
    """

    mean_px: float
    median_px: float
    p95_px: float
    jitter_px: float
    drift_px: float
    worst_frame_px: float
    frame_mean_px: FloatArray
    frames: int
    answered: float


@dataclass(frozen=True)
class DetectionScore:
    """Detections against cars. Cars cut by the frame's border count neither as missed nor as false positives."""

    precision: float
    recall: float
    f1: float
    recall_moving: float
    position_error_px: float
    axis_error_median_rad: float
    detections: int
    cars: int


@dataclass(frozen=True)
class TrackletScore:
    """Tracklets whose three detections are of one vehicle; their speeds against the truth between the same frames.

    ``precision_on_vehicle``: with detections anywhere along a vehicle, not only near its centre: of a lorry the load
    may be tracked.
    ``tracks_per_vehicle``: mean number of tracks of a vehicle; ideally one.
    """

    precision: float
    precision_moving: float
    precision_on_vehicle: float
    recall_moving: float
    speed_error_mean_km_per_h: float
    speed_bias_km_per_h: float
    direction_error_mean_rad: float
    tracklets: int
    tracks_per_vehicle: float


@dataclass(frozen=True)
class FieldScore:
    """Pixels with enough tracks: their number, and the fraction whose modal direction is within 10 degrees of a lane's.

    ``undirected``: number of further pixels with enough tracks but without a direction (most vehicles are stationary).
    """

    fraction_within: float
    pixels: int
    median_error_rad: float
    undirected: int


def sample_grid(truth: Truth, *, columns: int = 24, rows: int = 18) -> FloatArray:
    """Raw pixels (columns * rows, 2) spread over the frame."""
    x = (np.arange(columns) + 0.5) / columns * truth.camera.width - 0.5
    y = (np.arange(rows) + 0.5) / rows * truth.camera.height - 0.5
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def fit_homography(truth: Truth, to_base: ToBase, frames: list[int] | range) -> FloatArray:
    """The least-squares homography (3, 3) from a run's base pixels to the truth's over a grid in ``frames``."""
    grid = sample_grid(truth, columns=12, rows=9)
    found = np.concatenate([to_base(frame, grid) for frame in frames])
    true = np.concatenate([truth.to_base(frame, grid) for frame in frames])
    good = np.isfinite(found).all(axis=1)
    matrix, _ = cv2.findHomography(found[good], true[good], 0)
    return np.asarray(matrix, dtype=np.float64)


def apply_homography(matrix: FloatArray | None, xy: FloatArray) -> FloatArray:
    """Points (n, 2) transformed by a homography; unchanged if it is None."""
    if matrix is None:
        return xy
    h = np.column_stack([xy, np.ones(len(xy))]) @ matrix.T
    return np.asarray(h[:, :2] / h[:, 2:])


def score_registration(
    truth: Truth,
    to_base: ToBase,
    frames: Sequence[int],
    *,
    asked: Sequence[int] | None = None,
    to_truth: FloatArray | None = None,
) -> RegistrationScore:
    """Score a run's raw-to-base transform over its registered ``frames``, of those ``asked`` for (None: no others).

    Points outside the base image by the truth are not evaluated, nor those where the run gives NaN.
    """
    grid = sample_grid(truth)
    positions, errors, numbers, points = [], [], [], 0
    for frame in frames if asked is None else asked:
        true = truth.to_base(frame, grid)
        inside = (true >= 0).all(axis=1) & (true < truth.base_shape[::-1]).all(axis=1)
        points += int(inside.sum())
        if frame not in frames:
            continue
        error = apply_homography(to_truth, to_base(frame, grid)) - true
        inside &= np.isfinite(error).all(axis=1)
        positions.append(true[inside])
        errors.append(error[inside])
        numbers.append(np.full(int(inside.sum()), frame))
    position, error, number = np.concatenate(positions), np.concatenate(errors), np.concatenate(numbers)
    size = np.hypot(error[:, 0], error[:, 1])
    by_frame = pd.Series(size).groupby(number).mean().to_numpy()
    rest = _deviations(position, error, number)
    return RegistrationScore(
        mean_px=float(size.mean()),
        median_px=float(np.median(size)),
        p95_px=float(np.percentile(size, 95)),
        jitter_px=float(np.sqrt((rest**2).sum(axis=1).mean())),
        drift_px=_drift(rest),
        worst_frame_px=float(by_frame.max()),
        frame_mean_px=np.asarray(by_frame, dtype=np.float64),
        frames=len(by_frame),
        answered=len(size) / points,
    )


def _deviations(position: FloatArray, error: FloatArray, frame: IntArray) -> pd.DataFrame:
    """Errors ex, ey by cell (i, j) and frame, minus the cell's mean over the frames."""
    cell = np.floor(position / CELL_PX).astype(np.int64)
    table = pd.DataFrame({"i": cell[:, 1], "j": cell[:, 0], "frame": frame, "ex": error[:, 0], "ey": error[:, 1]})
    each = table.groupby(["i", "j", "frame"])[["ex", "ey"]].mean()
    return each - each.groupby(["i", "j"]).transform("mean")


def _drift(rest: pd.DataFrame) -> float:
    by_frame = rest.groupby("frame").mean().to_numpy()
    tenth = max(1, len(by_frame) // 10)
    return float(np.hypot(*(by_frame[-tenth:].mean(axis=0) - by_frame[:tenth].mean(axis=0))))


def score_detections(
    truth: Truth,
    detections: pd.DataFrame,
    *,
    frame_of: Mapping[int, int] | None = None,
    to_truth: FloatArray | None = None,
) -> DetectionScore:
    """Score detections (columns frame, x_px, y_px, orientation_rad; base px). ``frame_of``: run's frame -> flight's."""
    matches, n_detections, n_cars, n_moving = [], 0, 0, 0
    for frame, found in detections.groupby("frame"):
        cars = cars_near_frame(truth, flight_frame(frame, frame_of))
        xy = apply_homography(to_truth, found[["x_px", "y_px"]].to_numpy(dtype=np.float64))
        pairs = _match(xy, cars[["x_base_px", "y_base_px"]].to_numpy())
        evaluated = cars["evaluated"].to_numpy()
        ignored = ~evaluated[pairs[:, 1]]
        n_detections += len(xy) - int(ignored.sum())
        n_cars += int(evaluated.sum())
        n_moving += int((evaluated & cars["moving"]).sum())
        pairs = pairs[~ignored]
        here = cars.iloc[pairs[:, 1]]
        rotation = 0.0 if to_truth is None else float(np.arctan2(to_truth[1, 0], to_truth[0, 0]))
        orientation = found["orientation_rad"].to_numpy(dtype=np.float64)[pairs[:, 0]]
        axis = axial_difference(orientation + rotation, here["orientation_rad"].to_numpy())
        position = xy[pairs[:, 0]] - here[["x_base_px", "y_base_px"]].to_numpy()
        matches.append(
            pd.DataFrame({"moving": here["moving"].to_numpy(), "axis": axis, "position": np.hypot(*position.T)})
        )
    table = (
        pd.concat(matches, ignore_index=True) if matches else pd.DataFrame({"moving": [], "axis": [], "position": []})
    )
    precision, recall = len(table) / max(n_detections, 1), len(table) / max(n_cars, 1)
    return DetectionScore(
        precision=precision,
        recall=recall,
        f1=2 * precision * recall / max(precision + recall, 1e-9),
        recall_moving=float(table["moving"].sum()) / max(n_moving, 1),
        position_error_px=float(table["position"].median()),
        axis_error_median_rad=float(table["axis"].median()),
        detections=n_detections,
        cars=n_cars,
    )


def score_tracklets(
    truth: Truth,
    tracklets: pd.DataFrame,
    *,
    frame_of: Mapping[int, int] | None = None,
    to_truth: FloatArray | None = None,
) -> TrackletScore:
    """Score tracklets: correct if all three detections are nearest to one vehicle, within `MATCH_PX` of it."""
    frames = [np.array([flight_frame(f, frame_of) for f in tracklets[f"frame_{k}"]], dtype=np.int64) for k in range(3)]
    positions = [
        apply_homography(to_truth, tracklets[[f"x_{k}_px", f"y_{k}_px"]].to_numpy(np.float64)) for k in range(3)
    ]
    vehicles = np.stack([_nearest_vehicle(truth, f, xy) for f, xy in zip(frames, positions, strict=True)])
    right = _one_vehicle(vehicles)
    touched = [_nearest_vehicle(truth, f, xy, along=True) for f, xy in zip(frames, positions, strict=True)]
    cars = truth.cars.set_index(["frame", "vehicle_id"])
    table = pd.DataFrame({"frame": frames[1], "vehicle_id": vehicles[1]})[right]
    here = cars.loc[pd.MultiIndex.from_frame(table)] if len(table) else cars.iloc[:0]
    moving = here["moving"].to_numpy(dtype=bool)
    v = 0.5 * sum(_velocity(tracklets, name, positions[k], to_truth)[right] for k, name in ((0, "01"), (1, "12")))
    v = np.asarray(v).reshape(-1, 2)
    true = here[["vx_px_per_s", "vy_px_per_s"]].to_numpy()
    to_km_h = truth.gsd_m * 3.6
    fast = moving & (np.hypot(*true.T) * to_km_h > 20)
    speed = (np.hypot(*v.T) - np.hypot(*true.T)) * to_km_h
    direction = np.abs(np.angle(np.exp(1j * (np.arctan2(v[:, 1], v[:, 0]) - np.arctan2(true[:, 1], true[:, 0])))))
    claimed = np.hypot(*_velocity(tracklets, "01", positions[0], to_truth).T) * to_km_h > 5
    triples = _true_triples(truth, list(zip(*frames, strict=True)))
    hit = set(zip(frames[1][right].tolist(), vehicles[1][right].tolist(), strict=True))
    return TrackletScore(
        precision=float(right.mean()) if len(right) else 0.0,
        precision_moving=float(right[claimed].mean()) if claimed.any() else 0.0,
        precision_on_vehicle=float(_one_vehicle(np.stack(touched)).mean()) if len(right) else 0.0,
        recall_moving=len(hit & triples) / max(len(triples), 1),
        speed_error_mean_km_per_h=float(np.abs(speed[moving]).mean()) if moving.any() else 0.0,
        speed_bias_km_per_h=float(speed[moving].mean()) if moving.any() else 0.0,
        direction_error_mean_rad=float(direction[fast].mean()) if fast.any() else 0.0,
        tracklets=len(right),
        tracks_per_vehicle=_tracks_per_vehicle(tracklets["track_id"].to_numpy()[right], vehicles[1][right]),
    )


def _tracks_per_vehicle(track: IntArray, vehicle: IntArray) -> float:
    pairs = np.unique(np.stack([track, vehicle], axis=1), axis=0)
    return len(pairs) / max(len(np.unique(vehicle)), 1)


def score_field(
    truth: Truth,
    modal_velocity: FloatArray,
    count: NDArray[np.integer],
    *,
    to_truth: FloatArray | None = None,
    min_count: int = 5,
    within_rad: float = float(np.radians(10)),
) -> FieldScore:
    """Score a field's modal velocity (h, w, 2), px/s, where ``count`` (h, w) is at least ``min_count``; NaN where it
    has no direction.

    With ``to_truth``, pixels and velocities are carried over to the truth's base image first.
    """
    direction = np.arctan2(modal_velocity[..., 1], modal_velocity[..., 0])
    enough = np.asarray(count) >= min_count
    rows, columns = np.nonzero(enough & np.isfinite(direction))
    position = np.column_stack([columns, rows]).astype(np.float64)
    v = modal_velocity[rows, columns]
    v = v / np.maximum(np.hypot(v[:, 0], v[:, 1])[:, None], 1e-9)
    ahead = apply_homography(to_truth, position + v)
    position = apply_homography(to_truth, position)
    angle = np.arctan2(*(ahead - position).T[::-1])
    errors = _direction_errors(truth, position, angle)
    within = float((errors <= within_rad).mean()) if len(errors) else 0.0
    return FieldScore(
        fraction_within=within,
        pixels=len(errors),
        median_error_rad=float(np.median(errors)) if len(errors) else float("nan"),
        undirected=int((enough & ~np.isfinite(direction)).sum()),
    )


def _direction_errors(truth: Truth, position: FloatArray, angle: FloatArray) -> FloatArray:
    """Direction errors at positions (n, 2), against the lanes at the nearest pixel."""
    h, w = truth.base_shape
    at = np.rint(position)
    inside = ((at >= 0) & (at < [w, h])).all(axis=1)
    errors = np.full(len(position), np.pi)
    errors[inside] = truth.direction_error_rad(at[inside], angle[inside])
    return errors


def flight_frame(frame: object, frame_of: Mapping[int, int] | None) -> int:
    number = int(frame)  # type: ignore[call-overload]
    return number if frame_of is None else frame_of[number]


def cars_near_frame(truth: Truth, frame: int) -> pd.DataFrame:
    """Cars within or near a frame, and whether they are ``evaluated``: visible, and not near its border."""
    cars = truth.cars[truth.cars["frame"] == frame]
    size = [truth.camera.width - 1, truth.camera.height - 1]
    raw = cars[["x_raw_px", "y_raw_px"]].to_numpy()
    deep = (raw > BORDER_PX).all(axis=1) & (raw < np.array(size) - BORDER_PX).all(axis=1)
    near = (raw > -BORDER_PX).all(axis=1) & (raw < np.array(size) + BORDER_PX).all(axis=1)
    evaluated = cars.assign(evaluated=deep & cars["visible"].to_numpy())
    return evaluated.iloc[np.flatnonzero(near)].reset_index(drop=True)


def _match(found: FloatArray, true: FloatArray) -> IntArray:
    """Pairs (n, 2) of indices: the one-to-one assignment of minimum total distance, each within `MATCH_PX`."""
    if not len(found) or not len(true):
        return np.empty((0, 2), dtype=np.int64)
    distance = np.hypot(found[:, None, 0] - true[None, :, 0], found[:, None, 1] - true[None, :, 1])
    a, b = linear_sum_assignment(np.where(distance <= MATCH_PX, distance, 1e6))
    good = distance[a, b] <= MATCH_PX
    return np.column_stack([a[good], b[good]]).astype(np.int64)


def _one_vehicle(vehicles: IntArray) -> Mask:
    """(n,) whether the three positions of a tracklet, (3, n) vehicles or -1, are of one vehicle."""
    return np.asarray((vehicles[0] >= 0) & (vehicles[0] == vehicles[1]) & (vehicles[0] == vehicles[2]))


def _nearest_vehicle(truth: Truth, frame: IntArray, xy: FloatArray, *, along: bool = False) -> IntArray:
    """(n,) the vehicle whose centre, or any position along it, is nearest and within `MATCH_PX`; -1: none."""
    out = np.full(len(xy), -1, dtype=np.int64)
    for f in np.unique(frame):
        cars = truth.cars[truth.cars["frame"] == f]
        here = np.flatnonzero(frame == f)
        if len(cars):
            positions, vehicle = _along(cars) if along else (_centres(cars), cars["vehicle_id"].to_numpy())
            distance, k = cKDTree(positions).query(xy[here])
            out[here] = np.where(distance <= MATCH_PX, vehicle[np.minimum(k, len(vehicle) - 1)], -1)
    return out


def _centres(cars: pd.DataFrame) -> FloatArray:
    return cars[["x_base_px", "y_base_px"]].to_numpy(np.float64)


def _along(cars: pd.DataFrame) -> tuple[FloatArray, IntArray]:
    """Positions (m, 2) along the vehicles, `MATCH_PX` or more from the ends except the centre, and their vehicles."""
    half = np.maximum(cars["length_px"].to_numpy(np.float64) / 2 - MATCH_PX, 0.0)
    steps = np.linspace(-1.0, 1.0, 13)  # 2 px apart on the longest bus
    axis = cars["orientation_rad"].to_numpy(np.float64)
    ahead = np.column_stack([np.cos(axis), np.sin(axis)]) * half[:, None]
    positions = _centres(cars)[:, None] + steps[:, None] * ahead[:, None]
    return positions.reshape(-1, 2), np.repeat(cars["vehicle_id"].to_numpy(), len(steps))


def _velocity(tracklets: pd.DataFrame, part: str, position: FloatArray, to_truth: FloatArray | None) -> FloatArray:
    """Velocities (n, 2) of one segment, px/s, in the truth's base image."""
    v: FloatArray = tracklets[[f"vx_{part}_px_per_s", f"vy_{part}_px_per_s"]].to_numpy(np.float64)
    if to_truth is None:
        return v
    back = apply_homography(np.asarray(np.linalg.inv(to_truth), dtype=np.float64), position)
    ahead = apply_homography(to_truth, back + 0.01 * v)
    return np.asarray((ahead - position) / 0.01)


def _true_triples(truth: Truth, windows: list[tuple[int, int, int]]) -> set[tuple[int, int]]:
    """(middle frame, vehicle) of all moving cars that are evaluated in all three frames of a window."""
    evaluated: dict[int, set[int]] = {}
    moving: dict[int, set[int]] = {}
    out: set[tuple[int, int]] = set()
    for window in set(windows):
        for frame in window:
            if frame not in evaluated:
                cars = cars_near_frame(truth, frame)
                evaluated[frame] = set(cars.loc[cars["evaluated"], "vehicle_id"].tolist())
                moving[frame] = set(cars.loc[cars["evaluated"] & cars["moving"], "vehicle_id"].tolist())
        both = evaluated[window[0]] & evaluated[window[2]] & moving[window[1]]
        out |= {(window[1], vehicle) for vehicle in both}
    return out
