"""A new base image: mapped where it fits, registered again where asked, refused where it is of another place."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from flows.console import Console
from flows.reprocess import run_reprocess
from schemas.job import Inputs, Job
from schemas.records import RebaseRecord
from schemas.summary import RunSummary
from tests.new_base import NEW_FROM_OLD, SCALE, TURN_RAD, write_new_base
from tests.small_flight import digests
from velfield import open_run
from velfield.errors import InputError
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.stages.rebase import plan_rebase
from velfield.pipeline.verify import verify_run
from velfield.run.lineage import describe_base_image
from velfield.run.run import Run


@pytest.fixture(scope="module")
def new_base(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_new_base(flight, tmp_path_factory.mktemp("maps") / "spring 2026.png")


@pytest.fixture(scope="module")
def run(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of our own, to which results are added."""
    root = tmp_path_factory.mktemp("reprocess") / "run"
    shutil.copytree(whole, root)
    return root


@pytest.fixture(scope="module")
def reprocessed(run: Path, new_base: Path) -> tuple[Path, RunSummary | None]:
    return run_reprocess(run, new_base, console=Console("quiet"))


@pytest.fixture(scope="module")
def mapped(reprocessed: tuple[Path, RunSummary | None]) -> Path:
    """The run on the new base image, mapped."""
    return reprocessed[0]


def moved(xy: np.ndarray) -> np.ndarray:
    return xy @ NEW_FROM_OLD[:, :2].T + NEW_FROM_OLD[:, 2]


def added_error_px(root: Path) -> float:
    return RebaseRecord.model_validate_json((root / "base/rebased.json").read_bytes()).added_error_px


def frame_points(run: Run) -> np.ndarray:
    height, width = run.frames.shape
    y, x = np.mgrid[30 : height - 30 : 60, 30 : width - 30 : 60]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(float)


def apart_px(one: Run, another: Run) -> float:
    """Mean distance of where two results have the same raw pixels, base px."""
    points = frame_points(one)
    return float(np.nanmean([np.hypot(*(one.to_base(f, points) - another.to_base(f, points)).T) for f in (0, 8, 17)]))


def test_no_frame_is_processed_again(reprocessed: tuple[Path, RunSummary]) -> None:
    done = [stage.name for stage in reprocessed[1].stages if stage.done_before == stage.units]
    assert done == ["frames", "quality", "lens", "registration", "detector", "tracklets"]


def test_units_are_those_that_the_run_was_cut_into(run: Path, new_base: Path, mapped: Path) -> None:
    """Another release may cut units of another length: detections lie in a file a unit."""
    before, record = open_run(run), RebaseRecord.model_validate_json((mapped / "base/rebased.json").read_bytes())
    config = resolve_config(settings=["work.unit_frames=5"])
    job = Job(root=str(run), inputs=Inputs(source="none", base=str(new_base)), config=config)
    lengths = [len(unit) for unit in plan_rebase(before, job, record).units]
    assert len(lengths) == len(list(before.layout.detections.glob("unit-*.parquet")))
    assert sum(lengths) == before.frames.count


def test_mapped_results_are_right_to_the_stated_error(run: Path, mapped: Path) -> None:
    old, new = open_run(run), open_run(mapped)
    stated = added_error_px(mapped)
    assert 0 < stated < 1
    points = frame_points(old)
    missed = [np.hypot(*(new.to_base(f, points) - moved(old.to_base(f, points))).T).mean() for f in (0, 8, 17)]
    assert np.mean(missed) < stated
    before, after = old.detections(), new.detections()
    assert (
        np.hypot(*(after[["x_px", "y_px"]].to_numpy() - moved(before[["x_px", "y_px"]].to_numpy())).T).mean() < stated
    )
    turned = np.mod(after["orientation_rad"] - before["orientation_rad"] - TURN_RAD + np.pi / 2, np.pi) - np.pi / 2
    assert np.abs(turned).max() < 0.02
    assert (after["area_px"] / before["area_px"]).median() == pytest.approx(SCALE**2, rel=0.01)


def test_velocities_are_turned_and_scaled_and_the_ground_sample_distance_with_them(run: Path, mapped: Path) -> None:
    old, new = open_run(run), open_run(mapped)
    columns = ["vx_01_px_per_s", "vy_01_px_per_s"]
    before, after = old.tracklets()[columns].to_numpy(), new.tracklets()[columns].to_numpy()
    np.testing.assert_allclose(after, before @ NEW_FROM_OLD[:, :2].T, atol=0.5)
    assert new.grid.gsd_m == pytest.approx(0.23 / SCALE, rel=0.003)
    pd.testing.assert_series_equal(old.tracklets()["track_id"], new.tracklets()["track_id"])
    before, after = (run.vehicles(doubtful=True)["doubtful"] for run in (old, new))
    assert before.any()
    pd.testing.assert_series_equal(before, after)
    count = new.field.count()
    assert count.sum() == pytest.approx(old.field.count().sum() * SCALE**2, rel=0.1)


def test_both_results_are_kept_and_named_and_whole(run: Path, mapped: Path, whole: Path) -> None:
    assert mapped == run / "results" / "spring-2026"
    index = json.loads((run / "results.json").read_text())["results"]
    assert [(result["name"], result["how"]) for result in index] == [("first", "run"), ("spring-2026", "mapped")]
    assert index[1]["added_error_px"] == added_error_px(mapped)
    new = open_run(mapped)
    assert verify_run(new.layout, new.record) == []
    assert {name: digest for name, digest in digests(run).items() if not name.startswith("results")} == digests(whole)
    assert "adds" in describe_base_image(new)


def test_the_same_base_image_again_recomputes_nothing(run: Path, mapped: Path, new_base: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in mapped.rglob("*")}
    assert run_reprocess(run, new_base, console=Console("quiet")) == (mapped, None)
    assert {path: path.stat().st_mtime_ns for path in mapped.rglob("*")} == before


def test_registered_again_it_agrees_within_the_stated_error(run: Path, mapped: Path, new_base: Path) -> None:
    root, summary = run_reprocess(run, new_base, name="again", full=True, console=Console("quiet"))
    stages = {stage.name: stage for stage in summary.stages}
    assert stages["frames"].done_before == stages["frames"].units
    assert stages["registration"].done_before == 0
    full, composed = open_run(root), open_run(mapped)
    # Two results differ by the errors of both: of the map between base images, and of the frames' own registration.
    limit = np.hypot(added_error_px(mapped), full.grid.intersensor_error_px or 0)
    assert apart_px(composed, full) < limit
    names = [result["name"] for result in json.loads((run / "results.json").read_text())["results"]]
    assert names == ["first", "spring-2026", "again"]


def test_a_base_image_of_another_place_changes_nothing(run: Path, flight: Path, tmp_path: Path) -> None:
    image = cv2.imread(str(flight / "base.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "wrong.png"), image[:, ::-1])
    before, paths = digests(run), sorted(run.rglob("*"))
    with pytest.raises(InputError, match="found a mirrored image"):
        run_reprocess(run, tmp_path / "wrong.png", console=Console("quiet"))
    assert digests(run) == before
    assert sorted(run.rglob("*")) == paths
