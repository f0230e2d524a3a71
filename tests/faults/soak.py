"""A long flight of small frames: memory and file descriptors must not grow with the frames.

python -m tests.faults.soak [--frames 20000] [--size 160x120] [--folder FOLDER]

The frames are those of a simulated flight, there and back as often as needed (hard links). A process of its own runs
them; this one reads its memory and descriptors every few seconds.
"""

import argparse
import csv
import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[2]
SIMULATED = 120
SETTINGS = (
    "lens.calibrate=never",
    "registration.model=homography",
    "registration.max_keypoints=300",
    "registration.keypoint_scale=1.0",
    "registration.min_control_points=20",
)
_SAMPLE_S = 5.0


@dataclass(frozen=True)
class Sample:
    """Memory and files that a run's process held at one moment."""

    seconds: float
    commits: int
    rss_mb: float
    descriptors: int


def write_long_flight(folder: Path, frames: int, width: int, height: int, seed: int) -> None:
    """A flight of so many frames, there and back over a simulated one."""
    from schemas.simulation import SimulationConfig
    from velfield.synthetic.write import write_flight

    write_flight(folder / "simulated", SimulationConfig(frames=SIMULATED, width=width, height=height, seed=seed))
    names = sorted(path.name for path in (folder / "simulated/frames").iterdir())
    there_and_back = itertools.cycle([*names, *reversed(names[1:-1])])
    (folder / "frames").mkdir()
    with (folder / "timestamps.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("frame", "time_s"))
        for k, name in enumerate(itertools.islice(there_and_back, frames)):
            # The first frames keep their names, by which labels refer to them.
            linked = name if k < SIMULATED else f"z{k:06d}{Path(name).suffix}"
            os.link(folder / "simulated/frames" / name, folder / "frames" / linked)
            writer.writerow((linked, f"{0.2 * k:.3f}"))


def samples(process: "subprocess.Popen[bytes]", root: Path) -> Iterator[Sample]:
    """A sample every few seconds until the process ends."""
    own, started = psutil.Process(process.pid), time.monotonic()
    while process.poll() is None:
        with suppress(psutil.Error):
            yield Sample(
                seconds=time.monotonic() - started,
                commits=sum(1 for _ in root.glob("commits/*/*.json")),
                rss_mb=own.memory_info().rss / 1e6,
                descriptors=own.num_fds(),
            )
        time.sleep(_SAMPLE_S)


def main() -> None:
    """Make the flight, run it, write the samples, print them at tenths of the run."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--seed", type=int, default=21)
    parser.add_argument("--folder", type=Path, default=None)
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="velfield-soak-", dir=given.folder))
    width, height = map(int, given.size.split("x"))
    write_long_flight(folder, given.frames, width, height, given.seed)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "flows.cli", "run", str(folder / "frames"), "--out", str(folder / "run")]
    command += ["--timestamps", str(folder / "timestamps.csv")]
    command += ["--labels", str(folder / "simulated/labels.csv"), "--gsd-m", "0.23"]
    command += [word for setting in SETTINGS for word in ("--set", setting)]
    names, taken = [field.name for field in fields(Sample)], []
    with (
        subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL) as process,
        (folder / "samples.csv").open("w", newline="", buffering=1) as file,
    ):
        writer = csv.writer(file)
        writer.writerow(names)
        for sample in samples(process, folder / "run"):
            writer.writerow(astuple(sample))
            taken.append(sample)
    print(f"status {process.returncode}; {given.frames} frames of {given.size}; samples in {folder / 'samples.csv'}")
    print(" | ".join(names))
    for k in range(0, len(taken), max(1, len(taken) // 20)):
        print(" | ".join(f"{value:.0f}" for value in astuple(taken[k])))
    print(" | ".join(f"{value:.0f}" for value in astuple(taken[-1])))


if __name__ == "__main__":
    main()
