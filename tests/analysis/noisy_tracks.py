"""True tracks of simulated traffic with white or lasting errors: a signal of 28 s, 380 vehicles in 140 s."""

from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from schemas.arrays import FloatArray, IntArray
from schemas.simulation import SimulationConfig, TrafficSimulation
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import make_trajectories, moving
from velfield.synthetic.flight import Flight
from velfield.synthetic.observed import NO_ERRORS, observed_detections
from velfield.tracking.smoothing import clean_tracks

CYCLE_S, GSD_M = 28.0, 0.23


@dataclass(frozen=True)
class Noise:
    """Errors along each axis: white, and lasting over ``lasts_s`` (an Ornstein-Uhlenbeck process, or jumps)."""

    white_m: float = 0.0
    lasting_m: float = 0.0
    lasts_s: float = 1.0
    jumps: bool = False


@dataclass(frozen=True)
class TrueTracks:
    """True positions (m, 2), their times, and the first row of each vehicle."""

    first: IntArray
    time_s: FloatArray
    xy_m: FloatArray


@cache
def flight(seed: int, seconds: float) -> Flight:
    """A flight at 5 frames a second over a crossroads with a signal."""
    traffic = TrafficSimulation(cycle_s=CYCLE_S)
    return Flight(
        SimulationConfig(seed=seed, frames=round(5 * seconds), width=1300, height=1000, gsd_m=GSD_M, traffic=traffic)
    )


@cache
def driven(seed: int = 913, seconds: float = 140.0) -> TrueTracks:
    """True tracks of one flight."""
    made = flight(seed, seconds)
    rng = np.random.default_rng(seed)
    observe = partial(observed_detections, shape=made.base_shape, rng=rng, errors=NO_ERRORS)
    table = observe(made.city.traffic, made.times_s, made.city.to_px)
    table = table.sort_values(["vehicle_id", "frame"], kind="stable")
    owner = table["vehicle_id"].to_numpy()
    first = np.r_[0, np.flatnonzero(np.diff(owner)) + 1, len(owner)].astype(np.int64)
    time_s = table["time_s"].to_numpy(np.float64)
    return TrueTracks(first, time_s - time_s.min(), table[["x_px", "y_px"]].to_numpy(np.float64) * GSD_M)


def clip(tracks: TrueTracks, begin_s: float, end_s: float) -> TrueTracks:
    """The tracks between two times."""
    keep = (tracks.time_s >= begin_s) & (tracks.time_s < end_s)
    owner = np.repeat(np.arange(len(tracks.first) - 1), np.diff(tracks.first))[keep]
    first = np.r_[0, np.flatnonzero(np.diff(owner)) + 1, len(owner)].astype(np.int64)
    return TrueTracks(first, tracks.time_s[keep], tracks.xy_m[keep])


def add_noise(tracks: TrueTracks, noise: Noise, *, seed: int) -> FloatArray:
    """Positions (m, 2) with errors."""
    rng = np.random.default_rng(seed)
    n = len(tracks.time_s)
    out = tracks.xy_m + noise.white_m * rng.normal(size=(n, 2))
    if not noise.lasting_m:
        return out
    new = np.zeros(n, bool)
    new[tracks.first[:-1]] = True
    drawn, last = rng.normal(size=(n, 2)), np.zeros((n, 2))
    slot = np.floor(tracks.time_s / noise.lasts_s)
    for i in range(n):
        if new[i]:
            last[i] = drawn[i]
        elif noise.jumps:
            last[i] = drawn[i] if slot[i] != slot[i - 1] else last[i - 1]
        else:
            a = np.exp(-(tracks.time_s[i] - tracks.time_s[i - 1]) / noise.lasts_s)
            last[i] = a * last[i - 1] + np.sqrt(1 - a**2) * drawn[i]
    return np.asarray(out + noise.lasting_m * last)


def analyse(tracks: TrueTracks, noise: Noise, *, seed: int = 0) -> TrafficAnalysis:
    """The analysis of tracks with errors, as `velfield analyse --tracks` makes it."""
    owner = np.repeat(np.arange(len(tracks.first) - 1), np.diff(tracks.first))
    clean = clean_tracks(owner, tracks.time_s, add_noise(tracks, noise, seed=seed))
    frame = np.round(5 * tracks.time_s).astype(np.int64)
    made = make_trajectories(
        clean.track, frame, tracks.time_s, clean.xy_m, gsd_m=GSD_M, position_sd_m=clean.position_sd_m
    )
    return TrafficAnalysis(moving(made))
