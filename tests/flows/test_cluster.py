"""Clusters: by configuration alone, and with a worker killed in mid-chunk; workers without `flows`: `test_s3`."""

import os
import shutil
import socket
import subprocess
import sys
import time
import warnings
from pathlib import Path

import dask
import pytest
import yaml
from dask import delayed
from distributed import Client, LocalCluster
from distributed.versions import VersionMismatchWarning, get_versions

from flows.launch import prepare_process
from flows.runners import (
    ClusterFile,
    RunnerConfig,
    WorkersKilledError,
    _wait_for_worker,
    check_scheduler,
    open_runner,
    read_runner,
)
from tests.faults.test_refusals import command
from tests.small_flight import digests, job, process
from velfield.errors import InputError
from velfield.pipeline.stage import STAGES

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("cluster-*.yaml"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_are_read_and_list_what_runs_where(path: Path) -> None:
    runner = read_runner(path)
    assert runner.cluster_class.split(".")[0] in path.read_text().split("pip install ")[1].replace("-", "_")
    assert runner.workers > 1
    assert "What runs where" in path.read_text()


def test_there_is_an_example_for_each_kind() -> None:
    assert [path.stem for path in EXAMPLES] == ["cluster-cloudprovider", "cluster-kubernetes", "cluster-slurm"]


def test_an_example_whose_package_is_not_there_says_so() -> None:
    with (
        pytest.raises(InputError, match=r"cluster_class 'dask_jobqueue.SLURMCluster': .*install its package"),
        open_runner(read_runner(ROOT / "examples/cluster-slurm.yaml")),
    ):
        pass


@pytest.mark.parametrize(
    "text", ["workers: 2", "cluster_class: a.B\nworker: 3", "- 1", "cluster_class: [", "cluster_class: a.B\nworkers: 0"]
)
def test_a_cluster_file_that_is_none_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "cluster.yaml").write_text(text)
    with pytest.raises(InputError, match="keys: cluster_class"):
        read_runner(tmp_path / "cluster.yaml")


def stages_not_loaded() -> list[str]:
    modules = {path.partition(":")[0] for stage in STAGES for path in (stage.unit, stage.block) if path is not None}
    return sorted(modules - set(sys.modules))


def note_slowly(path: Path) -> None:
    time.sleep(0.5)
    with path.open("a") as file:
        file.write("computed\n")


def test_workers_of_our_own_keep_memory_for_pictures_import_the_stages_first_and_are_restarted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With Dask's own setting of memory a run takes half as long again; and Dask computes what a client still holds
    again, where the worker that has its result ends."""
    monkeypatch.setattr("flows.runners._WAIT_S", 0.1)
    prepare_process(verbose=False)
    with open_runner(RunnerConfig(workers=1)) as runner:
        assert runner.compute(delayed(stages_not_loaded)()) == []  # before the first task
        assert runner.call(os.environ.get, "MALLOC_TRIM_THRESHOLD_") == str(256 << 20)
        before = runner.call(os.getpid)
        assert runner.call(os.getpid) == before
        note = runner.compute(delayed(note_slowly)(tmp_path / "notes"))
        assert note is None
        runner.restart_workers()
        assert runner.call(os.getpid) not in (before, os.getpid())
        runner.call(time.sleep, 1.5)
    assert (tmp_path / "notes").read_text() == "computed\n"


def test_workers_of_others_are_not_restarted() -> None:
    with (
        LocalCluster(n_workers=1, dashboard_address="127.0.0.1:0", host="127.0.0.1") as cluster,
        open_runner(RunnerConfig(scheduler=cluster.scheduler_address)) as runner,
    ):
        before = runner.call(os.getpid)
        runner.restart_workers()
        assert runner.call(os.getpid) == before


@pytest.mark.timeout(90)
@pytest.mark.parametrize("cluster_class", [None, "distributed.LocalCluster"])
def test_workers_that_the_cluster_gave_up_are_replaced(
    cluster_class: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dask gives a worker up that is away for so long, as while it is restarted: then there would be none for ever."""
    monkeypatch.setattr("flows.runners._WAIT_S", 1.0)
    elsewhere = {"threads_per_worker": 1, "n_workers": 0, "dashboard_address": "127.0.0.1:0"}
    config = RunnerConfig(workers=1, cluster_class=cluster_class, cluster_kwargs=elsewhere if cluster_class else {})
    soon = {"distributed.deploy.lost-worker-timeout": "300ms", "distributed.scheduler.allowed-failures": 0}
    said: list[str] = []
    with dask.config.set(soon), open_runner(config, said.append) as runner:
        before = runner.call(os.getpid)
        if cluster_class is None:
            runner.restart_workers()
        else:
            with pytest.raises(WorkersKilledError):
                runner.call(os.kill, before, 9)
            # Its nanny may start it again just before it is given up, with the next call under way.
            runner._cluster.scheduler.allowed_failures = 3
        assert runner.call(os.getpid) not in (before, os.getpid())
    assert bool(said) == (cluster_class is not None)  # one that is restarted has not ended on its own


