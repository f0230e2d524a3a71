"""Ground truth of a simulated flight, in memory or in ``truth/``: transforms, cars, lanes."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import KDTree

from schemas.arrays import FloatArray
from velfield.errors import InputError
from velfield.synthetic.camera import Camera, Waves
from velfield.synthetic.city.relief import Relief
from velfield.synthetic.flight import Flight

CAR_COLUMNS: dict[str, str] = {
    "frame": "int32",
    "vehicle_id": "int64",
    "time_s": "float64",  # exposure time of the row that shows the car; x, y and the velocity are of this time
    "x_raw_px": "float64",  # its centre on the ground
    "y_raw_px": "float64",
    "x_base_px": "float64",
    "y_base_px": "float64",
    "orientation_rad": "float64",  # axial, in [0, pi), in the base image
    "direction_rad": "float64",
    "vx_px_per_s": "float64",  # base pixels
    "vy_px_per_s": "float64",
    "length_px": "float64",  # base pixels
    "width_px": "float64",
    "moving": "bool",  # faster than 0.5 m/s
    "visible": "bool",  # its centre is within the frame and not occluded by a building or a tree
}
"""Columns of ``truth/cars.parquet``: every vehicle in every frame, also beyond the frame's border."""

LANE_WIDTH_M = 3.5
_RENAMED = {"place_px": "position_px"}
"""Keys of ``truth/camera.json`` of flights simulated by the release before, and their names now."""


@dataclass(frozen=True)
class LanePath:
    """The centre line of a lane: ``path_px`` (n, 2) base px in the direction of travel; its limit in base px/s."""

    kind: str
    path_px: FloatArray
    limit_px_per_s: float


@dataclass(frozen=True)
class Truth:
    """The ground truth of one flight."""

    camera: Camera
    times_s: FloatArray
    gsd_m: float
    base_shape: tuple[int, int]
    cars: pd.DataFrame
    lanes: list[LanePath]

    def to_base(self, frame: int, xy_raw: FloatArray) -> FloatArray:
        """Raw pixels (n, 2) of a frame -> base pixels (n, 2), exact."""
        return self.camera.to_base(frame, xy_raw)

    def direction_error_rad(self, xy: FloatArray, direction_rad: FloatArray) -> FloatArray:
        """Angle between directions (n,) at base pixels (n, 2) and the closest direction of a lane there, rad.

        pi where no lane is within half a lane's width and half a metre. A lane's direction is that of its centre line
        at the nearest point.
        """
        error = np.full(len(xy), np.pi)
        reach_px = max(round((LANE_WIDTH_M + 1.0) / self.gsd_m), 1) / 2
        for lane in self.lanes:
            _lower_errors(lane.path_px, reach_px, xy, direction_rad, error)
        return error


def make_truth(flight: Flight) -> Truth:
    """The ground truth of a flight in memory."""
    cars = pd.concat([flight.cars(frame) for frame in range(flight.config.frames)], ignore_index=True)
    lanes = [
        LanePath(edge.kind, flight.city.to_px(edge.path), edge.speed_m_per_s / flight.config.gsd_m)
        for edge in flight.city.plan.road_network.edges
    ]
    cars = cars.astype(CAR_COLUMNS)
    return Truth(flight.camera, flight.times_s, flight.config.gsd_m, flight.base_shape, cars, lanes)


def save_truth(truth: Truth, folder: Path) -> None:
    """Write ``cars.parquet``, ``camera.json``, ``lanes.json`` into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    truth.cars.to_parquet(folder / "cars.parquet", index=False)
    record = {"gsd_m": truth.gsd_m, "base_shape": list(truth.base_shape), "camera": _camera_record(truth.camera)}
    (folder / "camera.json").write_text(json.dumps(record), encoding="utf-8")
    lanes = [
        {"kind": lane.kind, "limit_px_per_s": lane.limit_px_per_s, "path_px": np.round(lane.path_px, 3).tolist()}
        for lane in truth.lanes
    ]
    (folder / "lanes.json").write_text(json.dumps(lanes), encoding="utf-8")


def load_truth(folder: Path) -> Truth:
    """Read the ground truth of a simulated flight: ``folder`` is the flight's folder or its ``truth/``.

    Raises
    ------
    InputError
        There is none.
    """
    inner = folder / "truth" if (folder / "truth").is_dir() else folder
    if not (inner / "camera.json").is_file():
        raise InputError(f"{folder} holds no truth/camera.json; make a flight with `velfield simulate {folder}`")
    record = json.loads((inner / "camera.json").read_text(encoding="utf-8"))
    lanes = [
        LanePath(lane["kind"], np.array(lane["path_px"]), lane["limit_px_per_s"])
        for lane in json.loads((inner / "lanes.json").read_text(encoding="utf-8"))
    ]
    camera = _camera_from(record["camera"])
    height, width = record["base_shape"]
    cars = pd.read_parquet(inner / "cars.parquet")
    return Truth(camera, camera.times_s, record["gsd_m"], (height, width), cars, lanes)


def _camera_record(camera: Camera) -> dict[str, Any]:
    record: dict[str, Any] = {}
    for name, value in vars(camera).items():
        if isinstance(value, Waves | Relief):
            record[name] = {key: array.tolist() for key, array in vars(value).items()}
        else:
            record[name] = value.tolist() if isinstance(value, np.ndarray) else value
    return record


def _camera_from(record: dict[str, Any]) -> Camera:
    values = {_RENAMED.get(name, name): value for name, value in record.items()}
    for name, kind in (("motion", Waves), ("shake", Waves), ("relief", Relief)):
        values[name] = kind(**{key: np.array(array) for key, array in record[name].items()})
    for name in ("position_px", "times_s", "lens_terms"):
        values[name] = np.array(values.get(name, ()), dtype=np.float64)
    return Camera(**values)


def _lower_errors(path: FloatArray, reach: float, xy: FloatArray, direction_rad: FloatArray, error: FloatArray) -> None:
    """Lower ``error`` (n,) in place to the angle to a lane's direction where it is smaller, within ``reach`` of it."""
    around = np.flatnonzero(((xy > path.min(axis=0) - reach) & (xy < path.max(axis=0) + reach)).all(axis=1))
    step = np.diff(path, axis=0)
    length = np.hypot(*step.T)
    step, start, length = step[length > 0], path[:-1][length > 0], length[length > 0]
    pieces = np.repeat(np.arange(len(step)), np.ceil(length).astype(int))
    along = (np.arange(len(pieces)) - np.searchsorted(pieces, pieces) + 0.5) / np.ceil(length)[pieces]
    paths = KDTree(start[pieces] + along[:, None] * step[pieces])
    gap, nearest = (np.atleast_1d(found) for found in paths.query(xy[around]))
    near = gap <= reach
    here, heading = around[near], np.arctan2(*step[pieces[nearest[near]]].T[::-1])
    error[here] = np.minimum(error[here], np.abs(np.angle(np.exp(1j * (direction_rad[here] - heading)))))
