"""Units of an earlier plan of the same folder leave nothing behind: fewer frames, units of another size."""

import shutil
from pathlib import Path

import pytest

from schemas.summary import RunSummary
from tests.small_flight import digests, job, process
from velfield import open_run
from velfield.pipeline.stage import STAGE
from velfield.pipeline.verify import verify_run


@pytest.mark.parametrize("setting", ["frames.stop_s=1.7", "work.unit_frames=9"])
def test_a_run_into_a_folder_of_another_plan_is_as_into_a_new_one(
    whole: tuple[Path, RunSummary], flight: Path, tmp_path: Path, setting: str
) -> None:
    used, new = tmp_path / "used", tmp_path / "new"
    shutil.copytree(whole[0], used)
    for root in (used, new):
        process(job(flight, root, setting))
    run = open_run(used)
    assert run.detections()["frame"].max() < run.frames.count
    assert run.tracklets()["frame_2"].max() < run.frames.count
    assert verify_run(run.layout, run.record) == []
    assert digests(used) == digests(new)
    for stage in STAGE:
        assert_same_units(used / "commits" / stage, new / "commits" / stage)


def assert_same_units(one: Path, other: Path) -> None:
    assert sorted(path.name for path in one.iterdir()) == sorted(path.name for path in other.iterdir())
