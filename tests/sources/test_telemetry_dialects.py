"""Dialects of telemetry by rule: units, orders and sizes are read as programs write them, or not used, with a note."""

import io
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from schemas.flight import FramesConfig
from velfield.errors import Failure, InputError
from velfield.sources.frames import SourceInfo
from velfield.sources.source import probe
from velfield.sources.telemetry.flight_log import parse_flight_log
from velfield.sources.telemetry.placement import FramePoses, estimate_scale
from velfield.sources.telemetry.read import read_telemetry, read_telemetry_file
from velfield.sources.telemetry.srt import parse_srt
from velfield.sources.telemetry.telemetry import Telemetry

VIDEO = SourceInfo("video", 640, 480, 251, np.arange(251) / 25, tuple(map(str, range(251))))


def srt(*cues: str) -> str:
    return "".join(f"{k + 1}\n00:00:0{k},000 --> 00:00:0{k + 1},000\n{cue}\n\n" for k, cue in enumerate(cues))


def read(*cues: str) -> Telemetry:
    found = parse_srt(srt(*cues), "x.SRT")
    assert isinstance(found, Telemetry), found
    return found


FOCAL_LENGTHS = {
    "166.00": 166.0,  # Mavic 3 Pro's telephoto lens
    "162.00": 162.0,
    "24.00": 24.0,
    "24": 24.0,
    "240.00": 240.0,
    "240": 24.0,
    "280": 28.0,
    "480": 48.0,
    "70.5": 70.5,
    "166": None,  # 16.6 or 166 mm
    "162": None,
    "2400": None,
    "8.80": None,  # the lens's own
    "4.5": None,
    "9000.0": None,
}


@pytest.mark.parametrize(("text", "spaces"), list(product(FOCAL_LENGTHS, (": ", " : ", ":"))))
def test_a_focal_length_is_in_one_unit_or_not_used(text: str, spaces: str) -> None:
    found = read(f"[focal_len{spaces}{text}] [latitude: 52.5] [longitude: 13.4] [rel_alt: 100.0 abs_alt: 134.0]")
    expected = FOCAL_LENGTHS[text]
    if expected is not None:
        assert found.focal_35mm == pytest.approx([expected])
        assert not found.notes
        return
    assert np.isnan(found.focal_35mm).all()
    assert "not used" in found.notes[0]


PLACES = {
    "GPS(13.4,52.5,16) BAROMETER:91.2": 91.2,
    "GPS(52.5,13.4,0.0M) BAROMETER:91.2M": 91.2,  # Matrice 300
    "GPS(13.4,52.5,16) Hb:91.2 Hs:3.1": 91.2,
    "F/2.8, SS 206, ISO 150, EV 0, GPS (13.4, 52.5, 15), D 48.62m, H 91.20m, H.S 1.40m/s": 91.2,
    "F/2.8, SS 206, ISO 150, EV 0, RTK (13.4, 52.5, 15), D 48.62m, H 91.20m, H.S 1.40m/s": 91.2,
    "GPS (13.3, 52.4, 15), RTK (13.4, 52.5, 15), D 48.62m, H 299.2126ft": 91.2,
    "HOME(E: 13.1, N: 52.1) GPS(E: 13.4, N: 52.5, 91.2m)": 91.2,
    "[latitude: 52.5] [longtitude: 13.4] [rel_alt: 91.2 abs_alt: 134.0]": 91.2,
    "[latitude: 52.5] [longitude: 13.4] [rel_alt: 299.2126 ft abs_alt: 134.0]": 91.2,
    "[latitude: 0.916298] [longitude: 0.233874] [rel_alt: 91.2 abs_alt: 134.0]": 91.2,  # radians
    "[latitude: 525000000] [longitude: 134000000] [rel_alt: 91.2 abs_alt: 134.0]": 91.2,
}


@pytest.mark.parametrize("text", PLACES)
def test_a_place_is_the_same_in_every_order_and_unit(text: str) -> None:
    found = read(f"2022.6.1 6:06:17 {text}")
    assert found.latitude_deg == pytest.approx([52.5], abs=1e-4)
    assert found.longitude_deg == pytest.approx([13.4], abs=1e-4)
    assert found.height_m == pytest.approx([PLACES[text]], abs=1e-3)
    assert found.clock_s == pytest.approx([1654063577.0])  # dates are not padded either
    assert bool(found.notes) == ("radians" in str(found.notes) or "1e-7" in str(found.notes))


