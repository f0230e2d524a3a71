"""A Dask cluster that has nothing in common with the tests but what is installed."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]


@contextlib.contextmanager
def foreign_cluster(folder: Path) -> Iterator[str]:
    """Scheduler and worker as processes of their own, in other working folders, `flows` hidden; yields the address."""
    site = folder / "site"
    site.mkdir()
    for name in ("velfield", "schemas"):
        (site / name).symlink_to(ROOT / name, target_is_directory=True)  # not copied: numba's cache goes with it
    (site / "flows.py").write_text("raise ImportError('there is no flows here')")
    ours = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT")}
    environment = {**ours, "PYTHONPATH": str(site), "PYTHONSAFEPATH": "1", "HOME": str(folder)}
    address_file = folder / "scheduler.json"
    told = ["--scheduler-file", str(address_file)]
    scheduler = ["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", *told]
    worker = ["distributed.cli.dask_worker", "--host", "127.0.0.1", "--nthreads", "1", "--no-dashboard", *told]
    processes = []
    try:
        for number, command in enumerate((scheduler, worker)):
            elsewhere = folder / f"elsewhere-{number}"
            elsewhere.mkdir()
            processes.append(
                subprocess.Popen(
                    [sys.executable, "-m", *command], cwd=elsewhere, env=environment, stderr=subprocess.DEVNULL
                )
            )
            while not address_file.exists():
                assert processes[0].poll() is None
                with contextlib.suppress(subprocess.TimeoutExpired):
                    processes[0].wait(0.1)
        yield str(yaml.safe_load(address_file.read_text())["address"])
    finally:
        for started in processes:
            started.terminate()
            started.wait(30)
