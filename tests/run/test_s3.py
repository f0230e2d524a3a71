"""A run folder on S3, a local server's: the same bits as on a disk."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import s3fs

from flows.console import Console
from flows.reprocess import run_reprocess
from flows.runners import RunnerConfig
from schemas.records import ResultsRecord
from tests.foreign_cluster import foreign_cluster
from tests.new_base import write_new_base
from tests.small_flight import digests, digests_of, job, process, redone
from velfield import open_run
from velfield.errors import InputError
from velfield.pipeline.plan import make_plan
from velfield.pipeline.verify import verify_run
from velfield.run import layout
from velfield.run.layout import RunLayout, copy_objects, rename_tree, to_path
from velfield.run.results import link_shared_outputs
from velfield.run.s3 import S3_OPTIONS


@pytest.fixture(scope="module")
def remote(s3: None, whole: Path, flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flight's run on S3, worked on by processes in folders of their own that have nothing but that in common.

    All stores are written there; only lens, base image and detector are taken from the disk.
    """
    root = to_path("s3://flights/runs/whole")
    link_shared_outputs(RunLayout(whole), RunLayout(root), ("lens", "base", "detector"))
    with foreign_cluster(tmp_path_factory.mktemp("cluster")) as address:
        assert process(job(flight, root), RunnerConfig(scheduler=address)).complete
    return root


def remote_digests(root: Path) -> dict[str, str]:
    # All at once: one by one takes half a minute.
    files_there = s3fs.S3FileSystem(**S3_OPTIONS)
    objects = files_there.cat(files_there.find(str(root)))
    return digests_of(root, {to_path(f"s3://{key}"): data for key, data in objects.items()})


def test_the_same_bits_as_on_a_disk(remote: Path, whole: Path) -> None:
    assert remote_digests(remote) == digests(whole)


def test_a_bucket_that_is_not_there_is_refused_before_anything_starts(s3: None, flight: Path) -> None:
    work = job(flight, to_path("s3://nowhere/runs/whole"))
    with pytest.raises(InputError, match=r"^s3://nowhere/runs/whole/flight.json: the bucket nowhere does not exist"):
        make_plan(work)


def test_a_second_run_recomputes_nothing(remote: Path, flight: Path) -> None:
    assert redone(process(job(flight, remote))) == []


def test_it_is_read_and_verified_from_there(remote: Path, whole: Path) -> None:
    run, here = open_run("s3://flights/runs/whole"), open_run(whole)
    np.testing.assert_array_equal(run.field.modal_velocity(), here.field.modal_velocity())
    assert run.tracklets().equals(here.tracklets())
    assert (run.base_image == here.base_image).all()
    assert verify_run(run.layout, run.record) == []
    chunk = remote / "frames.zarr/raw/c/5/0/0"
    data = chunk.read_bytes()
    chunk.write_bytes(data[:50] + bytes([data[50] ^ 1]) + data[51:])
    assert [damage.path for damage in verify_run(run.layout, run.record)] == ["frames.zarr/raw/c/5/0/0"]
    chunk.write_bytes(data)


def test_a_new_base_image_under_a_run_that_is_there(remote: Path, flight: Path, tmp_path: Path) -> None:
    base = write_new_base(flight, tmp_path / "spring.png")
    there, summary = run_reprocess(Path("s3://flights/runs/whole"), base, console=Console("quiet"))
    assert summary.complete
    assert there == remote / "results/spring"
    result = open_run("s3://flights/runs/whole/results/spring")
    assert verify_run(result.layout, result.record) == []
    assert len(result.tracklets()) == len(open_run("s3://flights/runs/whole").tracklets())
    index = ResultsRecord.model_validate_json((remote / "results.json").read_bytes())
    assert [found.name for found in index.results] == ["first", "spring"]
    assert not list(remote.glob("results/.spring*/**"))


def test_a_folder_whose_naming_was_cut_short_has_no_last_file_and_is_named_again(
    s3: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = (to_path(f"s3://flights/naming/{name}") for name in ("source", "target"))
    written = {"a/1": b"one", "a/2": b"two", "last": b"three"}
    for name, data in written.items():
        (source / name).write_bytes(data)

    def cut_short(pairs: Sequence[tuple[Path, Path]]) -> None:
        copy_objects(pairs)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(layout, "copy_objects", cut_short)
        with pytest.raises(KeyboardInterrupt):
            rename_tree(source, target, last="last")
    assert (target / "a/1").exists()
    assert not (target / "last").exists()
    rename_tree(source, target, last="last")
    assert {name: (target / name).read_bytes() for name in written} == written
    assert not source.exists()
