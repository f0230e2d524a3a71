"""The same bits: a small flight by threads and processes, 1, 2 and 8 at a time, and under several versions of Python.

python -m tests.faults.determinism FOLDER [--threads 1 2 8] [--processes 2 8] [--set detection.method=cnn ...]

The flight is made in FOLDER where it is not there; each run leaves its digests in FOLDER/NAME.json and is compared with
all that are there, also of another Python: of what differs, by how much. Exit status 1 where that is more than
`TOLERANCE`.
"""

import argparse
import io
import json
import platform
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import zarr

from flows.runners import RunnerConfig, ThreadsRunner, open_runner
from schemas.arrays import FloatArray
from tests.faults.failing_store import TINY, tiny_job
from tests.small_flight import digests
from velfield.pipeline.graphs import unit_graph
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.pipeline.stage import STAGES
from velfield.pipeline.units import prepare_stage, stage_units


def run_by(compute: Callable[[Any], Any], flight: Path, root: Path, settings: Sequence[str] = ()) -> dict[str, str]:
    """Digests of the files of a run whose graphs are computed by a runner."""
    shutil.rmtree(root, ignore_errors=True)
    plan = make_plan(tiny_job(flight, root, *settings))
    write_flight_record(plan)
    for stage in STAGES:
        prepare_stage(plan, stage)
        for unit in stage_units(plan, stage):
            compute(unit_graph(plan, stage, unit))
    return digests(root)


TOLERANCE = 1e-6
"""Of every number (px, s, px/s) between versions of numpy and scipy; between runs of the same ones nothing differs."""


def largest_difference(one: Path, other: Path) -> float:
    """The largest difference of two files' numbers: tables, JSON, and the array that a chunk belongs to.

    Infinite where they differ in anything else: texts, counts of rows, shapes, bytes that are none of these.
    """
    if not (one.exists() and other.exists()):
        return np.inf
    if one.suffix == ".parquet":
        first, second = (pd.read_parquet(io.BytesIO(path.read_bytes())) for path in (one, other))
        return _frames(first, second)
    if one.suffix == ".json" and one.name != "zarr.json":
        return _values(*(json.loads(path.read_bytes()) for path in (one, other)))
    arrays = [_array_of(path) for path in (one, other)]
    return np.inf if any(array is None for array in arrays) else _numbers(*arrays)


def _array_of(chunk: Path) -> FloatArray | None:
    folder = next((folder for folder in chunk.parents if (folder / "zarr.json").exists()), None)
    array = None if folder is None else zarr.open(folder, mode="r")
    return array[...].astype(float) if isinstance(array, zarr.Array) else None


def _frames(first: pd.DataFrame, second: pd.DataFrame) -> float:
    numbers = list(first.select_dtypes("number").columns)
    if len(first) != len(second) or not first.drop(columns=numbers).equals(second.drop(columns=numbers)):
        return np.inf
    return _numbers(first[numbers].to_numpy(float), second[numbers].to_numpy(float))


def _values(first: object, second: object) -> float:
    if isinstance(first, dict) and isinstance(second, dict) and first.keys() == second.keys():
        return max((_values(first[key], second[key]) for key in first), default=0.0)
    if isinstance(first, list) and isinstance(second, list) and len(first) == len(second):
        return max((_values(*pair) for pair in zip(first, second, strict=True)), default=0.0)
    if isinstance(first, float) and isinstance(second, float):
        return abs(first - second)
    return 0.0 if first == second else np.inf


def _numbers(first: FloatArray, second: FloatArray) -> float:
    if first.shape != second.shape or not np.array_equal(np.isnan(first), np.isnan(second)):
        return np.inf
    return float(np.nanmax(np.abs(first - second), initial=0.0))


def main() -> int:
    """All runs; prints what differs between them."""
    from flows.launch import limit_threads, prepare_process

    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 2, 8])
    parser.add_argument("--processes", type=int, nargs="*", default=[2, 8])
    parser.add_argument("--set", dest="settings", nargs="*", default=[])
    given = parser.parse_args()
    limit_threads()
    prepare_process(verbose=False)
    flight = given.folder / "flight"
    if not flight.exists():
        from velfield.synthetic.write import write_flight

        write_flight(flight, TINY)
    python = f"{platform.python_version()}, numpy {np.__version__}"
    found: dict[str, dict[str, str]] = {}
    for threads in given.threads:
        name = f"python-{platform.python_version()}-threads-{threads}"
        found[name] = run_by(ThreadsRunner(threads).compute, flight, given.folder / name, given.settings)
    for processes in given.processes:
        name = f"python-{platform.python_version()}-processes-{processes}"
        with open_runner(RunnerConfig(workers=processes)) as runner:
            found[name] = run_by(runner.compute, flight, given.folder / name, given.settings)
    for name, made in found.items():
        (given.folder / f"{name}.json").write_text(json.dumps(made, indent=1))
    return 0 if _compare(given.folder, python) else 1


def _compare(folder: Path, python: str) -> bool:
    """Print what differs from the first run, and by how much; whether all of it is within the tolerance."""
    runs = {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("python-*.json"))}
    first, *others = runs
    print(f"Python {python}; all are compared with {first}: {len(runs[first])} files")
    largest = 0.0
    for name in others:
        differ = [
            file for file in runs[first].keys() | runs[name].keys() if runs[first].get(file) != runs[name].get(file)
        ]
        gaps = {file: largest_difference(folder / first / file, folder / name / file) for file in sorted(differ)}
        print(f"{name}: {len(gaps)} files differ" + "".join(f"\n  {file} by {gap:.2g}" for file, gap in gaps.items()))
        largest = max(largest, *gaps.values(), 0.0)
    return largest <= TOLERANCE


if __name__ == "__main__":
    sys.exit(main())
