"""``velfield bench speed``: what each stage of the whole job costs, on one core, and against the machine's peak."""

import resource
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path

from flows.options import parse_frame_size


def stages_by_frame() -> list[str]:
    """Stages that are cut by frames: their cost grows with these; that of others with the traffic, or never."""
    from velfield.pipeline.stage import STAGES, Cut

    return [stage.name for stage in STAGES if stage.cut is Cut.BY_FRAMES]


def speed(*, frames: int = 12, size: str = "2560x1920", preset: str = "fast", work: Path | None = None) -> int:
    """Time every stage on one core, without Prefect, beside other libraries: processor time, memory, GFLOP/s.

    Parameters
    ----------
    frames
        Of the simulated flight (seed 77); its first labels train the detector.
    size
        Frame size, WxH in pixels.
    preset
        best, fast or paper: the paper's chain, read literally.
    work
        Folder for flight and run, kept; a flight that is there is used again. Default: a temporary one.
    """
    from flows.launch import limit_threads, prepare_process

    limit_threads()
    prepare_process(verbose=False)
    from schemas.job import Inputs, Job
    from schemas.simulation import SimulationConfig
    from velfield.bench.detection import city, cnn_speed, matmul_gflops, network_gflop
    from velfield.bench.peers import time_stabilo, time_trackpy
    from velfield.detection.detector import shipped_detector
    from velfield.errors import InputError
    from velfield.pipeline.configuration import resolve_config
    from velfield.pipeline.local import compute_stages
    from velfield.pipeline.plan import make_plan, write_flight_record
    from velfield.pipeline.stage import STAGE
    from velfield.synthetic import write_flight

    width, height = parse_frame_size(size, "480 or more each, as 2560x1920", min_px=480)
    with nullcontext(work) if work is not None else tempfile.TemporaryDirectory(prefix="velfield-speed-") as folder:
        root = Path(str(folder))
        flight = root / f"flight-{frames}-{width}x{height}"
        simulation = SimulationConfig(frames=frames, width=width, height=height, seed=77)
        if not (flight / "truth").exists():
            write_flight(flight, simulation)
        inputs = Inputs.from_simulated_flight(flight)
        config = resolve_config(preset=preset, overrides={"gsd_m": 0.23})
        plan = make_plan(Job(root=str(root / f"run-{preset}"), inputs=inputs, config=config))
        write_flight_record(plan)
        seconds, by_frame = {}, stages_by_frame()
        print(f"{frames} frames of {width}x{height}, preset {preset}, one core")
        for name in STAGE:
            start, used = time.perf_counter(), time.process_time()
            compute_stages(plan, [name])
            wall, used = time.perf_counter() - start, time.process_time() - used
            seconds[name] = used
            each = f"{1000 * used / frames:8.0f} ms a frame" if name in by_frame else ""
            print(f"{name:13} {wall:7.1f} s, {used:7.1f} s of processor {each}")
        print(f"frames a second and core, set-up apart: {frames / sum(seconds[name] for name in by_frame):.2f}")
        print(f"whole job, one core: {frames / sum(seconds.values()):.2f} frames a second")
        print(f"peak memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GB")
        for peer in (
            lambda: time_stabilo(flight, simulation, seconds["registration"]),
            lambda: time_trackpy(plan, seconds["tracklets"]),
        ):
            try:
                print(peer())
            except InputError as error:
                print(error)
    image, peak = city(width, height), matmul_gflops()
    network = cnn_speed(image, shipped_detector())
    gflop = network_gflop(width, height)
    rate = gflop / network.seconds
    print(f"network: {gflop:.1f} GFLOP a frame, {rate:.0f} GFLOP/s of a peak of {peak:.0f} (matrix product, float32)")
    print(network.text())
    return 0
