"""Flipped bits: in any file of a run, each found by `velfield verify`, and put right by its `--repair`.

python -m tests.faults.flipped_bits RUN [--flips 200] [--seed 0] [--repair]

Without `--repair` the bits are flipped back after each round. With it, `velfield verify --repair` computes the units
that were hit again: the folder must then be what it was, and no other unit may have been computed. `flight.json` is
left out there, as a damaged one is refused (the same `velfield run` writes it again).
"""

import argparse
import shutil
import tempfile
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np

from flows.commands.verify import verify
from tests.small_flight import digests
from velfield.errors import InputError
from velfield.pipeline.stage import STAGE
from velfield.pipeline.verify import verify_run
from velfield.run.commits import PAGE, read_commits
from velfield.run.layout import RunLayout
from velfield.run.run import open_run
from velfield.run.stores import is_of_creation

UNREAD = (".lock",)
"""Files that nothing reads once a run has ended."""


@dataclass(frozen=True)
class Flip:
    """One flipped bit, and the files that `verify` named."""

    path: str
    byte: int
    bit: int
    found: tuple[str, ...]

    @property
    def is_found(self) -> bool:
        """Whether the file that it is in was named."""
        return self.path in self.found

    def text(self) -> str:
        """The flip in one line."""
        return f"{self.path} byte {self.byte} bit {self.bit}: found {', '.join(self.found) or 'nothing'}"


def flip_bits(root: Path, flips: int, seed: int, per_round: int = 25) -> list[Flip]:
    """Flip bits of a run, verify, and put them right again; files are drawn evenly, then the bit in each.

    Several files a round, one bit in each: every one of them must be named. ``flight.json`` has a round of its own, and
    so have the commit records: what a damaged one lists is not looked at.
    """
    rng = np.random.default_rng(seed)
    files = sorted(path for path in root.rglob("*") if path.is_file() and path.name not in UNREAD)
    done: list[Flip] = []
    while len(done) < flips:
        chosen = [
            files[k] for k in rng.choice(len(files), min(per_round, flips - len(done), len(files)), replace=False)
        ]
        for group in (
            [path for path in chosen if path.parent != root and "commits" not in path.parts],
            [path for path in chosen if "commits" in path.parts],
            *([path] for path in chosen if path.parent == root),
        ):
            done += _round(root, group, rng) if group else []
    return done


def repair_bits(root: Path, flips: int, seed: int, per_round: int = 10) -> list[str]:
    """Flip bits of a run and repair it, several files a round; what differs afterwards, each in one line."""
    rng = np.random.default_rng(seed)
    whole, problems, done, rounds = digests(root), [], 0, 0
    while done < flips:
        files = sorted(
            path
            for path in root.rglob("*")
            if path.is_file() and path.name not in UNREAD and path != RunLayout(root).flight
        )
        chosen = [files[k] for k in rng.choice(len(files), min(per_round, flips - done, len(files)), replace=False)]
        names = [path.relative_to(root).as_posix() for path in chosen]
        expected = _units_with(root, names)
        written = {path: path.stat().st_mtime_ns for path in (root / "commits").rglob("*.json")}
        for path in chosen:
            _flip(path, path.read_bytes(), rng)
        with redirect_stdout(StringIO()):
            status = verify(root, repair=True)
        after = digests(root)
        again = {
            path.relative_to(root / "commits").with_suffix("").as_posix()
            for path in (root / "commits").rglob("*.json")
            if written.get(path) != path.stat().st_mtime_ns
        }
        told = f"round {rounds}, {', '.join(names)}:"
        if status:
            problems.append(f"{told} not whole after the repair")
        if after != whole:
            changed = sorted(name for name in whole.keys() | after.keys() if whole.get(name) != after.get(name))
            problems.append(f"{told} differs in {', '.join(changed)}")
        # Every run writes the page again; and what follows a unit without a record may be computed with it.
        others = again - expected - {"page/all"}
        if expected - again or (others and not any("commits/" in name for name in names)):
            problems.append(f"{told} computed {sorted(again)} for {sorted(expected)}")
        done += len(chosen)
        rounds += 1
        print(f"{done} bits flipped and repaired, {len(problems)} problems", flush=True)
    return problems


def _units_with(root: Path, names: Sequence[str]) -> set[str]:
    """The units, as stage/unit, whose outputs or whose commit records these files are.

    A store whose metadata or coordinates are hit is made again: with all units that write to it.
    """
    layout = RunLayout(root)
    found = {Path(name).relative_to("commits").with_suffix("").as_posix() for name in names if "commits/" in name}
    whole = {Path(name).parts[0] for name in names if ".zarr/" in name and is_of_creation(name)}
    for stage in (*STAGE, PAGE):
        for record in read_commits(layout, stage):
            if set(record.outputs) & set(names) or whole & {Path(name).parts[0] for name in record.outputs}:
                found.add(f"{stage}/{record.unit}")
    return found


def _flip(path: Path, data: bytes, rng: np.random.Generator) -> tuple[int, int]:
    """Flip one bit of a file that holds these bytes."""
    byte, bit = int(rng.integers(len(data))), int(rng.integers(8))
    changed = bytearray(data)
    changed[byte] ^= 1 << bit
    path.write_bytes(changed)
    return byte, bit


def _round(root: Path, files: Sequence[Path], rng: np.random.Generator) -> list[Flip]:
    before = {path: path.read_bytes() for path in files}
    places = [(path.relative_to(root).as_posix(), *_flip(path, data, rng)) for path, data in before.items()]
    found = _damaged(root)
    for path, data in before.items():
        path.write_bytes(data)
    return [Flip(*place, found) for place in places]


def _damaged(root: Path) -> tuple[str, ...]:
    """The files that `velfield verify` names."""
    try:
        run = open_run(root)
        return tuple(damage.path or "" for damage in verify_run(run.layout, run.record))
    except InputError as error:
        return tuple(name for name in ("flight.json",) if name in str(error))


def main() -> None:
    """Flip bits of a copy of a run; print those that were not found."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("--flips", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--repair", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="velfield-bits-") as folder:
        shutil.copytree(given.run, Path(folder) / "run")
        if given.repair:
            problems = repair_bits(Path(folder) / "run", given.flips, given.seed)
            print("\n".join(problems))
            print(f"seed {given.seed}: {given.flips} bits flipped and repaired, {len(problems)} problems")
            return
        flips = flip_bits(Path(folder) / "run", given.flips, given.seed)
    silent = [flip.text() for flip in flips if not flip.is_found]
    print("\n".join(silent))
    print(f"seed {given.seed}: {len(flips)} bits flipped in {len({f.path for f in flips})} files, {len(silent)} silent")


if __name__ == "__main__":
    main()
