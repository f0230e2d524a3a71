"""`velfield` alone says what to do next: every command that it prints is one that it has."""

import shlex
from pathlib import Path

import pytest

from flows.cli import app, main
from flows.commands.start import next_steps, own_command
from flows.commands.view import view
from velfield import open_run
from velfield.errors import InputError
from velfield.viewer.server import view_app


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
    assert "its telemetry file may give scale and north" in text
    assert "velfield run 'my flight.mov' --out 'my flight-run'" in text
    assert "old is an unfinished run" in text
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


def test_a_folder_that_holds_a_run_leads_to_it(tmp_path: Path) -> None:
    (tmp_path / "demo" / "run").mkdir(parents=True)
    (tmp_path / "demo" / "run" / "flight.json").touch()
    for read in (open_run, view_app):
        with pytest.raises(InputError, match=r"it holds a run: give .*demo.run$"):
            read(tmp_path / "demo")
    with pytest.raises(InputError, match="make one with"):
        open_run(tmp_path / "none")


def test_the_program_is_called_as_the_shell_finds_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")
    assert own_command() == "velfield"
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setattr("sys.argv", [".venv/bin/velfield", "run"])
    assert own_command() == ".venv/bin/velfield"
    monkeypatch.setattr("sys.argv", ["flows/cli.py", "run"])
    assert own_command().endswith(" -m flows.cli")


def test_the_page_of_an_analysed_run_opens_with_the_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    starts: list[str] = []
    monkeypatch.setattr("velfield.viewer.server.view_app", lambda folder: None)
    monkeypatch.setattr("velfield.viewer.server.serve", lambda *_, start, **options: starts.append(start))
    view(tmp_path)
    (tmp_path / "analysis").mkdir()
    (tmp_path / "analysis" / "analysis.json").touch()
    view(tmp_path)
    assert starts == ["", "#tab=analysis"]


def test_simulated_tracks_are_analysed_by_the_command_that_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = {"result_action": "return_value", "exit_on_error": False}
    assert app(["simulate", str(tmp_path / "two minutes"), "--tracks", "2", "--size", "800x600"], **options) == 0
    found, line = capsys.readouterr().out.splitlines()
    vehicles = int(found.split(": ")[1].removesuffix(" vehicles"))
    assert app(["analyse", *shlex.split(line.partition(" analyse ")[2])], **options) == 0
    assert f"y down; times: time_s (s); {vehicles} vehicles" in capsys.readouterr().out
