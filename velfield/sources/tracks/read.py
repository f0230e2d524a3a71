"""`read_tracks`: positions, times and names of vehicles from a file of another program, in metres or pixels."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from rasterio.crs import CRS
from rasterio.warp import transform

from schemas.arrays import FloatArray
from velfield.errors import InputError
from velfield.sources.geo import utm_crs
from velfield.sources.tracks.checks import GivenSpeed, check_order, drop_repeated, mirrored_and_scale
from velfield.sources.tracks.files import numbers, read_columns
from velfield.sources.tracks.formats import (
    FRAMES,
    PLACES,
    POSITIONS,
    RECORDINGS,
    SIZES,
    SPEEDS,
    TIMES,
    TRACKS,
    UNIT_M,
    Position,
    Speed,
    TrackFormat,
    Unit,
    YAxis,
    find_format,
    normal_name,
)
from velfield.sources.tracks.times import check_clock, to_seconds

_SIZES_M = (0.3, 40.0)
"""A length or width beyond these is not one in metres: it is left out."""
_SAME_SCALE = 0.03
_NAMES = "name them track_id, time_s (or frame), x_m, y_m (or x_px, y_px)"


@dataclass(frozen=True)
class GivenPositions:
    """Tracks as read from a file."""

    table: pd.DataFrame
    """``track_id`` (int) and ``source_id``, its name in the file, ``frame`` (int), ``time_s`` from 0 on, ``x``, ``y``
    with y downwards; ``length_m``, ``width_m`` where the file has them (NaN: not known); by track and time."""
    unit: str
    """Unit of ``x`` and ``y``: ``m`` or ``px``."""
    y_axis: YAxis
    """Where y points in the file."""
    crs_wkt: str | None
    """Reference system of ``x`` and ``-y``: a UTM zone where the file has degrees; None: none."""
    y_is_north: bool
    """Whether ``-y`` is to the north of a map's grid whose reference system is not known."""
    speed: GivenSpeed | None
    """Speeds of the rows by the file."""
    notes: tuple[str, ...]
    """Notes on what was read and noticed, one line each."""


def read_tracks(
    path: Path, *, fps: float | None = None, unit: Unit | None = None, y_axis: YAxis | None = None
) -> GivenPositions:
    """Read tracks of another program: CSV with a header, Parquet, or SUMO's FCD; ``.gz`` too.

    `velfield.sources.tracks.formats` lists the formats. Frames a second, the unit of the positions and where y points
    are given where the columns do not say it; a unit also chooses among the positions of a format that has several.

    Raises
    ------
    InputError
        A column is missing, a value is not a number, or it is not known what it means.
    """
    raw = read_columns(path)
    if not len(raw):
        raise InputError(f"{path}: no tracks in it; expected a row for each track and time")
    columns: dict[str, str] = {}
    for name in raw.columns:
        columns.setdefault(normal_name(name), str(name))
    raw.columns = [str(name) for name in raw.columns]
    form = find_format(columns)
    reader = _Reader(path, raw, columns, form, unit, y_axis)
    return reader.read(fps)


