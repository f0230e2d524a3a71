"""Whole runs of a simulated drone's clip without any option: scale, north and place, with its subtitles and without.

python -m tests.benchmarks.drone_clip [FIRST_SEED] [SEEDS] [--size 800x600] [--car-length-sd 0.03] [--once]

Each seed is another city, another flight, other errors of the drone's sensors, and, with --car-length-sd, other cars:
the median length of the place is drawn about 4.45 m. First the run knows no metadata, and the scale is that by the
lengths of the vehicles; then the subtitles lie beside the clip.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.georeference import GeoreferenceRecord
from schemas.scale import CAR_LENGTH_M, ScaleEstimate
from schemas.simulation import SimulationConfig, TrafficSimulation
from velfield import open_run
from velfield.pipeline.georeference import plan_of_finished
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import Plan
from velfield.run.frame_transforms import read_georeference
from velfield.run.run import Run
from velfield.synthetic.clip import CLIP_NAME, SUBTITLE_NAME
from velfield.synthetic.score import apply_homography, fit_homography
from velfield.synthetic.truth import Truth, load_truth
from velfield.synthetic.write import write_flight


@dataclass(frozen=True)
class TrueGrid:
    """The true scale and north of a run's base pixels, at the middle of the base image.

    ``to_truth`` (3, 3): base pixels -> those of the simulation; ``gsd_m`` of the base image; ``north_rad``: direction
    of true north, from +x towards +y.
    """

    to_truth: np.ndarray
    gsd_m: float
    north_rad: float

    @classmethod
    def of(cls, run: Run, truth: Truth, north_deg: float) -> "TrueGrid":
        """By the true position of raw pixels, of which the run has its own."""
        source = run.frames.column("source_index")
        frames = {int(source[k]): k for k, status in enumerate(run.registration_status) if status == "ok"}
        to_truth = fit_homography(truth, lambda frame, xy: run.to_base(frames[frame], xy), sorted(frames))
        middle = np.array([run.grid.width_px / 2, run.grid.height_px / 2])
        a, b, c = apply_homography(to_truth, middle + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        jacobian = np.column_stack([b - a, c - a])
        up = np.radians(-90 - north_deg)
        north = np.linalg.solve(jacobian, [np.cos(up), np.sin(up)])
        return cls(
            to_truth, truth.gsd_m * float(np.sqrt(abs(np.linalg.det(jacobian)))), float(np.arctan2(north[1], north[0]))
        )


def scale_by(record: GeoreferenceRecord, source: str) -> ScaleEstimate | None:
    """The estimate by one source, None if there is none."""
    every = [record.scale.used, *record.scale.others]
    return next((one for one in every if one is not None and one.source == source), None)


def run_clip(clip: Path, out: Path, *options: str) -> tuple[Run, GeoreferenceRecord]:
    """`velfield run` on a clip, and what it found."""
    command = [sys.executable, "-m", "flows.cli", "run", str(clip), "--out", str(out), "--quiet", *options]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    run = open_run(out)
    record = read_georeference(run.layout)
    return run, record


def position_error_m(run: Run, true: TrueGrid, config: SimulationConfig, truth: Truth) -> float:
    """Distance of where the run puts the middle of the base image from where it is; NaN where it does not know."""
    from velfield.exports.georeference import Georeference

    georeference = Georeference.from_grid(run.grid)
    if not georeference.has_crs:
        return float("nan")
    middle = np.array([[run.grid.width_px / 2, run.grid.height_px / 2]])
    x, y = (apply_homography(true.to_truth, middle)[0] - np.array(truth.base_shape[::-1]) / 2) * truth.gsd_m
    t = config.telemetry
    up = np.radians(t.north_deg)
    east, north = x * np.cos(up) - y * np.sin(up), -x * np.sin(up) - y * np.cos(up)
    phi = np.radians(t.latitude_deg)
    metres_north = 111_132.95 - 559.85 * np.cos(2 * phi) + 1.175 * np.cos(4 * phi)
    metres_east = 111_412.88 * np.cos(phi) - 93.5 * np.cos(3 * phi) + 0.118 * np.cos(5 * phi)
    longitude, latitude = georeference.to_lonlat(middle)[0]
    return float(
        np.hypot((longitude - t.longitude_deg) * metres_east - east, (latitude - t.latitude_deg) * metres_north - north)
    )


def add_subtitles(run: Run, subtitles: Path) -> tuple[Run, GeoreferenceRecord]:
    """The same run as `velfield run` leaves it when subtitles lie beside the clip, but for the speeds in its field."""
    before = plan_of_finished(run)
    job = before.job.model_copy(update={"inputs": before.job.inputs.model_copy(update={"telemetry": str(subtitles)})})
    plan = Plan(job, before.info, before.indices, before.inputs, before.keys)
    compute_stages(plan, ("georeference", "scale"))
    again = open_run(run.layout.root)
    record = read_georeference(again.layout)
    return again, record


def measure(
    seed: int, size: tuple[int, int], frames: int, car_length_sd: float, folder: Path, *, once: bool
) -> dict[str, float]:
    """The errors of one seed: of scale as fractions, of north in degrees, of place in metres."""
    rng = np.random.default_rng(seed)
    usual_m = CAR_LENGTH_M * float(np.exp(rng.normal(0, car_length_sd))) if car_length_sd else None
    traffic = TrafficSimulation() if usual_m is None else TrafficSimulation(car_length_m=usual_m)
    config = SimulationConfig.model_validate(
        {"seed": seed, "frames": frames, "width": size[0], "height": size[1], "traffic": traffic}
        | {"telemetry": {"north_deg": rng.uniform(-180, 180)}}
    ).as_clip("beside")
    write_flight(folder / "flight", config)
    truth, alone = load_truth(folder / "flight"), folder / "alone"
    alone.mkdir()
    shutil.copy(folder / "flight" / CLIP_NAME, alone)
    run, record = run_clip(alone / CLIP_NAME, folder / "run")
    true = TrueGrid.of(run, truth, config.telemetry.north_deg)
    found = {"seed": seed, "vehicles": float("nan"), "held": float("nan")}
    by_vehicles = scale_by(record, "vehicles")
    if by_vehicles is not None:
        held = by_vehicles.low_m <= true.gsd_m <= by_vehicles.high_m
        found |= {"vehicles": by_vehicles.gsd_m / true.gsd_m - 1, "held": float(held)}
    shutil.copy(folder / "flight" / SUBTITLE_NAME, alone)
    if once:
        run, record = add_subtitles(run, alone / SUBTITLE_NAME)
    else:
        run, record = run_clip(alone / CLIP_NAME, folder / "run")
    metadata = scale_by(record, "metadata")
    assert metadata is not None, record.telemetry
    north_rad = record.north_rad  # true north; that of the grid's reference system is up to 3 degrees off it
    return found | {
        "metadata": metadata.gsd_m / true.gsd_m - 1,
        "metadata_held": float(metadata.low_m <= true.gsd_m <= metadata.high_m),
        "disagree": float(len(record.scale.disagreements)),
        "north_deg": float(np.degrees(np.angle(np.exp(1j * (north_rad - true.north_rad))))),
        "place_m": position_error_m(run, true, config, truth),
    }


def main() -> None:
    """Print the errors seed by seed, and over all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", nargs="?", type=int, default=921)
    parser.add_argument("seeds", nargs="?", type=int, default=10)
    parser.add_argument("--size", default="800x600")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--car-length-sd", type=float, default=0.0)
    parser.add_argument("--once", action="store_true", help="with subtitles, no second run: only what they give")
    given = parser.parse_args()
    width, height = map(int, given.size.split("x"))
    rows = []
    for seed in range(given.first, given.first + given.seeds):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(
                measure(seed, (width, height), given.frames, given.car_length_sd, Path(folder), once=given.once)
            )
        print("  ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()), flush=True)
    for name in ("vehicles", "metadata", "north_deg", "place_m"):
        values = np.array([row[name] for row in rows])
        print(f"{name}: RMS {np.sqrt(np.nanmean(values**2)):.3g}, at most {np.nanmax(np.abs(values)):.3g}")
    for name in ("held", "metadata_held"):
        print(f"{name}: {np.nanmean([row[name] for row in rows]):.0%}")


if __name__ == "__main__":
    main()
