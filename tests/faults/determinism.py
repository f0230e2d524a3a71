"""The same bits: a small flight by threads and processes, 1, 2 and 8 at a time, and under several versions of Python.

python -m tests.faults.determinism FOLDER [--threads 1 2 8] [--processes 2 8]

The flight is made in FOLDER where it is not there; each run leaves its digests in FOLDER/NAME.json and is compared with
all that are there, also of another Python: of what differs, by how much.
"""

import argparse
import io
import json
import platform
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from flows.runners import RunnerConfig, ThreadsRunner, open_runner
from tests.faults.failing_store import TINY, tiny_job
from tests.small_flight import digests
from velfield.pipeline.graphs import unit_graph
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.pipeline.stage import STAGES
from velfield.pipeline.units import prepare_stage, stage_units


def run_by(compute: Callable[[Any], Any], flight: Path, root: Path) -> dict[str, str]:
    """Digests of the files of a run whose graphs are computed by a runner."""
    shutil.rmtree(root, ignore_errors=True)
    plan = make_plan(tiny_job(flight, root))
    write_flight_record(plan)
    for stage in STAGES:
        prepare_stage(plan, stage)
        for unit in stage_units(plan, stage):
            compute(unit_graph(plan, stage, unit))
    return digests(root)


def largest_difference(one: Path, other: Path) -> str:
    """By how much two tables differ, or two JSON files; of other files only that they do."""
    if one.suffix == ".parquet" and other.exists():
        first, second = (pd.read_parquet(io.BytesIO(path.read_bytes())) for path in (one, other))
        if len(first) != len(second):
            return f"{len(first)} and {len(second)} rows"
        numbers = first.select_dtypes("number").columns
        gaps = np.abs(first[numbers].to_numpy(float) - second[numbers].to_numpy(float))
        return f"by {np.nanmax(gaps, initial=0.0):.2g}"
    return "in bytes"


def main() -> None:
    """All runs; prints what differs between them."""
    from flows.launch import limit_threads, prepare_process

    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 2, 8])
    parser.add_argument("--processes", type=int, nargs="*", default=[2, 8])
    given = parser.parse_args()
    limit_threads()
    prepare_process(verbose=False)
    flight = given.folder / "flight"
    if not flight.exists():
        from velfield.synthetic import write_flight

        write_flight(flight, TINY)
    python = f"{platform.python_version()}, numpy {np.__version__}"
    found: dict[str, dict[str, str]] = {}
    for threads in given.threads:
        name = f"python-{platform.python_version()}-threads-{threads}"
        found[name] = run_by(ThreadsRunner(threads).compute, flight, given.folder / name)
    for processes in given.processes:
        name = f"python-{platform.python_version()}-processes-{processes}"
        with open_runner(RunnerConfig(workers=processes)) as runner:
            found[name] = run_by(runner.compute, flight, given.folder / name)
    for name, made in found.items():
        (given.folder / f"{name}.json").write_text(json.dumps(made, indent=1))
    _compare(given.folder, python)


def _compare(folder: Path, python: str) -> None:
    runs = {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("python-*.json"))}
    first, *others = runs
    print(f"Python {python}; all are compared with {first}: {len(runs[first])} files")
    for name in others:
        differ = [file for file in runs[first] if runs[first][file] != runs[name].get(file)]
        tables = [f"{file} {largest_difference(folder / first / file, folder / name / file)}" for file in differ]
        print(f"{name}: {len(differ)} files differ" + "".join(f"\n  {line}" for line in tables))


if __name__ == "__main__":
    main()
