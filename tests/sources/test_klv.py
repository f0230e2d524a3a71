"""MISB KLV: a stream in the video or a file beside it gives scale, north and place as a drone's subtitles do."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from schemas.flight import FramesConfig
from schemas.georeference import GeoreferenceRecord
from tests.media import drifting, write_video
from tests.misb import KEY, encode_set, encode_telemetry, write_transport_stream
from tests.sources.test_telemetry import simulated_poses
from velfield.errors import Failure, InputError
from velfield.pipeline.stages.georeference import describe
from velfield.sources.capture_times import read_flight_start
from velfield.sources.frames import SourceInfo
from velfield.sources.source import probe
from velfield.sources.telemetry.find import find_beside
from velfield.sources.telemetry.klv import parse_klv
from velfield.sources.telemetry.placement import FramePoses, Place, estimate_north, estimate_place, estimate_scale
from velfield.sources.telemetry.read import read_telemetry, read_telemetry_file
from velfield.sources.telemetry.telemetry import Telemetry
from velfield.synthetic.flight import Flight

NADIR = {2: 1.7e9, 5: 30.0, 6: 0.0, 7: 0.0, 13: 52.5, 14: 13.4, 15: 537.0, 16: 40.0, 18: 0.0, 19: -90.0, 25: 37.0}


def true_hfov_deg(seed: int) -> float:
    config, _ = simulated_poses(seed)
    return float(2 * np.degrees(np.arctan(config.width / 2 / Flight(config).camera.focal_px)))


def in_transport_stream(packets: list[bytes], folder: Path) -> Telemetry | Failure:
    path = write_transport_stream(folder / "x.ts", packets)
    return read_telemetry(path, probe(path, frames=FramesConfig()))


def beside(packets: list[bytes], folder: Path) -> Telemetry | Failure:
    path = write_video(folder / "x.mp4", list(drifting(5)))
    (folder / "x.klv").write_bytes(b"".join(packets))
    return read_telemetry(path, probe(path, frames=FramesConfig()), find_beside(path))


VIDEO = SourceInfo("video", 640, 480, 2, np.arange(2) / 25, ("0", "1"))


@pytest.mark.parametrize("seed", [111, 112, 113])
@pytest.mark.parametrize("written", [in_transport_stream, beside], ids=["in the video", "beside it"])
def test_scale_north_and_place_by_klv(seed: int, written: object, tmp_path: Path) -> None:
    """The truth of a simulated flight, through the platform's and the sensor's angles, within the encoding's steps."""
    _, poses = simulated_poses(seed)
    packets = encode_telemetry(poses.telemetry, true_hfov_deg(seed))
    found = written(packets, tmp_path)
    truth = poses.telemetry
    expected_s = np.arange(len(packets)) / 25 if written is in_transport_stream else truth.time_s
    assert found.time_s == pytest.approx(expected_s, abs=2e-3)  # the clock of the subtitles is in milliseconds
    assert found.height_m == pytest.approx(truth.height_m, abs=0.35)
    # Of a camera that is tilted and rolled, "where the top points" differs by the product of both, some 0.03 degrees.
    assert np.abs((found.yaw_deg - truth.yaw_deg + 180) % 360 - 180).max() < 0.05
    assert found.pitch_deg == pytest.approx(truth.pitch_deg, abs=0.01)
    assert found.roll_deg == pytest.approx(truth.roll_deg, abs=0.01)
    by_klv = FramePoses(replace(found, time_s=truth.time_s), poses.width, poses.height, poses.centre_xy, poses.jacobian)
    config, _ = simulated_poses(seed)
    scale, north = estimate_scale(by_klv), estimate_north(by_klv)
    assert scale.gsd_m == pytest.approx(config.gsd_m, rel=0.03)
    assert scale.low_m < config.gsd_m < scale.high_m
    assert "above the ground" in scale.note
    true_rad = np.radians(-90 - config.telemetry.north_deg)
    assert abs(np.degrees(np.angle(np.exp(1j * (north.direction_rad - true_rad))))) < 2.5
    assert isinstance(estimate_place(by_klv, scale.gsd_m, north), Place)
    assert found.longitude_deg == pytest.approx(truth.longitude_deg, abs=1e-6)


