"""One run at a time on a run folder, on a disk and on S3, whoever comes and however the last one ended."""

import json
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from velfield.errors import InputError
from velfield.run import lock
from velfield.run.layout import RunLayout, to_path
from velfield.run.lock import holder_is_gone, locked

EXPIRED = json.dumps({"pid": 1, "host": "elsewhere", "since": "2024-05-01 12:00:00", "until_s": 0.0})


@pytest.fixture(params=["disk", "s3"])
def layout(request: pytest.FixtureRequest, tmp_path: Path) -> RunLayout:
    if request.param == "disk":
        return RunLayout(tmp_path / "run")
    request.getfixturevalue("s3")
    return RunLayout(to_path(f"s3://flights/locks/{tmp_path.name}"))


def record(layout: RunLayout) -> dict[str, object]:
    found: dict[str, object] = json.loads(layout.lock.read_bytes())
    return found


def _try_lock(root: str, answer: "multiprocessing.Queue[str]") -> None:
    try:
        with locked(RunLayout(to_path(root))):
            answer.put("got it")
    except InputError as error:
        answer.put(str(error))


def answer_of_another_process(root: Path) -> str:
    context = multiprocessing.get_context("spawn")
    answer: multiprocessing.Queue[str] = context.Queue()
    process = context.Process(target=_try_lock, args=(str(root), answer))
    process.start()
    found = answer.get(timeout=60)
    process.join()
    return found


def test_two_runs_on_one_folder(layout: RunLayout) -> None:
    with locked(layout):
        owner = record(layout)
        told = answer_of_another_process(layout.root)
        assert f"locked by pid {os.getpid()} on {owner['host']} since {owner['since']}" in told
        with pytest.raises(InputError, match=f"locked by pid {os.getpid()}"), locked(layout):
            pass
    assert answer_of_another_process(layout.root) == "got it"
    with locked(layout):
        pass


@pytest.mark.parametrize("name", ["lock", "commits", "frames.zarr", "view/report.json", "tables/deep/er"])
@pytest.mark.parametrize("exists", [True, False])
def test_a_link_out_of_the_run_folder_is_refused_and_not_written_through(
    tmp_path: Path, name: str, exists: bool
) -> None:
    root, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    link = root / (RunLayout(root).lock.name if name == "lock" else name)
    link.parent.mkdir(parents=True)
    if exists and link.suffix:
        elsewhere.write_text("of somebody")
    elif exists:
        elsewhere.mkdir()
    link.symlink_to(elsewhere)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=r"found a symbolic link to .*elsewhere, expected that all of a run folder"):
        locked(RunLayout(root)).__enter__()
    assert sorted(tmp_path.rglob("*")) == before
    assert not elsewhere.is_file() or elsewhere.read_text() == "of somebody"


def test_a_file_where_the_run_is_to_be_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "there").write_text("a file")
    with (
        pytest.raises(InputError, match=r"there: found that no folder can be made .* give another --out"),
        locked(RunLayout(tmp_path / "there")),
    ):
        pass


def test_links_within_the_run_folder_and_one_to_it_are_followed(tmp_path: Path) -> None:
    (tmp_path / "disk" / "a").mkdir(parents=True)
    (tmp_path / "disk" / "b").symlink_to("a")
    (tmp_path / "run").symlink_to(tmp_path / "disk")
    with locked(RunLayout(tmp_path / "run")):
        assert RunLayout(tmp_path / "disk").lock.exists()


def test_the_lock_of_a_process_that_was_killed_is_taken_over(layout: RunLayout) -> None:
    code = f"""if True:
        import os
        from velfield.run.layout import RunLayout
        from velfield.run.lock import locked
        from velfield.run.layout import to_path
        with locked(RunLayout(to_path({str(layout.root)!r}))):
            os.kill(os.getpid(), 9)
    """
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    with locked(layout):
        assert record(layout)["pid"] == os.getpid()


