"""Telemetry that drones write as subtitles, a cue a frame or a second: DJI's formats since 2016, and Autel's.

DJI, since 2018   [iso : 100] ... [focal_len: 24.00] [latitude: 52.5] [longitude: 13.4] [rel_alt: 100.2 abs_alt: 134.1]
                  [gb_yaw: -12.3 gb_pitch: -90.0 gb_roll: 0.0]
Phantom 4, Mavic  HOME(13.4,52.5) 2017.8.5 14:11:51 / GPS(13.4,52.5,16) BAROMETER:91.2, or Hb:91.2
Matrice 300       2022.06.21 16:06:17 / GPS(52.5,13.4,0.0M) BAROMETER:91.2M
Mavic Mini, P4R   F/2.8, SS 206.14, ISO 150, GPS (13.4, 52.5, 15), D 48.6m, H 4.6m, G_PRY (-90.0°, 0.0°, 43.7°)
                  with RTK (13.4, 52.5, 15) in place of GPS
Autel             HOME(E: 13.4, N: 52.5) / GPS(E: 13.4, N: 52.5, 100.1m) / G.PRY (-90.0°, 0.0°, -3.7°)
"""

import re
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import zip_longest

from velfield.errors import Failure
from velfield.sources.telemetry.telemetry import Telemetry

_NUMBER = r"\s*([-+]?\d+(?:\.\d+)?)"
_CUE = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_TAG = re.compile(r"<[^>]*>")
_PAIR = re.compile(rf"([A-Za-z_]+)\s*:{_NUMBER}\s*(ft\b|feet\b)?", re.IGNORECASE)
_PLACE = re.compile(rf"(GPS|RTK)\s*\({_NUMBER}\s*,{_NUMBER}\s*(?:,{_NUMBER}\s*(m)?)?", re.IGNORECASE)
_PLACE_SIGNED = re.compile(
    rf"(?:GPS|RTK)\s*\(\s*([EW])\s*:{_NUMBER}\s*,\s*([NS])\s*:{_NUMBER}\s*(?:,{_NUMBER}\s*m)?", re.IGNORECASE
)
_HEIGHT = re.compile(rf"(?:^|[\s,])H{_NUMBER}\s*(m|ft)\b")
_FOCAL = re.compile(rf"focal_len\s*:{_NUMBER}")
_ZOOM = re.compile(rf"\bDZOOM\s+{_NUMBER}")
_ATTITUDE = re.compile(rf"G[._]PRY\s*\({_NUMBER}°?\s*,{_NUMBER}°?\s*,{_NUMBER}")
_CLOCK = re.compile(r"(\d{4})[-./](\d\d?)[-./](\d\d?)\s+(\d\d?):(\d\d?):(\d\d?)(?:[.,:](\d{3}))?")
_PAIRS = {
    "latitude": "latitude_deg",
    "longitude": "longitude_deg",
    "longtitude": "longitude_deg",  # as DJI wrote it for years
    "rel_alt": "height_m",
    "barometer": "height_m",
    "hb": "height_m",
    "abs_alt": "altitude_m",
    "altitude": "altitude_m",
    "gb_yaw": "yaw_deg",
    "gb_pitch": "pitch_deg",
    "gb_roll": "roll_deg",
    "focal_len": "focal_35mm",
    "dzoom_ratio": "zoom",
}
FOOT_M = 0.3048
_MIN_FOCAL_35MM = 15.0
"""A smaller number is the lens's own focal length, which means nothing without the sensor's size."""
_AMBIGUOUS_FROM, _TENTHS_OF_MM = 150.0, (190.0, 1000.0)
"""Whole numbers between are tenths of a millimetre, as DJI wrote them up to 2021 (240 is 24 mm). From 150 up to these,
and above, they may be either: no drone has a lens of 16.6 mm, nor of 100 mm in that format."""
_ZOOM_OF_ONE = 10_000


def parse_srt(text: str, origin: str) -> Telemetry | Failure:
    """Telemetry of a subtitle file's text: cues ``H:MM:SS,mmm --> H:MM:SS,mmm`` and their lines."""
    return telemetry_from_cues(_cues(text), origin)


