"""Units of an earlier plan of the same folder leave nothing behind: fewer frames, units of another size."""

import shutil
from pathlib import Path

import pytest

from schemas.job import Job
from tests.faults.failing_store import TINY, run_again, tiny_job
from tests.small_flight import digests
from velfield import open_run
from velfield.pipeline.stage import STAGE
from velfield.pipeline.verify import verify_run
from velfield.synthetic.write import write_flight


def unlabelled(flight: Path, root: Path, *settings: str) -> Job:
    """By the detector that ships: training takes a third of such a run, and leaves one file, however it is cut."""
    given = tiny_job(flight, root, *settings)
    return given.model_copy(update={"inputs": given.inputs.model_copy(update={"labels": None})})


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("units")
    write_flight(folder / "flight", TINY)
    run_again(unlabelled(folder / "flight", folder / "whole"))
    return folder


@pytest.mark.parametrize("setting", ["frames.stop_s=0.9", "work.unit_frames=4"])
def test_a_run_into_a_folder_of_another_plan_is_as_into_a_new_one(flight: Path, tmp_path: Path, setting: str) -> None:
    used, new = tmp_path / "used", tmp_path / "new"
    shutil.copytree(flight / "whole", used)
    for root in (used, new):
        run_again(unlabelled(flight / "flight", root, setting))
    run = open_run(used)
    assert run.frames.count == (6 if "unit" in setting else 4)
    assert run.detections()["frame"].max() < run.frames.count
    assert run.tracklets()["frame_2"].max() < run.frames.count
    assert verify_run(run.layout, run.record) == []
    assert digests(used) == digests(new)
    for stage in STAGE:
        assert_same_units(used / "commits" / stage, new / "commits" / stage)


def assert_same_units(one: Path, other: Path) -> None:
    assert sorted(path.name for path in one.iterdir()) == sorted(path.name for path in other.iterdir())
