"""A store that fails, is torn or fills up at its n-th call: a random sample of what `tests.faults.nth_call` tries."""

import errno

import pytest

from tests.faults.failing_store import Fault, failing_disk, run_again, tiny_job
from tests.faults.nth_call import Flight, sample
from velfield.errors import InputError
from velfield.pipeline.estimate import disk_full_as_input_error
from velfield.pipeline.plan import make_plan

SEED = 25


@pytest.fixture(scope="module")
def disk(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    flight = Flight(tmp_path_factory.mktemp("disk"))
    flight.make()
    return flight


def test_whatever_call_fails_the_resumed_result_is_equal(disk: Flight) -> None:
    for step, mode, call in sample(disk, 12, SEED):
        assert disk.trial(step, mode, call) == [], f"seed {SEED}: {step}, call {call} {mode}"


def test_on_s3_too(disk: Flight, s3: None) -> None:
    remote = Flight(disk.folder, "s3://flights/nth-call")
    steps = ("frames", "quality", "lens")
    remote.make(steps)
    for step, mode, call in sample(remote, 6, SEED, steps):
        assert remote.trial(step, mode, call) == [], f"seed {SEED}: {step}, call {call} {mode}"


def test_a_full_disk_stops_the_run_in_one_line_and_keeps_what_is_finished(disk: Flight) -> None:
    root = disk.folder / "full"
    job, fault = tiny_job(disk.folder / "flight", root), Fault("fills up", 60)
    with (
        pytest.raises(InputError, match=r"full: the disk is full at .* GB more needed.* GB free; free space") as caught,
        failing_disk(root, fault),
        disk_full_as_input_error(make_plan(job)),
    ):
        run_again(job, until="frames")
    assert "\n" not in str(caught.value)
    assert len(list((root / "commits/frames").glob("*.json"))) == 1
    other = OSError(errno.EIO, "Input/output error")
    with pytest.raises(OSError, match="Input/output") as raised, disk_full_as_input_error(make_plan(job)):
        raise other
    assert raised.value is other
