"""Writing of a simulated flight as a user's input (frames, times, base image, labels), with the ground truth."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.simulation import SimulationConfig
from velfield.errors import InputError
from velfield.parallel import map_ahead
from velfield.synthetic.clip import open_clip, simulate_telemetry
from velfield.synthetic.flight import Flight
from velfield.synthetic.observed import observed_detections
from velfield.synthetic.truth import make_truth, save_truth

_RENDERED_AHEAD = 4
WRITERS = 2
"""Threads that render and write; numba, OpenCV and NumPy release the interpreter lock."""


def write_flight(out: Path, config: SimulationConfig, progress: Callable[[int, int], None] | None = None) -> Flight:
    """Write ``frames/`` or a clip, ``timestamps.csv``, ``base.png``, ``labels.csv`` and ``truth/`` into a folder.

    It is created if needed; ``progress`` is called with (frames done, number of frames).

    Raises
    ------
    InputError
        ``out`` holds a flight of another configuration, or other files.
    """
    _claim(out, config)
    flight = Flight(config)
    flight.prepare()
    _write_image(out / "base.png", flight.base_image, [])
    names = [frame_name(k, config) for k in range(config.frames)]
    pd.DataFrame({"frame": names, "time_s": np.round(flight.times_s, 6)}).to_csv(out / "timestamps.csv", index=False)
    labels = [flight.labels(k).assign(frame=names[k]) for k in labelled_frames(config)]
    columns = ["frame", "x_px", "y_px", "orientation_rad", "length_px", "width_px"]
    if labels:
        pd.concat(labels)[columns].round(3).to_csv(out / "labels.csv", index=False)
    save_truth(make_truth(flight), out / "truth")
    write = _write_frames if config.clip == "none" else _write_clip
    with ThreadPoolExecutor(WRITERS) as pool:
        try:
            for done, _ in enumerate(write(out, flight, names, pool), start=1):
                if progress is not None:
                    progress(done, config.frames)
        except BaseException:  # Ctrl-C above all: cancel the frames that have not begun
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return flight


def write_tracks(path: Path, config: SimulationConfig) -> int:
    """Write what a tracker sees of all vehicles as CSV, without rendering a frame; returns the number of vehicles.

    Columns ``id, frame, time_s, x_m, y_m, length_m, width_m``, y down, with `velfield.synthetic.observed.Errors`.
    """
    flight = Flight(config)
    traffic, rng = flight.city.traffic, np.random.default_rng(config.seed)
    seen = observed_detections(traffic, flight.times_s, flight.city.to_px, shape=flight.base_shape, rng=rng)
    vehicle = seen["vehicle_id"].to_numpy(np.int64)
    xy_m = seen[["x_px", "y_px"]].to_numpy(np.float64) * config.gsd_m
    table = pd.DataFrame({"id": vehicle, "frame": seen["frame"], "time_s": seen["time_s"]})
    size = traffic.dimensions
    table = table.assign(x_m=xy_m[:, 0], y_m=xy_m[:, 1], length_m=size.length_m[vehicle], width_m=size.width_m[vehicle])
    path.parent.mkdir(parents=True, exist_ok=True)
    table.sort_values(["id", "frame"]).round(3).to_csv(path, index=False)
    return len(np.unique(vehicle))


def _write_frames(out: Path, flight: Flight, names: list[str], pool: ThreadPoolExecutor) -> Iterator[None]:
    config = flight.config
    options = (
        [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality]
        if config.picture_format == "jpg"
        else [cv2.IMWRITE_PNG_COMPRESSION, 1]
    )
    yield from pool.map(
        lambda k: _write_image(out / "frames" / names[k], flight.frame(k), options), range(config.frames)
    )


def _write_clip(out: Path, flight: Flight, _names: list[str], pool: ThreadPoolExecutor) -> Iterator[None]:
    config = flight.config
    subtitles = simulate_telemetry(config, flight.camera, flight.base_shape)
    with open_clip(out, config, flight.times_s, subtitles) as clip:
        frames = range(config.frames)
        for frame, grey in zip(frames, map_ahead(pool, flight.frame, frames, ahead=_RENDERED_AHEAD), strict=True):
            clip.write(frame, grey)
            yield


def frame_name(index: int, config: SimulationConfig) -> str:
    """File name of a frame; sorts naturally and alphabetically. Of a clip, its index."""
    if config.clip != "none":
        return str(index)
    return f"{index:05d}.{config.picture_format}"


def labelled_frames(config: SimulationConfig) -> list[int]:
    """The frames that labels.csv labels: the first, and others at equal distances."""
    n = min(config.labelled_frames, config.frames)
    return sorted({k * config.frames // n for k in range(n)}) if n else []


def _claim(out: Path, config: SimulationConfig) -> None:
    record = out / "simulation.json"
    if out.exists() and any(out.iterdir()):
        if not record.is_file():
            raise InputError(f"{out} contains other files; give an empty or new folder for the simulated flight")
        if SimulationConfig.model_validate_json(record.read_text(encoding="utf-8")) != config:
            raise InputError(f"{out} contains a flight of another configuration (simulation.json); give a new folder")
    (out if config.clip != "none" else out / "frames").mkdir(parents=True, exist_ok=True)
    record.write_text(config.model_dump_json(indent=1), encoding="utf-8")


def _write_image(path: Path, image: NDArray[np.uint8], options: list[int]) -> None:
    done, data = cv2.imencode(path.suffix, image, options)
    if not done:
        raise InputError(f"{path.suffix} cannot be encoded here; choose png or jpg")
    # not cv2.imwrite, which on a full disk returns False and raises nothing
    path.write_bytes(data.tobytes())
