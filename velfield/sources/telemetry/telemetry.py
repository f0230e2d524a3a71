"""Telemetry of a flight: position, height, attitude and focal length of the camera over time; NaN where not known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray

MAX_GAP_S = 5.0
"""A value is interpolated between records, and held beyond them, over no more than this."""
QUANTITIES = (
    "latitude_deg",
    "longitude_deg",
    "height_m",
    "altitude_m",
    "yaw_deg",
    "pitch_deg",
    "roll_deg",
    "focal_35mm",
    "focal_px",
    "zoom",
    "clock_s",
)
"""What a record may hold; `Telemetry` says what each is."""
_ANGLES = ("yaw_deg", "roll_deg")


@dataclass(frozen=True)
class Telemetry:
    """Records of the camera's pose, (n,) each.

    Attributes
    ----------
    origin
        Where it was read, for messages: ``DJI_0001.SRT``, ``the subtitles of DJI_0001.MP4``.
    time_s
        Ascending, s from the source's first frame.
    latitude_deg, longitude_deg
        Of the camera, WGS 84.
    height_m
        Above the place of take-off, by barometer.
    altitude_m
        Above the sea or the ellipsoid: not comparable with the ground, whose altitude is not known.
    yaw_deg
        Of the camera, clockwise from north: where the top of a picture taken straight down points.
    pitch_deg, roll_deg
        Of the camera: -90 is straight down.
    focal_35mm
        Focal length that gives the same diagonal angle of view on 36 mm x 24 mm, mm, before digital zoom.
    focal_px
        Focal length, px of the picture; by the maker's calibration.
    zoom
        Digital zoom.
    clock_s
        The camera's clock, s since 1970 as if it were set to UTC; it mostly shows local time.
    notes
        One line each: what could not be read.
    """

    origin: str
    time_s: FloatArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    height_m: FloatArray
    altitude_m: FloatArray
    yaw_deg: FloatArray
    pitch_deg: FloatArray
    roll_deg: FloatArray
    focal_35mm: FloatArray
    focal_px: FloatArray
    zoom: FloatArray
    clock_s: FloatArray
    notes: tuple[str, ...] = ()

    @classmethod
    def from_records(
        cls, origin: str, records: Sequence[tuple[float, Mapping[str, float]]], notes: Sequence[str] = ()
    ) -> "Telemetry":
        """From (time in s, quantities) pairs, in any order."""
        ordered = sorted(records, key=lambda record: record[0])
        columns = {name: np.array([one.get(name, np.nan) for _, one in ordered], np.float64) for name in QUANTITIES}
        return cls(origin, np.array([time_s for time_s, _ in ordered], np.float64), notes=tuple(notes), **columns)

    def at(self, times_s: FloatArray) -> "Telemetry":
        """The telemetry at other times (m,), s from the source's first frame, interpolated between records."""
        at_s = np.asarray(times_s, np.float64)
        columns = {name: self._interpolate(name, at_s) for name in QUANTITIES}
        return Telemetry(self.origin, at_s, notes=self.notes, **columns)

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
