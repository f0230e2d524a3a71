"""Checks of tracks against themselves: speeds by the positions and by the file, repeated rows, what vehicles can do."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray
from velfield.errors import InputError
from velfield.sources.tracks.formats import FOOT_M, MILE_PER_HOUR, UNIT_M

_SPAN_S = 0.5
"""Speeds are of positions at least so far apart in time, where the file has such."""
_SAME = 0.15
"""Speeds by the positions and by the file that differ by more than this fraction are in different units."""
_MIN_ROWS = 10
_MOVING_M_PER_S = 2.0
_FASTEST_M_PER_S = 85.0
"""306 km/h: where a tenth of all moving rows are faster, a unit is wrong."""
_JUMP_M, _JUMP_M_PER_S, _LONGEST_GAP_S = 15.0, 120.0, 300.0
_USUAL_M_PER_S = (5.0, 150 / 3.6)
"""Half of the vehicles of a place reach a speed in this range, 18 to 150 km/h, or one below it in queues."""
_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": MILE_PER_HOUR, "ft/s": FOOT_M}
_STANDING_M_PER_S, _QUEUE_M, _LANE_M, _MOMENTS = 0.3, 60.0, 1.9, 300
_GAPS_M = 3.5, 12.0
"""Least median, and largest tenth percentile, of the gaps of vehicles that queue."""
_MOSTLY_SAME = 0.01
_MOSTLY_BACK = 9
"""A track's rows run back in time where so many times more steps do than run forth; of rows in no order half do."""
_MIN_EXTENT_M = 6.0
_FAR_M, _CRAWL_M_PER_S = 20.0, 0.55


@dataclass(frozen=True)
class GivenSpeed:
    """Speeds by the file, in a unit of ``factor`` m/s (None: not known), and the columns' name for messages."""

    values: FloatArray
    factor: float | None
    name: str


def step_speeds(table: pd.DataFrame, xy: FloatArray) -> tuple[FloatArray, IntArray]:
    """Speeds (k,) by positions of a table sorted by track and time, and the rows (k, 2) between which they are."""
    track, time_s = table["track_id"].to_numpy(np.int64), table["time_s"].to_numpy(np.float64)
    steps = np.diff(time_s)[np.diff(track) == 0]
    step_s = float(np.median(steps[steps > 0])) if (steps > 0).any() else _SPAN_S
    ahead = max(1, round(_SPAN_S / step_s))
    ahead = max(1, min(ahead, int(np.bincount(track).max(initial=1)) - 1))
    first = np.flatnonzero((track[ahead:] == track[:-ahead]) & (time_s[ahead:] > time_s[:-ahead]))
    rows = np.column_stack([first, first + ahead])
    moved = np.hypot(*(xy[rows[:, 1]] - xy[rows[:, 0]]).T)
    return moved / (time_s[rows[:, 1]] - time_s[rows[:, 0]]), rows


def check_speeds(
    path: object, table: pd.DataFrame, xy_m: FloatArray, given: GivenSpeed | None, unit: str | None
) -> list[str]:
    """Compare the speeds by the positions (m, 2), m, with those of the file and with what vehicles can do; ``unit``:
    the one that the user gave for the positions.

    Raises
    ------
    InputError
        They contradict the file's speeds, whose unit is known; or vehicles cannot be so fast.
    """
    speed, rows = step_speeds(table, xy_m)
    notes = []
    if given is not None:
        stated = given.values[rows].mean(axis=1)
        known = np.isfinite(stated) & (stated * (given.factor or 1 / 3.6) > _MOVING_M_PER_S)
        if known.sum() >= _MIN_ROWS and np.median(speed[known]) > 0:
            notes += _compare(path, float(np.median(speed[known] / stated[known])), speed[known], given)
    moving = speed[speed > _MOVING_M_PER_S]
    high = float(np.quantile(moving, 0.9)) if len(moving) else 0.0
    if high > _FASTEST_M_PER_S:
        raise InputError(
            f"{path}: found vehicles at {3.6 * high:.0f} km/h by their positions and times, expected at most "
            f"{3.6 * _FASTEST_M_PER_S:.0f}; {_other_units(unit, high)}"
        )
    return notes


def _other_units(unit: str | None, speed_m_per_s: float) -> str:
    """What to do about vehicles that are too fast: the units of positions in which they are not."""
    low, high = _USUAL_M_PER_S
    made = {other: speed_m_per_s * factor / UNIT_M[unit] for other, factor in UNIT_M.items()} if unit in UNIT_M else {}
    fits = [f"--unit {other} makes it {3.6 * v:.0f} km/h" for other, v in made.items() if low <= v <= high]
    otherwise = "check the unit of positions (--unit, --gsd-m) and the times (--fps)"
    return f"{', '.join(fits)}; else {otherwise}" if fits else otherwise


