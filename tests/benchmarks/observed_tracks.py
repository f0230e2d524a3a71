"""Tracks of simulated traffic without rendering, with the errors that tracking makes: cuts, gaps, trees, false tracks.

The traffic itself gets what its model lacks: drivers keep to their own line within the lane.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.synthetic.observed import NO_ERRORS, Errors, observed_detections
from velfield.synthetic.traffic.traffic import Traffic


@dataclass(frozen=True)
class TrackErrors:
    """Errors of tracking.

    Attributes
    ----------
    cuts_per_vehicle
        Mean number of places at which a vehicle's track ends and another begins.
    gap_s
        Mean time that nothing is seen at a cut, s.
    occluders
        Number of trees over the roads, under which nothing is seen.
    occluder_m
        Their radii: least and largest, m.
    cut_by_occluder
        Probability that a track ends under one; otherwise it goes on behind it.
    false_per_minute
        Tracks a minute of what is no vehicle: places that stand and jitter.
    lateral_sd_m
        Standard deviation of drivers' lines across the lane, m.
    """

    cuts_per_vehicle: float = 0.12
    gap_s: float = 0.8
    occluders: int = 6
    occluder_m: tuple[float, float] = (2.0, 5.0)
    cut_by_occluder: float = 0.3
    false_per_minute: float = 6.0
    lateral_sd_m: float = 0.25


def observed_tracks(
    traffic: Traffic,
    times_s: FloatArray,
    to_px: Callable[[FloatArray], FloatArray],
    *,
    shape: tuple[int, int],
    gsd_m: float,
    rng: np.random.Generator,
    errors: Errors = Errors(),  # noqa: B008  # frozen
    tracking: TrackErrors = TrackErrors(),
) -> pd.DataFrame:
    """Positions of tracks: ``track_id, vehicle_id`` (-1: none), ``frame, time_s, x_px, y_px``, and ``dx_px, dy_px``,
    the measured displacement to the track's next position, NaN where there is none.

    Parameters
    ----------
    gsd_m
        Metres a base pixel; the others as in `velfield.synthetic.observed.observed_tracklets`.
    """
    true = observed_detections(traffic, times_s, to_px, shape=shape, rng=rng, errors=NO_ERRORS)
    true = true.sort_values(["vehicle_id", "frame"], kind="stable", ignore_index=True)
    vehicle = true["vehicle_id"].to_numpy(np.int64)
    xy = true[["x_px", "y_px"]].to_numpy(np.float64) + _own_lines(true, rng, tracking.lateral_sd_m / gsd_m)
    piece = _cuts(vehicle, true["time_s"].to_numpy(np.float64), rng, tracking)
    hidden, after_tree = _hide(xy, vehicle, shape, gsd_m, rng, tracking)
    seen = (piece >= 0) & ~hidden & (rng.uniform(size=len(true)) < errors.recall)
    piece = np.maximum(piece, 0) * 1000 + after_tree
    table = true[seen].assign(piece=piece[seen], x_true=xy[seen, 0], y_true=xy[seen, 1])
    _, table["track_id"] = np.unique(table[["vehicle_id", "piece"]].to_numpy(), axis=0, return_inverse=True)
    noise = rng.normal(0, 1, (len(table), 2)) * errors.position_sd_px
    table["x_px"], table["y_px"] = table["x_true"] + noise[:, 0], table["y_true"] + noise[:, 1]
    table = _with_displacements(table, rng, errors)
    table = pd.concat([table, _false_tracks(times_s, shape, table, rng, errors, tracking)], ignore_index=True)
    columns = ["track_id", "vehicle_id", "frame", "time_s", "x_px", "y_px", "dx_px", "dy_px"]
    long = table.groupby("track_id")["frame"].transform("size") >= 3
    return table.loc[long, columns].reset_index(drop=True)


def _own_lines(true: pd.DataFrame, rng: np.random.Generator, sd_px: float) -> FloatArray:
    """Offsets (n, 2) across the direction of travel, one a vehicle."""
    vehicle = true["vehicle_id"].to_numpy(np.int64)
    offset = rng.normal(0, sd_px, int(vehicle.max(initial=0)) + 1)[vehicle]
    step = (
        np.gradient(true[["x_px", "y_px"]].to_numpy(np.float64), axis=0) if len(true) > 1 else np.zeros((len(true), 2))
    )
    length = np.hypot(*step.T)
    moves = (length > 0.05) & (length < 100)
    unit = np.divide(step, length[:, None], out=np.full_like(step, np.nan), where=moves[:, None])
    unit = pd.DataFrame(unit).groupby(vehicle).ffill().groupby(vehicle).bfill().fillna(0.0).to_numpy(np.float64)
    return np.asarray(offset[:, None] * np.column_stack([-unit[:, 1], unit[:, 0]]))


def _cuts(vehicle: IntArray, time_s: FloatArray, rng: np.random.Generator, tracking: TrackErrors) -> IntArray:
    """Number of the piece of its vehicle's track that each row belongs to; -1 in the gap at a cut."""
    piece = np.zeros(len(vehicle), np.int64)
    starts = np.flatnonzero(np.r_[True, np.diff(vehicle) != 0]) if len(vehicle) else np.empty(0, np.int64)
    for a, b in zip(starts, np.r_[starts[1:], len(vehicle)], strict=True):
        for _ in range(rng.poisson(tracking.cuts_per_vehicle)):
            at = int(rng.integers(a, b))
            until = time_s[at] + rng.exponential(tracking.gap_s)
            rows = np.arange(at, b)
            piece[rows] += piece[rows] >= 0
            piece[rows[time_s[rows] < until]] = -1
    return piece


