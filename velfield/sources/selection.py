"""Choose the source's frames to process: every n-th, or the nearest to an interval, from a start to a stop."""

import numpy as np

from schemas.arrays import FloatArray, IntArray
from schemas.flight import FramesConfig
from velfield.errors import InputError


def select_frames(times_s: FloatArray, frames: FramesConfig) -> IntArray:
    """Choose the frames to process of those of times (n,), ascending, s: indices (m,), ascending.

    Of frames with equal times only the first can be chosen, so that no interval is zero. Start and stop count from the
    first frame.

    Raises
    ------
    InputError
        No frame lies between start and stop.
    """
    times_s = np.asarray(times_s, np.float64)
    if times_s.size == 0:
        raise InputError("the source has no frames")
    start_s = 0.0 if frames.start_s is None else frames.start_s
    stop_s = np.inf if frames.stop_s is None else frames.stop_s
    later = np.r_[True, np.diff(times_s) > 0]
    since_first = times_s - times_s[0]
    tolerance = 1e-9  # a start given as a frame's own time must not lose that frame to rounding
    inside = np.flatnonzero(later & (since_first >= start_s - tolerance) & (since_first < stop_s - tolerance))
    if inside.size == 0:
        until = "on" if frames.stop_s is None else f"to {stop_s:g} s"
        raise InputError(
            f"found no frame from {start_s:g} s {until}: the source lasts {since_first[-1]:.3f} s; "
            "--start-s and --stop-s count from the first frame, in s"
        )
    if frames.every == "auto":
        return inside[_nearest_to_interval(times_s[inside], frames.target_interval_s)]
    return inside[:: frames.every]


def _nearest_to_interval(times_s: FloatArray, interval_s: float) -> IntArray:
    """Step from frame to frame, each the nearest to one interval after the last.

    Measured from the frame last taken, not from a fixed comb: at 24 frames a second a comb of 0.2 s gives steps of 5,
    5, 4 frames, and the acceleration gate is sensitive to uneven intervals.
    """
    taken = [0]
    while taken[-1] + 1 < times_s.size:
        target = times_s[taken[-1]] + interval_s
        after = int(np.searchsorted(times_s, target))
        if after >= times_s.size and target - times_s[-1] > (times_s[-1] - times_s[-2]) / 2:
            break  # the nearest frame lies beyond the end: the last one would make an uneven interval
        candidates = [i for i in (after - 1, after) if taken[-1] < i < times_s.size]
        if not candidates:
            break
        taken.append(min(candidates, key=lambda i: (abs(times_s[i] - target), i)))
    return np.array(taken, np.int64)
