"""Fail the n-th call: a store that fails, is torn or fills up at any call of a small flight; resumed, all is equal.

python -m tests.faults.nth_call [--store disk|s3] [--modes fails tears "fills up"] [--every 1]

A trial starts from the unbroken run as it was before the stage that makes the n-th call, runs that stage with the
fault, and resumes without it. The folder must then be that of the unbroken run after the stage: every file, byte for
byte, and every commit record but for its time. Later stages read nothing else.
"""

import argparse
import json
import os
import shutil
import tempfile
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np

from tests.faults.failing_store import MODES, TINY, Fault, Mode, failing_disk, failing_s3, run_again, tiny_job
from tests.s3_server import s3_server
from velfield.pipeline.stage import STAGE
from velfield.run.commits import PAGE, digest_bytes
from velfield.run.layout import RunLayout, is_remote, remove_tree, to_path

STEPS = (*STAGE, PAGE)


def content(root: Path) -> dict[str, str]:
    """Digest of every file of a run by its path, without those of the time or the place of the run."""
    if is_remote(root):
        names = [key.removeprefix(f"{root.path}/") for key in root.fs.find(root.path)]
        data = {name: root.fs.cat_file(f"{root.path}/{name}") for name in names}
    else:
        data = {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}
    layout = RunLayout(Path("."))
    timed = {str(path) for path in (layout.report, layout.report_record, layout.flight, layout.lock)}
    found = {name: digest_bytes(value) for name, value in data.items() if name not in timed}
    for name in found:
        if name.startswith("commits/"):
            record = json.loads(data[name])
            kept = {key: value for key, value in record.items() if key not in ("seconds", "digest")}
            if name.startswith(f"commits/{PAGE}/"):
                kept["outputs"] = sorted(kept["outputs"])
            found[name] = digest_bytes(json.dumps(kept, sort_keys=True).encode())
    return found


@dataclass
class Flight:
    """A small flight with an unbroken run, kept as it was after each stage."""

    folder: Path
    remote: str | None = None
    """Address below which runs are kept, on S3; none: in the folder."""
    calls: dict[str, int] = field(default_factory=dict)
    """Calls of each stage in the unbroken run."""
    after: dict[str, dict[str, str]] = field(default_factory=dict)

    def root(self, name: str) -> Path:
        return to_path(f"{self.remote}/{name}") if self.remote else self.folder / name

    def make(self, steps: Sequence[str] = STEPS) -> None:
        """The flight, where it is not there, and its unbroken run up to the last of the steps."""
        from velfield.synthetic.write import write_flight

        if not (self.folder / "flight").exists():
            write_flight(self.folder / "flight", TINY)
        root = self.root("run")
        for step in steps:
            fault = Fault()
            with (failing_s3 if self.remote else failing_disk)(root, fault):
                run_again(tiny_job(self.folder / "flight", root), until=step)
            self.calls[step], self.after[step] = fault.calls, content(root)
            self._copy(root, self.root(f"after-{step}"))

    def trial(self, step: str, mode: Mode, call: int) -> list[str]:
        """The names of the files that differ after a fault and a resume; none where all is well."""
        root = self.root("run")
        remove_tree(root)
        number = STEPS.index(step)
        if number:
            self._copy(self.root(f"after-{STEPS[number - 1]}"), root)
        job, fault = tiny_job(self.folder / "flight", root), Fault(mode, call)
        with (failing_s3 if self.remote else failing_disk)(root, fault):
            try:
                run_again(job, until=step)
            except OSError:
                pass
            else:
                raise AssertionError(f"call {call} of {step} did not fail: {fault.calls} calls")
        run_again(job, until=step)
        found, expected = content(root), self.after[step]
        return sorted(name for name in found.keys() | expected.keys() if found.get(name) != expected.get(name))

    def _copy(self, source: Path, target: Path) -> None:
        if is_remote(source) and is_remote(target):
            names = [key.removeprefix(f"{source.path}/") for key in source.fs.find(source.path)]
            for name in names:
                target.fs.pipe_file(f"{target.path}/{name}", source.fs.cat_file(f"{source.path}/{name}"))
        else:
            shutil.copytree(source, target, dirs_exist_ok=True)


def trials(flight: Flight, modes: Sequence[Mode], every: int) -> list[tuple[str, Mode, int]]:
    """Every n-th call of every stage in each mode."""
    pairs = [(step, call) for step in STEPS for call in range(flight.calls[step])]
    return [(step, mode, call) for mode in modes for step, call in pairs[::every]]


def sample(flight: Flight, count: int, seed: int, steps: Sequence[str] = STEPS) -> list[tuple[str, Mode, int]]:
    """``count`` random trials, spread evenly over the stages: the field alone makes half of all calls."""
    rng = np.random.default_rng(seed)
    return [
        (str(step), MODES[int(rng.integers(len(MODES)))], int(rng.integers(flight.calls[str(step)])))
        for step in np.resize(rng.permutation(np.array(steps)), count)
    ]


def main() -> None:
    """All trials; prints what differed, and the counts."""
    from flows.launch import limit_threads, prepare_process

    parser = argparse.ArgumentParser()
    parser.add_argument("--store", choices=("disk", "s3"), default="disk")
    parser.add_argument("--modes", nargs="*", default=MODES)
    parser.add_argument("--every", type=int, default=1)
    given = parser.parse_args()
    limit_threads()
    prepare_process(verbose=False)
    remote = f"s3://flights/nth-call-{os.getpid()}" if given.store == "s3" else None
    with tempfile.TemporaryDirectory(prefix="velfield-nth-call-") as folder, s3_server() if remote else nullcontext():
        flight = Flight(Path(folder), remote)
        flight.make()
        print(f"calls of an unbroken run: {flight.calls}", flush=True)
        asked = trials(flight, [cast(Mode, mode) for mode in given.modes], given.every)
        differed = _try_all(flight, asked)
    print(f"{given.store}: {len(asked)} faults ({', '.join(given.modes)}), {differed} results differed")


def _try_all(flight: Flight, asked: Sequence[tuple[str, Mode, int]]) -> int:
    """How many of the results differed; prints which."""
    started, differed = time.monotonic(), 0
    for number, (step, mode, call) in enumerate(asked, 1):
        others = flight.trial(step, mode, call)
        differed += bool(others)
        if others:
            print(f"{step} call {call} {mode}: {', '.join(others[:5])}", flush=True)
        if number % 50 == 0:
            print(
                f"{number} of {len(asked)} trials, {differed} differed, {time.monotonic() - started:.0f} s", flush=True
            )
    return differed


if __name__ == "__main__":
    main()
