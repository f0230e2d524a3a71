"""Telemetry of a flight: position, height, attitude and focal length of the camera over time; NaN where not known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray

MAX_GAP_S = 5.0
"""A value is interpolated between records, and held beyond them, over no more than this."""
_ANGLES = ("yaw_deg", "roll_deg")
_LIMITS = {
    "latitude_deg": (-90.0, 90.0),
    "longitude_deg": (-180.0, 360.0),
    "height_m": (-500.0, 20_000.0),
    "altitude_m": (-1000.0, 30_000.0),
    "yaw_deg": (-360.0, 360.0),
    "pitch_deg": (-180.0, 180.0),
    "roll_deg": (-360.0, 360.0),
    "focal_35mm": (10.0, 3000.0),
    "focal_px": (10.0, 1e6),
    "hfov_deg": (0.2, 150.0),
    "vfov_deg": (0.2, 150.0),
    "zoom": (0.0, 200.0),
    "clock_s": (-np.inf, np.inf),
}
"""Range of valid values; others are in another unit, or wrong."""
QUANTITIES = tuple(_LIMITS)
"""Quantities that a record may hold; `Telemetry` describes each."""
_E7 = 1e6
_DOWN_RAD = 0.2


@dataclass(frozen=True)
class HeightSource:
    """Reference of heights, in words, and their standard deviation, m."""

    above: str
    sd_m: float


ABOVE_TAKE_OFF = HeightSource("above the place of take-off", 1.2)
"""By barometer: it drifts, and the ground is elsewhere not as high as at the place of take-off."""
ABOVE_GROUND = HeightSource("above the ground", 5.0)
"""By satellites, less the elevation of a terrain model at the middle of the picture, or by a range."""


@dataclass(frozen=True)
class Telemetry:
    """Records of the camera's pose, (n,) each."""

    origin: str
    """Where it was read, for messages: ``DJI_0001.SRT``, ``the subtitles of DJI_0001.MP4``."""
    time_s: FloatArray
    """Ascending, s from the source's first frame."""
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    """Position of the camera, WGS 84."""
    height_m: FloatArray
    """As ``height`` says."""
    altitude_m: FloatArray
    """Above the sea or the ellipsoid: not comparable with the ground, whose altitude is not known."""
    yaw_deg: FloatArray
    """Yaw of the camera, clockwise from north: the direction of the top of a picture taken straight down."""
    pitch_deg: FloatArray
    roll_deg: FloatArray
    """Pitch and roll of the camera; a pitch of -90 is straight down."""
    focal_35mm: FloatArray
    """Focal length that gives the same diagonal angle of view on 36 mm x 24 mm, mm, before digital zoom."""
    focal_px: FloatArray
    """Focal length, px of the picture; by the maker's calibration."""
    hfov_deg: FloatArray
    vfov_deg: FloatArray
    """Angle of view of the picture's width and of its height, at the zoom that there was."""
    zoom: FloatArray
    """Digital zoom."""
    clock_s: FloatArray
    """The camera's clock, s since 1970 as if it were set to UTC; it shows local time unless ``is_utc``."""
    notes: tuple[str, ...] = ()
    """One line each: what could not be read."""
    height: HeightSource = ABOVE_TAKE_OFF
    """Reference of ``height_m``."""
    is_utc: bool = False
    """Whether the clock shows UTC."""

    @classmethod
    def from_records(
        cls,
        origin: str,
        records: Sequence[tuple[float, Mapping[str, float]]],
        notes: Sequence[str] = (),
        *,
        height: HeightSource = ABOVE_TAKE_OFF,
        is_utc: bool = False,
    ) -> "Telemetry":
        """From (time in s, quantities) pairs, in any order; what cannot be is left out, with a note.

        Places and attitudes in radians, and places in 1e-7 degrees, become degrees.
        """
        ordered = sorted(records, key=lambda record: record[0])
        columns = {name: np.array([one.get(name, np.nan) for _, one in ordered], np.float64) for name in QUANTITIES}
        times_s = np.array([time_s for time_s, _ in ordered], np.float64)
        found = [*notes, *(f"{origin}: {note}" for note in (*_to_degrees(columns), *_leave_out(columns)))]
        return cls(origin, times_s, notes=tuple(found), height=height, is_utc=is_utc, **columns)

    def at(self, times_s: FloatArray) -> "Telemetry":
        """The telemetry at other times (m,), s from the source's first frame, interpolated between records."""
        at_s = np.asarray(times_s, np.float64)
        columns = {name: self._interpolate(name, at_s) for name in QUANTITIES}
        return Telemetry(self.origin, at_s, notes=self.notes, height=self.height, is_utc=self.is_utc, **columns)

    def _interpolate(self, name: str, times_s: FloatArray) -> FloatArray:
        values = getattr(self, name)
        known = np.isfinite(values)
        if not known.any():
            return np.full(len(times_s), np.nan)
        at_s, values = self.time_s[known], values[known]
        if name in _ANGLES:
            values = np.unwrap(values, period=360.0)
        after = np.clip(np.searchsorted(at_s, times_s), 0, len(at_s) - 1)
        before = np.clip(after - 1, 0, len(at_s) - 1)
        near = np.minimum(np.abs(at_s[after] - times_s), np.abs(at_s[before] - times_s)) <= MAX_GAP_S
        return np.where(near, np.interp(times_s, at_s, values), np.nan)

    def known_quantities(self) -> tuple[str, ...]:
        """Names of the quantities that at least one record has."""
        return tuple(name for name in QUANTITIES if np.isfinite(getattr(self, name)).any())


def _to_degrees(columns: dict[str, FloatArray]) -> list[str]:
    """Change places and attitudes of other units to degrees; a note for each."""
    notes = []
    place = np.column_stack([columns["latitude_deg"], columns["longitude_deg"]])
    place = place[np.isfinite(place).all(axis=1)]
    if len(place) and (np.abs(place) > _E7).all():
        notes.append(_scale(columns, ("latitude_deg", "longitude_deg"), 1e-7, "positions are in 1e-7 degrees"))
    # Taken for degrees, all places that radians can give lie in the Gulf of Guinea, at sea.
    elif len(place) and (np.abs(place) <= (np.pi / 2, np.pi)).all():
        notes.append(_scale(columns, ("latitude_deg", "longitude_deg"), 180 / np.pi, "positions are in radians"))
    attitude = np.column_stack([columns[name] for name in ("pitch_deg", "yaw_deg", "roll_deg")])
    known = attitude[np.isfinite(attitude[:, :2]).all(axis=1)]
    is_small = len(known) > 0 and bool((np.abs(np.nan_to_num(known)) <= 2 * np.pi).all())
    if is_small and abs(np.median(known[:, 0]) + np.pi / 2) < _DOWN_RAD:
        notes.append(_scale(columns, ("pitch_deg", "yaw_deg", "roll_deg"), 180 / np.pi, "angles are in radians"))
    return notes


def _scale(columns: dict[str, FloatArray], names: Sequence[str], factor: float, note: str) -> str:
    for name in names:
        columns[name] = columns[name] * factor
    return note


def _leave_out(columns: dict[str, FloatArray]) -> list[str]:
    """Drop values that cannot be; a note for each quantity."""
    notes = []
    for name, (low, high) in _LIMITS.items():
        wrong = (columns[name] < low) | (columns[name] > high)
        if wrong.any():
            first = columns[name][wrong][0]
            columns[name] = np.where(wrong, np.nan, columns[name])
            notes.append(f"{name} {first:g} is not from {low:g} to {high:g}: {int(wrong.sum())} values are not used")
    return notes
