"""`velfield init`: its file is read back as the defaults that it lists."""

import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from flows.cli import app
from tests.media import drifting, write_video
from velfield.errors import InputError
from velfield.pipeline.configuration import resolve_config


@pytest.fixture
def images(tmp_path: Path) -> Path:
    folder = tmp_path / "frames"
    folder.mkdir()
    for k in range(12):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((48, 64), 10 * k, np.uint8))
    return folder


def init(*words: str) -> int:
    return int(app(["init", *words], result_action="return_value"))


def test_what_is_written_is_the_default_and_says_what_was_found(
    images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "flight.yaml"
    assert init(str(images), "--fps", "10", "--out", str(out)) == 0
    text = out.read_text()
    assert "12 frames of 64 x 48 px" in text
    assert "6 frames are processed" in text
    assert "12 frames of 64 x 48 px" in capsys.readouterr().out
    assert resolve_config(file=out) == resolve_config()


def test_the_command_that_it_prints_is_whole(images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "my flight.yaml"
    init(str(images), "--fps", "10", "--out", str(out))
    words = shlex.split(capsys.readouterr().out.splitlines()[-1].partition(" try ")[2])
    run = words[words.index("run") :]
    assert app([*run[:-1], str(tmp_path / "RUN"), "--plan"], result_action="return_value") == 0


def test_it_says_what_the_source_knows_of_scale_and_north(
    images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    init(str(images), "--fps", "10", "--out", str(tmp_path / "flight.yaml"))
    assert "Telemetry: none (the images have no position" in capsys.readouterr().out
    write_video(tmp_path / "x.mp4", list(drifting(5)))
    (tmp_path / "x.SRT").write_text(
        "1\n00:00:00,000 --> 00:00:01,000\n[focal_len: 24.00] [rel_alt: 100.2 abs_alt: 134.1] [gb_yaw: 3.0]\n"
    )
    init(str(tmp_path / "x.mp4"), "--out", str(tmp_path / "x.yaml"))
    assert "Telemetry: x.SRT: height, heading, focal length." in capsys.readouterr().out


def test_it_lists_every_key_which_may_be_uncommented(images: Path, tmp_path: Path) -> None:
    out = tmp_path / "flight.yaml"
    init(str(images), "--fps", "10", "--out", str(out))
    _, body = out.read_text().split("preset:", 1)
    uncommented = re.sub(r"^# ", "", f"preset:{body}", flags=re.MULTILINE)
    out.write_text(uncommented)
    assert resolve_config(file=out) == resolve_config(overrides={"gsd_m": 0.23})
    text = yaml.safe_load(uncommented)
    defaults = resolve_config().model_dump()
    assert {name: set(text[name]) for name in text if isinstance(text[name], dict)} == {
        name: set(section) for name, section in defaults.items() if isinstance(section, dict)
    }


def test_a_key_is_set_by_uncommenting_it(images: Path, tmp_path: Path) -> None:
    out = tmp_path / "flight.yaml"
    init(str(images), "--fps", "10", "--out", str(out))
    out.write_text(out.read_text().replace("#   max_speed_m_per_s: 34.5", "   max_speed_m_per_s: 20", 1))
    assert resolve_config(file=out).tracking.max_speed_m_per_s == 20


def test_an_existing_file_is_not_overwritten(images: Path, tmp_path: Path) -> None:
    out = tmp_path / "flight.yaml"
    out.write_text("preset: fast\n")
    with pytest.raises(InputError, match="exists already"):
        init(str(images), "--fps", "10", "--out", str(out))
    assert out.read_text() == "preset: fast\n"


def test_a_folder_without_timestamps_is_refused_with_the_remedy(images: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--fps"):
        init(str(images), "--out", str(tmp_path / "flight.yaml"))
