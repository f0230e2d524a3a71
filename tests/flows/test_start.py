"""`velfield` alone says what to do next: every command that it prints is one that it has."""

import shlex
from pathlib import Path

import pytest

from flows.cli import app, main
from flows.commands.start import next_steps


def printed(folder: Path) -> str:
    text = "\n".join(next_steps(folder))
    for line in text.splitlines():
        if line.startswith("  velfield "):
            arguments = shlex.split(line.split("  #")[0].split("   #")[0])[1:]
            app.parse_args(arguments, exit_on_error=False, print_error=False)
    return text


def test_an_empty_folder_leads_to_the_demo(tmp_path: Path) -> None:
    assert "velfield demo" in printed(tmp_path)


def test_videos_runs_and_images_are_named(tmp_path: Path) -> None:
    for name in ("DJI_0001.MP4", "DJI_0001.SRT", "my flight.mov"):
        (tmp_path / name).touch()
    for folder, file in (("old", "flight.json"), ("done", "flight.json"), ("done", "index.html")):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / file).touch()
    (tmp_path / "frames").mkdir()
    for number in range(4):
        (tmp_path / "frames" / f"{number}.jpg").touch()
    text = printed(tmp_path)
    assert "velfield run DJI_0001.MP4 --out DJI_0001-run" in text
    assert "its .SRT may give scale and north" in text
    assert "velfield run 'my flight.mov' --out 'my flight-run'" in text
    assert "old is a run that is not finished" in text
    assert "velfield view done" in text
    assert "velfield run frames --timestamps" in text
    assert "velfield demo" not in text


def test_the_command_alone_exits_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["velfield"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    assert "velfield demo" in capsys.readouterr().out
