"""The whole job as a flow: what it leaves, what a second run does again, what a failing unit costs."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from flows.commands.run import conclude
from flows.console import Console
from flows.runners import ClientRunner, RunnerConfig
from schemas.summary import RunSummary
from schemas.tables import DETECTION_COLUMNS, TRACK_COLUMNS
from tests.small_flight import FRAMES, digests, job, process, redone
from velfield import open_run
from velfield.errors import InputError
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.pipeline.stage import STAGE, STAGES, stages_before
from velfield.pipeline.stages.report import make_report
from velfield.pipeline.summary import summarise_run
from velfield.report.report import render_report
from velfield.run.commits import read_commit
from velfield.run.layout import RunLayout
from velfield.run.results import link_shared_outputs


def test_the_run_folder_is_as_the_contract_lists(whole: Path, summary: RunSummary) -> None:
    assert [stage.name for stage in summary.stages] == list(STAGE)
    assert [stage.text for stage in summary.stages if "nan" in stage.text] == []
    assert summary.complete
    names = ("flight.json", "frames.zarr", "camera.json", "base/grid.json", "base/base_image.png", "registration.zarr")
    names += (
        "detector.json",
        "detections",
        "tracklets",
        "tracks",
        "field.zarr",
        "maps/direction.png",
        "maps/speed.png",
    )
    names += ("maps/direction.tif", "maps/speed.tif", "index.html", "commits")
    assert [name for name in names if not (whole / name).exists()] == []


def test_the_python_side_of_the_contract(whole: Path) -> None:
    run = open_run(whole)
    assert run.times_s.shape == (FRAMES,)
    assert list(run.registration_status) == ["ok"] * FRAMES
    assert list(run.detections().columns) == list(DETECTION_COLUMNS)
    tracklets = run.tracklets()
    assert list(tracklets.columns) == list(TRACK_COLUMNS)
    assert len(tracklets) > 50
    raw = np.array([[100.0, 90.0], [500.0, 400.0]])
    np.testing.assert_allclose(run.to_raw(4, run.to_base(4, raw)), raw, atol=1e-2)
    with pytest.raises(InputError, match=f"frames go from 0 to {FRAMES - 1}"):
        run.to_base(FRAMES, raw)
    with pytest.raises(InputError, match=f"frames go from 0 to {FRAMES - 1}"):
        run.frames.read(-1)
    count, velocity = run.field.count(), run.field.modal_velocity()
    assert count.shape == velocity.shape[:2] == run.base_image.shape
    assert np.isfinite(velocity[count > 0]).all()
    assert np.isnan(velocity[count == 0]).all()
    y, x = np.unravel_index(count.argmax(), count.shape)
    here = run.field.at(int(x), int(y))
    assert here.n == count[y, x]
    assert here.weights.sum() == pytest.approx(1)
    np.testing.assert_allclose(run.field.modal_velocity()[y, x], here.modal_velocity_px_per_s, rtol=1e-5)
    fast, slow = run.field.log_density(np.array([[x, y], [x, y]]), np.array([velocity[y, x], velocity[y, x] + 90]))
    assert fast > slow


def test_accuracy_on_the_small_flight(whole: Path, flight: Path) -> None:
    from velfield.synthetic.run_score import score_run

    score = score_run(whole, flight, min_count=1)
    assert score.registration.mean_px < 1.0
    assert score.registration.jitter_px < 0.25
    assert score.tracking.precision_moving > 0.95
    assert score.field.pixels > 1000


def test_a_run_on_another_base_image_has_no_score(whole: Path, flight: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from velfield.synthetic.run_score import score_run
    from velfield.synthetic.truth import Truth

    def turned(truth: Truth, frame: int, xy_raw: np.ndarray) -> np.ndarray:
        return truth.camera.to_base(frame, xy_raw)[:, ::-1] * (1, -1) + (0, 400)

    monkeypatch.setattr(Truth, "to_base", turned)
    with pytest.raises(
        InputError,
        match=r"positions differ from those of .* px \(mean\): its base image is another one; score a run with --base",
    ):
        score_run(whole, flight)


def test_a_second_run_recomputes_nothing(whole: Path, flight: Path) -> None:
    before = digests(whole)
    again = process(job(flight, whole))
    assert redone(again) == []
    assert digests(whole) == before
    assert all(stage.seconds_before > 0 for stage in again.stages)  # the report lists what the work took, once done


def test_a_changed_gate_redoes_tracking_onward(copy: Path, flight: Path) -> None:
    changed = process(job(flight, copy, "tracking.max_speed_m_per_s=5"))
    assert redone(changed) == ["tracklets", "tracks", "scale", "field", "maps"]
    velocities = open_run(copy).tracklets()[["vx_01_px_per_s", "vy_01_px_per_s"]]
    speeds = np.hypot(*velocities.to_numpy().T) * 0.23
    assert np.quantile(speeds, 0.99) < 10.5  # 5 m/s and what jitter adds
    assert speeds.max() < 14  # a position may be refined by a pixel or two after the gates


def test_workers_give_the_same_bits(whole: Path, flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers of a long flight, which are restarted on the way; previews have a test of their own.

    The first time they are: each start takes 5 s of processor, and tests of clusters show what a restart does.
    """
    monkeypatch.setattr("velfield.pipeline.plan.LONG_MPX", 0.0)
    monkeypatch.setattr("flows.process_flight.Previews", lambda *_: None)
    restarted, true = [], ClientRunner.restart_workers
    monkeypatch.setattr(
        ClientRunner, "restart_workers", lambda self: restarted.append(None if restarted else true(self))
    )
    process(job(flight, tmp_path / "workers"), RunnerConfig(workers=2))
    assert len(restarted) == sum(stage.new_workers for stage in STAGES) > 0
    assert digests(tmp_path / "workers") == digests(whole)