@pytest.mark.parametrize(("first", "unit"), [(174.0, ""), (174.0, "M"), (-41.4, "M")])
def test_no_latitude_is_beyond_ninety_degrees(first: float, unit: str) -> None:
    second = -41.4 if first == 174.0 else 174.0
    found = read(f"GPS({first},{second},16{unit}) BAROMETER:91.2")
    assert (found.latitude_deg[0], found.longitude_deg[0]) == (-41.4, 174.0)


def test_angles_in_radians_of_a_camera_that_looks_down_are_known() -> None:
    found = read("[gb_yaw: 0.52 gb_pitch: -1.57 gb_roll: 0.0]", "[gb_yaw: 0.53 gb_pitch: -1.56 gb_roll: 0.0]")
    assert found.pitch_deg == pytest.approx([-90, -89.4], abs=0.1)
    assert found.yaw_deg == pytest.approx([29.8, 30.4], abs=0.1)
    assert found.notes == ("x.SRT: angles are in radians",)
    assert read("[gb_yaw: 30.0 gb_pitch: -1.57 gb_roll: 0.0]").pitch_deg == pytest.approx([-1.57])


@pytest.mark.parametrize("text", ["dzoom_ratio: 2.00", "dzoom_ratio: 20000, delta:0", "DZOOM 2.000"])
def test_zoom_is_a_factor(text: str) -> None:
    assert read(f"[{text}] [rel_alt: 91.2 abs_alt: 134.0]").zoom == pytest.approx([2.0])


def pose(**quantities: float) -> FramePoses:
    telemetry = Telemetry.from_records("x.SRT", [(0.0, {"height_m": 728.0, "pitch_deg": -90.0, **quantities})])
    return FramePoses(telemetry, 640, 480, np.zeros((1, 2)), np.eye(2)[None])


def test_a_field_of_view_that_no_camera_has_is_refused() -> None:
    scale = estimate_scale(pose(focal_35mm=166.0))
    assert scale.gsd_m == pytest.approx(728 / (166 / 43.267 * 800))
    for wrong in ({"focal_px": 20.0}, {"focal_px": 3e5}, {"hfov_deg": 0.01}, {"hfov_deg": 179.0}, {"focal_35mm": 3.0}):
        found = estimate_scale(pose(**wrong))
        assert isinstance(found, Failure), wrong
        assert "no focal length that can be" in found.reason


def image(size: tuple[int, int], *, tags: dict[int, object], calibrated: float = 0.0, centre: float = 0.0) -> bytes:
    xmp = f' drone-dji:CalibratedFocalLength="{calibrated}"' if calibrated else ""
    xmp += f' drone-dji:CalibratedOpticalCenterX="{centre}"' if centre else ""
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    data, packet = io.BytesIO(), f'<rdf:Description drone-dji:RelativeAltitude="+188.3" GimbalPitchDegree="-90" {xmp}/>'
    Image.new("L", size, 90).save(data, "JPEG", exif=exif, xmp=f"<x:xmpmeta>{packet}</x:xmpmeta>".encode())
    return data.getvalue()


WHOLE = {0xA002: 640, 0xA003: 480}
LARGE = {0xA002: 2560, 0xA003: 1920}
IMAGES: dict[str, tuple[bytes, float | None, str]] = {
    "as written": (image((640, 480), tags=WHOLE, calibrated=797.0), 797.0, ""),
    "resized": (image((640, 480), tags=LARGE, calibrated=3188.0), 797.0, "is scaled"),
    "enlarged": (image((1280, 960), tags=WHOLE, calibrated=797.0), 1594.0, "is scaled"),
    "resized, tags of the size gone": (
        image((640, 480), tags={0xA405: 43}, calibrated=3188.0),
        43 / 43.267 * 800,
        "calibrated one is not used",
    ),
    "resized, tags of the size new": (
        image((640, 480), tags=WHOLE, calibrated=3188.0, centre=1280.0),
        None,
        "their calibration is of 2560",
    ),
    "with its centre": (image((640, 480), tags=LARGE, calibrated=3188.0, centre=1290.0), 797.0, "is scaled"),
    "cropped": (image((640, 360), tags=LARGE | {0xA405: 43}, calibrated=3188.0), None, "a part of the picture"),
    "cropped, no calibration": (image((600, 480), tags=WHOLE | {0xA405: 43}), None, "a part of the picture"),
    "turned": (image((480, 640), tags=WHOLE, calibrated=797.0), 797.0, "heading is not used"),
    "to be turned for show": (image((640, 480), tags=WHOLE | {0x0112: 6}, calibrated=797.0), 797.0, ""),
    "equivalent": (image((640, 480), tags={0xA405: 43}), 43 / 43.267 * 800, ""),
    "digital zoom": (image((640, 480), tags={0xA405: 22, 0xA404: 2.0}), 44 / 43.267 * 800, ""),
    "no zoom": (image((640, 480), tags={0xA405: 43, 0xA404: 0.0}), 43 / 43.267 * 800, ""),
    "own focal length as equivalent": (image((640, 480), tags={0xA405: 43, 0x920A: 0.9}), None, ""),
}