@dataclass(frozen=True)
class _Reader:
    """The columns of a file and what is known of them."""

    path: Path
    raw: pd.DataFrame
    columns: dict[str, str]
    form: TrackFormat | None
    unit: Unit | None
    y_axis: YAxis | None

    def read(self, fps: float | None) -> GivenPositions:
        position = self._position()
        x, y = (numbers(self.raw[self.columns[name]], self.path) for name in (position.x, position.y))
        known = np.isfinite(x) & np.isfinite(y)
        notes = [] if known.all() else [f"{int((~known).sum())} rows without a position are left out"]
        if not known.all():
            rows = np.flatnonzero(known)
            kept = replace(self, raw=self.raw.iloc[rows].reset_index(drop=True))
            return kept._read(position, x[rows], y[rows], fps, notes)
        return self._read(position, x, y, fps, notes)

    def _read(
        self, position: Position, x: FloatArray, y: FloatArray, fps: float | None, notes: list[str]
    ) -> GivenPositions:
        if not len(self.raw):
            raise InputError(f"{self.path}: no tracks in it; expected a row for each track and time")
        position = self._in_degrees(position, x, y)
        time_s, frame, times_note, more = self._times(fps)
        notes += more
        unit, axis, crs_wkt = self._unit(position), self._axis(position), None
        xy = self._to_units(x, y, unit)
        if unit == "deg":
            xy, crs_wkt = _to_utm(self.path, x, y)
            xy[:, 1] *= -1
        elif axis == "up":
            xy[:, 1] *= -1
        if unit in UNIT_M:
            axis, xy, more = self._against_degrees(position, axis, xy)
            notes += more
        key, more = self._key(time_s, xy)
        notes += more
        table = pd.DataFrame({"track_id": key[0], "source_id": key[1], "frame": frame, "time_s": time_s})
        table["x"], table["y"] = xy.T
        sizes, more = self._sizes()
        notes += more
        table = table.assign(**sizes)
        speed = self._speed()
        notes += check_order(table)
        table["row"] = np.arange(len(table))
        table, more = drop_repeated(self.path, table, ["x", "y"])
        table = table.sort_values(["track_id", "time_s"], kind="stable", ignore_index=True)
        rows = table.pop("row").to_numpy(np.int64)
        speed = None if speed is None else replace(speed, values=speed.values[rows])
        named = "read by its columns" if self.form is None else self.form.name
        point = "centre" if self.form is None else self.form.point
        names = f"{self.columns[position.x]}, {self.columns[position.y]}"
        of = {"centre": "", "front": ", of the vehicle's front", "corner": ", corner of a box"}[point]
        taken = " (taken so; --y-axis up where it points up)" if self._is_plain(position) and not self.y_axis else ""
        what = f"{self.path.name}: {named}; {names} in {unit}, y {axis}{taken}{of}; times: {times_note}; "
        what += f"{table['track_id'].nunique()} vehicles"
        kind = "px" if unit == "px" else "m"
        north = position.y_is_north and axis == "up"
        return GivenPositions(table, kind, axis, crs_wkt, north, speed, (what, *notes, *more))

    def _find(self, names: Sequence[str]) -> str | None:
        return next((self.columns[name] for name in names if name in self.columns), None)

    def _missing(self, what: str) -> InputError:
        found = ", ".join(map(str, self.raw.columns[:12]))
        return InputError(f"{self.path}: found the columns {found}, expected {what}; {_NAMES}")

    # positions

    def _position(self) -> Position:
        listed = POSITIONS if self.form is None else self.form.positions
        named = [p for p in listed if p.x in self.columns and p.y in self.columns]
        there = [p for p in named if not (self.raw[[self.columns[p.x], self.columns[p.y]]].isna().any(axis=1).all())]
        if named and not there:
            names = " and ".join(self.columns[name] for name in (named[0].x, named[0].y))
            raise InputError(f"{self.path}: found no number in columns {names}, expected positions; fill them")
        if not there:
            raise self._missing("x and y")
        asked = [p for p in there if p.unit in (None, self.unit)] if self.unit else there
        if not asked:
            units = ", ".join(dict.fromkeys(str(p.unit) for p in there))
            raise InputError(f"{self.path}: found positions in {units} and --unit {self.unit}; omit --unit")
        return next((p for p in asked if p.unit is not None and p.y_axis is not None), asked[0])

    def _unit(self, position: Position) -> Unit:
        unit = position.unit or self.unit
        if unit is None:
            raise InputError(
                f"{self.path}: found columns {self.columns[position.x]} and {self.columns[position.y]} without a unit; "
                "give --unit m, ft, cm, mm, px or deg"
            )
        return unit

    def _axis(self, position: Position) -> YAxis:
        unit = self._unit(position)
        usual: YAxis | None = {"px": "down", "deg": "up"}.get(unit)  # type: ignore[assignment]
        axis = (self.y_axis if self._is_plain(position) else None) or position.y_axis or self.y_axis or usual
        if axis is None:
            raise InputError(
                f"{self.path}: found columns {self.columns[position.x]} and {self.columns[position.y]} in {unit}, "
                "but not which way y points: give --y-axis up (north, as in maps) or --y-axis down (as in images)"
            )
        if self.y_axis is not None and axis != self.y_axis:
            raise InputError(f"{self.path}: found --y-axis {self.y_axis}, expected {axis}, as in this format; omit it")
        return axis

    def _is_plain(self, position: Position) -> bool:
        """Whether it is x_m and y_m of no format: ours points down, as images do, others' may point up."""
        return self.form is None and (position.x, position.y) == ("xm", "ym")

    def _in_degrees(self, position: Position, x: FloatArray, y: FloatArray) -> Position:
        """The position in degrees where a format that has metres or degrees (SUMO) has degrees."""
        if self.form is None or self.form.name != "SUMO FCD":
            return position
        inside = np.abs(x).max() <= 180 and np.abs(y).max() <= 90
        small = max(float(np.ptp(x)), float(np.ptp(y))) < 1.0
        return replace(position, unit="deg", y_axis="up") if self.unit == "deg" or (inside and small) else position

    def _to_units(self, x: FloatArray, y: FloatArray, unit: Unit) -> FloatArray:
        xy = np.column_stack([x, y])
        xy *= UNIT_M.get(unit, 1.0)
        if self.form is not None and self.form.point == "corner" and self.form.size is not None:
            width, height = (numbers(self.raw[self.columns[name]], self.path) for name in self.form.size[:2])
            xy += np.column_stack([width, height]) / 2
        return xy

    def _against_degrees(self, position: Position, axis: YAxis, xy: FloatArray) -> tuple[YAxis, FloatArray, list[str]]:
        """The axis by the file's own degrees, where it has them too.

        Raises
        ------
        InputError
            A unit of the positions is not a metre by the degrees.
        """
        pairs = [p for p in POSITIONS if p.unit == "deg" and p.x in self.columns and p.y in self.columns]
        if not pairs:
            return axis, xy, []
        lon, lat = (numbers(self.raw[self.columns[name]], self.path) for name in (pairs[0].x, pairs[0].y))
        known = np.isfinite(lon) & np.isfinite(lat)
        if known.sum() < 3:
            return axis, xy, []
        east_north, _ = _to_utm(self.path, lon[known], lat[known])
        found = mirrored_and_scale(xy[known] * (1.0, -1.0), east_north)
        if found is None:
            return axis, xy, []
        mirrored, scale = found
        if abs(scale - 1) > _SAME_SCALE:
            raise InputError(
                f"{self.path}: found {scale:.3g} m by longitude and latitude for one of {self.columns[position.x]}, "
                "expected 1; give --unit deg to use the degrees"
            )
        if not mirrored:
            return axis, xy, []
        other: YAxis = "down" if axis == "up" else "up"
        note = f"{self.columns[position.y]} points {other}, by the file's latitudes"
        return other, xy * (1.0, -1.0), [note]

    # times

    def _times(self, fps: float | None) -> tuple[FloatArray, np.ndarray, str, list[str]]:
        listed = TIMES if self.form is None else (*self.form.times, *TIMES)
        found = next(((self.columns[name], unit) for name, unit in listed if name in self.columns), None)
        own = () if self.form is None or self.form.frame is None else (self.form.frame,)
        frame_column = self._find((*own, *FRAMES))
        frame = None if frame_column is None else numbers(self.raw[frame_column], self.path)
        if frame is not None and np.isnan(frame).any():
            row = int(np.flatnonzero(np.isnan(frame))[0])
            raise InputError(f"{self.path}: found nothing in column {frame_column}, row {row + 2}, expected a frame")
        notes: list[str] = []
        if found is not None:
            seconds, note = to_seconds(self.raw[found[0]], found[1], self.path)
            if frame is None or len(np.unique(seconds)) > 0.5 * len(np.unique(frame)):
                if note == "dates without a zone":
                    track = pd.factorize(self._names(self._key_columns()))[0].astype(np.float64)
                    clock = check_clock(track, seconds, self.path)
                    notes += [clock] if clock else []
                notes += ["--fps is not used: the file has times"] if fps is not None else []
                number = frame if frame is not None else np.unique(seconds.round(4), return_inverse=True)[1]
                return seconds, (number - number.min()).astype(np.int64), f"{found[0]} ({note})", notes
            if fps is None:
                raise InputError(
                    f"{self.path}: found {len(np.unique(seconds))} times of {len(np.unique(frame))} frames in column "
                    f"{found[0]}: too coarse; give the frame rate with --fps"
                )
            notes.append(f"{found[0]} is too coarse: times are computed from the frames")
        if frame is None:
            raise self._missing("a column of the time or of the frame")
        rate = fps or self._rate_beside()
        if rate is None:
            usual = "" if self.form is None or self.form.frame_rate is None else f" ({self.form.name}: mostly "
            usual += f"{self.form.frame_rate:g})" if usual and self.form is not None else ""
            raise InputError(f"{self.path}: found frames and no times; give the frame rate with --fps{usual}")
        frame = frame - frame.min()
        return frame / rate, frame.astype(np.int64), f"{frame_column} at {rate:g} a second", notes

    def _rate_beside(self) -> float | None:
        """Frames a second by the recording's ``NN_recordingMeta.csv`` (inD and its kin, highD)."""
        number = re.match(r"(\d+)_tracks\b", self.path.name)
        meta = self.path.with_name(f"{number[1]}_recordingMeta.csv") if number else None
        if meta is None or not meta.is_file():
            return None
        table = pd.read_csv(meta)
        rate = float(table["frameRate"].iloc[0]) if "frameRate" in table and len(table) else 0.0
        return rate if rate > 0 else None

    # names of vehicles

    def _key_columns(self) -> list[str]:
        if self.form is not None:
            return [self.columns[name] for name in self.form.track if name in self.columns]
        track = self._find(TRACKS)
        if track is None:
            raise self._missing("a column of the track")
        return [*(self.columns[name] for name in RECORDINGS if name in self.columns), track]

    def _names(self, columns: list[str]) -> pd.Series:
        missing = self.raw[columns].isna().any(axis=1).to_numpy()
        if missing.any():
            row = int(np.flatnonzero(missing)[0])
            raise InputError(f"{self.path}: found no name of a track in row {row + 2}, expected one in each row")
        names = self.raw[columns[0]].astype(str)
        for column in columns[1:]:
            names = names + "/" + self.raw[column].astype(str)
        return names

    def _key(self, time_s: FloatArray, xy: FloatArray) -> tuple[tuple[np.ndarray, np.ndarray], list[str]]:
        """Numbers and names (n,) of the rows' tracks."""
        columns, notes = self._key_columns(), []
        names = self._names(columns)
        if _is_twice(names, time_s, xy):
            more = [self.columns[name] for name in PLACES if name in self.columns and self.columns[name] not in columns]
            for column in more:
                wider = self._names([column, *columns])
                if not _is_twice(wider, time_s, xy):
                    columns, names = [column, *columns], wider
                    break
        recordings = self.raw[columns[:-1]].drop_duplicates() if len(columns) > 1 else ()
        if len(recordings) > 1:
            what = ", ".join(columns[:-1])
            notes.append(f"{len(recordings)} recordings ({what}) are combined, and their vehicles are kept apart")
        return (pd.factorize(names, sort=False)[0], names.to_numpy()), notes

    # sizes and speeds

    def _sizes(self) -> tuple[dict[str, FloatArray], list[str]]:
        listed = SIZES if self.form is None else (self.form.size,) if self.form.size else ()
        found: tuple[str, str | None, float] | None
        found = next((s for s in listed if s[0] in self.columns and s[1] in self.columns), None)
        found = found or next(((s[0], None, s[2]) for s in listed if s[0] in self.columns), None)
        if found is None or found[2] == 0 or (self.form is not None and self.form.point == "corner"):
            return {}, []  # a box along the axes is not as long as its vehicle
        sizes: dict[str, FloatArray] = {}
        for name, column in (("length_m", found[0]), ("width_m", found[1])):
            if column is not None:
                values = pd.to_numeric(self.raw[self.columns[column]], errors="coerce").to_numpy(np.float64) * found[2]
                sizes[name] = np.where((values > _SIZES_M[0]) & (values < _SIZES_M[1]), values, np.nan)
        known = sizes["length_m"][np.isfinite(sizes["length_m"])]
        if not len(known):
            span = f"{_SIZES_M[0]:g} to {_SIZES_M[1]:g} m"
            return {}, [f"{self.columns[found[0]]} holds no length of {span}: it is left out"]
        if len(known) and self.form is None and float(np.median(known)) > 9.0 and found[0] != "lengthm":
            name = self.columns[found[0]]
            return {}, [
                f"{name} is {np.median(known):.3g} for most: in feet? It is left out; if the positions are in feet, "
                "too, give --unit ft"
            ]
        return sizes, []

    def _speed(self) -> GivenSpeed | None:
        own = () if self.form is None or self.form.speed is None else (self.form.speed,)
        listed: Sequence[Speed] = SPEEDS if self.form is None else own
        found = next((s for s in listed if all(name in self.columns for name in s.columns)), None)
        if found is None:
            return None
        names = [self.columns[name] for name in found.columns]
        try:
            values = np.column_stack([numbers(self.raw[name], self.path) for name in names])
        except InputError:
            return None  # it is only for a comparison
        return GivenSpeed(np.sqrt((values**2).sum(axis=1)), found.factor, ", ".join(names))


def _is_twice(names: pd.Series, time_s: FloatArray, xy: FloatArray) -> bool:
    """Whether some tracks are at two places at one time."""
    rows = pd.DataFrame({"name": names.to_numpy(), "time": time_s, "x": xy[:, 0], "y": xy[:, 1]})
    return bool((rows.duplicated(["name", "time"]) & ~rows.duplicated()).any())


def _to_utm(path: Path, longitude: FloatArray, latitude: FloatArray) -> tuple[FloatArray, str]:
    """Metres east and north (n, 2) in the UTM zone of degrees, and that reference system."""
    worst = float(np.abs(latitude).max())
    if worst > 84 or float(np.abs(longitude).max()) > 180:
        raise InputError(
            f"{path}: found a latitude of {worst:g} degrees or a longitude beyond 180, expected x as longitude and y "
            "as latitude between 84 south and 84 north; check their order"
        )
    crs = utm_crs(float(np.median(longitude)), float(np.median(latitude)))
    east, north = transform(CRS.from_epsg(4326), crs, longitude, latitude)
    return np.column_stack([east, north]).astype(np.float64), crs.to_wkt()
