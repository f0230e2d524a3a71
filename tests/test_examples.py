"""The scripts of `examples/`, each run as a user runs it, on the small flight."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from velfield.detection.registry import load_detector

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def run_example(name: str, *arguments: object) -> str:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    words = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=os.environ | {"PATH": path})
    assert "Warning" not in done.stderr
    return done.stdout


def test_every_script_is_run_by_a_test() -> None:
    text = Path(__file__).read_text(encoding="utf-8")
    elsewhere = {"prior_for_a_tracker.py"}  # tests/field/test_prior.py, which asserts its gain
    assert [
        p.name for p in sorted(EXAMPLES.glob("*.py")) if f'"{p.name}"' not in text and p.name not in elsewhere
    ] == []


def test_a_field_is_read(copy: Path) -> None:
    assert "pixels known, the busiest seen by" in run_example("read_field.py", copy)


def test_a_day_is_merged(copy: Path, tmp_path: Path) -> None:
    other = shutil.copytree(copy, tmp_path / "other")
    lines = run_example("merge_a_day.py", tmp_path / "day", copy, other).splitlines()
    busiest = [int(line.rpartition(", ")[2].split()[0]) for line in lines[-3:]]
    assert busiest[2] == busiest[0] + busiest[1]


def test_before_and_after_of_one_flight_are_the_same(copy: Path, tmp_path: Path) -> None:
    other = shutil.copytree(copy, tmp_path / "other")
    assert run_example("before_and_after.py", copy, other, tmp_path / "change")
    assert (tmp_path / "change" / "change.tif").exists()


def test_a_detector_of_ones_own(flight: Path, tmp_path: Path) -> None:
    given = flight / "frames", flight / "labels.csv", 0.23, tmp_path / "detector.json"
    assert "cars" in run_example("own_detector.py", *given, "detection.fine_tune_steps=5")
    assert load_detector(tmp_path / "detector.json").record.method == "cnn"


def test_a_field_for_a_gis(copy: Path) -> None:
    assert "speed_p50" in run_example("field_to_gis.py", copy)
    assert len(list((copy / "exports").iterdir())) == 2


def test_tracks_of_another_program(tmp_path: Path) -> None:
    assert "30" in run_example("own_tracks.py", tmp_path)
    assert (tmp_path / "analysis" / "report.html").exists()
