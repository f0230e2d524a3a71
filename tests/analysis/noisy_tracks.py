"""True tracks of simulated traffic with white or lasting errors: a signal of 28 s, 380 vehicles in 140 s."""

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from schemas.arrays import FloatArray, IntArray, Mask
from schemas.simulation import SimulationConfig, TrafficSimulation
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import make_trajectories, moving
from velfield.synthetic.flight import Flight
from velfield.synthetic.observed import NO_ERRORS, observed_detections
from velfield.synthetic.traffic.traffic import Traffic
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
    """True positions (m, 2), their frames and times, the first row of each vehicle (n + 1,), and its number (n,)."""

    first: IntArray
    frame: IntArray
    time_s: FloatArray
    xy_m: FloatArray
    vehicle: IntArray

    @property
    def owner(self) -> IntArray:
        """(m,) number of the track of each position."""
        return np.repeat(np.arange(len(self.vehicle)), np.diff(self.first))

    def select(self, rows: Mask) -> "TrueTracks":
        """The tracks of some positions (m,)."""
        owner = self.owner[rows]
        begin = np.flatnonzero(np.diff(owner, prepend=-1))
        first = np.r_[begin, len(owner)].astype(np.int64)
        return TrueTracks(first, self.frame[rows], self.time_s[rows], self.xy_m[rows], self.vehicle[owner[begin]])


TRAFFIC = TrafficSimulation(cycle_s=CYCLE_S)


@cache
def flight(seed: int, seconds: float, traffic: TrafficSimulation = TRAFFIC, signals: bool = True) -> Flight:
    """A flight at 5 frames a second over a crossroads, whose axes are on two levels where it has no signal."""
    made = Flight(
        SimulationConfig(seed=seed, frames=round(5 * seconds), width=1300, height=1000, gsd_m=GSD_M, traffic=traffic)
    )
    if not signals:
        edges = made.city.plan.road_network.edges
        edges[:] = [replace(edge, signal=-1) for edge in edges]
    return made


@cache
def driven(seed: int = 913, seconds: float = 140.0) -> TrueTracks:
    """True tracks of one flight."""
    return true_tracks(flight(seed, seconds))


def true_tracks(made: Flight, traffic: Traffic | None = None, times_s: FloatArray | None = None) -> TrueTracks:
    """True tracks of a flight; ``traffic``: of other traffic over its roads, at ``times_s``."""
    observe = partial(observed_detections, shape=made.base_shape, rng=np.random.default_rng(0), errors=NO_ERRORS)
    table = observe(traffic or made.city.traffic, made.times_s if times_s is None else times_s, made.city.to_px)
    table = table.sort_values(["vehicle_id", "frame"], kind="stable")
    owner = table["vehicle_id"].to_numpy()
    first = np.r_[0, np.flatnonzero(np.diff(owner)) + 1, len(owner)].astype(np.int64)
    time_s = table["time_s"].to_numpy(np.float64)
    xy_m = table[["x_px", "y_px"]].to_numpy(np.float64) * GSD_M
    frame = table["frame"].to_numpy(np.int64)
    return TrueTracks(first, frame, time_s - time_s.min(), xy_m, owner[first[:-1]])


def clip(tracks: TrueTracks, begin_s: float, end_s: float) -> TrueTracks:
    """The tracks between two times."""
    return tracks.select((tracks.time_s >= begin_s) & (tracks.time_s < end_s))


def true_numbers(analysis: TrafficAnalysis, true: TrueTracks) -> IntArray:
    """(n,) the true track of each track, by the place and time of its middle: ids may be of pieces."""
    t, owner = analysis.trajectories, true.owner
    order = np.argsort(true.time_s, kind="stable")
    out = np.empty(len(t), np.int64)
    for track, (a, b) in enumerate(zip(t.first[:-1], t.first[1:], strict=True)):
        row = (a + b) // 2
        low, high = np.searchsorted(true.time_s[order], t.time_s[row] + np.array([-1e-6, 1e-6]))
        same = order[low:high]
        out[track] = owner[same[np.argmin(np.hypot(*(true.xy_m[same] - t.xy_m[row]).T))]]
    return out


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


def analyse(
    tracks: TrueTracks, noise: Noise, *, seed: int = 0, lengths_m: FloatArray | None = None, **known: Any
) -> TrafficAnalysis:
    """The analysis of tracks with errors, as `velfield analyse --tracks` makes it; ``lengths_m`` (vehicles,): measured
    lengths, ``known``: what else the analysis is given."""
    owner = tracks.owner
    clean = clean_tracks(owner, tracks.time_s, add_noise(tracks, noise, seed=seed))
    made = make_trajectories(
        clean.track, tracks.frame, tracks.time_s, clean.xy_m, gsd_m=GSD_M, position_sd_m=clean.position_sd_m
    )
    if lengths_m is not None:
        of = tracks.vehicle[np.minimum(made.track_id, len(tracks.vehicle) - 1)]
        made = replace(made, measured_length_m=np.where(made.track_id < len(tracks.vehicle), lengths_m[of], np.nan))
    return TrafficAnalysis(moving(made), **known)
