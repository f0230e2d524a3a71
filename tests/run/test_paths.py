"""Paths of a run folder: the same operations on a disk and on S3."""

import pickle
from pathlib import Path

import pytest

from velfield.errors import InputError
from velfield.run import layout
from velfield.run.commits import digest_path, sweep_partial, write_atomically
from velfield.run.layout import (
    RunLayout,
    copy_objects,
    is_remote,
    local_copy,
    remove_tree,
    rename_tree,
    to_path,
)
from velfield.run.s3 import S3ObjectPath, s3_path


@pytest.fixture(params=["disk", "s3"])
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    if request.param == "disk":
        return tmp_path / "run"
    request.getfixturevalue("s3")
    return to_path(f"s3://flights/paths/{tmp_path.name}")


@pytest.fixture
def remote(s3: None, tmp_path: Path) -> S3ObjectPath:
    return s3_path(f"s3://flights/objects/{tmp_path.name}")


def content(root: Path) -> dict[str, bytes]:
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("text", ["s3://bucket/run/a", "s3:/bucket/run/a", Path("s3://bucket/run/a")])
def test_a_path_on_s3_is_one_however_it_is_written(text: str | Path) -> None:
    path = to_path(text)
    assert is_remote(path)
    assert str(path) == "s3://bucket/run/a"
    assert path == to_path("s3://bucket/run") / "a"
    assert to_path(path) == path
    assert path.parent.name == "run"
    assert path.is_relative_to(to_path("s3://bucket/run"))


def test_a_path_on_a_disk_stays_a_path() -> None:
    assert to_path("run/a") == Path("run/a")
    assert not is_remote(to_path(Path("s3")))


def test_a_path_on_s3_travels_to_a_worker_as_it_is() -> None:
    layout = RunLayout(to_path("s3://bucket/run"))
    received = pickle.loads(pickle.dumps(layout))
    assert received == layout
    assert is_remote(received.camera)
    assert received.camera.storage_options == layout.camera.storage_options
    assert hash(received) == hash(layout)


@pytest.mark.parametrize("missing", ["s3fs", "upath"])
def test_without_the_extra_a_path_on_s3_is_refused_with_what_to_install(
    missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(layout, "find_spec", lambda name: None if name == missing else object())
    with pytest.raises(InputError, match=r"s3://bucket/run: a run folder on s3:// needs s3fs; pip install '.*\[s3\]'"):
        to_path("s3://bucket/run")
    assert to_path("run") == Path("run")


def test_files_are_written_read_listed_and_removed(root: Path) -> None:
    write_atomically(root / "a/one.json", b"1")
    write_atomically(root / "a/one.json", b"one")
    write_atomically(root / "b.json", b"two")
    assert content(root) == {"a/one.json": b"one", "b.json": b"two"}
    assert (root / "a/one.json").read_text() == "one"
    assert (root / "a").is_dir()
    assert not (root / "a").is_file()
    assert [path.name for path in root.glob("*.json")] == ["b.json"]
    assert (root / "b.json").stat().st_size == 3
    (root / "b.json").unlink()
    (root / "b.json").unlink(missing_ok=True)
    assert not (root / "b.json").exists()
    with pytest.raises(FileNotFoundError):
        (root / "b.json").read_bytes()
    remove_tree(root)
    remove_tree(root)
    assert not root.exists()
    assert sweep_partial(root) == 0


def test_a_folder_is_renamed_with_all_that_is_in_it(root: Path) -> None:
    files = {"deep/er/1": b"one", "2": b"two", "last": b"three"}
    for name, data in files.items():
        write_atomically(root / "old" / name, data)
    digest = digest_path(root / "old")
    rename_tree(root / "old", root / "new", last="last")
    assert content(root) == {f"new/{name}": data for name, data in files.items()}
    assert digest_path(root / "new") == digest


def test_libraries_read_a_local_file(root: Path) -> None:
    write_atomically(root / "a.bin", b"written")
    with local_copy(root / "a.bin") as local:
        assert isinstance(local, Path)
        assert local.name == "a.bin"
        assert local.read_bytes() == b"written"


def test_objects_are_copied_within_the_store(remote: S3ObjectPath) -> None:
    names = [f"{k}.bin" for k in range(5)]
    for name in names:
        (remote / "from" / name).write_bytes(name.encode())
    copy_objects([(remote / "from" / name, remote / "to" / name) for name in names])
    copy_objects([])
    assert [(remote / "to" / name).read_bytes() for name in names] == [name.encode() for name in names]


def test_an_object_is_created_once_and_replaced_by_its_version(remote: S3ObjectPath) -> None:
    path = remote / "lock"
    with pytest.raises(FileNotFoundError):
        path.version()
    assert path.replace_version('"none"', b"0") is None
    first = path.create(b"1")
    assert first == path.version()
    assert path.create(b"2") is None
    second = path.replace_version(first, b"3")
    assert second == path.version() != first
    assert path.replace_version(first, b"4") is None
    assert path.read_bytes() == b"3"


@pytest.mark.parametrize(("status", "lost"), [(409, True), (412, True), (403, False), (503, False)])
def test_only_a_condition_that_failed_is_a_lost_race(
    status: int, lost: bool, remote: S3ObjectPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Response(Exception):
        response = {"ResponseMetadata": {"HTTPStatusCode": status}}  # noqa: RUF012

    def refuse(*_: object, **__: object) -> None:
        raise OSError(5, "refused") from Response()

    monkeypatch.setattr(remote.fs, "pipe_file", refuse)
    if lost:
        assert remote.replace_version('"1"', b"1") is None
    else:
        with pytest.raises(OSError, match="refused"):
            remote.replace_version('"1"', b"1")


def test_a_bucket_that_is_not_there_is_an_error(s3: None) -> None:
    with pytest.raises(FileNotFoundError):
        s3_path("s3://no-such-bucket/lock").create(b"1")