def _compare(path: object, ratio: float, speed: FloatArray, given: GivenSpeed) -> list[str]:
    """``ratio``: m/s by the positions over the file's number."""
    if given.factor is None:
        unit = next((name for name, factor in _UNITS.items() if abs(ratio / factor - 1) < _SAME / 2), None)
        if unit is not None:
            return [f"{given.name} agrees with the positions in {unit}"]
        return [
            f"warning: {given.name} is {1 / ratio:.3g} for 1 m/s by the positions, no usual unit: check --unit, --fps"
        ]
    if abs(ratio / given.factor - 1) <= _SAME:
        return []
    shown = 3.6 * float(np.median(speed))
    raise InputError(
        f"{path}: found {shown:.3g} km/h by the positions and {shown * given.factor / ratio:.3g} km/h by {given.name}; "
        "check the unit of the positions (--unit, --gsd-m) and the times (--fps)"
    )


def check_standing_gaps(table: pd.DataFrame, xy_m: FloatArray) -> list[str]:
    """Compare how far apart vehicles stand in queues with what their lengths allow; a warning where it cannot be.

    Queued vehicles stand 6 to 9 m apart, from middle to middle, whatever the road: feet taken for metres are 20 to 30,
    metres taken for feet 2 to 3. The table has ``track_id, time_s``, by track and time, of positions (n, 2), m.
    """
    speed, rows = step_speeds(table, xy_m)
    track = table["track_id"].to_numpy(np.int64)[rows[:, 0]]
    here, step = xy_m[rows[:, 0]], xy_m[rows[:, 1]] - xy_m[rows[:, 0]]
    heading = np.where((speed > _MOVING_M_PER_S)[:, None], step / np.maximum(np.hypot(*step.T), 1e-9)[:, None], np.nan)
    heading = pd.DataFrame(heading).groupby(track).ffill().to_numpy()  # of a vehicle that stands: where it drove before
    standing = np.flatnonzero((speed < _STANDING_M_PER_S) & np.isfinite(heading).all(axis=1))
    moments = pd.DataFrame({"time_s": table["time_s"].to_numpy()[rows[standing, 0]].round(2)}).groupby("time_s").indices
    spread = np.linspace(0, max(len(moments) - 1, 0), min(len(moments), _MOMENTS)).astype(int)
    gaps: dict[int, float] = {}
    for at in [list(moments.values())[k] for k in spread]:
        cars = standing[at]
        away = here[cars][None] - here[cars][:, None]
        along = (away * heading[cars][:, None]).sum(axis=2)
        across = np.abs(away[..., 0] * heading[cars][:, None, 1] - away[..., 1] * heading[cars][:, None, 0])
        ahead = np.where((along > 0) & (along < _QUEUE_M) & (across < _LANE_M), along, np.inf).min(axis=1)
        for car, gap in zip(track[cars[np.isfinite(ahead)]], ahead[np.isfinite(ahead)], strict=True):
            gaps[int(car)] = min(gap, gaps.get(int(car), np.inf))
    if len(gaps) < _MIN_ROWS:
        return []
    low, middle = np.quantile(list(gaps.values()), [0.1, 0.5])
    if low <= _GAPS_M[1] and middle >= _GAPS_M[0]:
        return []
    return [
        f"warning: {len(gaps)} vehicles stand {middle:.3g} m behind the next in queues (median, middle to middle), "
        "expected 6 to 9 m: check the unit of positions (--unit, --gsd-m)"
    ]


def check_order(table: pd.DataFrame) -> list[str]:
    """A warning where the rows of most tracks, in the order of the file, run back in time: the times may count down, as
    of a clip that is read from its end, and the vehicles would drive backwards. The table has ``track_id, time_s``."""
    order = np.argsort(table["track_id"].to_numpy(np.int64), kind="stable")
    track, time_s = table["track_id"].to_numpy(np.int64)[order], table["time_s"].to_numpy(np.float64)[order]
    same = np.diff(track) == 0
    forth, back = (np.bincount(track[1:][same & (sense * np.diff(time_s) > 0)], minlength=1) for sense in (1, -1))
    n = max(len(forth), len(back))
    forth, back = (np.pad(counts, (0, n - len(counts))) for counts in (forth, back))
    moves, falls = int(((forth + back) > 0).sum()), int((back > _MOSTLY_BACK * forth).sum())
    if falls <= moves / 2:
        return []
    return [
        f"warning: the rows of {falls} of {moves} tracks are in descending order of time, expected ascending: if the "
        "times count down, all vehicles drive backwards here, and their origins are their destinations"
    ]


