"""Accelerations of vehicles that start and stop, as a check of the frame rate.

An acceleration grows with the square of a wrong frame rate, and people accelerate much alike everywhere: comfort and
tyres set it, not the street. So the median over the vehicles that set off or stop reveals a rate of twice or half the
true one, where a speed, which may be that of a street or of a motorway, does not.
"""

from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray
from velfield.analysis.trajectories import Trajectories

USUAL_M_PER_S2 = 1.7
"""Median of `speed_changes`: 1.5 to 2.1 over simulated flights; of passenger cars at signals, 1 to 2.5 are reported."""
PLAUSIBLE_M_PER_S2 = (0.8, 3.2)
MIN_VEHICLES = 10
_SLOW, _FAST = 0.2, 0.8
"""Fractions of a vehicle's own high speed between which its acceleration is measured."""
_MIN_PATH_M, _MIN_POSITIONS = 8.0, 10
_SPAN_M = 3.0
"""A speed is measured over so long a path at the high speed, whatever the frame rate: errors of positions are below."""
_MAX_LAG = 40


@dataclass(frozen=True)
class TimeCheck:
    """Check of the times by the vehicles' accelerations."""

    vehicles: int
    """How many set off or stop."""
    median_m_per_s2: float
    """Median of `speed_changes`; NaN of fewer than `MIN_VEHICLES`."""

    @property
    def known(self) -> bool:
        """Whether enough vehicles set off or stop."""
        return self.vehicles >= MIN_VEHICLES

    @property
    def plausible(self) -> bool:
        """Whether people drive so; true where it is not known."""
        return not self.known or PLAUSIBLE_M_PER_S2[0] <= self.median_m_per_s2 <= PLAUSIBLE_M_PER_S2[1]

    @property
    def factor(self) -> float:
        """About how many times too high the frame rate is, and with it all speeds."""
        return float(np.sqrt(self.median_m_per_s2 / USUAL_M_PER_S2))


def check_times(trajectories: Trajectories) -> TimeCheck:
    """Compare the accelerations of a flight with those of usual traffic."""
    found = speed_changes(trajectories)
    return TimeCheck(len(found), float(np.median(found)) if len(found) >= MIN_VEHICLES else np.nan)


def speed_changes(trajectories: Trajectories) -> FloatArray:
    """The acceleration with which each vehicle sets off or comes to a stop, m/s2, of those that do.

    It is the mean one between 0.2 and 0.8 of the vehicle's own high speed; of several, the largest counts.

    Returns
    -------
    (n,) of the vehicles in order; those that neither set off nor stop are left out.
    """
    found = [
        change
        for rows in trajectories
        if np.isfinite(change := _largest_change(trajectories.time_s[rows], trajectories.xy_m[rows]))
    ]
    return np.array(found, np.float64)


def _largest_change(time_s: FloatArray, xy_m: FloatArray) -> float:
    """NaN where a track neither sets off nor stops, or is too short to say."""
    if len(time_s) < _MIN_POSITIONS or np.hypot(*np.diff(xy_m, axis=0).T).sum() < _MIN_PATH_M:
        return np.nan
    for lag in range(2, min(_MAX_LAG, len(time_s) - 3), 2):
        duration = time_s[lag:] - time_s[:-lag]
        speed, middle_s = np.hypot(*(xy_m[lag:] - xy_m[:-lag]).T) / duration, (time_s[lag:] + time_s[:-lag]) / 2
        high = float(np.percentile(speed, 90))
        if high * np.median(duration) >= _SPAN_M:
            forth, back = _rises(middle_s, speed, high), _rises(-middle_s[::-1], speed[::-1], high)
            return max([*forth, *back], default=np.nan)
    return np.nan


def _rises(time_s: FloatArray, speed: FloatArray, high: float) -> list[float]:
    """Accelerations from the last moment at a slow speed to the first at a fast one, for each such rise."""
    slow, fast = np.flatnonzero(speed < _SLOW * high), np.flatnonzero(speed > _FAST * high)
    found = []
    for start in slow[np.r_[np.diff(slow) > 1, True]] if len(slow) else ():
        after = fast[fast > start]
        if len(after):
            end = int(after[0])
            begin_s = np.interp(_SLOW * high, speed[start : start + 2], time_s[start : start + 2])
            end_s = np.interp(_FAST * high, speed[end - 1 : end + 1], time_s[end - 1 : end + 1])
            found.append((_FAST - _SLOW) * high / max(end_s - begin_s, 1e-6))
    return found
