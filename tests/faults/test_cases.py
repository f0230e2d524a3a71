"""Every fault of ../shared/cases, which people's files and machines had, with the right value.

The same kinds without that folder: tests of tables, labels, telemetry, frames and exports, by the name of each test.
"""

import os
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from schemas.flight import FlightConfig, FramesConfig
from tests.exports.test_exports import tracklets_of
from tests.exports.test_frames_of_exports import MAPS, PATHS
from tests.media import drifting, write_video
from velfield.detection.onnx.detector import OnnxDetector
from velfield.errors import Failure
from velfield.exports.tracks.sumo import sumo_fcd
from velfield.pipeline.analysis.analyse import analyse_tracks
from velfield.pipeline.given_tracks.load import load_tracks
from velfield.sources.frames import SourceInfo
from velfield.sources.geo import read_base_raster
from velfield.sources.labels.labels import read_labels
from velfield.sources.quality import UNUSABLE
from velfield.sources.source import iter_frames, probe
from velfield.sources.telemetry.placement import FramePoses, estimate_scale
from velfield.sources.telemetry.read import read_telemetry, read_telemetry_file
from velfield.sources.telemetry.telemetry import Telemetry
from velfield.sources.tracks.checks import step_speeds

pytestmark = pytest.mark.footage
CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"
ONE = SourceInfo("folder", 800, 600, 1, np.zeros(1), ("00000.png",))
VIDEO = SourceInfo("video", 640, 480, 251, np.arange(251) / 25, tuple(map(str, range(251))))


def case(number: str) -> Path:
    """The folder of a case; skips the test, saying so, where it is not there."""
    found = sorted(CASES.glob(f"{number}-*"))
    return found[0] if found else pytest.skip(f"case {number} is not there ({CASES})")


def test_all_of_them_are_tested() -> None:
    there = {path.name[:2] for path in CASES.glob("[0-9]*")} or pytest.skip(f"{CASES} is not there")
    assert there <= {name[10:12] for name in globals() if name.startswith("test_case_")}


# ------------------------------------------------------------------------------------------------------------- tables


def analysed(number: str, name: str, folder: Path, fps: float | None = None) -> str:
    """What `velfield analyse --tracks` prints."""
    lines = analyse_tracks(case(number) / name, folder / "out", gsd_m=None, fps=fps, unit=None, y_axis=None)
    return "\n".join(lines)


def test_case_01_a_left_turn_of_geotrax(tmp_path: Path) -> None:
    text = analysed("01", "tracks.csv", tmp_path)
    assert "W to N" in text
    assert "W to S" not in text


def test_case_09_fcd_in_degrees(tmp_path: Path) -> None:
    text = analysed("09", "fcd.xml", tmp_path)
    assert "8 vehicles that drive" in text
    assert "W to N" in text


def test_case_10_ngsim_in_feet(tmp_path: Path) -> None:
    text = analysed("10", "trajectories.csv", tmp_path, fps=10.0)
    assert "0.13 km" in text
    assert "W to N" in text
    loaded = load_tracks(case("10") / "trajectories.csv", FlightConfig())
    speed, _ = step_speeds(loaded.table, loaded.xy_m)
    assert 3.6 * np.median(speed) == pytest.approx(36.0, rel=0.02)


def test_case_17_over_the_end_of_summer_time(tmp_path: Path) -> None:
    text = analysed("17", "tracks.csv", tmp_path)
    assert "41 s" in text
    assert "W to N" in text


def test_case_22_two_recordings_in_one_table(tmp_path: Path) -> None:
    assert "16 vehicles that drive" in analysed("22", "tracks.csv", tmp_path, fps=10.0)


def test_case_15_sumos_angles_are_in_the_frame_of_its_positions(tmp_path: Path) -> None:
    (tmp_path / "t.xml").write_text(sumo_fcd(tracklets_of(PATHS), MAPS["turned"]))
    command = [sys.executable, str(case("15") / "check.py"), str(tmp_path / "t.xml")]
    said = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout.split()
    assert float(said[said.index("median") + 1]) == pytest.approx(0.0, abs=0.5)
    assert int(said[-1]) > 20


# ------------------------------------------------------------------------------------- labels, detectors, base images


@pytest.mark.parametrize("folder", ["labels/train", "."])
def test_case_07_a_data_set_of_ultralytics(folder: str) -> None:
    labels = read_labels(case("07") / "dataset" / folder, ONE)
    assert (len(labels.cars), len(labels.ignored)) == (104, 9)


def test_case_06_rotations_of_cvat_in_coco() -> None:
    found = read_labels(case("06") / "instances_default.json", ONE).cars["orientation_rad"]
    assert len(found) == 104
    assert (np.degrees(found.min()), np.degrees(found.max())) == pytest.approx((80.73, 175.21), abs=0.01)


def test_case_21_a_frame_in_the_name_of_a_coco_image() -> None:
    assert read_labels(case("21") / "coco.json", VIDEO).frames == ("2",)


@pytest.mark.parametrize("name", ["v8", "strkeys"])
def test_case_20_names_of_an_onnx_model_with_keys_of_text(name: str) -> None:
    detector = OnnxDetector.from_file(case("20") / f"{name}.onnx")
    assert detector.record.vehicles == (2, 5, 7)
    assert len(detector.detect_raw(np.full((640, 640), 90, np.uint8))) == 20
    assert "vehicles are car, bus, truck" in detector.notes[0]


