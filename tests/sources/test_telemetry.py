"""Files that drones write: subtitles of every format, tags of images, and scale, north and place from them."""

from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from rasterio.crs import CRS
from rasterio.warp import transform

from schemas.flight import FramesConfig
from schemas.simulation import SimulationConfig
from tests.media import drifting, write_video
from velfield.errors import Failure, InputError
from velfield.sources.frames import SourceInfo
from velfield.sources.source import probe
from velfield.sources.telemetry.find import find_beside, note_unusable
from velfield.sources.telemetry.image_tags import parse_xmp
from velfield.sources.telemetry.placement import (
    FramePoses,
    estimate_north,
    estimate_place,
    estimate_scale,
    metres_per_degree,
)
from velfield.sources.telemetry.read import read_telemetry, read_telemetry_file
from velfield.sources.telemetry.srt import parse_cue, parse_srt
from velfield.sources.telemetry.telemetry import Telemetry
from velfield.synthetic.clip import simulate_telemetry, srt_text
from velfield.synthetic.flight import Flight

HERE = {"latitude_deg": 52.5, "longitude_deg": 13.4}
FORMATS = {
    "DJI of 2023": (
        '<font size="28">FrameCnt: 1, DiffTime: 33ms\n2023-07-01 12:00:00.123\n[iso: 100] [shutter: 1/1000.0] '
        "[fnum: 1.7] [ev: 0] [color_md : default] [focal_len: 24.00] [dzoom_ratio: 1.00] [latitude: 52.5] "
        "[longitude: 13.4] [rel_alt: 100.2 abs_alt: 150.3] [gb_yaw: -12.3 gb_pitch: -90.0 gb_roll: 0.0] </font>",
        HERE | {"height_m": 100.2, "altitude_m": 150.3, "focal_35mm": 24.0, "yaw_deg": -12.3, "pitch_deg": -90.0},
    ),
    "DJI of 2018": (
        '<font size="36">SrtCnt : 1, DiffTime : 40ms\n2019-09-25 05:11:39,232,160\n[iso : 110] [shutter : 1/200.0] '
        "[fnum : 280] [ev : 0.7] [ct : 5064] [color_md : default] [focal_len : 280] [dzoom_ratio: 10000, delta:0] "
        "[latitude : 52.5] [longtitude : 13.4] [altitude: 142.7] </font>",
        HERE | {"altitude_m": 142.7, "focal_35mm": 28.0, "zoom": 1.0},
    ),
    "Phantom 4, Mavic Pro": (
        "HOME(13.39,52.49) 2017.08.05 14:11:51\nGPS(13.4,52.5,16) BAROMETER:91.2\nISO:100 Shutter:60 EV: Fnum:2.2",
        HERE | {"height_m": 91.2},
    ),
    "Mavic Mini": (
        "F/2.8, SS 206.14, ISO 150, EV 0, GPS (13.4, 52.5, 15), D 48.62m, H 4.60m, H.S 1.40m/s, V.S 0.50m/s",
        HERE | {"height_m": 4.6},
    ),
    "Phantom 4 RTK": (
        "F/5.6, SS 240, ISO 100, EV 0, DZOOM 1.000, GPS (13.4, 52.5, 15), D 24.26m, H 60.00m, H.S 0.00m/s, "
        "V.S 0.00m/s, F_PRY (2.1°, -5.2°, 43.1°), G_PRY (-90.0°, 0.0°, 43.7°)",
        HERE | {"height_m": 60.0, "pitch_deg": -90.0, "roll_deg": 0.0, "yaw_deg": 43.7},
    ),
    "Autel": (
        "HOME(W: 13.4, N: 52.5) 2018-12-05 10:38:46\nGPS(W: 13.4, N: 52.5, 100.10m)\nISO:100 SHUTTER:60 EV:0 F-NUM:2.8"
        "\nF.PRY (1.0°, -0.6°, -3.7°), G.PRY (-89.9°, 0.0°, -3.7°)",
        {"latitude_deg": 52.5, "longitude_deg": -13.4, "height_m": 100.1, "pitch_deg": -89.9, "yaw_deg": -3.7},
    ),
}


