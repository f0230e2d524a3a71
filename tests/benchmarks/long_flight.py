"""Memory and rate of a long flight: as many frames as wanted, of a few simulated ones there and back again.

python -m tests.benchmarks.long_flight --frames 1126 --size 2560x1920
python -m tests.benchmarks.long_flight --frames 5000 --size 640x480
"""

import argparse
import os
import sys
import tempfile
from contextlib import nullcontext
from pathlib import Path


def main() -> None:
    """Print wall time, frames a second, and the memory of driver and workers, by quarters of the run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1126)
    parser.add_argument("--size", default="2560x1920")
    parser.add_argument("--simulated", type=int, default=60)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--workers", type=int, default=2, help="0: the threads of the driver")
    parser.add_argument("--flight", type=Path, help="of `velfield simulate`, instead of simulating one")
    parser.add_argument("--work", type=Path, help="folder to keep; default: a temporary one")
    given = parser.parse_args()
    with nullcontext(given.work) if given.work else tempfile.TemporaryDirectory() as folder:
        root = Path(str(folder))
        flight = given.flight or _simulate(root / "flight", given.simulated, given.size)
        source = repeat_frames(flight, root / "long", given.frames)
        _run(source, flight, root / "run", given)


def _simulate(flight: Path, frames: int, size: str) -> Path:
    from schemas.simulation import SimulationConfig
    from velfield.synthetic import write_flight

    width, height = (int(side) for side in size.split("x"))
    if not (flight / "truth").exists():
        write_flight(flight, SimulationConfig(frames=frames, width=width, height=height, seed=77))
    return flight


def repeat_frames(flight: Path, long: Path, frames: int) -> Path:
    """A folder of links to a simulated flight's frames, forwards and backwards in turn so that nothing jumps, with
    time stamps and the labels of its first frame."""
    images = sorted((flight / "frames").iterdir())
    there_and_back = [*range(len(images)), *range(len(images) - 2, 0, -1)]
    (long / "frames").mkdir(parents=True, exist_ok=True)
    lines = ["frame,time_s"]
    for k in range(frames):
        source = images[there_and_back[k % len(there_and_back)]]
        target = long / "frames" / (source.name if k == 0 else f"frame_{k:06d}{source.suffix}")
        target.unlink(missing_ok=True)
        os.symlink(source.resolve(), target)
        lines.append(f"{target.name},{0.2 * k:.3f}")
    (long / "timestamps.csv").write_text("\n".join(lines) + "\n")
    header, *labels = (flight / "labels.csv").read_text().splitlines()
    mine = [line for line in labels if line.startswith(f"{images[0].name},")]
    (long / "labels.csv").write_text("\n".join([header, *mine]) + "\n")
    return long


def _run(long: Path, flight: Path, out: Path, given: argparse.Namespace) -> None:
    from velfield.bench.measured_run import run_measured
    from velfield.run.layout import remove_tree

    remove_tree(out)
    inputs = [f"--timestamps={long}/timestamps.csv", f"--base={flight}/base.png", f"--labels={long}/labels.csv"]
    command = [sys.executable, "-m", "flows.cli", "run", f"{long}/frames", *inputs, "--gsd-m=0.23", "--quiet"]
    workers = [f"--workers={given.workers}"] if given.workers else []
    run = run_measured([*command, f"--preset={given.preset}", *workers, f"--out={out}"], watch=out / "index.html")
    print(f"{given.frames} frames of {given.size}, {given.preset}: {given.frames / run.wall_s:.2f} frames a second")
    print(run.text())
    print(f"first map after {run.appeared_s or run.wall_s:.0f} s")


if __name__ == "__main__":
    main()
