"""``velfield bench speed``: what the whole job and each of its stages cost, against the machine's peak and peers."""

import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from flows.options import parse_frame_size

if TYPE_CHECKING:
    from velfield.pipeline.plan import Plan

Part = Literal["stages", "network", "peers", "workers", "job", "clips"]
PARTS: tuple[Part, ...] = ("stages", "network", "peers", "workers", "job", "clips")


def peak_memory_bytes() -> int:
    """The most memory that this process has had."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def stages_by_frame() -> list[str]:
    """Stages that are cut by frames: their cost grows with these; that of others with the traffic, or never."""
    from velfield.pipeline.stage import STAGES, Cut

    return [stage.name for stage in STAGES if stage.cut is Cut.BY_FRAMES]


def speed(
    *,
    frames: int = 16,
    size: str = "2560x1920",
    preset: str = "fast",
    parts: tuple[Part, ...] = PARTS,
    work: Path | None = None,
) -> int:
    """Time the whole job and every stage on simulated frames: processor time, memory, GFLOP/s, and ratios to peers.

    Parameters
    ----------
    frames
        Frames of the simulated flight (seed 77); its first labels train the detector.
    size
        Frame size, WxH in pixels.
    preset
        best, fast or paper.
    parts
        Parts to measure: `stages` on one core; the `network` against the machine's peak; `peers` (stabilo, trackpy,
        boost-histogram and xhistogram, where `make bench` installed them, and convolutions of YOLOv8n's sizes); two
        `workers` against one; the whole `job` by `velfield run --workers 2`, with the memory of driver and workers;
        `clips` of 1080p and 4K with nothing given, as many frames at 30 a second. All but `network` and `clips` follow
        on the stages.
    work
        Folder for flight and runs, kept; a flight that is there is used again. Default: a temporary one.
    """
    from flows.launch import limit_threads, prepare_process

    limit_threads()
    prepare_process(verbose=False)
    width, height = parse_frame_size(size, "480 or more each, as 2560x1920", min_px=480)
    with nullcontext(work) if work is not None else tempfile.TemporaryDirectory(prefix="velfield-speed-") as folder:
        root = Path(str(folder))
        if "clips" in parts:
            _time_clips(root, preset, frames)
        if set(parts) == {"clips"}:
            return 0
        flight = _simulate(root / f"flight-{frames}-{width}x{height}", frames, width, height)
        plan = _plan(flight, root / f"run-{preset}", preset, frames)
        print(f"{frames} frames of {width}x{height}, preset {preset}")
        seconds = _time_stages(plan) if set(parts) - {"network", "job", "clips"} else {}
        if "network" in parts or "peers" in parts:
            _time_network(width, height)
        if "peers" in parts:
            _time_peers(plan, flight, seconds)
        if "workers" in parts:
            _time_workers(plan)
        if "job" in parts:
            _time_job(flight, root / f"job-{preset}", preset, frames)
    return 0


def _simulate(flight: Path, frames: int, width: int, height: int) -> Path:
    from schemas.simulation import SimulationConfig
    from velfield.synthetic.write import write_flight

    if not (flight / "truth").exists():
        write_flight(flight, SimulationConfig(frames=frames, width=width, height=height, seed=77))
    return flight


def _plan(flight: Path, root: Path, preset: str, frames: int) -> "Plan":
    from schemas.job import Inputs, Job
    from velfield.pipeline.configuration import resolve_config
    from velfield.pipeline.plan import make_plan, write_flight_record

    # Units so short that two workers share a few frames evenly, and every eighth frame is searched whole as it is.
    overrides = {"gsd_m": 0.23, "work.unit_frames": max(1, min(32, frames // 2))}
    config = resolve_config(preset=preset, overrides=overrides)
    plan = make_plan(Job(root=str(root), inputs=Inputs.from_simulated_flight(flight), config=config))
    write_flight_record(plan)
    return plan


def _time_stages(plan: "Plan") -> dict[str, float]:
    """Processor time of each stage, s, on this thread, without Prefect."""
    from velfield.pipeline.local import compute_stages
    from velfield.pipeline.stage import STAGE

    seconds, by_frame, frames = {}, stages_by_frame(), plan.frame_count
    print("each stage on one core:")
    for name in STAGE:
        start, used = time.perf_counter(), time.process_time()
        compute_stages(plan, [name])
        wall, used = time.perf_counter() - start, time.process_time() - used
        seconds[name] = used
        each = f"{1000 * used / frames:8.0f} ms a frame" if name in by_frame else ""
        print(f"{name:13} {wall:7.1f} s, {used:7.1f} s of processor {each}")
    print(f"frames a second and core, set-up apart: {frames / sum(seconds[name] for name in by_frame):.2f}")
    print(f"whole job, one core: {frames / sum(seconds.values()):.2f} frames a second")
    print(f"peak memory: {peak_memory_bytes() / 2**30:.1f} GB")
    return seconds


def _time_network(width: int, height: int) -> None:
    from velfield.bench.detection import city, cnn_speed, matmul_gflops, network_gflop
    from velfield.detection.registry import shipped_detector

    image, peak = city(width, height), matmul_gflops()
    network = cnn_speed(image, shipped_detector())
    gflop = network_gflop(width, height)
    rate = gflop / network.seconds
    print(f"network: {gflop:.1f} GFLOP a frame, {rate:.0f} GFLOP/s of a peak of {peak:.0f} (matrix product, float32)")
    print(network.text())


def _time_peers(plan: "Plan", flight: Path, seconds: dict[str, float]) -> None:
    from schemas.simulation import SimulationConfig
    from velfield.bench.peers import time_accumulation, time_stabilo, time_trackpy
    from velfield.errors import InputError

    info = plan.info
    simulation = SimulationConfig(frames=plan.frame_count, width=info.width, height=info.height, seed=77)
    peers: tuple[Callable[[], Iterable[str]], ...] = (
        lambda: [time_stabilo(flight, simulation, seconds["registration"])],
        lambda: [time_trackpy(plan, seconds["tracklets"])],
        lambda: time_accumulation(plan),
    )
    for peer in peers:
        try:
            print("\n".join(peer()))
        except InputError as error:
            print(error)


def _time_workers(plan: "Plan") -> None:
    from velfield.bench.workers import time_workers

    one_s, two_s = (time_workers(plan, stages_by_frame(), workers) for workers in (1, 2))
    print(f"stages by frame on one worker {one_s:.1f} s, on two {two_s:.1f} s: {one_s / two_s:.3g} times")


def _time_clips(root: Path, preset: str, frames: int) -> None:
    from schemas.job import Inputs, Job
    from velfield.bench.clips import CLIPS, decode_s, make_clip
    from velfield.bench.measured_run import run_measured
    from velfield.pipeline.configuration import resolve_config
    from velfield.pipeline.plan import make_plan, write_flight_record
    from velfield.run.layout import remove_tree

    root.mkdir(parents=True, exist_ok=True)
    for name in CLIPS:
        clip = make_clip(name, root, frames)
        out = root / f"run-{clip.stem}"
        remove_tree(out)
        plan = make_plan(Job(root=str(out), inputs=Inputs(source=str(clip)), config=resolve_config(preset=preset)))
        write_flight_record(plan)
        print(f"{name}, {frames} frames, {plan.frame_count} of them used, nothing given")
        _time_stages(plan)
        print(f"libav alone, all frames: {decode_s(clip):.1f} s of processor")
        remove_tree(out)
        command = [sys.executable, "-m", "flows.cli", "run", str(clip), f"--preset={preset}", "--quiet", f"--out={out}"]
        print(f"velfield run: {run_measured(command).text()}", flush=True)


def _time_job(flight: Path, out: Path, preset: str, frames: int) -> None:
    from velfield.bench.measured_run import run_measured
    from velfield.run.layout import remove_tree

    remove_tree(out)
    inputs = [f"--timestamps={flight}/timestamps.csv", f"--base={flight}/base.png", f"--labels={flight}/labels.csv"]
    command = [sys.executable, "-m", "flows.cli", "run", f"{flight}/frames", *inputs, "--gsd-m=0.23"]
    run = run_measured([*command, f"--preset={preset}", "--workers=2", "--quiet", f"--out={out}"])
    print(f"velfield run, two workers: {frames / run.wall_s:.2f} frames a second, {run.text()}")
