"""Tracklets of simulated traffic without rendering: true trajectories with the pipeline's errors.

Rendering a frame takes a second, simulating an hour of traffic as long as ten frames: for the long-run traffic that
intervals are compared with, and for fields of the size of a long flight.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray
from schemas.tables import TRACKLET_COLUMNS
from velfield.synthetic.traffic.traffic import STEP_S, Traffic
from velfield.tracking.joins import assign_tracks

_MAX_INTERVAL_S = 0.45


@dataclass(frozen=True)
class Errors:
    """Errors of the pipeline; the defaults were measured on rendered simulated flights."""

    recall: float = 0.97
    """Probability that a vehicle is detected, independently in each frame."""
    position_sd_px: float = 0.8
    """Standard deviation of a detection's position along one axis, base px."""
    displacement_sd_px: float = 0.09
    claimed_sd_px: float = 0.13
    """Standard deviation of an aligned link's displacement along one axis, and the one that the alignment reports."""
    unaligned_fraction: float = 0.05
    """Fraction of links whose crops do not align, with the displacement of the detections."""


NO_ERRORS = Errors(recall=1.0, position_sd_px=0.0, displacement_sd_px=0.0, claimed_sd_px=0.0, unaligned_fraction=0.0)


def observed_tracklets(
    traffic: Traffic,
    times_s: FloatArray,
    to_px: Callable[[FloatArray], FloatArray],
    *,
    shape: tuple[int, int],
    rng: np.random.Generator,
    errors: Errors = Errors(),
) -> pd.DataFrame:
    """Tracklets of all vehicles within a (height, width) base image, one for each window of three frames.

    ``times_s`` (frames,) are those of the frames; ``to_px`` maps plan metres (n, 2) to base pixels. The table has
    `schemas.tables.TRACKLET_COLUMNS`; the low 20 bits of a detection's id are the vehicle's number.
    """
    vehicle, frame, true, position = _detected(traffic, times_s, to_px, shape, rng, errors)
    moved, sd = _displacements(true, position, errors, rng)
    # rows are sorted by vehicle, then frame: a window is three rows of one vehicle in consecutive frames
    step = (np.diff(vehicle) == 0) & (np.diff(frame) == 1) & (np.diff(times_s[frame]) <= _MAX_INTERVAL_S)
    start = np.flatnonzero(step[:-1] & step[1:])
    columns: dict[str, NDArray[np.generic]] = {}
    for k in range(3):
        rows = start + k
        columns[f"frame_{k}"], columns[f"time_{k}_s"] = frame[rows], times_s[frame[rows]]
        columns[f"detection_id_{k}"] = (frame[rows] << 20) + vehicle[rows]
        columns[f"x_{k}_px"], columns[f"y_{k}_px"] = position[rows].T
    for k, link in ((0, "01"), (1, "12")):
        rows = start + k
        interval = times_s[frame[rows + 1]] - times_s[frame[rows]]
        columns[f"vx_{link}_px_per_s"], columns[f"vy_{link}_px_per_s"] = (moved[rows] / interval[:, None]).T
        columns[f"displacement_sd_{link}_px"] = sd[rows]
        columns[f"sad_{link}"] = np.full(len(rows), np.nan)
    columns["confidence"] = np.ones(len(start))
    columns["tracklet_id"] = columns["detection_id_1"]
    ids = np.stack([columns[f"detection_id_{k}"] for k in range(3)], axis=1).astype(np.int64)
    columns["track_id"] = assign_tracks(ids)
    return pd.DataFrame({name: columns[name].astype(kind) for name, kind in TRACKLET_COLUMNS.items()})


def observed_detections(
    traffic: Traffic,
    times_s: FloatArray,
    to_px: Callable[[FloatArray], FloatArray],
    *,
    shape: tuple[int, int],
    rng: np.random.Generator,
    errors: Errors = Errors(),
) -> pd.DataFrame:
    """Detections by frame: ``frame, time_s, x_px, y_px, vehicle_id``; parameters as in `observed_tracklets`."""
    vehicle, frame, _, position = _detected(traffic, times_s, to_px, shape, rng, errors)
    columns = {"frame": frame, "time_s": times_s[frame], "x_px": position[:, 0], "y_px": position[:, 1]}
    return pd.DataFrame({**columns, "vehicle_id": vehicle}).sort_values("frame", kind="stable", ignore_index=True)


def _detected(
    traffic: Traffic,
    times_s: FloatArray,
    to_px: Callable[[FloatArray], FloatArray],
    shape: tuple[int, int],
    rng: np.random.Generator,
    errors: Errors,
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Vehicle, frame, true position and detected position (n, 2) of every detection, by vehicle, then frame."""
    vehicle, frame = _appearances(traffic, times_s)
    true = to_px(traffic.at(vehicle, times_s[frame])[0])
    inside = (true >= 0).all(axis=1) & (true <= np.array(shape[::-1]) - 1).all(axis=1)
    detected = inside & (rng.uniform(size=len(frame)) < errors.recall)
    vehicle, frame, true = vehicle[detected], frame[detected], true[detected]
    return vehicle, frame, true, true + rng.normal(0, 1, true.shape) * errors.position_sd_px


def _appearances(traffic: Traffic, times_s: FloatArray) -> tuple[IntArray, IntArray]:
    """(vehicle, frame) of every vehicle on the road in every frame, sorted."""
    begin = traffic.start_step * STEP_S
    end = begin + (np.diff(traffic.first) - 1) * STEP_S
    low, high = np.searchsorted(times_s, begin), np.searchsorted(times_s, end)
    count = np.maximum(high - low, 0)
    vehicle = np.repeat(np.arange(len(traffic)), count)
    frame = np.arange(len(vehicle)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(low, count)
    return vehicle, frame


def _displacements(
    true: FloatArray, position: FloatArray, errors: Errors, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Displacement (n, 2) from each row to the next and its reported standard deviation (n,); the last row's is
    zero."""
    aligned = np.zeros_like(true)
    aligned[:-1] = np.diff(true, axis=0) + rng.normal(0, 1, (len(true) - 1, 2)) * errors.displacement_sd_px
    plain = np.zeros_like(true)
    plain[:-1] = np.diff(position, axis=0)
    unaligned = rng.uniform(size=len(true)) < errors.unaligned_fraction
    sd = np.where(unaligned, np.sqrt(2) * errors.position_sd_px, errors.claimed_sd_px)
    return np.where(unaligned[:, None], plain, aligned), sd
