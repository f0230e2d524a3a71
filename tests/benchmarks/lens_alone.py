"""Error of the lens calibrated from ten simulated frames, RMS over the image up to a homography: `docs/benchmarks.md`.

python -m tests.benchmarks.lens_alone [--city] [--seconds 2] [--a 0.05 0.1 0.2 0.3] [--seeds 431 432 433 434 435]

A plane under a lens with a shifted centre, or a city with roofs, hills and a rolling shutter of 1.5 px; frames spread
over some seconds: within 2 s they show the same lines, over 40 s the camera moves by some metres.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from schemas.job import Inputs, Job
from schemas.simulation import CameraSimulation, SimulationConfig, TimesSimulation
from tests.scenes import frame_grid, rms_after_homography
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.pipeline.stage import stages_before
from velfield.run.frame_transforms import read_lens
from velfield.synthetic.cases import lens_only
from velfield.synthetic.truth import load_truth
from velfield.synthetic.write import write_flight

FRAMES, SIZE = 10, (960, 1280)


def main() -> None:
    """Simulate, calibrate, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--city", action="store_true")
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--a", type=float, nargs="+", default=[0.05, 0.1, 0.2, 0.3])
    parser.add_argument("--seeds", type=int, nargs="+", default=[431, 432, 433, 434, 435])
    arguments = parser.parse_args()
    for a in arguments.a:
        errors = [
            calibration_error(simulation(a, seed, arguments.city, FRAMES / arguments.seconds))
            for seed in arguments.seeds
        ]
        rms_px = [error for error, _ in errors]
        each = ", ".join(f"{seed} {error:.2f}" for seed, error in zip(arguments.seeds, rms_px, strict=True))
        print(
            f"a = {a:g}: median {np.median(rms_px):.3f}, worst {max(rms_px):.3f} px, {errors[0][1]:.2f} without a lens "
            f"({each})",
            flush=True,
        )


def simulation(a: float, seed: int, city: bool, fps: float) -> SimulationConfig:
    """The flight of a seed, with exact frame times."""
    height, width = SIZE
    if city:
        flight = SimulationConfig(
            seed=seed, frames=FRAMES, width=width, height=height, camera=CameraSimulation(lens_a=a)
        )
    else:
        flight = lens_only(a, seed=seed, frames=FRAMES, width=width, height=height)
    return flight.model_copy(update={"times": TimesSimulation(fps=fps, late_half_share=0, late_whole_share=0)})


def calibration_error(config: SimulationConfig) -> tuple[float, float]:
    """RMS error of the calibrated lens and of the pinhole model, px."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_flight(folder / "flight", config)
        inputs = Inputs(source=str(folder / "flight" / "frames"), timestamps=str(folder / "flight" / "timestamps.csv"))
        flight = resolve_config(overrides={"gsd_m": 0.23, "frames.every": 1})
        plan = make_plan(Job(root=str(folder / "run"), inputs=inputs, config=flight))
        write_flight_record(plan)
        compute_stages(plan, stages_before("base"))
        points = frame_grid(SIZE, 24)
        true = load_truth(folder / "flight").camera.undistort(points)
        return (
            rms_after_homography(read_lens(plan.layout).undistort_points(points), true),
            rms_after_homography(points, true),
        )


if __name__ == "__main__":
    main()
