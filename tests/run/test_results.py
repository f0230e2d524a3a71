"""Results of one flight on several base images: named, shared, published, each once."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.flight import FlightConfig
from schemas.records import CommitRecord, FlightRecord, InputsRecord, SourceRecord
from velfield.errors import InputError
from velfield.run.commits import digest_path, read_commit, valid_commit, write_commit
from velfield.run.layout import RunLayout
from velfield.run.results import (
    final_root,
    link_shared_outputs,
    publish_result,
    read_results,
    result_exists,
    result_name,
    staging_layout,
)
from velfield.run.run import Run, open_run

SOURCE = SourceRecord(path="flight.mp4", kind="video", digest="0", width=8, height=8, frame_count=9)


def flight_record(base: Path | None = None) -> str:
    inputs = InputsRecord(source=SOURCE, base=None if base is None else digest_path(base))
    return FlightRecord(code_version="0", config=FlightConfig(), inputs=inputs).model_dump_json()


@pytest.fixture
def base(tmp_path: Path) -> Path:
    path = tmp_path / "spring 2026.tif"
    path.write_bytes(b"a base image")
    return path


@pytest.fixture
def run(tmp_path: Path) -> Run:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/flight.json").write_text(flight_record())
    return open_run(tmp_path / "run")


def commit(layout: RunLayout, stage: str, unit: str, *outputs: str, key: str = "k") -> None:
    for name in outputs:
        (layout.root / name).parent.mkdir(parents=True, exist_ok=True)
        (layout.root / name).write_bytes(name.encode())
    digests = dict.fromkeys(outputs, "digest")
    write_commit(layout, CommitRecord(stage=stage, unit=unit, key=key, outputs=digests, code_version="0"))


@given(st.text(max_size=40))
def test_a_results_name_is_one_folder_inside_the_run(stem: str) -> None:
    try:
        name = result_name(None, Path("maps") / f"{stem.replace('/', '')}x.tif")
    except (InputError, ValueError):
        return
    assert Path(name).name == name
    assert not name.startswith(".")
    assert final_root(staging_layout(RunLayout(Path("RUN")), name).root) == Path("RUN/results") / name


@pytest.mark.parametrize("name", ["", "..", "../out", "/tmp/x", "a/b", ".hidden", "first", "x" * 101])
def test_a_name_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(InputError, match="expected a name of letters, digits"):
        result_name(name, Path("spring.tif"))


def test_a_folder_that_is_no_staging_folder_stays_where_it_is() -> None:
    for root in (Path("RUN"), Path("RUN/results/spring"), Path("RUN/results/.spring")):
        assert final_root(root) == root


def test_a_result_is_published_once_and_listed_after_the_first(run: Run, base: Path) -> None:
    assert read_results(run.layout) == ()
    assert not result_exists(run.layout, "spring", base)
    for _ in range(2):  # the second time as after a kill between the renaming and the list
        staged = staging_layout(run.layout, "spring").root
        staged.mkdir(parents=True)
        (staged / "flight.json").write_text(flight_record(base))
        target = publish_result(run, "spring", base)
        assert target == run.layout.results / "spring"
        assert not staged.exists()
    first, second = read_results(run.layout)
    assert (first.name, first.path, first.how, first.base_digest) == ("first", ".", "run", None)
    assert (second.name, second.path, second.how) == ("spring", "results/spring", "registered again")
    assert second.base_digest == digest_path(base)
    assert result_exists(run.layout, "spring", base)


def test_a_name_that_another_base_image_has_is_refused(run: Run, base: Path) -> None:
    (run.layout.results / "spring").mkdir(parents=True)
    (run.layout.results / "spring/flight.json").write_text(flight_record(base))
    base.write_bytes(b"another base image")
    with pytest.raises(InputError, match="is the result of another base image; name this one with --out"):
        result_exists(run.layout, "spring", base)


def test_shared_outputs_are_the_same_files_and_what_is_not_shared_is_not_recorded(run: Run) -> None:
    old, new = run.layout, staging_layout(run.layout, "spring")
    commit(old, "frames", "00000", "frames.zarr/c/0", "frames.zarr/c/1")
    commit(old, "registration", "00000", "registration.zarr/c/0", "base/own.png")
    commit(old, "field", "0-0", "field.zarr/c/0")
    link_shared_outputs(old, new, ("frames", "registration"), without=("base/",))
    assert os.path.samefile(old.root / "frames.zarr/c/1", new.root / "frames.zarr/c/1")
    assert valid_commit(new, "frames", "00000", "k") is not None
    record = read_commit(new, "registration", "00000")
    assert list(record.outputs) == ["registration.zarr/c/0"]
    assert not (new.root / "base/own.png").exists()
    assert read_commit(new, "field", "0-0") is None


def test_a_unit_that_the_new_result_has_is_not_linked_again(run: Run) -> None:
    old, new = run.layout, staging_layout(run.layout, "spring")
    commit(old, "frames", "00000", "frames.zarr/c/0")
    commit(new, "frames", "00000", "frames.zarr/c/0")
    link_shared_outputs(old, new, ("frames",))
    assert not os.path.samefile(old.root / "frames.zarr/c/0", new.root / "frames.zarr/c/0")
    commit(old, "frames", "00000", "frames.zarr/c/0", key="another")
    link_shared_outputs(old, new, ("frames",))
    assert os.path.samefile(old.root / "frames.zarr/c/0", new.root / "frames.zarr/c/0")