def before_detection(whole: Path, root: Path) -> Path:
    """A copy of the run of which only detection onward is to be done."""
    shutil.copytree(whole, root)
    for stage in ("detections", "tracklets", "tracks", "field", "maps"):
        shutil.rmtree(root / "commits" / stage)
    return root


def one_that_kills_its_worker(plan: object, frames: range) -> object:
    """In place of the step: the first worker that gets frame 8 dies of it."""
    from velfield.pipeline.stages.detections import detect_block

    mark = Path(plan.job.root) / "killed"
    if 8 in frames and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), 9)
    return detect_block(plan, frames)


def test_a_worker_killed_in_mid_chunk_on_a_cluster_by_class(
    whole: Path, flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = before_detection(whole, tmp_path / "run")
    asked = {"cluster_class": "distributed.LocalCluster", "workers": 2}
    asked["cluster_kwargs"] = {"n_workers": 0, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    (tmp_path / "cluster.yaml").write_text(yaml.safe_dump(ClusterFile.model_validate(asked).model_dump()))
    # Patched here alone: a graph names the function by its place in this file, and workers import the true one.
    monkeypatch.setattr("velfield.pipeline.stages.detections.detect_block", one_that_kills_its_worker)
    summary = process(job(flight, root), read_runner(tmp_path / "cluster.yaml"))
    assert (root / "killed").exists()
    (root / "killed").unlink()
    assert summary.complete
    said = "".join(capsys.readouterr())
    assert said.count("ended, or was lost: its work is computed again on another") == 1, said
    assert digests(root) == digests(whole)


def one_that_needs_too_much_memory(plan: object, frames: range) -> object:
    """In place of the step: frame 8 takes more than the limit of its worker, wherever it is computed."""
    from velfield.pipeline.stages.detections import detect_block

    if 8 in frames:
        with (Path(plan.job.root) / "attempts").open("a") as file:
            file.write(f"{os.getpid()}\n")
        taken = []
        for _ in range(600):  # the worker's nanny looks a few times a second
            taken.append(b"\1" * (20 << 20))
            time.sleep(0.02)
    return detect_block(plan, frames)


def test_a_unit_over_the_memory_limit_is_tried_once_more_and_then_left_out_with_the_reason(
    whole: Path, copy: Path, flight: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (copy / "commits/detections/000008-000015.json").unlink()
    here = {"n_workers": 0, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0", "memory_limit": "1200MB"}
    runner = RunnerConfig(cluster_class="distributed.LocalCluster", workers=1, cluster_kwargs=here)
    monkeypatch.setattr("velfield.pipeline.stages.detections.detect_block", one_that_needs_too_much_memory)
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}):  # else Dask itself tries it on others first
        summary = process(job(flight, copy), runner)
    assert len(set((copy / "attempts").read_text().split())) == 2
    assert not summary.complete
    (why,) = next(stage.failures for stage in summary.stages if stage.name == "detections")
    assert "detections of frames 8 to 15 (" in why
    assert "failed: 1 worker of tcp://" in why
    assert "the memory limit is too small" in why
    said = "".join(capsys.readouterr())  # Dask gave it up each time: that another computes it is no promise
    assert said.count("is computed again on another") == said.count("another, unless it has ended too many workers") > 0
    monkeypatch.undo()
    (copy / "attempts").unlink()
    assert process(job(flight, copy)).complete
    assert digests(copy) == digests(whole)


def test_a_cluster_without_workers_is_said_and_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """As after a restart of the scheduler, whose workers ended with it: Dask itself waits without a word."""
    monkeypatch.setattr("flows.runners._WAIT_S", 0.05)
    monkeypatch.setattr("flows.runners._NO_WORKERS_S", 0.2)
    warned: list[str] = []
    with LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as cluster:

        def warn(text: str) -> None:
            if not warned:
                cluster.scale(1)
            warned.append(text)

        with open_runner(RunnerConfig(scheduler=cluster.scheduler_address), warn) as runner:
            assert runner.description.endswith("0 workers")
            assert runner.compute(delayed(sum)([1, 2])) == 3
            with pytest.raises(TimeoutError, match="its own"):  # not that of the waiting
                runner.compute(delayed(_out_of_time)())
    assert warned
    assert "no workers at" in warned[0]
    assert "the run waits" in warned[0]


@pytest.mark.parametrize(
    ("address", "text"),
    [
        ("tcp://127.0.0.1:{silent}", "no answer within 1 s"),  # as the port of the dashboard, or of anything else
        ("tcp://127.0.0.1:{refused}", "no answer within 1 s"),
        ("http://127.0.0.1:8787", "unknown address scheme 'http'"),
        ("host", "missing port number"),
    ],
)
def test_an_address_without_a_scheduler_is_refused_in_one_line(
    address: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("flows.runners._ANSWER_S", 1.0)
    with socket.socket() as silent, socket.socket() as refused:
        for port in (silent, refused):
            port.bind(("127.0.0.1", 0))
        silent.listen()
        at = address.format(silent=silent.getsockname()[1], refused=refused.getsockname()[1])
        status, lines = command(
            monkeypatch, capsys, "run", str(tmp_path), "--fps", "5", "--out", str(tmp_path / "run"), "--scheduler", at
        )
    assert (status, len(lines)) == (1, 1), lines
    assert text in lines[0]
    assert "give the address that `dask scheduler` prints, such as tcp://HOST:8786" in lines[0]
    assert not (tmp_path / "run").exists()


def test_a_worker_is_no_scheduler() -> None:
    with (
        LocalCluster(n_workers=1, processes=False, dashboard_address="127.0.0.1:0", protocol="tcp") as cluster,
        pytest.raises(InputError, match=r"no Dask scheduler there \(Worker\)"),
    ):
        check_scheduler(next(iter(cluster.workers.values())).address)


_HIDDEN = "import sys; sys.modules['velfield'] = None; from distributed.cli.dask_worker import main; main()"


def test_workers_without_velfield_are_refused_and_live_on() -> None:
    """A task of velfield would end these workers one after the other, and the run would not notice."""
    with LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0") as cluster:
        address = cluster.scheduler_address
        options = ["--no-nanny", "--nthreads", "1", "--no-dashboard", "--host", "127.0.0.1"]
        worker = subprocess.Popen([sys.executable, "-c", _HIDDEN, address, *options], stderr=subprocess.DEVNULL)
        try:
            with Client(address, set_as_default=False) as client:
                client.wait_for_workers(1, timeout=60)
            with (
                pytest.raises(
                    InputError, match=r"velfield is not installed on 1 \(tcp://.*\) of the cluster's 1 workers"
                ),
                open_runner(RunnerConfig(scheduler=address)),
            ):
                pass
            assert worker.poll() is None
        finally:
            worker.kill()
            worker.wait()


@pytest.mark.parametrize("name", ["velfield", "numpy", "python"])
def test_workers_of_other_versions(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another velfield is refused, others are warned of in one line each, and Dask's table is not printed."""
    here = get_versions(packages=["velfield"])

    def told(self: Client, check: bool = False, packages: object = ()) -> dict[str, object]:
        return {"client": here, "workers": {"tcp://a:1": {"packages": {**here["packages"], name: "0.1.2"}}}}

    monkeypatch.setattr(Client, "get_versions", told)
    said: list[str] = []
    with LocalCluster(n_workers=1, processes=False, dashboard_address="127.0.0.1:0") as cluster:
        where = RunnerConfig(scheduler=cluster.scheduler_address)
        with warnings.catch_warnings():
            warnings.simplefilter("error", VersionMismatchWarning)
            if name == "velfield":
                with pytest.raises(InputError, match=r"found velfield 0\.1\.2 on 1 \(tcp://a:1\)"), open_runner(where):
                    pass
                return
            with open_runner(where, said.append):
                pass
    assert len(said) == 1
    assert said[0].startswith(f"found {name} 0.1.2 on 1 (tcp://a:1) of its workers, expected ")


def test_a_cluster_whose_queue_gives_no_worker_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flows.runners._NO_WORKERS_S", 0.2)
    said: list[str] = []
    with LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as cluster:

        def warn(text: str) -> None:
            said.append(text)
            cluster.scale(1)

        with Client(cluster, set_as_default=False) as client:
            _wait_for_worker(client, warn)
    assert said
    assert said[0].startswith("no workers at ")


def _out_of_time() -> None:
    raise TimeoutError("its own")
