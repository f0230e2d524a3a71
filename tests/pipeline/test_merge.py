"""`velfield merge` of two drones side by side: one city, one base image, one map; what both saw is told."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from schemas.simulation import SimulationConfig
from tests.small_flight import job, process
from velfield.analysis.shared_vehicles import find_shared_vehicles
from velfield.errors import InputError
from velfield.exports.export import export_run
from velfield.pipeline.merge import merge_runs
from velfield.run.run import open_run
from velfield.synthetic.camera import make_camera
from velfield.synthetic.flight import Flight
from velfield.synthetic.random_streams import RandomStream, random_generator

GSD_M, FRAMES = 0.23, 12
CAMERA = {"lens_a": 0.0, "drift_m": 2.0, "turn_deg": 1.0, "tilt_deg": 0.5}


def drone(city: Flight, shift_px: float, seed: int, start_s: float) -> Flight:
    """A camera of its own over another flight's city, beside the middle of it, from another time on."""
    config = SimulationConfig(seed=seed, frames=FRAMES, width=400, height=320, gsd_m=GSD_M, camera=CAMERA)
    found = Flight(config)
    camera = make_camera(
        config, found.times_s + start_s, city.camera.relief, random_generator(seed, RandomStream.CAMERA)
    )
    above = np.array([city.camera.position_px[0] + shift_px, city.camera.position_px[1], camera.position_px[2]])
    found.camera, found.times_s = replace(camera, position_px=above), found.times_s + start_s
    found.city, found.base_shape = city.city, city.base_shape
    return found


def write_drone(folder: Path, flight: Flight, clock_s: float) -> None:
    """Frames with the camera's clock in their EXIF, times from the first frame, the boxes of all visible cars."""
    (folder / "frames").mkdir(parents=True)
    names, boxes = [f"{k:05d}.jpg" for k in range(FRAMES)], []
    for k, name in enumerate(names):
        at = pd.Timestamp(clock_s + flight.times_s[k], unit="s")
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x9003: f"{at:%Y:%m:%d %H:%M:%S}", 0x9291: f"{at.microsecond // 1000:03d}"})
        Image.fromarray(flight.frame(k)).save(folder / "frames" / name, exif=exif, quality=95)
        boxes.append(flight.labels(k).assign(frame=name))
    times = pd.DataFrame({"frame": names, "time_s": np.round(flight.times_s - flight.times_s[0], 6)})
    times.to_csv(folder / "timestamps.csv", index=False)
    pd.concat(boxes).round(3).to_csv(folder / "detections.csv", index=False)


@pytest.fixture(scope="module")
def two(server: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Flight], list[Path]]:
    """Two drones that see the same third of the map, the second from 0.6 s later on and its clock 1 s ahead."""
    root = tmp_path_factory.mktemp("two")
    city = Flight(SimulationConfig(seed=21, frames=FRAMES + 6, width=640, height=320, gsd_m=GSD_M, camera=CAMERA))
    flights = [drone(city, -120.0, 31, 0.0), drone(city, 120.0, 32, 0.6)]
    cv2.imwrite(str(root / "base.png"), city.base_image)
    folders = []
    for name, flight, clock_s in zip("ab", flights, (1.7e9, 1.7e9 + 1.0), strict=True):
        write_drone(root / name, flight, clock_s)
        work = job(
            root / name,
            root / f"run-{name}",
            base=str(root / "base.png"),
            detections=str(root / name / "detections.csv"),
            labels=None,
        )
        process(work)
        folders.append(root / f"run-{name}")
    return flights, folders


def seen(flight: Flight) -> pd.DataFrame:
    """The true vehicles of all frames, where visible."""
    cars = pd.concat([flight.cars(k) for k in range(FRAMES)])
    return cars[cars["visible"]]