def test_a_unit_that_fails_once_is_retried(
    copy: Path, flight: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from velfield.pipeline.stages import frames as step

    calls: list[range] = []
    true = step.read_unit

    def failing(plan: object, frames: range) -> object:
        calls.append(frames)
        if len(calls) == 1:
            raise OSError("the disk blinked")
        return true(plan, frames)

    monkeypatch.setattr(step, "read_unit", failing)
    shutil.rmtree(copy / "commits/frames")
    summary = process(job(flight, copy))
    assert redone(summary) == ["frames"]
    assert not summary.stages[0].lost
    assert len(calls) == summary.stages[0].units + 1
    assert capsys.readouterr().err.count("failed: the disk blinked; trying again") == 1


def starts(root: Path) -> set[int]:
    """Frames at which tracklets start."""
    return set(open_run(root).tracklets()["frame_0"])


def test_a_unit_that_always_fails_is_lost_and_computed_by_the_next_run(
    whole: Path, flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from velfield.pipeline.stages import detections as step

    true = step.detect_block

    def failing(plan: object, frames: range) -> object:
        if 8 in frames:
            raise RuntimeError("this chunk kills its worker")
        return true(plan, frames)

    root = tmp_path / "run"
    link_shared_outputs(RunLayout(whole), RunLayout(root), ("lens", "base", "detector"))
    monkeypatch.setattr(step, "detect_block", failing)
    summary = process(job(flight, root))
    lost = {stage.name: stage.lost for stage in summary.stages if stage.lost}
    assert lost == {"detections": ("000008-000015",), "tracklets": ("000008-000015",)}
    # The units beside it lose no more than the windows that reach into it.
    assert starts(root) == {frame for frame in starts(whole) if frame < 6 or frame >= 16}
    assert not summary.complete
    (why,) = next(stage.failures for stage in summary.stages if stage.name == "detections")
    assert why.startswith(f"{root}: detections of frames 8 to 15 (")
    assert why.endswith(" s) failed: this chunk kills its worker; re-run to retry")
    assert why in json.loads(RunLayout(root).report_record.read_text())["warnings"]
    monkeypatch.setattr(step, "detect_block", true)
    again = process(job(flight, root))
    assert again.complete
    assert digests(root) == digests(whole)


@pytest.mark.parametrize("fault", ["a frame more", "a time twice", "a frame without time"])
def test_footage_that_is_not_all_there_ends_with_status_3(
    fault: str, whole: Path, summary: RunSummary, flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = (flight / "timestamps.csv").read_text().splitlines()
    if fault == "a frame more":
        lines.append("999999.png,1000.0")
    elif fault == "a time twice":
        lines[5] = f"{lines[5].split(',')[0]},{lines[4].split(',')[1]}"
    else:
        del lines[5]
    (tmp_path / "timestamps.csv").write_text("\n".join(lines))
    plan = make_plan(job(flight, whole, timestamps=str(tmp_path / "timestamps.csv")))
    found = summarise_run(plan, summary.stages)
    assert summary.complete
    assert not found.complete
    assert len(found.footage_lost) == 1
    assert conclude(found, Console()) == 3
    assert found.footage_lost[0] in capsys.readouterr().err
    assert "Not complete" in render_report(make_report(plan, found), [])


def test_refused_labels_leave_no_folder(flight: Path, server: None, tmp_path: Path) -> None:
    (tmp_path / "labels.csv").write_text("no,such,columns\n1,2,3\n")
    with pytest.raises(InputError, match="--labels"):
        process(job(flight, tmp_path / "run", labels=str(tmp_path / "labels.csv")))
    assert not (tmp_path / "run").exists()


def test_a_scale_at_which_no_car_can_be_seen_is_refused(copy: Path, flight: Path) -> None:
    """A slip of the decimal point: the search for cars of 2 px takes hours."""
    work = job(flight, copy)
    with pytest.raises(InputError, match=r"found a scale of 2\.3 m a pixel of the map, at which a car is 1\.9 px long"):
        process(work.model_copy(update={"config": work.config.model_copy(update={"gsd_m": 2.3})}))


def true_boxes(flight: Path) -> pd.DataFrame:
    """Places of the visible cars within the frames, raw px, as another detector gives them."""
    from velfield.synthetic.truth import load_truth

    cars = load_truth(flight).cars
    names = sorted(path.name for path in (flight / "frames").iterdir())
    cars = cars[cars["visible"] & cars["x_raw_px"].between(0, 639) & cars["y_raw_px"].between(0, 479)]
    return pd.DataFrame(
        {"frame": [names[k] for k in cars["frame"]], "x_px": cars["x_raw_px"], "y_px": cars["y_raw_px"]}
    )


def test_detections_of_another_detector_take_the_place_of_ours(whole: Path, flight: Path, tmp_path: Path) -> None:
    table = true_boxes(flight)
    table.to_csv(tmp_path / "boxes.csv", index=False)
    summary = process(job(flight, tmp_path / "run", detections=str(tmp_path / "boxes.csv")))
    counts = {stage.name: stage.counts for stage in summary.stages}
    assert counts["detections"]["cars"] == pytest.approx(len(table), rel=0.02)
    assert counts["tracks"]["tracks"] > 20
    assert "external detections" in next(stage.text for stage in summary.stages if stage.name == "detector")


def test_boxes_of_few_frames_unused_inputs_and_empty_maps_are_warned_of(flight: Path, tmp_path: Path) -> None:
    first = sorted(path.name for path in (flight / "frames").iterdir())[0]
    boxes = tmp_path / "boxes.csv"
    boxes.write_text(f"frame,x_px,y_px,length_px,width_px\n{first},320,240,20,9\n")
    settings = ("tracking.max_interval_s=0.05", "frames.stop_s=1.0")
    summary = process(job(flight, tmp_path / "run", *settings, detections=str(boxes)))  # labels are given as well
    warned = {stage.name: stage.warnings for stage in summary.stages}
    assert any("boxes in 1 of the" in line for line in warned["detector"])
    assert any("--labels not used" in line for line in warned["detector"])
    (text,) = warned["tracks"]
    assert "no tracklets, so the maps are empty" in text
    assert "--set tracking.max_interval_s=0." in text


def test_the_size_of_given_boxes_sets_the_working_scale(flight: Path, tmp_path: Path) -> None:
    """Where no ground sample distance is given; boxes without a size are warned of."""
    table = true_boxes(flight)
    sized, bare = tmp_path / "sized.csv", tmp_path / "bare.csv"
    table.to_csv(bare, index=False)
    table.assign(length_px=20.0, width_px=9.0).to_csv(sized, index=False)
    scales, warned = [], []
    for boxes in (sized, bare):
        unsized = job(flight, tmp_path / boxes.stem, "frames.stop_s=1.0", detections=str(boxes))
        plan = make_plan(unsized.model_copy(update={"config": unsized.config.model_copy(update={"gsd_m": None})}))
        write_flight_record(plan)
        compute_stages(plan, stages_before("detections"))
        record = json.loads((tmp_path / boxes.stem / "base" / "working.json").read_text())
        scales.append(record["scale"])
        commit = read_commit(plan.layout, "detector", "all")
        warned.append([line for line in commit.warnings if "size" in line])
    assert scales[0] == pytest.approx(0.8, rel=0.1)
    assert scales[1] == 1.0
    assert not warned[0]
    assert "give one" in warned[1][0]
