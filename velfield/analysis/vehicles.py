"""Vehicles: one row a track, and whether it is part of the traffic.

A detector finds parked cars as well as those that drive. The traffic distinguishes them from a car that waits: where
vehicles drive along its axis, ahead of it, behind it or over its place at another time, it stands in a lane. So it does
where another came up behind it and stopped: the head of a queue that stands for all of a short clip.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray, IntArray, Mask
from schemas.flight import STATIONARY_SPEED_M_PER_S, assumed_gsd_m
from velfield.tracking.doubtful import MOVED_M, end_means

STATES = ("moving", "stopped", "parked")
"""``moving``: at some time; ``stopped``: never, but in a lane that others drive or queue in; ``parked``: never, and in
none, or no vehicle at all."""
SURE_SCORE = 0.15
"""Of the parked ones with this mean score, by the shipped network, or more, 15 of 18 in a frame of a clip of 1080p are
vehicles, and 83 of 83 in a simulated city; of those with less 24 of 58, and 2 of 7."""
_MOVED_SIGMAS = 4.0
"""A shorter one counts where it is so many standard deviations, at more than a stationary vehicle's speed."""
_CELL_M, _SECTOR_RAD = 0.5, np.pi / 12
"""Sides of the cells and sectors of axial direction in which driven lanes are noted."""
_REACH_M, _HALF_WIDTH_M = 8.0, 1.0
"""A lane is looked for so far ahead and behind, and to either side: parked cars stand 2 m and more beside it."""
_QUEUE_M = (2.5, 10.0)
"""Least and largest distance between the middles of two vehicles of a queue: two bicycles; a car behind a bus."""
_QUEUE_RAD = np.radians(20)
"""Their axes differ by less."""
_QUEUE_S = 1.0
"""Neither is missed for longer at the time when the other is seen."""
_DRIVEN_FRACTION = 0.4
"""Minimum fraction of that length that others drove, for a stationary vehicle to be in a lane."""


VEHICLE_COLUMNS = (
    *("track_id", "displacement_sd_01_px", "displacement_sd_12_px"),
    *(f"{name}_{k}{unit}" for k in range(3) for name, unit in (("time", "_s"), ("x", "_px"), ("y", "_px"))),
    *(f"{name}_{k}" for k in range(3) for name in ("frame", "detection_id")),
)
"""Columns of tracklets that `find_vehicles` reads."""


def count_states(vehicles: pd.DataFrame) -> dict[str, float]:
    """Number of vehicles (`find_vehicles`) in each of `STATES`; ``parked_sure``: parked, with `SURE_SCORE` or more."""
    counts = {name: float((vehicles["state"] == name).sum()) for name in STATES}
    sure = (vehicles["state"] == "parked") & (vehicles["score"] >= SURE_SCORE)
    return {**counts, "parked_sure": float(sure.sum())}