VIDEO = SourceInfo("video", 640, 480, 2, np.arange(2) / 25, ("0", "1"))


@pytest.mark.parametrize(("text", "expected"), FORMATS.values(), ids=list(FORMATS))
def test_subtitles_of_every_format_are_read(text: str, expected: dict[str, float]) -> None:
    found = parse_cue(text)
    assert {name: found.get(name) for name in expected} == pytest.approx(expected)
    assert found.get("clock_s", 1.6e9) > 1.48e9


def test_subtitles_that_are_no_telemetry_are_none(tmp_path: Path) -> None:
    plain = "1\n00:00:01,000 --> 00:00:02,000\nA bird sings: 3 times.\n"
    assert isinstance(parse_srt(plain, "x.srt"), Failure)
    (tmp_path / "x.srt").write_text(plain)
    with pytest.raises(InputError, match="expected a drone's telemetry"):
        read_telemetry_file(tmp_path / "x.srt", VIDEO)
    (tmp_path / "x.srt").write_text("no cue at all")
    with pytest.raises(InputError, match="expected a drone's telemetry"):
        read_telemetry_file(tmp_path / "x.srt", VIDEO)
    (tmp_path / "x.mp4").touch()
    assert find_beside(tmp_path / "x.mp4") is None
    assert note_unusable(tmp_path / "x.mp4").startswith("x.srt, next to the video, holds no position")
    (tmp_path / "x.SRT").write_text(f"1\n00:00:01,000 --> 00:00:02,000\n{FORMATS['Mavic Mini'][0]}\n")
    assert find_beside(tmp_path / "x.mp4") == tmp_path / "x.SRT"
    assert note_unusable(tmp_path / "x.mp4") == ""


def test_zero_coordinates_are_no_place() -> None:
    assert "latitude_deg" not in parse_cue("[latitude: 0.000000] [longitude: 0.000000] [rel_alt: 3.0 abs_alt: 4.0]")


def test_values_between_records_are_interpolated_and_far_from_them_unknown() -> None:
    records = [(0.0, {"yaw_deg": 179.0, "height_m": 10.0}), (2.0, {"yaw_deg": -179.0, "height_m": 20.0})]
    found = Telemetry.from_records("test", records).at(np.array([1.0, 3.0, 60.0]))
    assert found.height_m[:2] == pytest.approx([15.0, 20.0])
    assert found.yaw_deg[0] % 360 == pytest.approx(180.0)
    assert np.isnan(found.height_m[2])


def test_subtitles_in_the_video_are_read_as_those_beside_it(tmp_path: Path) -> None:
    from velfield.synthetic.clip import open_clip

    config = SimulationConfig(frames=5, width=160, height=120, clip="embedded")
    times_s = np.arange(5) / 25
    texts = [FORMATS["DJI of 2023"][0].replace("100.2", f"{100 + k}.0") for k in range(5)]
    with open_clip(tmp_path, config, times_s, texts) as clip:
        for k, grey in enumerate(drifting(5)):
            clip.write(k, grey)
    path = tmp_path / "DJI_0001.MP4"
    inside = read_telemetry(path, probe(path, frames=FramesConfig()))
    beside = parse_srt(srt_text(texts, times_s), "x.srt")
    assert inside.height_m.tolist() == beside.height_m.tolist() == [100.0, 101.0, 102.0, 103.0, 104.0]
    assert inside.time_s == pytest.approx(times_s, abs=1e-3)
    with av.open(str(path)) as made:
        assert not made.streams.video[0].codec_context.has_b_frames


def test_a_video_without_telemetry_gives_the_reason(tmp_path: Path) -> None:
    path = write_video(tmp_path / "x.mp4", list(drifting(5)))
    found = read_telemetry(path, probe(path, frames=FramesConfig()))
    assert isinstance(found, Failure)
    assert "no subtitles" in found.reason


