"""Have the kernels compiled: ``python -m velfield.pipeline.compile_kernels``.

Tiny jobs are run and discarded; what numba compiles on the way is cached beside the modules. The first begins at what a
run needs last, so that a first real run beside it, which begins at its frames, meets it half way.
"""

import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

from schemas.flight import FlightConfig
from schemas.job import Inputs, Job
from schemas.scale import CAR_LENGTH_M
from schemas.simulation import SimulationConfig
from velfield.pipeline.analysis.analyse import analyse_run
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.given_tracks.plan import plan_tracks
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.synthetic.write import write_flight

_FLIGHT = SimulationConfig(frames=9, width=480, height=360, seed=3)
_QUICK = {
    "lens.frames": 4,
    "lens.max_edge_points": 5000,
    "registration.max_keypoints": 800,
    "detection.fine_tune_steps": 2,
    "gsd_m": 0.23,
}
_SPEED_M_PER_S, _LENGTH_M, _EVERY_S, _VEHICLES = 10.0, 60.0, 2.0, 8


def compile_kernels() -> None:
    """Run tracks to an analysis, then a simulated flight to its maps: with nothing given, and with base and labels."""
    with tempfile.TemporaryDirectory(prefix="velfield-kernels-") as folder:
        _process_tracks(Path(folder))
        _process_flight(Path(folder))


def _process_tracks(folder: Path) -> None:
    tracks, run = folder / "tracks.csv", folder / "run-of-tracks"
    _crossing_streets().to_csv(tracks, index=False)
    plan = plan_tracks(Job(root=str(run), inputs=Inputs(source=str(tracks)), config=FlightConfig()))
    write_flight_record(plan)
    compute_stages(plan)
    for _ in analyse_run(run):
        pass


def _crossing_streets() -> pd.DataFrame:
    """Vehicles that follow each other on two streets, which cross."""
    vehicle, along_m = np.mgrid[: 2 * _VEHICLES, 0 : _LENGTH_M : _SPEED_M_PER_S / 5].reshape(2, -1)
    east = vehicle % 2 == 0
    x_m, y_m = np.where(east, along_m, _LENGTH_M / 2), np.where(east, _LENGTH_M / 2, along_m)
    time_s = vehicle // 2 * _EVERY_S + along_m / _SPEED_M_PER_S
    return pd.DataFrame({"id": vehicle.astype(int), "time_s": time_s, "x_m": x_m, "y_m": y_m, "length_m": CAR_LENGTH_M})


def _process_flight(folder: Path) -> None:
    write_flight(folder / "flight", _FLIGHT)
    given = Inputs.from_simulated_flight(folder / "flight")
    config = resolve_config(preset="fast", overrides=_QUICK)
    for k, inputs in enumerate((Inputs(source=given.source, timestamps=given.timestamps), given)):
        plan = make_plan(Job(root=str(folder / f"run-{k}"), inputs=inputs, config=config))
        write_flight_record(plan)
        compute_stages(plan)


if __name__ == "__main__":
    compile_kernels()
