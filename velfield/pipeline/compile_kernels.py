"""Have the kernels compiled: ``python -m velfield.pipeline.compile_kernels``.

Tiny jobs are run and discarded; what numba compiles on the way is cached beside the modules. What a run needs last
comes first: tracks to an analysis, two crops, two pictures, then flights. With ``--late`` there are no flights: a first
real run beside it begins at its frames, and where both reached one kernel together, both would compile it, and every
one after it.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

from schemas.arrays import ByteArray
from schemas.flight import FlightConfig
from schemas.job import Inputs, Job
from schemas.scale import CAR_LENGTH_M
from schemas.simulation import SimulationConfig
from velfield.detection.crops import CHIP_PX
from velfield.detection.detect import attach_crops, search_frame
from velfield.detection.frame import ComparableFrame
from velfield.detection.registry import shipped_detector
from velfield.pipeline.analysis.analyse import analyse_run
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.given_tracks.plan import plan_tracks
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.synthetic.write import write_flight
from velfield.tracking import appearance, crop_alignment

_FLIGHT = SimulationConfig(frames=9, width=480, height=360, seed=3)
_QUICK = {
    "lens.frames": 4,
    "lens.max_edge_points": 5000,
    "registration.max_keypoints": 800,
    "detection.fine_tune_steps": 2,
    "gsd_m": 0.23,
}
_PICTURE_PX = (256, 256)
_LATE = "--late"
_SPEED_M_PER_S, _LENGTH_M, _EVERY_S, _VEHICLES = 10.0, 60.0, 2.0, 8


def compile_kernels(*, late_alone: bool = False) -> None:
    """Run tracks to an analysis, link and detect, then simulated flights: with nothing given, and with base and labels.

    Parameters
    ----------
    late_alone
        Without the flights: for a run beside, which compiles what they would itself.
    """
    with tempfile.TemporaryDirectory(prefix="velfield-kernels-") as folder:
        _process_tracks(Path(folder))
        _link_crops()
        _search_pictures()
        if not late_alone:
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


def _link_crops() -> None:
    crops, axis_rad, first, second = _noise(2, CHIP_PX, CHIP_PX), np.zeros(2), np.array([0]), np.array([1])
    prepared = appearance.prepare_crops(crops, axis_rad)
    appearance.crop_differences(prepared, prepared, first, second)
    alignable = crop_alignment.prepare_crops(crops, axis_rad)
    crop_alignment.align_prepared(alignable, alignable, first, second)


def _search_pictures() -> None:
    before, after = (ComparableFrame(picture, np.ones(picture.shape, bool)) for picture in _noise(2, *_PICTURE_PX))
    reference = search_frame(shipped_detector(), before)
    attach_crops(before.image, reference.detections)
    search_frame(shipped_detector(), after, reference=reference)


def _noise(*shape: int) -> ByteArray:
    return np.random.default_rng(0).integers(0, 256, shape, np.uint8)


def _process_flight(folder: Path) -> None:
    write_flight(folder / "flight", _FLIGHT)
    given = Inputs.from_simulated_flight(folder / "flight")
    config = resolve_config(preset="fast", overrides=_QUICK)
    for k, inputs in enumerate((Inputs(source=given.source, timestamps=given.timestamps), given)):
        plan = make_plan(Job(root=str(folder / f"run-{k}"), inputs=inputs, config=config))
        write_flight_record(plan)
        compute_stages(plan)


if __name__ == "__main__":
    compile_kernels(late_alone=_LATE in sys.argv)