def test_tags_of_images_are_read(tmp_path: Path) -> None:
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description drone-dji:GimbalYawDegree="+30.50" '
        'drone-dji:GimbalPitchDegree="-90.00" drone-dji:GimbalRollDegree="+0.00" drone-dji:RelativeAltitude="+80.20"/>'
        "</x:xmpmeta>"
    )
    exif = Image.Exif()
    exif.get_ifd(0x8825).update({1: "N", 2: (52.0, 30.0, 0.0), 3: "W", 4: (13.0, 24.0, 0.0)})
    exif.get_ifd(0x8769).update({0xA405: 24, 0x9003: "2024:05:01 12:00:00"})
    for k in range(3):
        Image.new("L", (64, 48), 90).save(tmp_path / f"{k}.jpg", exif=exif, xmp=xmp.encode())
    found = read_telemetry(tmp_path, probe(tmp_path, frames=FramesConfig(fps=1.0)))
    assert found.latitude_deg == pytest.approx([52.5] * 3)
    assert found.longitude_deg == pytest.approx([-13.4] * 3)
    assert found.height_m == pytest.approx([80.2] * 3)
    assert found.focal_35mm == pytest.approx([24.0] * 3)
    assert found.yaw_deg == pytest.approx([30.5] * 3)


XMP = {
    # As developer.parrot.com lists them for ANAFI Ai: elements, a height as a fraction, Pix4D's angles beside its own.
    "Parrot": (
        '<rdf:Description rdf:about="" xmlns:drone-parrot="http://www.parrot.com/drone-parrot/1.0/" '
        'xmlns:Camera="http://pix4d.com/camera/1.0"><Camera:Roll>-0.041258</Camera:Roll>'
        "<Camera:Pitch>3.011101</Camera:Pitch><Camera:Yaw>146.781036</Camera:Yaw>"
        "<Camera:AboveGroundAltitude>11485529/262144</Camera:AboveGroundAltitude>"
        "<drone-parrot:CameraRollDegree>0.0</drone-parrot:CameraRollDegree>"
        "<drone-parrot:CameraPitchDegree>-86.988888</drone-parrot:CameraPitchDegree>"
        "<drone-parrot:CameraYawDegree>146.848038</drone-parrot:CameraYawDegree></rdf:Description>",
        {"height_m": 11485529 / 262144, "pitch_deg": -86.988888, "yaw_deg": 146.848038, "roll_deg": 0.0},
    ),
    # Skydio 2 and X2: attributes of a structure, beside the same structure of the vehicle and in other axes.
    "Skydio X2": (
        '<rdf:Description drone-skydio:Latitude="52.5" drone-skydio:Longitude="13.4" '
        'drone-skydio:AbsoluteAltitude="1034.441910" drone-skydio:RelativeAltitude="61.5" '
        'drone-skydio:CalibratedFocalLengthX="2376.5625" drone-skydio:CalibratedFocalLengthY="2376.5625">'
        '<drone-skydio:VehicleOrientationNED drone-skydio:Roll="1.0" drone-skydio:Pitch="2.0" drone-skydio:Yaw="3.0"/>'
        '<drone-skydio:CameraOrientationFLU drone-skydio:Roll="4.0" drone-skydio:Pitch="87" drone-skydio:Yaw="6.0"/>'
        '<drone-skydio:CameraOrientationNED drone-skydio:Roll="0.0" drone-skydio:Pitch="-87.468572" '
        'drone-skydio:Yaw="127.444323"/></rdf:Description>',
        HERE
        | {"height_m": 61.5, "focal_px": 2376.5625}
        | {"pitch_deg": -87.468572, "yaw_deg": 127.444323, "roll_deg": 0.0},
    ),
    "Skydio X10": (
        "<drone-skydio:Latitude>52.5</drone-skydio:Latitude><drone-skydio:Longitude>13.4</drone-skydio:Longitude>"
        '<drone-skydio:CameraOrientationFLU rdf:parseType="Resource"><drone-skydio:Yaw>9</drone-skydio:Yaw>'
        "</drone-skydio:CameraOrientationFLU>"
        '<drone-skydio:CameraOrientationNED rdf:parseType="Resource"><drone-skydio:Roll>0.0</drone-skydio:Roll>'
        "<drone-skydio:Pitch>-80.5</drone-skydio:Pitch><drone-skydio:Yaw>-12.5</drone-skydio:Yaw>"
        "</drone-skydio:CameraOrientationNED>",
        HERE | {"pitch_deg": -80.5, "yaw_deg": -12.5, "roll_deg": 0.0},
    ),
    "Autel of old": (
        '<rdf:Description Camera:Yaw="30" Camera:Pitch="2.5" Camera:Roll="0"/>',
        {"pitch_deg": -87.5, "yaw_deg": 30.0, "roll_deg": 0.0},
    ),
    # Straight down yaw and roll turn about one axis: 100 and 50 are as 150 and 0, and DJI's roll of 180 turns about.
    "straight down": (
        ' drone-parrot:CameraYawDegree="100" drone-parrot:CameraPitchDegree="-90" drone-parrot:CameraRollDegree="50"',
        {"pitch_deg": -90.0, "yaw_deg": 150.0},
    ),
    "DJI upside down": (
        'drone-dji:GimbalYawDegree="+30.0" drone-dji:GimbalPitchDegree="-90.00" drone-dji:GimbalRollDegree="+180.00"',
        {"pitch_deg": -90.0, "yaw_deg": -150.0, "roll_deg": 0.0},
    ),
}