def drop_repeated(path: object, table: pd.DataFrame, columns: list[str]) -> tuple[pd.DataFrame, list[str]]:
    """A table with one position of each track at a time, and a note on rows that were dropped.

    Raises
    ------
    InputError
        Tracks are at two places at one time: a column of their names is missing, or times are too coarse.
    """
    repeated = table.duplicated(["track_id", "time_s"])
    if not repeated.any():
        return table, []
    same = table.duplicated(["track_id", "time_s", *columns])
    elsewhere = float((repeated & ~same).mean())
    if elsewhere > _MOSTLY_SAME:
        raise InputError(
            f"{path}: found {elsewhere:.0%} of the rows at a second place of the same track at the same time; several "
            "recordings in one table need a column recordingId, coarse times need --fps and a column of the frame"
        )
    kept = table[~repeated].reset_index(drop=True)
    return kept, [f"{int(repeated.sum())} rows of a track and time that were there already are left out"]


def split_reused(table: pd.DataFrame, xy_m: FloatArray) -> tuple[pd.DataFrame, list[str]]:
    """A table (sorted by track and time) whose tracks end where no vehicle could go on, and a note on it."""
    track, time_s = table["track_id"].to_numpy(np.int64), table["time_s"].to_numpy(np.float64)
    gap, moved = np.diff(time_s), np.hypot(*np.diff(xy_m, axis=0).T)
    jump = (gap > _LONGEST_GAP_S) | ((moved > _JUMP_M) & (moved > _JUMP_M_PER_S * gap))
    cut = (np.diff(track) == 0) & jump
    if not cut.any():
        return table, []
    part = np.r_[0, np.cumsum(cut | (np.diff(track) != 0))]
    named = f"{int(cut.sum())} names of tracks come back elsewhere or after {_LONGEST_GAP_S:.0f} s: other vehicles"
    return table.assign(track_id=part), [named]


def check_motion(path: object, table: pd.DataFrame, xy_m: FloatArray, unit: str | None) -> list[str]:
    """Refuse tracks of which none goes anywhere, or all crawl; a warning where most are faster than on any road.

    ``unit`` is the one that the user gave for the positions.

    Raises
    ------
    InputError
        No track moves by 6 m; or most that drive 20 m never go faster than 2 km/h.
    """
    first = np.flatnonzero(np.r_[True, np.diff(table["track_id"].to_numpy(np.int64)) != 0])
    low, high = (reduce.reduceat(xy_m, first, axis=0) for reduce in (np.minimum, np.maximum))
    extent = np.hypot(*(high - low).T)
    longest = float(extent.max())
    if longest < _MIN_EXTENT_M:
        raise InputError(
            f"{path}: found no track that moves {_MIN_EXTENT_M:g} m or more (the longest: {longest:.3g} m), expected "
            "tracks of vehicles; check --unit and --gsd-m"
        )
    speed, rows = step_speeds(table, xy_m)
    of = np.searchsorted(first, rows[:, 0], side="right") - 1
    fastest = np.maximum.reduceat(speed, np.flatnonzero(np.r_[True, np.diff(of) != 0]))[extent[np.unique(of)] > _FAR_M]
    if len(fastest) and np.median(fastest) < _CRAWL_M_PER_S:
        raise InputError(
            f"{path}: found vehicles that drive {_FAR_M:g} m and more at {3.6 * np.median(fastest):.2g} km/h at most "
            "by their positions and times; check that times are in seconds (time_s; time_ms for milliseconds, or --fps)"
        )
    typical = float(np.median(fastest)) if len(fastest) >= _MIN_ROWS else 0.0
    if typical <= _USUAL_M_PER_S[1]:
        return []
    return [
        f"warning: half of the vehicles reach {3.6 * typical:.0f} km/h or more by their positions and times, expected "
        f"at most {3.6 * _USUAL_M_PER_S[1]:.0f} on roads; {_other_units(unit, typical)}"
    ]


def mirrored_and_scale(xy_up: FloatArray, east_north: FloatArray) -> tuple[bool, float] | None:
    """Whether y points against the north of the same positions (n, 2) in metres, and metres of those for one of these.

    None where the positions lie on a line, or agree with neither.
    """
    z, w = ((a - a.mean(axis=0)) @ np.array([1.0, 1j]) for a in (xy_up, east_north))
    power = float(np.vdot(z, z).real)
    straight, turned = abs(np.vdot(z, w)) / power, abs(np.vdot(z.conj(), w)) / power
    total = float(np.sqrt(np.vdot(w, w).real / power))
    best, other = max(straight, turned), min(straight, turned)
    if best < 0.98 * total or other > 0.98 * best:
        return None
    return bool(turned > straight), best