def test_of_many_that_meet_an_expired_lock_one_takes_it_over(layout: RunLayout) -> None:
    contenders, rounds = 6, 12
    start, end = threading.Barrier(contenders), threading.Barrier(contenders)
    holders: list[list[int]] = [[] for _ in range(rounds)]
    refusals: list[str] = []

    def contend(number: int) -> None:
        for k in range(rounds):
            if start.wait(60) == 0:
                layout.root.mkdir(parents=True, exist_ok=True)
                layout.lock.write_bytes(EXPIRED.encode())
            start.wait(60)
            try:
                with locked(layout):
                    holders[k].append(number)
                    end.wait(60)  # held until all have tried
            except InputError as error:
                refusals.append(str(error))
                end.wait(60)

    threads = [threading.Thread(target=contend, args=(number,)) for number in range(contenders)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [len(found) for found in holders] == [1] * rounds
    assert len(refusals) == rounds * (contenders - 1)


def test_what_is_no_record_is_an_expired_one(layout: RunLayout) -> None:
    layout.root.mkdir(parents=True, exist_ok=True)
    layout.lock.write_bytes(b"not JSON")
    with locked(layout):
        assert record(layout)["pid"] == os.getpid()


@pytest.fixture
def lease(s3: None, tmp_path: Path) -> RunLayout:
    return RunLayout(to_path(f"s3://flights/leases/{tmp_path.name}"))


def test_a_lease_is_renewed_while_it_is_held_and_expires_when_it_is_given_back(
    lease: RunLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "_LEASE_S", 0.6)
    with locked(lease):
        first = record(lease)
        time.sleep(0.5)
        assert record(lease)["until_s"] > first["until_s"]
    assert record(lease)["until_s"] <= time.time()


def test_the_holder_of_a_lease_is_gone_when_it_expired(lease: RunLayout) -> None:
    assert not holder_is_gone(lease)  # nobody ever held it
    with locked(lease):
        assert not holder_is_gone(lease)
    assert holder_is_gone(lease)
    lease.lock.write_bytes(EXPIRED.encode())
    assert holder_is_gone(lease)


def test_a_lease_that_was_taken_over_is_not_taken_back(lease: RunLayout) -> None:
    theirs = json.dumps({"pid": 1, "host": "elsewhere", "since": "now", "until_s": time.time() + 60})
    with pytest.raises(InputError, match="taken over by another process"), locked(lease):
        lease.lock.write_bytes(theirs.encode())
    assert lease.lock.read_bytes().decode() == theirs


def take_over_and_fail(lease: RunLayout) -> None:
    lease.lock.write_bytes(EXPIRED.encode())
    raise ZeroDivisionError


def test_an_exception_is_not_hidden_by_the_loss_of_the_lease(lease: RunLayout) -> None:
    with pytest.raises(ZeroDivisionError), locked(lease):
        take_over_and_fail(lease)


def test_a_write_whose_answer_was_lost_is_known_for_ones_own(lease: RunLayout, monkeypatch: pytest.MonkeyPatch) -> None:
    from velfield.run.s3 import S3ObjectPath

    replace = S3ObjectPath.replace_version

    def lose_answer(path: S3ObjectPath, version: str, data: bytes) -> None:
        replace(path, version, data)

    def lose_created(path: S3ObjectPath, data: bytes) -> None:
        path.write_bytes(data)

    monkeypatch.setattr(S3ObjectPath, "create", lose_created)
    monkeypatch.setattr(S3ObjectPath, "replace_version", lose_answer)
    with locked(lease):
        assert record(lease)["pid"] == os.getpid()


def test_connections_that_fail_do_not_end_the_renewal(lease: RunLayout, monkeypatch: pytest.MonkeyPatch) -> None:
    from botocore.exceptions import EndpointConnectionError

    from velfield.run.s3 import S3ObjectPath

    replace, tries = S3ObjectPath.replace_version, []

    def refuse_twice(path: S3ObjectPath, version: str, data: bytes) -> str | None:
        tries.append(version)
        if len(tries) <= 2:
            raise EndpointConnectionError(endpoint_url="http://127.0.0.1:9")
        return replace(path, version, data)

    monkeypatch.setattr(lock, "_LEASE_S", 1.5)
    monkeypatch.setattr(S3ObjectPath, "replace_version", refuse_twice)
    with locked(lease):
        time.sleep(2.5)
        assert record(lease)["until_s"] > time.time()


@pytest.mark.parametrize("fault", ["taken over", "no answer"])
def test_a_run_that_lost_its_lease_stops_writing(fault: str, lease: RunLayout, monkeypatch: pytest.MonkeyPatch) -> None:
    from velfield.run.s3 import S3ObjectPath

    def refuse(*_: object) -> None:
        raise ConnectionError("no network")

    monkeypatch.setattr(lock, "_LEASE_S", 0.6)
    written: list[int] = []

    def write() -> None:
        if fault == "taken over":
            lease.lock.write_bytes(json.dumps(json.loads(EXPIRED) | {"until_s": time.time() + 60}).encode())
        else:
            monkeypatch.setattr(S3ObjectPath, "replace_version", refuse)
        for k in range(300):
            time.sleep(0.02)
            written.append(k)

    with pytest.raises(InputError, match="taken over by another process, or no answer"), locked(lease):
        write()
    assert len(written) < 300


def test_a_lock_of_a_container_with_the_same_host_name_is_respected(lease: RunLayout) -> None:
    with locked(lease):
        found = record(lease)
    for machine in ("another boot pid:[4026531836]", ""):
        other = found | {"machine": machine, "pid": 2**22 + 1, "lease": "", "until_s": time.time() + 60}
        lease.lock.write_bytes(json.dumps(other).encode())
        with pytest.raises(InputError, match="is locked by"), locked(lease):
            pass
        assert not holder_is_gone(lease)
    lease.lock.write_bytes(json.dumps(other | {"machine": found["machine"]}).encode())
    with locked(lease):
        pass


def test_on_a_disk_too_a_container_with_the_same_host_name_is_not_taken_for_gone(tmp_path: Path) -> None:
    layout = RunLayout(tmp_path / "run")
    with locked(layout):
        found = record(layout)
    layout.lock.write_text(json.dumps(found | {"machine": "another", "pid": 2**22 + 1}))
    assert not holder_is_gone(layout)
    layout.lock.write_text(json.dumps(found | {"pid": 2**22 + 1}))
    assert holder_is_gone(layout)


def test_a_file_system_without_locks_is_not_taken_for_a_locked_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import errno
    import fcntl

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(OSError, match="No locks available"):
        locked(RunLayout(tmp_path / "run")).__enter__()


def test_the_lock_of_a_file_that_was_removed_meanwhile_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    layout, tries = RunLayout(tmp_path / "run"), []

    def remove_once(file: object) -> bool:
        tries.append(file)
        if len(tries) == 1:
            layout.lock.unlink()
            layout.root.rmdir()
        return True

    monkeypatch.setattr(lock, "try_lock", remove_once)
    with locked(layout):
        assert record(layout)["pid"] == os.getpid()
    assert len(tries) == 2