@pytest.mark.parametrize("kind", IMAGES)
def test_the_focal_length_is_of_the_picture_that_there_is(kind: str, tmp_path: Path) -> None:
    data, focal_px, note = IMAGES[kind]
    (tmp_path / "a.jpg").write_bytes(data)
    info = probe(tmp_path, frames=FramesConfig(fps=1))
    found = read_telemetry(tmp_path, info)
    poses = FramePoses(found, info.width, info.height, np.zeros((1, 2)), np.eye(2)[None])
    assert poses.focal_px == pytest.approx([np.nan if focal_px is None else focal_px], nan_ok=True)
    assert (note in " ".join(found.notes)) if note else not found.notes


HEADERS = {
    "Airdata": "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),gimbal_heading(degrees),"
    "gimbal_pitch(degrees),isVideo",
    "flight record": "CUSTOM.updateTime,OSD.flyTime [s],OSD.latitude,OSD.longitude,OSD.height [m],GIMBAL.yaw,"
    "GIMBAL.pitch,CAMERA.isVideo",
    "own": "time_s,lat,lon,rel_alt_m,gimbal_yaw,gimbal_pitch,is_video",
}


def log(kind: str, seconds: int, filmed: range) -> str:
    lines = [HEADERS[kind]]
    for k in range(seconds):
        clock, height_m, is_filmed = f"2026-05-04 08:30:{k % 60:02d}", 90.0 + k, int(k in filmed)
        lines.append(
            {
                "Airdata": f"{k * 1000},{clock},52.5,13.4,{height_m / 0.3048},30,-90,{is_filmed}",
                "flight record": f"{clock},{k},52.5,13.4,{height_m},30,-90,{bool(is_filmed)}",
                "own": f"{k},52.5,13.4,{height_m},30,-90,{is_filmed}",
            }[kind]
        )
    return ("sep=,\n" if kind == "flight record" else "") + "\n".join(lines) + "\n"


@pytest.mark.parametrize("kind", HEADERS)
def test_a_flight_log_begins_where_the_recording_does(kind: str, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(log(kind, 60, range(20, 31)))
    found = read_telemetry_file(tmp_path / "log.csv", VIDEO)
    assert found.height_m[:2] == pytest.approx([110.0, 111.0])
    assert (found.time_s[0], found.latitude_deg[0], found.longitude_deg[0]) == (0.0, 52.5, 13.4)
    assert (found.yaw_deg[0], found.pitch_deg[0]) == (30.0, -90.0)
    assert "row at 20.0 s is taken for the first frame" in found.notes[0]


REFUSED = {
    "no unit": (log("own", 11, range(11)).replace("rel_alt_m", "rel_alt"), "column 'rel_alt' without a unit"),
    "no unit of time": (log("own", 11, range(11)).replace("time_s", "time"), "column 'time' without a unit"),
    "another recording": (log("Airdata", 60, range(20, 50)), "1 recordings, expected one of the video's 10 s"),
    "a whole flight": (log("own", 60, range(0)).replace(",is_video", ",x"), "a log of 59 s without a column isVideo"),
    "no time": (log("own", 11, range(11)).replace("time_s", "x"), "no column of the time"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_flight_log_that_may_be_read_in_two_ways_is_asked_about(kind: str, tmp_path: Path) -> None:
    text, match = REFUSED[kind]
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(InputError, match=match):
        read_telemetry_file(tmp_path / "log.csv", VIDEO)


def test_two_recordings_as_long_as_the_video_are_a_question() -> None:
    text = log("own", 60, range(20, 31)).splitlines()
    text[41:51] = [line[:-1] + "1" for line in text[41:51]]
    with pytest.raises(InputError, match="2 recordings"):
        parse_flight_log("\n".join(text), "log.csv", 10.0)
