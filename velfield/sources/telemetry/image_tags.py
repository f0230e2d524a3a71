"""Telemetry of single images: EXIF, and XMP of DJI, Autel, Parrot, Skydio and others who write the same names."""

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path

import numpy as np
from PIL import ExifTags

from velfield.sources.images import image_size, read_image_tags
from velfield.sources.telemetry.attitude import DIAGONAL_35MM, camera_angles, rotation_to_ned

_FOCAL_35MM, _FOCAL, _ZOOM, _TAKEN, _FRACTION, _WIDTH, _HEIGHT = 0xA405, 0x920A, 0xA404, 0x9003, 0x9291, 0xA002, 0xA003
_CENTRE = (("CalibratedOpticalCenterX", "x"), ("CalibratedOpticalCenterY", "y"))
_SAME_ASPECT, _MAX_CENTRE, _MAX_LOG_FOCAL = 0.01, 0.15, 0.3
_CROPS = 0.9, 15.0
"""Equivalent over own focal length: 1 of 36 mm x 24 mm, up to 15 of a telephone's sensors."""
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
"""Orientation tags of older Autel firmware, and of Parrot, which also writes its own: a pitch of 0 is straight down."""


def read_image_telemetry(path: Path) -> tuple[dict[str, float], list[str]]:
    """The quantities in one image's EXIF and XMP, by their names in `Telemetry`, and notes on what is not used.

    Tags describe the picture that the camera wrote: a focal length in its pixels is scaled to this one's.

    Raises
    ------
    InputError
        It is no image.
    """
    exif, xmp = read_image_tags(path)
    tags, text = exif.get_ifd(ExifTags.IFD.Exif), xmp.decode("utf-8", "replace")
    found = _exif_position(exif.get_ifd(ExifTags.IFD.GPSInfo)) | _exif_camera(tags) | parse_xmp(text)
    taken = _number(tags.get(_WIDTH)), _number(tags.get(_HEIGHT))
    centre = _find_properties(_CENTRE, text)
    return _of_this_size(found, image_size(path, max_pixels=2**62), taken, centre)


def _of_this_size(
    found: dict[str, float], size: tuple[int, int], taken: tuple[float | None, float | None], centre: dict[str, float]
) -> tuple[dict[str, float], list[str]]:
    """The quantities as they are for a picture of a size, px, whose camera wrote one of another size.

    A resized picture shows all of the camera's, so that its focal length in pixels is reduced alike; of a part of the
    picture neither that nor the equivalent focal length is known.
    """
    width, height = size
    written = (float(taken[0]), float(taken[1])) if taken[0] and taken[1] else size
    across = {"focal_35mm", "focal_px"}
    note = f"the images are {width}x{height}, their tags of {written[0]:g}x{written[1]:g}"
    notes = []
    if abs(np.log(width / height * written[0] / written[1])) < _SAME_ASPECT and abs(np.log(width / height)) > 0.05:
        written = written[1], written[0]
        found = {name: value for name, value in found.items() if name != "yaw_deg"}
        notes.append(f"{note}: turned, so that their heading is not used")
    if abs(np.log(width / height / (written[0] / written[1]))) > _SAME_ASPECT:
        left = {name: value for name, value in found.items() if name not in across}
        return left, [f"{note}: a part of the picture, so that their focal length is not used"] if left != found else []
    factor = width / written[0]
    equivalent_px = found.get("focal_35mm", 0.0) / DIAGONAL_35MM * float(np.hypot(*written))
    # The optical centre lies near the middle of the picture that was calibrated.
    off = abs(np.log(2 * centre["x"] * factor / width)) if centre.get("x", 0) > 0 else 0.0
    if "focal_px" in found:
        if off > _MAX_CENTRE:
            found = {name: value for name, value in found.items() if name != "focal_px"}
            notes.append(
                f"the images are {width} px wide, their calibration is of {2 * centre['x']:.0f}: it is not used"
            )
        else:
            if equivalent_px and abs(np.log(found["focal_px"] / equivalent_px)) > _MAX_LOG_FOCAL:
                notes.append(
                    f"the calibrated focal length is {found['focal_px']:.0f} px, by that of 35 mm film it is "
                    f"{equivalent_px:.0f} px: the calibrated one is not used"
                )
                return {name: value for name, value in found.items() if name != "focal_px"}, notes
            found = found | {"focal_px": found["focal_px"] * factor}
            notes += [f"{note}: the calibrated focal length is scaled"] if factor != 1 else []
    return found, notes


def parse_xmp(text: str) -> dict[str, float]:
    """The quantities in an XMP packet."""
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
    focal, own, zoom = (_number(tags.get(tag)) for tag in (_FOCAL_35MM, _FOCAL, _ZOOM))
    if focal and (not own or _CROPS[0] <= focal / own <= _CROPS[1]):
        found["focal_35mm"] = focal
    if zoom and zoom > 0:
        found["zoom"] = zoom
    clock = parse_clock(*exif_time(tags))
    return found if clock is None else {**found, "clock_s": clock[0]}


def exif_time(tags: Mapping[int, object]) -> tuple[str, str]:
    """When an image was taken by its EXIF, and the digits of the fraction of a second; empty where it has none."""
    text, digits = (str(tags.get(tag, "")).strip("\0 ") for tag in (_TAKEN, _FRACTION))
    return text, digits


def parse_clock(text: str, digits: str) -> tuple[float, float] | None:
    """A camera's clock, s since 1970 as if it were set to UTC, and its resolution, s; None where it is no time.

    Examples
    --------
    >>> parse_clock("1970:01:01 00:01:00", "25"), parse_clock("", "")
    ((60.25, 0.01), None)
    """
    try:
        taken = datetime.strptime(text.replace("-", ":").replace("T", " "), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return None
    if not digits.isdecimal():
        return taken.timestamp(), 1.0
    return taken.timestamp() + float(f"0.{digits}"), 10.0 ** -len(digits)


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