def find_vehicles(tracklets: pd.DataFrame, detections: pd.DataFrame, *, gsd_m: float | None) -> pd.DataFrame:
    """One row a track.

    Parameters
    ----------
    tracklets
        `VEHICLE_COLUMNS`.
    detections
        ``schemas.tables.DETECTION_COLUMNS``: ``detection_id``, ``orientation_rad`` and ``score`` are read.
    gsd_m
        Metres a base pixel; None: the paper's.

    Returns
    -------
    DataFrame
        ``track_id, first_frame, last_frame, first_time_s, last_time_s, detections`` (their number), ``x_px, y_px``
        (median position), ``orientation_rad`` (axial, NaN where unknown), ``displacement_m`` (from the first positions
        to the last), ``state`` (of `STATES`), ``score`` (mean of its detections); by ``track_id``.
    """
    metres = assumed_gsd_m(gsd_m)
    positions = _track_positions(tracklets, detections)
    groups = positions.groupby("track_id", sort=True)
    table = groups.agg(
        first_frame=("frame", "first"),
        last_frame=("frame", "last"),
        first_time_s=("time_s", "first"),
        last_time_s=("time_s", "last"),
        detections=("frame", "size"),
        x_px=("x_px", "median"),
        y_px=("y_px", "median"),
        cos=("cos", "mean"),
        sin=("sin", "mean"),
        score=("score", "mean"),
        last_cos=("cos", "last"),
        last_sin=("sin", "last"),
    ).reset_index()
    ends = end_means(positions, last=True)
    between = (ends - end_means(positions, last=False)).to_numpy(np.float64)
    displacement_m = np.hypot(between[:, 1], between[:, 2]) * metres
    sd_m = _position_sd_px(tracklets, table["track_id"].to_numpy()) * metres
    speed = displacement_m / np.maximum(between[:, 0], 1e-9)
    surely = (displacement_m > _MOVED_SIGMAS * sd_m) & (speed > STATIONARY_SPEED_M_PER_S)
    moving = (displacement_m > MOVED_M) | surely
    twice = (table[[f"{when}cos", f"{when}sin"]].to_numpy(np.float64) for when in ("", "last_"))
    axis, last_axis = (np.mod(np.arctan2(two[:, 1], two[:, 0]) / 2, np.pi) for two in twice)
    driven = _DrivenLanes.of(tracklets[np.isin(tracklets["track_id"], table["track_id"][moving])], metres)
    standing = _Standing(
        table.loc[~moving, ["x_px", "y_px"]].to_numpy(np.float64) * metres,
        axis[~moving],
        table.loc[~moving, ["first_time_s", "last_time_s"]].to_numpy(np.float64),
    )
    queue = standing.ahead_of(
        ends.loc[moving, ["x_px", "y_px"]].to_numpy(np.float64) * metres,
        _along(last_axis[moving], between[moving, 1:]),
        table.loc[moving, "last_time_s"].to_numpy(np.float64),
    )
    in_lane = queue | (driven.along(standing.xy_m, standing.axis_rad) >= _DRIVEN_FRACTION)
    state = np.full(len(table), STATES[0], object)
    state[~moving] = np.where(in_lane, STATES[1], STATES[2])
    return table.drop(columns=["cos", "sin", "last_cos", "last_sin"]).assign(
        orientation_rad=axis, displacement_m=displacement_m, state=pd.Categorical(state, STATES)
    )


def _track_positions(tracklets: pd.DataFrame, detections: pd.DataFrame) -> pd.DataFrame:
    """Every detection of every track once, in time order; ``cos`` and ``sin`` are of twice the axial orientation."""
    names = ("frame_{}", "time_{}_s", "detection_id_{}", "x_{}_px", "y_{}_px")
    parts = [
        tracklets[["track_id", *(name.format(k) for name in names)]].set_axis(
            ["track_id", "frame", "time_s", "detection_id", "x_px", "y_px"], axis=1
        )
        for k in range(3)
    ]
    positions = pd.concat(parts, ignore_index=True).drop_duplicates("detection_id").sort_values("frame", kind="stable")
    seen = detections.set_index("detection_id")[["orientation_rad", "score"]].reindex(positions["detection_id"])
    doubled = 2 * seen["orientation_rad"].to_numpy()
    return positions.assign(cos=np.cos(doubled), sin=np.sin(doubled), score=seen["score"].to_numpy(np.float64))


def _position_sd_px(tracklets: pd.DataFrame, ids: IntArray) -> FloatArray:
    """Standard deviation of a displacement within each track: the median of its links'."""
    links = tracklets[["displacement_sd_01_px", "displacement_sd_12_px"]].mean(axis=1)
    return links.groupby(tracklets["track_id"]).median().reindex(ids).to_numpy(np.float64)


def _along(axis_rad: FloatArray, way: FloatArray) -> FloatArray:
    """Unit vectors (n, 2) of axes (n,), of the sense that agrees with ways (n, 2)."""
    u = np.column_stack([np.cos(axis_rad), np.sin(axis_rad)])
    return np.asarray(u * np.where((u * way).sum(1) < 0, -1.0, 1.0)[:, None])


