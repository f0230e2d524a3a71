"""A run folder on S3, a local server's: the same bits as on a disk."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import s3fs

from flows.runners import RunnerConfig
from schemas.summary import RunSummary
from tests.foreign_cluster import foreign_cluster
from tests.small_flight import digests, digests_of, job, process, redone
from velfield import open_run
from velfield.errors import InputError
from velfield.layout import RunLayout
from velfield.locking import locked
from velfield.places import S3_OPTIONS, RemotePath, place
from velfield.results import share
from velfield.verifying import verify_run


@pytest.fixture(scope="module")
def s3() -> Iterator[None]:
    """An S3 of our own with a bucket, on this machine alone, told by the environment as any other would be."""
    from moto.server import ThreadedMotoServer

    with pytest.MonkeyPatch.context() as patch:
        started = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        started.start()
        host, port = started.get_host_and_port()
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "testing")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "testing")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        import boto3

        boto3.client("s3").create_bucket(Bucket="flights")
        yield
        started.stop()


@pytest.fixture(scope="module")
def remote(
    s3: None, whole: tuple[Path, RunSummary], flight: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[RemotePath, RunSummary]:
    """The flight's run on S3, worked on by processes in folders of their own that have nothing but that in common.

    All stores are written there; only lens, base image and detector are taken from the disk.
    """
    root = RemotePath("s3://flights/runs/whole")
    share(RunLayout(whole[0]), RunLayout(place("s3://flights/runs/whole")), ("lens", "base", "detector"))
    with foreign_cluster(tmp_path_factory.mktemp("cluster")) as address:
        return root, process(job(flight, root), RunnerConfig(scheduler=address))  # type: ignore[arg-type]


def remote_digests(root: RemotePath) -> dict[str, str]:
    # All at once: one by one takes half a minute.
    files_there = s3fs.S3FileSystem(**S3_OPTIONS)
    objects = files_there.cat(files_there.find(root.url))
    return digests_of(root, {RemotePath("s3:/", key): data for key, data in objects.items()})  # type: ignore[arg-type,misc]


def test_the_same_bits_as_on_a_disk(remote: tuple[RemotePath, RunSummary], whole: tuple[Path, RunSummary]) -> None:
    assert remote[1].complete
    assert remote_digests(remote[0]) == digests(whole[0])


def test_a_second_run_does_nothing_again(remote: tuple[RemotePath, RunSummary], flight: Path) -> None:
    assert redone(process(job(flight, remote[0]))) == []  # type: ignore[arg-type]


def test_it_is_read_and_verified_from_there(
    remote: tuple[RemotePath, RunSummary], whole: tuple[Path, RunSummary]
) -> None:
    run, here = open_run("s3://flights/runs/whole"), open_run(whole[0])
    np.testing.assert_array_equal(run.field.modal_velocity(), here.field.modal_velocity())
    assert run.tracklets().equals(here.tracklets())
    assert (run.base_image == here.base_image).all()
    assert verify_run(run.layout, run.record) == []
    chunk = remote[0] / "frames.zarr/raw/c/5/0/0"
    data = chunk.read_bytes()
    chunk.write_bytes(data[:50] + bytes([data[50] ^ 1]) + data[51:])
    assert [damage.path for damage in verify_run(run.layout, run.record)] == ["frames.zarr/raw/c/5/0/0"]
    chunk.write_bytes(data)


def test_two_runs_on_one_folder(s3: None) -> None:
    layout = RunLayout(place("s3://flights/locked"))
    with locked(layout), pytest.raises(InputError, match=f"locked by pid {os.getpid()}"), locked(layout):
        pass
    with locked(layout):
        pass


def test_the_lock_of_a_process_that_was_killed_is_taken_over(s3: None) -> None:
    code = """if True:
        import os
        from velfield.layout import RunLayout
        from velfield.locking import locked
        from velfield.places import place
        with locked(RunLayout(place("s3://flights/killed"))):
            os.kill(os.getpid(), 9)
    """
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    with locked(RunLayout(place("s3://flights/killed"))):
        pass
