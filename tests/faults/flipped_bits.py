"""Flipped bits: in any file of a run, each found by `velfield verify`.

python -m tests.faults.flipped_bits RUN [--flips 200] [--seed 0]
"""

import argparse
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from velfield.errors import InputError
from velfield.pipeline.verify import verify_run
from velfield.run.run import open_run

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


def _round(root: Path, files: Sequence[Path], rng: np.random.Generator) -> list[Flip]:
    before = {path: path.read_bytes() for path in files}
    places = []
    for path, data in before.items():
        byte, bit = int(rng.integers(len(data))), int(rng.integers(8))
        changed = bytearray(data)
        changed[byte] ^= 1 << bit
        path.write_bytes(changed)
        places.append((path.relative_to(root).as_posix(), byte, bit))
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
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="velfield-bits-") as folder:
        shutil.copytree(given.run, Path(folder) / "run")
        flips = flip_bits(Path(folder) / "run", given.flips, given.seed)
    silent = [flip.text() for flip in flips if not flip.is_found]
    print("\n".join(silent))
    print(f"seed {given.seed}: {len(flips)} bits flipped in {len({f.path for f in flips})} files, {len(silent)} silent")


if __name__ == "__main__":
    main()
