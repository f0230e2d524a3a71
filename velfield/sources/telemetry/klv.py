"""MISB ST 0601 metadata (KLV), as military and survey drones put it into an MPEG-TS: a local set a frame or a second.

The sets are found by their key and kept where their checksum holds; klv-parser (the extra ``klv``) reads their values.
The camera's attitude is the platform's turned by the sensor's relative to it.
"""

import re
from collections.abc import Iterator, Mapping
from datetime import datetime
from importlib.util import find_spec
from itertools import pairwise

import numpy as np

from velfield.errors import Failure, InputError
from velfield.sources.telemetry.attitude import camera_angles, rotation_to_ned
from velfield.sources.telemetry.telemetry import ABOVE_GROUND, Telemetry

KLV_KEY = bytes.fromhex("060e2b34020b01010e01030101000000")
"""Key of a UAS Datalink Local Set."""
KLV_SUFFIX = ".klv"
NEEDS_KLV = "needs klv-parser: pip install 'velfield[klv]'"
MAX_SETS = 20_000
"""Maximum number of sets that are read, evenly spread: about 80 microseconds each."""
_TIME, _HEADING, _PITCH, _ROLL, _LATITUDE, _LONGITUDE, _ALTITUDE = 2, 5, 6, 7, 13, 14, 15
_WIDTH, _HEIGHT, _AZIMUTH, _ELEVATION, _SENSOR_ROLL, _RANGE, _GROUND = 16, 17, 18, 19, 20, 21, 25
_ELLIPSOID, _GROUND_ELLIPSOID, _FULL_PITCH, _FULL_ROLL = 75, 78, 90, 91


def parse_klv(data: bytes, origin: str, times_s: Mapping[int, float] | None = None) -> Telemetry | Failure:
    """Telemetry of a stream of local sets; all else in it is skipped.

    ``times_s`` has the time from the source's first frame, s, of what begins at an offset in the stream, ascending.
    Without it the stream is taken to begin with the first frame, and times are by the sets' own clock.

    Raises
    ------
    InputError
        klv-parser is not installed.
    """
    if find_spec("klv_parser") is None:
        raise InputError(f"{origin}: found MISB KLV, which {NEEDS_KLV}, or move it elsewhere")
    packets = list(_local_sets(data))
    valid = [(offset, value) for offset, value in packets if value is not None]
    read = [(offset, _read_tags(value)) for offset, value in valid[:: -(-len(valid) // MAX_SETS) or 1]]
    if times_s is not None:
        at_s = np.array(list(times_s.values()))
        parts = np.searchsorted(list(times_s), [offset for offset, _ in read], side="right") - 1
        timed = [(float(at_s[part]), tags) for part, (_, tags) in zip(parts, read, strict=True)]
    else:
        clocked = [(tags[_TIME], tags) for _, tags in read if _TIME in tags]
        timed = [(clock_s - clocked[0][0], tags) for clock_s, tags in clocked]
    wrong = len(packets) - len(valid)
    notes = [f"{wrong} of {len(packets)} sets of {origin} have a wrong checksum: left out"] if wrong else []
    records = [(time_s, _quantities(tags)) for time_s, tags in timed]
    telemetry = Telemetry.from_records(origin, records, notes, height=ABOVE_GROUND, is_utc=True)
    if not set(telemetry.known_quantities()) - {"clock_s", "hfov_deg", "vfov_deg"}:
        found = f"{len(packets)} MISB ST 0601 sets, {wrong} of them with a wrong checksum"
        return Failure(f"{origin}: found {found}, expected a position, height or attitude in them")
    return telemetry


def _local_sets(data: bytes) -> Iterator[tuple[int, bytes | None]]:
    """Offset and value of each local set; None for the value where the checksum is wrong."""
    from klv_parser.common import packet_checksum

    starts = [match.start() for match in re.finditer(re.escape(KLV_KEY), data)]
    for start, following in pairwise([*starts, len(data)]):
        at = start + len(KLV_KEY)
        first = int.from_bytes(data[at : at + 1])
        header = at + 1 + max(first - 128, 0)  # the length in one byte, or the number of bytes that it takes
        length = first if first < 128 else int.from_bytes(data[at + 1 : header])
        # A length that is corrupt may reach over the next set: that one is read all the same.
        packet = data[start : min(header + length, following)]
        is_valid = length > 4 and packet[-2:] == packet_checksum(packet)
        yield start, data[header : start + len(packet)] if is_valid else None


def _read_tags(value: bytes) -> dict[int, float]:
    """The numbers in a local set by their tags; those that its maker marks as errors are left out."""
    from klv_parser.misb0601 import UASLocalMetadataSet

    try:
        items = UASLocalMetadataSet(value).items
    except (ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError):
        return {}  # of a correct checksum, and against the standard all the same
    values = {key[0]: getattr(getattr(item, "value", None), "value", None) for key, item in items.items() if key}
    values |= {tag: value.timestamp() for tag, value in values.items() if isinstance(value, datetime)}
    return {tag: value for tag, value in values.items() if isinstance(value, float) and np.isfinite(value)}


def _quantities(tags: Mapping[int, float]) -> dict[str, float]:
    """The quantities of a local set, by their names in `Telemetry`."""
    names = {_TIME: "clock_s", _WIDTH: "hfov_deg", _HEIGHT: "vfov_deg"}
    found = {name: tags[tag] for tag, name in names.items() if tags.get(tag, 0.0) > 0}
    if tags.get(_LATITUDE) or tags.get(_LONGITUDE):
        found |= {name: tags[tag] for tag, name in _POSITION.items() if tag in tags}
    found |= _attitude(tags)
    altitude_m = tags.get(_ALTITUDE, tags.get(_ELLIPSOID))
    if altitude_m is not None:
        found["altitude_m"] = altitude_m
    for sensor, ground in ((_ALTITUDE, _GROUND), (_ELLIPSOID, _GROUND_ELLIPSOID)):
        if sensor in tags and ground in tags:
            return found | {"height_m": tags[sensor] - tags[ground]}
    if tags.get(_RANGE, 0.0) > 0 and "pitch_deg" in found:
        across = np.tan(np.radians([90.0 + found["pitch_deg"], found["roll_deg"]]))
        return found | {"height_m": float(tags[_RANGE] / np.sqrt(1 + across @ across))}
    return found


_POSITION = {_LATITUDE: "latitude_deg", _LONGITUDE: "longitude_deg"}


def _attitude(tags: Mapping[int, float]) -> dict[str, float]:
    """The camera's angles; of sensors without an axis of roll that angle is 0."""
    pitch, roll = tags.get(_PITCH, tags.get(_FULL_PITCH)), tags.get(_ROLL, tags.get(_FULL_ROLL))
    if pitch is None or roll is None or not {_HEADING, _AZIMUTH, _ELEVATION} <= set(tags):
        return {}
    platform = rotation_to_ned(tags[_HEADING], pitch, roll)
    return camera_angles(platform @ rotation_to_ned(tags[_AZIMUTH], tags[_ELEVATION], tags.get(_SENSOR_ROLL, 0.0)))