def _hide(
    xy: FloatArray,
    vehicle: IntArray,
    shape: tuple[int, int],
    gsd_m: float,
    rng: np.random.Generator,
    tracking: TrackErrors,
) -> tuple[Mask, IntArray]:
    """Whether a tree hides each row, and how often a tree has ended the track before it."""
    hidden, ended = np.zeros(len(xy), bool), np.zeros(len(xy), np.int64)
    if not len(xy):
        return hidden, ended
    for _ in range(tracking.occluders):
        centre = xy[rng.integers(len(xy))] + rng.normal(0, 4 / gsd_m, 2)
        radius = rng.uniform(*tracking.occluder_m) / gsd_m
        hidden |= np.hypot(*(xy - centre).T) < radius
    leaves = np.flatnonzero(hidden[:-1] & ~hidden[1:] & (vehicle[:-1] == vehicle[1:])) + 1
    ended[leaves] = rng.uniform(size=len(leaves)) < tracking.cut_by_occluder
    total = np.cumsum(ended)
    first = np.r_[0, np.flatnonzero(np.diff(vehicle)) + 1]
    before = (total - ended)[first]
    return hidden, total - np.repeat(before, np.diff(np.r_[first, len(xy)]))


def _with_displacements(table: pd.DataFrame, rng: np.random.Generator, errors: Errors) -> pd.DataFrame:
    """With the aligned displacement to the track's next position; unaligned ones are not known."""
    table = table.sort_values(["track_id", "frame"], kind="stable", ignore_index=True)
    last = (table["track_id"] != table["track_id"].shift(-1)).to_numpy()
    unaligned = last | (rng.uniform(size=len(table)) < errors.unaligned_fraction)
    for axis in "xy":
        true = table[f"{axis}_true"].to_numpy(np.float64)
        moved = np.r_[np.diff(true), 0.0] + rng.normal(0, 1, len(true)) * errors.displacement_sd_px
        table[f"d{axis}_px"] = np.where(unaligned, np.nan, moved)
    return table


def _false_tracks(
    times_s: FloatArray,
    shape: tuple[int, int],
    table: pd.DataFrame,
    rng: np.random.Generator,
    errors: Errors,
    tracking: TrackErrors,
) -> pd.DataFrame:
    """Tracks of what stands and is no vehicle."""
    minutes = float(np.ptp(times_s)) / 60 if len(times_s) else 0.0
    rows = []
    first = int(table["track_id"].max()) + 1 if len(table) else 0
    for k in range(rng.poisson(tracking.false_per_minute * minutes)):
        start = int(rng.integers(len(times_s)))
        frames = np.arange(start, min(start + int(rng.integers(3, 40)), len(times_s)))
        xy = rng.uniform([0, 0], shape[::-1]) + rng.normal(0, 1.5 * errors.position_sd_px, (len(frames), 2))
        rows.append(
            pd.DataFrame(
                {
                    "track_id": first + k,
                    "vehicle_id": -1,
                    "frame": frames,
                    "time_s": times_s[frames],
                    "x_px": xy[:, 0],
                    "y_px": xy[:, 1],
                    "dx_px": np.nan,
                    "dy_px": np.nan,
                }
            )
        )
    return pd.concat(rows, ignore_index=True) if rows else table.iloc[:0]
