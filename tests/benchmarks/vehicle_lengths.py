"""The scale by the lengths of vehicles, with its interval, over many simulated flights.

python -m tests.benchmarks.vehicle_lengths [FIRST_SEED] [SEEDS] [--size 800x600] [--frames 12]

The network that ships measures each visible vehicle at its true place in each frame, with a detector's error in
position; its track has the mean, as in a run. What the detector misses is left out, as are what it takes for vehicles
and the ratio by which the lengths of moving vehicles are too great (`tests.benchmarks.drone_clip` has them). Each seed
has other cars, of a median length drawn about 4.45 m as those of places and decades differ. For each a --gsd-m that is
right, and one that is wrong by 1.2 either way: then vehicles are measured at that wrong scale.
"""

import argparse

import numpy as np

from schemas.arrays import FloatArray
from schemas.detector import CnnConfig
from schemas.scale import CAR_LENGTH_M, ScaleEstimate
from schemas.simulation import SimulationConfig
from velfield.analysis.vehicle_scale import POPULATION_SD, TRACK_LENGTH_SD, estimate_vehicle_scale
from velfield.detection.cnn.model import measure_vehicles
from velfield.detection.registry import shipped_detector
from velfield.detection.scale_search import working_scale
from velfield.pipeline.stages.labels import rescale
from velfield.sources.scale import choose_scale
from velfield.synthetic.flight import Flight
from velfield.tracking.dimensions import mean_dimensions

_POSITION_SD_PX = 0.7
"""Of a detector, working px."""
_MIN_FRAMES = 3
_MARGIN_PX = 12.0
WRONG = (1.2, 1 / 1.2)


def lengths_of(flight: Flight, gsd_m: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Measured lengths of the vehicles of a flight and their standard deviations, base px, the working grid's scale
    being that of ``gsd_m``."""
    scale, detector = working_scale(CnnConfig(), gsd_m), shipped_detector()
    sizes, vehicles = [], []
    for frame in range(flight.config.frames):
        cars = flight.cars(frame)
        cars = cars[cars["visible"]]
        raw = cars[["x_raw_px", "y_raw_px"]].to_numpy(np.float64)
        limit = np.array([flight.config.width, flight.config.height]) - _MARGIN_PX
        inside = ((raw > _MARGIN_PX) & (raw < limit)).all(axis=1)
        image = rescale(flight.frame(frame), scale)
        xy = (raw + 0.5) * scale - 0.5 + rng.normal(0, _POSITION_SD_PX, raw.shape)
        sizes.append(measure_vehicles(detector.predictor, image, xy[inside]))
        vehicles.append(cars["vehicle_id"].to_numpy(np.int64)[inside])
    ids, vehicle = np.unique(np.concatenate(vehicles), return_inverse=True)
    length, _, log_sd, _, count = mean_dimensions(np.concatenate(sizes), vehicle, len(ids)).T
    seen = count >= _MIN_FRAMES
    return length[seen] / scale, (length * log_sd)[seen] / scale


def estimate(seed: int, size: tuple[int, int], frames: int) -> tuple[float, int, dict[float, ScaleEstimate]]:
    """The true ground sample distance, the number of vehicles, and the estimates by the factor that ``--gsd-m`` is
    wrong by."""
    rng = np.random.default_rng(seed)
    usual_m = CAR_LENGTH_M * float(np.exp(rng.normal(0, POPULATION_SD)))
    config = SimulationConfig.model_validate(
        {"seed": seed, "frames": frames, "width": size[0], "height": size[1], "traffic": {"car_length_m": usual_m}}
    ).as_clip("beside")
    config = config.model_copy(update={"times": config.times.model_copy(update={"fps": 5.0})})
    flight = Flight(config)
    flight.prepare()
    found, vehicles = {}, 0
    for factor in (1.0, *WRONG):
        length, sd = lengths_of(flight, factor * config.gsd_m, rng)
        vehicles, scale = len(length), estimate_vehicle_scale(length, sd, measurement_sd=TRACK_LENGTH_SD)
        if scale is not None:
            found[factor] = scale
    return config.gsd_m, vehicles, found


def main() -> None:
    """Print each seed's error, and over all seeds error, coverage, and how often a wrong --gsd-m is told."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", nargs="?", type=int, default=1001)
    parser.add_argument("seeds", nargs="?", type=int, default=40)
    parser.add_argument("--size", default="800x600")
    parser.add_argument("--frames", type=int, default=12)
    given = parser.parse_args()
    width, height = map(int, given.size.split("x"))
    errors, held, reported = [], [], {factor: list[bool]() for factor in (1.0, *WRONG)}
    for seed in range(given.first, given.first + given.seeds):
        true_m, vehicles, found = estimate(seed, (width, height), given.frames)
        if 1.0 not in found:
            print(f"seed {seed}: {vehicles} vehicles, too few", flush=True)
            continue
        errors.append(found[1.0].gsd_m / true_m - 1)
        held.append(found[1.0].low_m <= true_m <= found[1.0].high_m)
        for factor, one in found.items():
            wrong_m = factor * true_m
            typed = ScaleEstimate(gsd_m=wrong_m, low_m=wrong_m, high_m=wrong_m, source="given")
            reported[factor].append(bool(choose_scale([typed, one]).disagreements))
        off = " ".join(f"{factor:.2f}: {one.gsd_m / true_m - 1:+.2%}" for factor, one in found.items())
        print(f"seed {seed}: {vehicles} vehicles, {off}, interval {'holds' if held[-1] else 'misses'}", flush=True)
    size = np.abs(errors)
    print(
        f"{len(errors)} flights: RMS {np.sqrt(np.mean(size**2)):.2%}, at most {size.max():.2%}, mean error "
        f"{np.mean(errors):+.2%}; within 5 %: {np.mean(size < 0.05):.0%}; interval holds it in {np.mean(held):.0%}"
    )
    for factor, told in reported.items():
        print(f"--gsd-m times {factor:.2f}: contradicted in {np.mean(told):.0%} of {len(told)}")


if __name__ == "__main__":
    main()