def test_case_13_a_base_image_in_a_local_reference_system() -> None:
    base = read_base_raster(case("13") / "ortho.tif", FramesConfig())
    assert base.gsd_m == pytest.approx(0.23, rel=1e-3)
    assert base.crs_wkt is None
    assert "no place on Earth" in base.notes[0]


def test_case_24_a_place_without_a_reference_system() -> None:
    base = read_base_raster(case("24") / "nocrs.tif", FramesConfig())
    assert base.gsd_m is None
    assert "names its reference system: it is not used" in base.notes[0]


# ------------------------------------------------------------------------------------------------ telemetry and frames


def scale_m(telemetry: Telemetry | Failure) -> float:
    count = len(telemetry.time_s)
    found = estimate_scale(FramePoses(telemetry, 640, 480, np.zeros((count, 2)), np.tile(np.eye(2), (count, 1, 1))))
    return found.gsd_m


def test_case_04_a_telephoto_lens() -> None:
    assert scale_m(read_telemetry_file(case("04") / "tele.SRT", VIDEO)) == pytest.approx(0.236, rel=0.02)


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Path]]:
    """Runs a case's ``make.py`` beside a clip of 60 frames; the folder that it writes to."""
    (tmp_path / "clip").mkdir()
    write_video(tmp_path / "clip" / "DJI_0001.MP4", list(drifting(60, 640, 480)))
    monkeypatch.chdir(tmp_path)

    def make(number: str) -> Path:
        runpy.run_path(str(case(number) / "make.py"), run_name="__main__")
        return tmp_path

    return make


@pytest.mark.parametrize("name", ["ex_ok", "ex_resized"])
def test_case_08_tags_of_photographs_four_times_as_large(name: str, made: Callable[[str], Path]) -> None:
    folder = made("08") / name
    assert scale_m(read_telemetry(folder, probe(folder, frames=FramesConfig(fps=5)))) == pytest.approx(0.236, rel=0.02)


@pytest.mark.parametrize("name", ["thermal", "u12"])
def test_case_12_frames_of_16_bits(name: str, made: Callable[[str], Path]) -> None:
    """Stretched as the frames of 8 bits are, whose range of grey levels is the test's own."""
    folder = made("12")
    frames = {}
    for kind in (name, "thermal8"):
        info = probe(folder / kind, frames=FramesConfig(fps=5))
        frames[kind] = list(iter_frames(folder / kind, info, np.arange(info.frame_count)))
    assert len(frames[name]) == 12
    for deep, plain in zip(frames[name], frames["thermal8"], strict=True):
        assert not deep.flags & UNUSABLE
        fitted = np.polyfit(plain.grey.ravel(), deep.grey.ravel(), 1)
        assert fitted[0] > 0.8
        assert np.abs(np.polyval(fitted, plain.grey) - deep.grey).mean() < 2


def test_case_23_intra_refresh() -> None:
    path = case("23") / "intra_refresh.mp4"
    info = probe(path, frames=FramesConfig())
    frames = list(iter_frames(path, info, np.arange(info.frame_count)))
    assert len(frames) == 30
    assert not [frame.source_index for frame in frames if frame.flags & UNUSABLE]


# ------------------------------------------------------------------------------------------------------------ machines


def ended(command: list[str], environment: dict[str, str], folder: Path) -> str:
    """What a command says that has to succeed, in an environment that lacks proxies' exceptions."""
    kept = {name: value for name, value in os.environ.items() if not name.lower().endswith("_proxy")}
    done = subprocess.run(
        command, env={**kept, **environment}, capture_output=True, text=True, timeout=580, check=False, cwd=folder
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout + done.stderr


@pytest.mark.slow
def test_case_02_proxies_for_every_address(tmp_path: Path) -> None:
    """A run reaches no address, so none stands in its way; a SOCKS proxy needs a package that is not there."""
    proxies = {"http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"}
    proxies["ALL_PROXY"] = "socks5h://127.0.0.1:9"
    tracks = case("01") / "tracks.csv"
    command = [sys.executable, "-m", "flows.cli", "run", "--tracks", str(tracks), "--out", str(tmp_path / "run")]
    ended(command, {**proxies, "PYTHONPATH": os.getcwd()}, tmp_path)
    assert (tmp_path / "run" / "index.html").exists()


def test_case_05_nothing_but_a_temporary_folder_can_be_written(tmp_path: Path) -> None:
    """As containers of a foreign user: neither the installation nor a home."""
    case("05")
    video = case("23") / "intra_refresh.mp4"
    if os.geteuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("another user can only be taken by root, with setpriv")
    tmp_path.chmod(0o777)
    other = ["--reuid=12345", "--regid=12345", "--clear-groups", "--inh-caps=+dac_read_search"]
    command = ["setpriv", *other, "--ambient-caps=+dac_read_search", sys.executable, "-m", "flows.cli", "init"]
    environment = {"HOME": "/nonexistent", "TMPDIR": str(tmp_path), "PYTHONPATH": os.getcwd()}
    said = ended([*command, str(video), "--out", str(tmp_path / "flight.yaml")], environment, tmp_path)
    assert "30 frames" in said
    assert "set HOME" in said
