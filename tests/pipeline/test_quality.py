"""A blurred frame, and one that does not belong to the flight, are flagged, in no tracklet, and reported."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.summary import RunSummary
from tests.small_flight import FRAMES, job, process
from velfield import open_run
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import make_plan
from velfield.pipeline.stage import stages_before
from velfield.run.commits import read_commit
from velfield.run.layout import RunLayout
from velfield.run.stores import open_frames
from velfield.sources.quality import FrameFlag

BLURRED, FOREIGN = 5, 8
"""The second one is the first frame of a unit of eight."""
EXPECTED = [0] * FRAMES
EXPECTED[BLURRED], EXPECTED[FOREIGN] = int(FrameFlag.BLURRED), int(FrameFlag.OUTLIER)


@pytest.fixture(scope="module")
def damaged(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small flight with one frame out of focus and one of another place."""
    folder = tmp_path_factory.mktemp("damaged") / "flight"
    shutil.copytree(flight, folder)
    names = sorted((folder / "frames").iterdir())
    blurred, foreign = (cv2.imread(str(names[k]), cv2.IMREAD_GRAYSCALE) for k in (BLURRED, FOREIGN))
    cv2.imwrite(str(names[BLURRED]), cv2.GaussianBlur(blurred, (0, 0), 4))
    cv2.imwrite(str(names[FOREIGN]), 255 - cv2.rotate(foreign, cv2.ROTATE_180))
    return folder


@pytest.fixture(scope="module")
def run(damaged: Path, server: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunSummary]:
    root = tmp_path_factory.mktemp("quality") / "run"
    return root, process(job(damaged, root))


def test_they_are_flagged_and_no_other_frame_is(run: tuple[Path, RunSummary]) -> None:
    assert open_run(run[0]).frames.column("flags").tolist() == EXPECTED


def test_they_are_in_no_tracklet(run: tuple[Path, RunSummary]) -> None:
    tracklets = open_run(run[0]).tracklets()
    used = set(np.unique(tracklets[["frame_0", "frame_1", "frame_2"]].to_numpy()).tolist())
    assert used == set(range(FRAMES)) - {BLURRED, FOREIGN}


def test_they_are_reported(run: tuple[Path, RunSummary]) -> None:
    root, summary = run
    assert [line.split(": ", 1)[1] for line in summary.frames_lost] == ["skipped:blurred", "skipped:outlier"]
    (stage,) = [stage for stage in summary.stages if stage.name == "quality"]
    assert stage.text == f"{FRAMES - 2} frames usable, 2 flagged: 1 blurred, 1 unlike their neighbours"
    assert [warning.split(" (")[0] for warning in stage.warnings] == [f"frame {BLURRED}", f"frame {FOREIGN}"]
    report = (root / "index.html").read_text()
    assert all(warning in report for warning in stage.warnings)


def test_flags_are_the_same_however_the_flight_is_cut(damaged: Path, tmp_path: Path) -> None:
    for unit in (3, 18):
        root = tmp_path / f"unit-{unit}"
        compute_stages(make_plan(job(damaged, root, f"work.unit_frames={unit}")), stages_before("lens"))
        assert open_frames(RunLayout(root).frames).column("flags").tolist() == EXPECTED


def test_no_frame_of_a_good_flight_is_flagged(whole: tuple[Path, RunSummary]) -> None:
    run = open_run(whole[0])
    assert not run.frames.column("flags").any()
    record = read_commit(run.layout, "quality", "all")
    assert record is not None
    assert (record.counts["usable"], record.counts["flagged"]) == (FRAMES, 0)