@pytest.mark.slow
def test_two_drones_side_by_side_make_one_map(two: tuple[list[Flight], list[Path]], tmp_path: Path) -> None:
    flights, folders = two
    lines = merge_runs(folders, tmp_path / "merged")
    merged, parts = open_run(tmp_path / "merged"), [open_run(folder) for folder in folders]
    counts = [run.field.count() for run in parts]
    assert merged.field.count().tolist() == (counts[0] + counts[1]).tolist()
    assert min(int(((a > 0) & (b == 0)).sum()) for a, b in (counts, counts[::-1])) > 1000  # each has ground of its own
    y, x = np.unravel_index(int(np.minimum(*counts).argmax()), counts[0].shape)
    pixels = [run.field.at(int(x), int(y)) for run in (merged, *parts)]
    mixed = sum(part.weights * part.n for part in pixels[1:]) / pixels[0].n
    np.testing.assert_allclose(mixed, pixels[0].weights, atol=1e-12)

    truth = [seen(flight) for flight in flights]
    velocity, errors = merged.field.modal_velocity(), []
    for car in pd.concat(truth).query("moving").itertuples():
        found = velocity[round(car.y_base_px), round(car.x_base_px)]
        errors.append(np.hypot(found[0] - car.vx_px_per_s, found[1] - car.vy_px_per_s) * GSD_M)
    assert np.mean(np.isfinite(errors)) > 0.85  # the first and the last frame, the border
    assert np.nanmedian(errors) < 1.0

    assert len(lines) == 1
    found = re.match(r"(\d+) vehicles seen by .*, counted twice, of (\d+) and (\d+) tracks; (.*)", lines[0])
    assert found is not None, lines[0]
    assert int(found[1]) == pytest.approx(len(truly_shared(*truth)), abs=2)
    apart = re.fullmatch(r"their clocks differ by (.*) s", found[4])
    assert apart is not None, lines[0]
    assert float(apart[1]) == pytest.approx(1.0, abs=0.21)


def truly_shared(first: pd.DataFrame, second: pd.DataFrame) -> set[int]:
    """Vehicles that both saw during one and the same time of 0.6 s or more."""
    spans = [cars.groupby("vehicle_id")["time_s"].agg(["min", "max"]) for cars in (first, second)]
    both = spans[0].add_suffix("_a").join(spans[1].add_suffix("_b"), how="inner")
    common = np.minimum(both["max_a"], both["max_b"]) - np.maximum(both["min_a"], both["min_b"])
    return set(both.index[common >= 0.6])


@pytest.mark.slow
def test_a_merged_field_has_no_tracks_to_export(two: tuple[list[Flight], list[Path]], tmp_path: Path) -> None:
    """Not an empty file: one line, and the runs to ask."""
    merge_runs(two[1], tmp_path / "merged")
    merged = open_run(tmp_path / "merged")
    assert repr(merged) == f"Run({str(tmp_path / 'merged')!r}, field of {two[1][0]}, {two[1][1]})"
    for name in ("geoparquet", "geotrax", "sumo", "highd", "trajectories", "report", "video"):
        with pytest.raises(InputError, match=r"run-a and .*run-b and has no frames or tracks"):
            export_run(merged, name, tmp_path / f"{name}.out")
    assert export_run(merged, "cog", tmp_path / "cog.tif").stat().st_size > 1000
    assert merge_runs([tmp_path / "merged", two[1][0]], tmp_path / "again")[0].startswith(
        f"{tmp_path / 'merged'} is itself a merged field"
    )


def positions(tracks: dict[int, tuple[np.ndarray, np.ndarray]]) -> pd.DataFrame:
    """Track positions of (times, points) by id."""
    rows = [
        {"track_id": number, "time_s": time_s, "x_px": x, "y_px": y}
        for number, (times_s, points) in tracks.items()
        for time_s, (x, y) in zip(times_s, points, strict=True)
    ]
    return pd.DataFrame(rows, columns=["track_id", "time_s", "x_px", "y_px"])


def lane(start_s: float, y_px: float, *, speed: float = 60.0, seconds: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    times_s = start_s + np.arange(0.0, seconds, 0.2)
    return times_s, np.column_stack([speed * (times_s - start_s), np.full(len(times_s), y_px)])


def test_a_vehicle_on_the_next_lane_or_behind_is_another() -> None:
    first = positions({1: lane(0.0, 100.0), 2: lane(2.0, 100.0), 3: lane(0.5, 114.0)})
    beside = positions({7: lane(0.0, 128.0), 8: lane(30.0, 100.0)})
    assert find_shared_vehicles(first, beside, gsd_m=GSD_M).count == 0
    assert find_shared_vehicles(first, positions({}), gsd_m=GSD_M).count == 0


def test_a_track_in_two_parts_is_one_vehicle() -> None:
    times_s, points = lane(0.0, 100.0)
    halves = positions({7: (times_s[:9], points[:9]), 8: (times_s[11:], points[11:])})
    found = find_shared_vehicles(positions({1: (times_s, points)}), halves, gsd_m=GSD_M)
    assert found.count == 1
    assert found.tracks.tolist() == [[1, 7], [1, 8]]
    assert found.offset_s == 0.0
