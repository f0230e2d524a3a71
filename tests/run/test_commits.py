"""Content keys, commit records and the lock."""

import os
from pathlib import Path

import pytest

from schemas.flight import TrackingConfig
from schemas.records import CommitRecord, InputsRecord, SourceRecord
from velfield.run.commits import (
    commit_path,
    content_key,
    digest_file,
    digest_input,
    digest_outputs,
    sweep_partial,
    valid_commit,
    write_atomically,
    write_commit,
)
from velfield.run.layout import RunLayout

INPUTS = InputsRecord(source=SourceRecord(path="a", kind="video", digest="d", width=10, height=10, frame_count=3))


def test_keys_do_not_depend_on_the_order_of_fields() -> None:
    one = content_key("s", 1, parameters=[{"a": 1, "b": 2}])
    assert one == content_key("s", 1, parameters=[{"b": 2, "a": 1}])
    assert one != content_key("s", 1, parameters=[TrackingConfig()])


def test_a_unit_is_finished_under_its_own_key_and_with_its_outputs(tmp_path: Path) -> None:
    layout = RunLayout(tmp_path)
    (tmp_path / "out.bin").write_bytes(b"x")
    write_commit(layout, CommitRecord(stage="lens", unit="all", key="k", outputs={"out.bin": ""}, code_version="1"))
    assert valid_commit(layout, "lens", "all", "k")
    assert valid_commit(layout, "lens", "all", "another") is None
    assert valid_commit(layout, "lens", "other", "k") is None
    (tmp_path / "out.bin").unlink()
    assert valid_commit(layout, "lens", "all", "k") is None


def test_a_file_of_any_size_has_a_digest_of_its_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "video"
    monkeypatch.setattr("velfield.run.commits._WHOLE_FILE_BYTES", 1000)
    monkeypatch.setattr("velfield.run.commits._SAMPLE_BYTES", 16)
    file.write_bytes(bytes(4096))
    digest, sampled = digest_file(file), digest_input(file)
    assert sampled != digest
    file.write_bytes(bytes(4095) + b"x")
    assert digest_file(file) != digest
    assert digest_input(file) != sampled
    file.write_bytes(bytes(4097))
    assert digest_file(file) != digest
    assert digest_input(file) != sampled
    for changed in (20, 1000, 2222):  # an output is read whole, however large
        file.write_bytes(bytes(changed) + b"x" + bytes(4095 - changed))
        assert digest_file(file) != digest


def test_partial_files_are_swept(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a" / "whole", b"1")
    (tmp_path / "a" / "torn.77.partial").write_bytes(b"1")
    assert sweep_partial(tmp_path) == 1
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["whole"]


def test_outputs_are_on_the_disk_before_the_record_that_vouches_for_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = RunLayout(tmp_path)
    (tmp_path / "frames.zarr/c/0").mkdir(parents=True)
    chunks = [tmp_path / f"frames.zarr/c/0/{k}" for k in range(3)]
    for chunk in chunks:
        chunk.write_bytes(b"chunk")
    synced: list[int] = []

    def note(descriptor: int) -> None:
        assert not commit_path(layout, "frames", "000000-000002").exists()
        synced.append(os.fstat(descriptor).st_ino)

    monkeypatch.setattr(os, "fsync", note)
    outputs = digest_outputs(layout, chunks)
    record = CommitRecord(stage="frames", unit="000000-000002", key="k", outputs=outputs, code_version="0")
    write_commit(layout, record)
    on_disk = [path.stat().st_ino for path in (*chunks, chunks[0].parent)]
    assert sorted(synced[:-1]) == sorted(on_disk)
    assert synced[-1] == commit_path(layout, "frames", "000000-000002").stat().st_ino