def telemetry_from_cues(cues: Iterator[tuple[float, str]], origin: str) -> Telemetry | Failure:
    """Telemetry of subtitles, each with its time in s from the first frame; a failure where they hold none."""
    texts = list(cues)
    records = [(start_s, found) for start_s, text in texts if (found := parse_cue(text))]
    lens = [
        match[2] for _, text in texts if (match := _PAIR.search(text, text.find("focal_len"))) and "focal_len" in text
    ]
    unread = lens and not any("focal_35mm" in found for _, found in records)
    notes = [f"{origin}: focal_len {lens[0]} may be of two units, or of the lens itself: not used"] if unread else []
    telemetry = Telemetry.from_records(origin, records, notes)
    if not set(telemetry.known_quantities()) - {"clock_s", "zoom", "focal_35mm"}:
        return Failure(
            f"{origin}: found no position, height or attitude in the subtitles, expected a drone's telemetry"
        )
    return telemetry


def parse_cue(text: str) -> dict[str, float]:
    """The quantities in one subtitle, by their names in `Telemetry`."""
    plain, found = _TAG.sub(" ", text), dict[str, float]()
    for name, number, feet in _PAIR.findall(plain):
        if (quantity := _PAIRS.get(name.lower())) is not None:
            value = _focal(number) if quantity == "focal_35mm" else float(number) * (FOOT_M if feet else 1.0)
            found |= {} if value is None else {quantity: value}
    if match := _ZOOM.search(plain):
        found["zoom"] = float(match[1])
    if found.get("zoom", 0.0) >= _ZOOM_OF_ONE:
        found["zoom"] /= _ZOOM_OF_ONE
    found |= _position(plain) | _attitude(plain) | _clock(plain)
    if found.get("latitude_deg") == found.get("longitude_deg") == 0.0:
        del found["latitude_deg"], found["longitude_deg"]  # no satellites yet
    return found


def _focal(number: str) -> float | None:
    """The 35 mm equivalent, mm; None where the number may be of two units, or of the lens itself."""
    value = float(number)
    if "." not in number and value >= _AMBIGUOUS_FROM:
        if not _TENTHS_OF_MM[0] <= value < _TENTHS_OF_MM[1]:
            return None
        value /= 10
    return value if value >= _MIN_FOCAL_35MM else None


def _position(text: str) -> dict[str, float]:
    found = {}
    if match := _PLACE_SIGNED.search(text):
        east, longitude, north, latitude, altitude = match.groups()
        found["longitude_deg"] = _with_sign(longitude, east in "Ww")
        found["latitude_deg"] = _with_sign(latitude, north in "Ss")
        found |= {"height_m": float(altitude)} if altitude else {}
    elif places := _PLACE.findall(text):
        _, first, second, _, metres = next((place for place in places if place[0].upper() == "RTK"), places[0])
        x, y = float(first), float(second)
        # Longitude comes first, but in the dialect whose altitude has a unit; a latitude is 90 degrees at most.
        latitude_first = abs(y) > 90 or (bool(metres) and abs(x) <= 90)
        found["longitude_deg"], found["latitude_deg"] = (y, x) if latitude_first else (x, y)
    if match := _HEIGHT.search(text):
        found["height_m"] = float(match[1]) * (FOOT_M if match[2] == "ft" else 1.0)
    return found


def _with_sign(number: str, negative: bool) -> float:
    return -abs(float(number)) if negative else float(number)


def _attitude(text: str) -> dict[str, float]:
    match = _ATTITUDE.search(text)
    return dict(zip(("pitch_deg", "roll_deg", "yaw_deg"), map(float, match.groups()), strict=True)) if match else {}


def _clock(text: str) -> dict[str, float]:
    match = _CLOCK.search(text)
    if match is None:
        return {}
    year, month, day, hour, minute, second, milliseconds = (int(part or 0) for part in match.groups())
    try:
        moment = datetime(year, month, day, hour, minute, second, milliseconds * 1000, tzinfo=UTC)
        return {"clock_s": moment.timestamp()}
    except ValueError:
        return {}


def _cues(text: str) -> Iterator[tuple[float, str]]:
    """Start in s and text of each cue."""
    matches = list(_CUE.finditer(text))
    for match, following in zip_longest(matches, matches[1:]):
        end = following.start() if following else len(text)
        hours, minutes, seconds = (int(part) for part in match.groups()[:3])
        fraction = int(match[4]) / 10 ** len(match[4])
        yield 3600 * hours + 60 * minutes + seconds + fraction, text[match.end() : end]
