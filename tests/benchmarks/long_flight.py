"""Memory and rate of a long flight: as many frames as wanted, of a few simulated ones there and back again.

python -m tests.benchmarks.long_flight --frames 1126 --size 2560x1920 [--video]
python -m tests.benchmarks.long_flight --frames 5000 --size 640x480
"""

import argparse
import os
import sys
import tempfile
from contextlib import nullcontext
from pathlib import Path

import av
import cv2


def main() -> None:
    """Print wall time, frames a second, and the memory of driver and workers, by quarters of the run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1126)
    parser.add_argument("--size", default="2560x1920")
    parser.add_argument("--simulated", type=int, default=60)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--workers", type=int, default=2, help="0: the threads of the driver")
    parser.add_argument("--video", action="store_true", help="as H.264, as cameras record, instead of PNG images")
    parser.add_argument("--flight", type=Path, help="of `velfield simulate`, instead of simulating one")
    parser.add_argument("--work", type=Path, help="folder to keep; default: a temporary one")
    given = parser.parse_args()
    with nullcontext(given.work) if given.work else tempfile.TemporaryDirectory() as folder:
        root = Path(str(folder))
        flight = given.flight or _simulate(root / "flight", given.simulated, given.size)
        source = (encode_frames if given.video else repeat_frames)(flight, root / "long", given.frames)
        _run(source, flight, root / "run", given)


def _simulate(flight: Path, frames: int, size: str) -> Path:
    from schemas.simulation import SimulationConfig
    from velfield.synthetic.write import write_flight

    width, height = (int(side) for side in size.split("x"))
    if not (flight / "truth").exists():
        write_flight(flight, SimulationConfig(frames=frames, width=width, height=height, seed=77))
    return flight


def _there_and_back(flight: Path, frames: int) -> list[Path]:
    """A simulated flight's frames, forwards and backwards in turn so that nothing jumps."""
    images = sorted((flight / "frames").iterdir())
    period = [*images, *images[-2:0:-1]]
    return [period[k % len(period)] for k in range(frames)]


def _write_labels(flight: Path, long: Path, first: str) -> None:
    """The labels of the flight's first frame, by another name."""
    header, *labels = (flight / "labels.csv").read_text().splitlines()
    name = sorted((flight / "frames").iterdir())[0].name
    mine = [first + line.removeprefix(name) for line in labels if line.startswith(f"{name},")]
    (long / "labels.csv").write_text("\n".join([header, *mine]) + "\n")


def repeat_frames(flight: Path, long: Path, frames: int) -> list[str]:
    """A folder of links to the frames, with time stamps and the labels of the first: the options that give them."""
    (long / "frames").mkdir(parents=True, exist_ok=True)
    lines, first = ["frame,time_s"], ""
    for k, source in enumerate(_there_and_back(flight, frames)):
        target = long / "frames" / (source.name if k == 0 else f"frame_{k:06d}{source.suffix}")
        first = first or target.name
        target.unlink(missing_ok=True)
        os.symlink(source.resolve(), target)
        lines.append(f"{target.name},{0.2 * k:.3f}")
    (long / "timestamps.csv").write_text("\n".join(lines) + "\n")
    _write_labels(flight, long, first)
    return [f"{long}/frames", f"--timestamps={long}/timestamps.csv", f"--labels={long}/labels.csv"]


def encode_frames(flight: Path, long: Path, frames: int) -> list[str]:
    """The frames as a video of 5 frames a second: the options that give it."""
    long.mkdir(parents=True, exist_ok=True)
    with av.open(str(long / "flight.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=5)
        stream.options = {"preset": "veryfast", "crf": "18", "g": "15"}
        stream.pix_fmt = "yuv420p"
        first = cv2.imread(str(sorted((flight / "frames").iterdir())[0]), cv2.IMREAD_GRAYSCALE)
        stream.height, stream.width = first.shape
        for path in _there_and_back(flight, frames):
            grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            frame = av.VideoFrame.from_ndarray(grey, format="gray").reformat(format="yuv420p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    _write_labels(flight, long, "0")
    return [f"{long}/flight.mp4", f"--labels={long}/labels.csv"]


def _run(source: list[str], flight: Path, out: Path, given: argparse.Namespace) -> None:
    from velfield.bench.measured_run import run_measured
    from velfield.run.layout import remove_tree

    remove_tree(out)
    command = [
        sys.executable,
        "-m",
        "flows.cli",
        "run",
        *source,
        f"--base={flight}/base.png",
        "--gsd-m=0.23",
        "--quiet",
    ]
    workers = [f"--workers={given.workers}"] if given.workers else []
    run = run_measured([*command, f"--preset={given.preset}", *workers, f"--out={out}"], watch=out / "index.html")
    print(f"{given.frames} frames of {given.size}, {given.preset}: {given.frames / run.wall_s:.2f} frames a second")
    print(run.text())
    print(f"first map after {run.appeared_s or run.wall_s:.0f} s")


if __name__ == "__main__":
    main()
