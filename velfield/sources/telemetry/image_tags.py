"""Telemetry of single images: EXIF, and XMP of DJI, Autel, Parrot, Skydio and others who write the same names."""

import re
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path

from PIL import ExifTags

from velfield.sources.images import read_image_tags
from velfield.sources.telemetry.attitude import camera_angles, rotation_to_ned

_FOCAL_35MM, _TAKEN, _FRACTION = 0xA405, 0x9003, 0x9291
_XMP_NUMBER = r"""\s*(?:=\s*["']|>)\s*([-+]?\d+(?:\.\d+)?)(?:/(\d+))?"""
"""As an attribute or an element; Parrot writes fractions."""
_XMP: tuple[tuple[str, str], ...] = (
    ("GimbalYawDegree", "yaw_deg"),  # DJI, Autel
    ("GimbalPitchDegree", "pitch_deg"),
    ("GimbalRollDegree", "roll_deg"),
    ("CameraYawDegree", "yaw_deg"),  # Parrot
    ("CameraPitchDegree", "pitch_deg"),
    ("CameraRollDegree", "roll_deg"),
    ("RelativeAltitude", "height_m"),  # DJI, Autel, Skydio
    ("AboveGroundAltitude", "height_m"),  # Parrot
    ("AbsoluteAltitude", "altitude_m"),
    ("CalibratedFocalLength", "focal_px"),
    ("CalibratedFocalLengthX", "focal_px"),  # Skydio
    ("GpsLatitude", "latitude_deg"),
    ("GpsLongitude", "longitude_deg"),
    ("GpsLongtitude", "longitude_deg"),
    ("drone-skydio:Latitude", "latitude_deg"),
    ("drone-skydio:Longitude", "longitude_deg"),
)
"""Name of a property, whatever its prefix, and what it is in `Telemetry`; the first that is there is used."""
_ORIENTATION = (("Yaw", "yaw_deg"), ("Pitch", "pitch_deg"), ("Roll", "roll_deg"))
_SKYDIO_ORIENTATION = re.compile(r"[:\s<]CameraOrientationNED\b(.*?)(?:/>|</[\w-]+:CameraOrientationNED>)", re.DOTALL)
"""A structure; others beside it (of the vehicle, in other axes) have properties of the same names."""
_PIX4D_ORIENTATION = tuple((f"Camera:{name}", quantity) for name, quantity in _ORIENTATION)
"""Of older Autel firmware, and of Parrot's beside its own: a pitch of 0 is straight down."""


def read_image_telemetry(path: Path) -> dict[str, float]:
    """The quantities in one image's EXIF and XMP, by their names in `Telemetry`; empty where there are none.

    Raises
    ------
    InputError
        It is no image.
    """
    exif, xmp = read_image_tags(path)
    found = _exif_position(exif.get_ifd(ExifTags.IFD.GPSInfo)) | _exif_camera(exif.get_ifd(ExifTags.IFD.Exif))
    return found | parse_xmp(xmp.decode("utf-8", "replace"))


def parse_xmp(text: str) -> dict[str, float]:
    """The quantities in an XMP packet.

    Examples
    --------
    >>> parse_xmp('<rdf:Description drone-dji:RelativeAltitude="+80.20" drone-dji:GimbalPitchDegree="-90.00"/>')
    {'pitch_deg': -90.0, 'height_m': 80.2}
    """
    pix4d = _find_properties(_PIX4D_ORIENTATION, text)
    if "pitch_deg" in pix4d:
        pix4d["pitch_deg"] -= 90.0
    skydio = _SKYDIO_ORIENTATION.search(text)
    found = pix4d | (_find_properties(_ORIENTATION, skydio[1]) if skydio else {}) | _find_properties(_XMP, text)
    angles = [found.get(name) for _, name in _ORIENTATION]
    if None not in angles:
        found |= camera_angles(rotation_to_ned(*(angle or 0.0 for angle in angles)))
    return found


def _find_properties(names: tuple[tuple[str, str], ...], text: str) -> dict[str, float]:
    found: dict[str, float] = {}
    for name, quantity in names:
        match = re.search(rf"[:\s<]{re.escape(name)}{_XMP_NUMBER}", text)
        divisor = float(match[2] or 1) if match else 0.0
        if match and divisor and quantity not in found:
            found[quantity] = float(match[1]) / divisor
    return found


def _exif_position(gps: dict[int, object]) -> dict[str, float]:
    found = {}
    for quantity, value, reference, negative in (
        ("latitude_deg", ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef, "S"),
        ("longitude_deg", ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef, "W"),
    ):
        degrees = _degrees(gps.get(value))
        if degrees is not None:
            found[quantity] = -degrees if gps.get(reference) == negative else degrees
    altitude_m = _number(gps.get(ExifTags.GPS.GPSAltitude))
    if altitude_m is not None:
        found["altitude_m"] = altitude_m
    return found if found.get("latitude_deg") or found.get("longitude_deg") else {}


def _exif_camera(tags: dict[int, object]) -> dict[str, float]:
    found = {}
    focal = _number(tags.get(_FOCAL_35MM))
    if focal:
        found["focal_35mm"] = focal
    try:
        taken = datetime.strptime(str(tags.get(_TAKEN)), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return found
    fraction = str(tags.get(_FRACTION, "")).strip()
    found["clock_s"] = taken.timestamp() + (int(fraction) / 10 ** len(fraction) if fraction.isdecimal() else 0.0)
    return found


def _degrees(value: object) -> float | None:
    parts = [_number(part) for part in value] if isinstance(value, tuple) else []
    if len(parts) != 3 or None in parts:
        return None
    degrees, minutes, seconds = (part or 0.0 for part in parts)
    return degrees + minutes / 60 + seconds / 3600


def _number(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]  # what is no number raises
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if isfinite(number) else None
