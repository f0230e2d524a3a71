"""Scale: what is planned for four hours, and that a driver's memory does not grow with the flight."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flows.console import Console
from flows.orchestration import Threads
from flows.process_flight import process_tracks
from flows.runners import RunnerConfig
from schemas.job import Inputs, Job
from schemas.records import InputsRecord, SourceRecord
from tests.small_flight import job
from velfield.errors import InputError
from velfield.pipeline.check_inputs import validate_inputs
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.estimate import describe_plan, planned_units
from velfield.pipeline.plan import Plan, changed_since, check_inputs, make_plan, write_clips, write_flight_record
from velfield.pipeline.stage import stage_keys
from velfield.run.layout import RunLayout
from velfield.sources.frames import SourceInfo

FOUR_HOURS = 72_000


def planned(frames: int, root: Path, width: int = 2560, height: int = 1920, unit_frames: int | str = "auto") -> Plan:
    """The plan of a flight at 5 frames a second that need not exist."""
    source = SourceRecord(path="flight.mp4", kind="video", digest="d", width=width, height=height, frame_count=frames)
    inputs, config = InputsRecord(source=source), resolve_config(overrides={"work.unit_frames": unit_frames})
    info = SourceInfo("video", width, height, frames, np.arange(frames) / 5, ())
    job = Job(root=str(root), inputs=Inputs(source="flight.mp4"), config=config)
    return Plan(job, info, np.arange(frames), inputs, stage_keys(config, inputs))


def test_four_hours_are_fewer_than_3000_task_runs(tmp_path: Path) -> None:
    plan = planned(FOUR_HOURS, tmp_path)
    total = sum(len(units) for units in planned_units(plan).values())
    assert total < 3000
    text = describe_plan(plan)
    assert f"{total} units; " in text
    assert "memory" in text
    assert "GB needed" in text


@pytest.mark.parametrize("frames", [17, 33, 60, 64, 65, 100, 128, 257, 300, 1126])
def test_units_are_cut_evenly(tmp_path: Path, frames: int) -> None:
    lengths = [len(unit) for unit in planned(frames, tmp_path).units]
    assert sum(lengths) == frames
    assert len(lengths) % 2 == 0
    assert min(lengths) >= 0.8 * max(lengths)


def test_task_runs_grow_with_chunks_not_with_frames(tmp_path: Path) -> None:
    runs = {frames: len(planned(frames, tmp_path).units) for frames in (18, 300, 3000, 30_000, FOUR_HOURS)}
    assert max(runs.values()) < 300
    assert runs[300] >= 4  # and yet several workers have something to do


def test_changed_inputs_and_settings_are_known(flight: Path, tmp_path: Path) -> None:
    first = make_plan(job(flight, tmp_path / "run"))
    assert changed_since(first) == []
    write_flight_record(first)
    assert changed_since(make_plan(job(flight, tmp_path / "run"))) == []
    given = job(flight, tmp_path / "run", "tracking.max_interval_s=0.6")
    given = given.model_copy(update={"inputs": given.inputs.model_copy(update={"base": None})})
    assert changed_since(make_plan(given)) == ["base", "settings"]
    first.layout.flight.write_text('{"format_version": 999}')
    assert changed_since(first) == []


def test_the_folder_of_another_flight_is_refused(flight: Path, tmp_path: Path) -> None:
    def plan_with(frames: Path) -> Plan:
        made = job(flight, tmp_path / "run")
        return make_plan(made.model_copy(update={"inputs": made.inputs.model_copy(update={"source": str(frames)})}))

    grows, moved = tmp_path / "grows", tmp_path / "moved"
    for folder in (grows, moved):
        shutil.copytree(job(flight, tmp_path / "run").inputs.source, folder)
    last = max(grows.glob("*.png"))
    last.rename(tmp_path / last.name)
    write_flight_record(plan_with(grows))
    with pytest.raises(InputError, match=r"run holds the run of .*grows, which that of .*moved would overwrite"):
        plan_with(moved)
    shutil.move(tmp_path / last.name, last)
    write_flight_record(plan_with(grows))
    plan_with(moved)  # of the same content


def test_a_folder_of_other_things_is_refused_and_nothing_is_written(flight: Path, tmp_path: Path) -> None:
    root = tmp_path / "holiday"
    (root / "album").mkdir(parents=True)
    for name in ("a.jpg", "b.jpg", "c.txt"):
        (root / name).touch()
    before = sorted(root.iterdir())
    said = r"holiday is not empty and no run folder: it holds a\.jpg, album, b\.jpg and 1 more; give another --out"
    for refuse in (
        lambda: check_inputs(job(flight, root)),
        lambda: make_plan(job(flight, root)),
        lambda: write_clips(root, [Path(job(flight, root).inputs.source)]),
        lambda: process_tracks(job(flight, root), RunnerConfig(), Console("quiet"), Threads()),
    ):
        with pytest.raises(InputError, match=said) as caught:
            refuse()
        assert "\n" not in str(caught.value)
    assert sorted(root.iterdir()) == before


def test_an_empty_folder_and_one_of_a_run_that_ended_early_are_taken(flight: Path, tmp_path: Path) -> None:
    work = job(flight, tmp_path / "run")
    layout = RunLayout(tmp_path / "run")
    layout.root.mkdir()
    make_plan(work)
    for path in (layout.lock, layout.clips, layout.root / ".DS_Store", layout.root / "flight.json.77.partial"):
        path.touch()
    for path in (layout.frames, layout.commits, layout.preview):
        path.mkdir()
    make_plan(work)
    write_flight_record(make_plan(work))
    (layout.root / "notes.txt").touch()  # among the results of a run
    make_plan(work)
    assert layout.foreign_names() == []


@pytest.mark.parametrize("text", ["nonsense", "6-0", "0-3,2-5"])
def test_impossible_time_intervals_are_refused_before_any_work(flight: Path, tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match="time interval"):
        make_plan(job(flight, tmp_path, f"field.time_intervals={text}"))


@pytest.mark.parametrize("option", ["base", "labels", "detector", "detections"])
def test_an_input_of_the_wrong_kind_is_refused_before_any_work(flight: Path, tmp_path: Path, option: str) -> None:
    (tmp_path / "hello.txt").write_text("hello\n")
    given = job(flight, tmp_path / "run")
    given = given.model_copy(update={"inputs": given.inputs.model_copy(update={option: str(tmp_path / "hello.txt")})})
    with pytest.raises(InputError, match=f"^--{option}: .*hello.txt") as caught:
        validate_inputs(make_plan(given))
    assert "b'" not in str(caught.value)


def test_frames_too_far_apart_to_link_are_warned_of(flight: Path, tmp_path: Path) -> None:
    assert make_plan(job(flight, tmp_path)).info.warnings == ()
    (warning,) = make_plan(job(flight, tmp_path, "frames.every=4")).info.warnings
    assert "--set tracking.max_interval_s=1.3" in warning
    assert make_plan(job(flight, tmp_path, "frames.every=4", "tracking.max_interval_s=1.3")).info.warnings == ()


def test_a_plan_is_small(tmp_path: Path) -> None:
    """It goes with every node of every graph."""
    import pickle

    assert len(pickle.dumps(planned(FOUR_HOURS, tmp_path))) < 3_000_000
    small = len(pickle.dumps(planned(300, tmp_path)))
    assert small < 20_000


def test_paths_of_a_plan_mean_the_same_to_workers_in_other_folders(
    flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(flight)
    sent = make_plan(job(Path(), Path("run"))).job
    paths = [sent.root, *filter(None, sent.inputs.model_dump().values())]
    assert len(paths) == 5
    assert [path for path in paths if not path.startswith(str(flight))] == []


@pytest.mark.parametrize("frames", [300, FOUR_HOURS])
def test_the_estimate_of_bytes_is_of_the_order_of_what_was_measured(tmp_path: Path, frames: int) -> None:
    """354 GB are four hours of raw frames of that size; Zstandard leaves 0.6 to 0.8 of them."""
    from velfield.pipeline.estimate import estimated_bytes

    raw = frames * 2560 * 1920
    assert 0.6 * raw < estimated_bytes(planned(frames, tmp_path)) < 1.1 * raw


def test_a_disk_that_is_too_small_is_refused_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from velfield.errors import InputError
    from velfield.pipeline import estimate as planning

    monkeypatch.setattr(planning, "_free_bytes", lambda root: 400_000_000_000)
    planning.check_space(planned(FOUR_HOURS, tmp_path))
    monkeypatch.setattr(planning, "_free_bytes", lambda root: 100_000_000_000)
    with pytest.raises(InputError, match=r"about 36\d.\d\d GB needed, 100.00 GB free"):
        planning.check_space(planned(FOUR_HOURS, tmp_path))


def test_memory_does_not_grow_with_the_flight(tmp_path: Path) -> None:
    from velfield.pipeline.estimate import estimated_memory

    assert estimated_memory(planned(300, tmp_path), 4) == estimated_memory(planned(FOUR_HOURS, tmp_path), 4)


def test_no_stage_function_is_imported_by_planning() -> None:
    code = (
        "import sys, velfield.pipeline.plan; sys.exit(any(name in sys.modules for name in ('prefect', 'dask', 'zarr')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