@dataclass(frozen=True)
class _Standing:
    """Vehicles that never move: where (n, 2), how they stand (n,), and when they are first and last seen (n, 2)."""

    xy_m: FloatArray
    axis_rad: FloatArray
    seen_s: FloatArray

    def ahead_of(self, xy_m: FloatArray, course: FloatArray, time_s: FloatArray) -> Mask:
        """Whether each (n,) stands ahead of a vehicle that came up behind it, or of one that does.

        Parameters
        ----------
        xy_m, course, time_s
            (k, 2) where vehicles that moved were last, (k, 2) unit vectors of where they look, and (k,) when.
        """
        found = np.zeros(len(self.xy_m), bool)
        if not len(found):
            return found
        tree = cKDTree(self.xy_m)
        while len(xy_m):
            near = cKDTree(xy_m).sparse_distance_matrix(tree, _QUEUE_M[1], output_type="ndarray")
            behind, ahead = near["i"], near["j"]
            step, u = self.xy_m[ahead] - xy_m[behind], _along(self.axis_rad[ahead], course[behind])
            along, across = (step * u).sum(1), np.abs(step[:, 0] * u[:, 1] - step[:, 1] * u[:, 0])
            joined = (along > _QUEUE_M[0]) & (across < _HALF_WIDTH_M) & ~found[ahead]
            joined &= (u * course[behind]).sum(1) > np.cos(_QUEUE_RAD)
            joined &= self.seen_s[ahead, 0] <= time_s[behind] + _QUEUE_S
            joined &= time_s[behind] - _QUEUE_S <= self.seen_s[ahead, 1]
            ahead, first = np.unique(ahead[joined], return_index=True)
            found[ahead] = True
            xy_m, course, time_s = self.xy_m[ahead], u[joined][first], time_s[behind[joined][first]]
        return found


@dataclass(frozen=True)
class _DrivenLanes:
    """Cells in which vehicles drove, with the sector of their axis: sorted keys."""

    keys: IntArray

    @classmethod
    def of(cls, tracklets: pd.DataFrame, metres: float) -> "_DrivenLanes":
        """Driven lanes by the tracklets of moving vehicles: their paths in steps of a cell."""
        keys = [np.empty(0, np.int64)]
        for k in (0, 1):
            start, end = (tracklets[[f"x_{j}_px", f"y_{j}_px"]].to_numpy(np.float64) * metres for j in (k, k + 1))
            length = np.hypot(*(end - start).T)
            steps = np.ceil(length / _CELL_M).astype(np.int64)
            row = np.repeat(np.arange(len(start)), steps)
            step = np.arange(len(row)) - np.repeat(np.cumsum(steps) - steps, steps)
            fraction = ((step + 0.5) / np.maximum(steps[row], 1))[:, None]
            axis = np.arctan2(*(end - start).T[::-1])
            keys.append(np.unique(_key(start[row] + fraction * (end - start)[row], _sector(axis[row]))))
        return cls(np.unique(np.concatenate(keys)))

    def along(self, xy_m: FloatArray, axis_rad: FloatArray) -> FloatArray:
        """Fraction (n,) of the line through each position along its axis that others drove, in its direction."""
        ahead = np.arange(-_REACH_M, _REACH_M + _CELL_M / 2, _CELL_M)
        aside = np.arange(-_HALF_WIDTH_M, _HALF_WIDTH_M + _CELL_M / 2, _CELL_M)
        driven = np.zeros((len(xy_m), len(ahead)), bool)
        known = np.nan_to_num(axis_rad)
        direction = np.column_stack([np.cos(known), np.sin(known)])
        normal = direction[:, ::-1] * [-1.0, 1.0]
        for offset in aside:
            places = xy_m[:, None] + ahead[:, None] * direction[:, None] + offset * normal[:, None]
            for turn in (-1, 0, 1):
                sector = np.mod(_sector(known) + turn, _SECTORS)
                driven |= self._holds(_key(places, sector[:, None]))
        return np.where(np.isfinite(axis_rad), driven.mean(axis=1), 0.0)

    def _holds(self, keys: IntArray) -> Mask:
        if not len(self.keys):
            return np.zeros(keys.shape, bool)
        where = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.asarray(self.keys[where] == keys)


_SECTORS = round(np.pi / _SECTOR_RAD)


def _sector(axis_rad: FloatArray) -> IntArray:
    return np.asarray(np.mod(np.round(axis_rad / _SECTOR_RAD), _SECTORS), np.int64)


def _key(xy_m: FloatArray, sector: IntArray) -> IntArray:
    """One number for a cell and a sector; cells of a flight lie within a million of zero."""
    cell = np.floor(xy_m / _CELL_M).astype(np.int64) + (1 << 20)
    return np.asarray((cell[..., 1] << 21 | cell[..., 0]) * _SECTORS + sector, np.int64)