@pytest.mark.parametrize(
    ("change", "height_m"),
    [
        ({}, 500.0),
        ({25: None, 21: 400.0}, 400.0),
        ({25: None, 21: 400.0, 19: -60.0}, 400.0 * np.cos(np.radians(30))),
        ({15: None, 25: None, 75: 580.0, 78: 180.0}, 400.0),
        ({25: None}, np.nan),
        ({25: None, 21: 400.0, 18: None}, np.nan),  # a range without the direction it is along
    ],
    ids=["elevations", "range", "range, tilted", "ellipsoid", "altitude alone", "no attitude"],
)
def test_height_above_the_ground(change: dict[int, float | None], height_m: float) -> None:
    tags = {tag: value for tag, value in (NADIR | change).items() if value is not None}
    found = parse_klv(encode_set(tags), "x.klv")
    assert found.height_m == pytest.approx([height_m], abs=0.35, nan_ok=True)


def test_the_vertical_angle_of_view_serves_where_it_is_alone() -> None:
    _, poses = simulated_poses(111)
    for tags in (NADIR, {tag: value for tag, value in NADIR.items() if tag != 16} | {17: 30.5}):
        found = parse_klv(encode_set(tags), "x.klv")
        still = found.at(np.zeros(len(poses.centre_xy)))
        focal = FramePoses(still, 640, 480, poses.centre_xy, poses.jacobian).focal_px
        expected = 320 / np.tan(np.radians(20)) if 16 in tags else 240 / np.tan(np.radians(15.25))
        assert focal == pytest.approx(expected, rel=1e-3)


def test_sets_with_a_wrong_checksum_are_left_out_and_told() -> None:
    good, bad = encode_set(NADIR), bytearray(encode_set(NADIR | {2: 1.7e9 + 1, 13: 10.0}))
    bad[60] ^= 1
    found = parse_klv(good + b"noise" + bytes(bad) + encode_set(NADIR | {2: 1.7e9 + 2}), "x.klv")
    assert found.time_s.tolist() == [0.0, 2.0]
    assert found.latitude_deg == pytest.approx([52.5, 52.5])
    assert found.notes == ("1 of 3 sets of x.klv have a wrong checksum: left out",)
    none = parse_klv(bytes(bad), "x.klv")
    assert isinstance(none, Failure)
    assert "1 MISB ST 0601 sets, 1 of them with a wrong checksum" in none.reason


def test_values_marked_as_errors_are_not_known() -> None:
    plain = {tag: value for tag, value in NADIR.items() if tag != 13}
    found = parse_klv(encode_set(plain, extra=b"\x0d\x04\x80\x00\x00\x00"), "x.klv")
    assert np.isnan(found.latitude_deg).all()
    assert found.height_m == pytest.approx([500.0], abs=0.35)


def test_a_set_cut_by_the_transport_is_put_together(tmp_path: Path) -> None:
    packet = encode_set(NADIR)
    found = in_transport_stream([packet[:40], packet[40:], b"\0", packet, b"\0"], tmp_path)
    assert found.time_s == pytest.approx([0.0, 0.12], abs=1e-3)


def test_the_clock_of_klv_is_utc(tmp_path: Path) -> None:
    path = write_transport_stream(tmp_path / "x.ts", [encode_set(NADIR | {2: 1.7e9 + k / 25}) for k in range(5)])
    start = read_flight_start(path, probe(path, frames=FramesConfig()))
    assert (start.is_utc, start.source) == (True, "MISB KLV of x.ts")
    assert start.clock_s == pytest.approx(1.7e9, abs=1e-3)


def test_without_klv_parser_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "klv_parser", None)
    monkeypatch.setattr("velfield.sources.telemetry.klv.find_spec", lambda name: None)
    found = in_transport_stream([encode_set(NADIR)] * 5, tmp_path)
    assert isinstance(found, Failure)
    assert "is not read: it needs klv-parser: pip install 'velfield[klv]'" in found.reason
    assert describe(GeoreferenceRecord(telemetry=found.reason)) == [f"metadata: {found.reason}"]
    assert describe(GeoreferenceRecord(telemetry="x.ts has no subtitles")) == []
    with pytest.raises(InputError, match=r"pip install 'velfield\[klv\]'"):
        beside([encode_set(NADIR)], tmp_path)


def test_a_file_that_is_no_klv_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.klv").write_bytes(b"no key" * 20)
    with pytest.raises(InputError, match="found 0 MISB ST 0601 sets"):
        read_telemetry_file(tmp_path / "x.klv", VIDEO)
    (tmp_path / "x.mp4").touch()
    assert find_beside(tmp_path / "x.mp4") is None
    (tmp_path / "x.bin").write_bytes(encode_set(NADIR))
    assert read_telemetry_file(tmp_path / "x.bin", VIDEO).height_m == pytest.approx([500.0], abs=0.35)
    assert KEY in (tmp_path / "x.bin").read_bytes()