@pytest.mark.parametrize(("text", "expected"), XMP.values(), ids=list(XMP))
def test_xmp_of_every_maker_is_read(text: str, expected: dict[str, float]) -> None:
    found = parse_xmp(text)
    assert {name: found.get(name) for name in expected} == pytest.approx(expected, abs=1e-6)


def test_a_fraction_over_zero_is_not_known() -> None:
    assert "height_m" not in parse_xmp("<Camera:AboveGroundAltitude>5/0</Camera:AboveGroundAltitude>")


def simulated_poses(seed: int) -> tuple[SimulationConfig, FramePoses]:
    """The frames of a simulated flight on its base image, exactly, with the telemetry of a drone."""
    config = SimulationConfig(seed=seed, frames=40, width=640, height=480, clip="beside")
    flight = Flight(config)
    telemetry = parse_srt(
        srt_text(simulate_telemetry(config, flight.camera, flight.base_shape), flight.times_s), "x.SRT"
    )
    centre = np.array([(config.width - 1) / 2, (config.height - 1) / 2])
    around = centre + 60.0 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    base = np.stack([flight.camera.to_base(k, around) for k in range(config.frames)])
    jacobian = np.stack([base[:, 1] - base[:, 2], base[:, 3] - base[:, 4]], axis=2) / 120.0
    poses = FramePoses(telemetry.at(flight.times_s), config.width, config.height, base[:, 0], jacobian)
    return config, poses


@pytest.mark.parametrize("seed", [101, 102, 103])
def test_scale_north_and_place_of_a_simulated_drone(seed: int) -> None:
    config, poses = simulated_poses(seed)
    scale, north = estimate_scale(poses), estimate_north(poses)
    assert scale.gsd_m == pytest.approx(config.gsd_m, rel=0.03)
    assert scale.low_m < config.gsd_m < scale.high_m
    true_rad = np.radians(-90 - config.telemetry.north_deg)
    assert abs(np.degrees(np.angle(np.exp(1j * (north.direction_rad - true_rad))))) < 2.5
    place = estimate_place(poses, scale.gsd_m, north)
    height, width = Flight(config).base_shape
    x, y = np.reshape(place.affine, (2, 3)) @ (width / 2, height / 2, 1.0)
    (longitude,), (latitude,) = transform(CRS.from_wkt(place.crs_wkt), CRS.from_epsg(4326), [x], [y])
    east_m, north_m = metres_per_degree(config.telemetry.latitude_deg)
    off = (longitude - config.telemetry.longitude_deg) * east_m, (latitude - config.telemetry.latitude_deg) * north_m
    assert np.hypot(*off) < 3 * place.sd_m < 20


def test_a_camera_that_looks_at_the_horizon_has_no_scale() -> None:
    _, poses = simulated_poses(101)
    tilted = Telemetry.from_records("x.SRT", [(0.0, {"height_m": 100.0, "pitch_deg": -30.0, "focal_35mm": 24.0})])
    flat = FramePoses(
        tilted.at(np.zeros(len(poses.centre_xy))), poses.width, poses.height, poses.centre_xy, poses.jacobian
    )
    found = estimate_scale(flat)
    assert isinstance(found, Failure)
    assert "tilted by 60°" in found.reason
