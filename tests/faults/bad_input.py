"""Bad input by the thousand: what a reader cannot use is refused in one line, within seconds, and nothing is written.

python -m tests.faults.bad_input [--cases 10000] [--seed 0]

Each case is a good file of one kind (below), mutated: bytes flipped, cut, repeated, swapped for another's, numbers and
words replaced by extreme ones. A reader may accept it, or raise `InputError` (`StoreError` for files of a run) with a
message of one line. Anything else counts as a failure: another exception, more than ten seconds, a new file.
"""

import argparse
import io
import json
import os
import re
import signal
import tempfile
import time
import warnings
from base64 import b64encode
from collections import Counter
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pandas as pd
import yaml
from PIL import Image

from schemas.flight import FlightConfig, FramesConfig
from tests.media import drifting, write_images, write_times, write_video
from tests.misb import encode_set, with_checksum
from tests.track_files import parquet_bytes
from velfield.errors import InputError, StoreError

LIMIT_S, WAIT_S = 10, 60
WIDTH, HEIGHT, FRAMES = 96, 64, 6
FPS = FramesConfig(fps=5, max_pixels=1_000_000)
_EXTREMES = (
    *("nan", "inf", "-inf", "1e309", "-1", "0", "1e-320", "99999999999999999999", "true", "null", "", " ", "\0", "'"),
    *("../../etc/passwd", "http://host/a", "é", "\U0001f697", "[" * 2000, "{" * 2000, "%s%n", "=1+1", "\ufeff", "0x10"),
)


class TooLong(Exception):
    """A case took more than its time."""


@dataclass(frozen=True, repr=False)
class Kind:
    """A kind of input: good files to start from, and what reads a file."""

    name: str
    good: tuple[bytes, ...]
    file: str
    read: Callable[[Path], object]
    weight: int = 1

    def __repr__(self) -> str:
        """Name alone: the files are megabytes."""
        return f"Kind({self.name!r})"

    def _repr_pretty_(self, printer: Any, _cycle: bool) -> None:
        """What hypothesis prints with the case that failed, in place of the fields."""
        printer.text(repr(self))


def mutate(data: bytes, others: tuple[bytes, ...], rng: np.random.Generator) -> bytes:
    """A file with one to four mutations."""
    for _ in range(int(rng.integers(1, 5))):
        data = _MUTATIONS[int(rng.integers(len(_MUTATIONS)))](data, others, rng)
    return data[:2_000_000]


def _flip(data: bytes, _others: tuple[bytes, ...], rng: np.random.Generator) -> bytes:
    if not data:
        return bytes(rng.integers(0, 256, 20, dtype=np.uint8))
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _cut(data: bytes, _others: tuple[bytes, ...], rng: np.random.Generator) -> bytes:
    start, stop = np.sort(rng.integers(0, len(data) + 1, 2))
    return data[:stop] if rng.random() < 0.5 else data[:start] + data[stop:]


def _repeat(data: bytes, _others: tuple[bytes, ...], rng: np.random.Generator) -> bytes:
    start, stop = np.sort(rng.integers(0, len(data) + 1, 2))
    return data[:stop] + data[start:stop] * int(rng.integers(1, 4)) + data[stop:]


def _splice(data: bytes, others: tuple[bytes, ...], rng: np.random.Generator) -> bytes:
    other = others[int(rng.integers(len(others)))]
    return data[: int(rng.integers(len(data) + 1))] + other[int(rng.integers(len(other) + 1)) :]


def _word(data: bytes, _others: tuple[bytes, ...], rng: np.random.Generator) -> bytes:
    words = list(re.finditer(rb"[-+.\w]+", data[:20_000]))
    if not words:
        return data
    word = words[int(rng.integers(len(words)))]
    extreme = _EXTREMES[int(rng.integers(len(_EXTREMES)))].encode()
    return data[: word.start()] + extreme + data[word.end() :]


def _number(data: bytes, _others: tuple[bytes, ...], rng: np.random.Generator) -> bytes:
    """Four bytes as an extreme number: sizes and offsets of binary formats."""
    if len(data) < 8:
        return data
    at, value = int(rng.integers(len(data) - 4)), int(rng.choice([0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xFFFF]))
    return data[:at] + value.to_bytes(4, "little" if rng.random() < 0.5 else "big") + data[at + 4 :]


_MUTATIONS = (_flip, _cut, _repeat, _splice, _word, _word, _number)


def read_frames(path: Path, timestamps: Path | None = None) -> int:
    """All frames of a source, as a run reads them."""
    from velfield.sources.source import iter_frames, probe

    config = FPS if path.is_dir() and timestamps is None else FPS.model_copy(update={"fps": None})
    info = probe(path, frames=config, timestamps=timestamps)
    return sum(1 for _ in iter_frames(path, info, range(min(info.frame_count, 200))))


def read_detector(path: Path) -> int:
    """Load a detector, and look for cars: weights are read then."""
    from velfield.detection.registry import load_detector

    image = np.random.default_rng(0).integers(0, 255, (64, 96), dtype=np.uint8)
    detector = load_detector(path)
    return len(detector.detect(image))


def link_detections(path: Path) -> int:
    """Tracklets and tracks of detections that no detector would give."""
    from schemas.flight import TrackingConfig
    from velfield.tracking.association import FrameTable
    from velfield.tracking.join_costs import GapLimits
    from velfield.tracking.joins import assign_tracks, close_gaps, find_ends
    from velfield.tracking.tracklets import link_windows

    rng = np.random.default_rng(int.from_bytes(path.read_bytes()[:8].ljust(8), "little"))
    extreme = np.array([0.0, -1e9, 1e9, 1e-300, 5.0, 5.0])
    tables, at_s = [], 0.0
    for k in range(6):
        at_s += float(rng.choice([0.0, 1e-9, 0.2, 0.2, 0.45, 1e6]))
        n = int(rng.choice([0, 1, 2, 30]))
        xy = rng.choice(extreme, (n, 2)) if rng.random() < 0.4 else rng.normal(100, 30, (n, 2))
        tables.append(
            FrameTable(
                frame=k,
                time_s=at_s,
                registered=bool(rng.random() < 0.9),
                residual_px=float(rng.choice([0.0, 0.3, 50.0, np.nan])),
                detection_id=np.arange(n, dtype=np.int64) + (k << 20),
                x_px=xy[:, 0],
                y_px=xy[:, 1],
                orientation_rad=np.where(rng.random(n) < 0.2, np.nan, rng.uniform(0, np.pi, n)),
                orientation_sd_rad=rng.choice([0.0, 0.1, np.nan], n),
                score=rng.choice([0.0, 0.5, 1.0, np.nan], n),
            )
        )
    config = TrackingConfig()
    tracklets, _ = link_windows(tables, config, gsd_m=0.23, starts=range(len(tables)))
    tracks = assign_tracks(tracklets[[f"detection_id_{k}" for k in range(3)]].to_numpy(np.int64))
    limits = GapLimits(
        config.max_gap_s, config.max_stationary_gap_s, config.max_hidden_gap_s, config.stationary_speed_m_per_s
    )
    ids, track = np.unique(tracks, return_inverse=True)
    starts, ends = find_ends(tracklets, track, len(ids), 0.23)
    return len(np.unique(close_gaps(ids, ends, starts, limits).tracks))


def _onnx_files() -> tuple[bytes, ...]:
    """ONNX models that a detector file must not bring: weights in other files, huge shapes, operators of its own."""
    import onnx
    from onnx import TensorProto, helper

    from velfield.detection.cnn.graph import network_to_onnx
    from velfield.detection.registry import shipped_detector

    good = network_to_onnx(shipped_detector().network)
    external = onnx.ModelProto.FromString(good)
    tensor = external.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="/etc/passwd")
    huge = onnx.ModelProto.FromString(good)
    huge.graph.initializer[0].dims[:] = [2**31, 2**31, 4, 4]
    odd = onnx.ModelProto.FromString(good)
    odd.graph.node.append(helper.make_node("Loop", ["image"], ["endless"], domain="elsewhere"))
    return good, external.SerializeToString(), huge.SerializeToString(), odd.SerializeToString()


def kinds(folder: Path) -> list[Kind]:
    """All kinds; `folder` gets the good files that others refer to."""
    from flows.runners import read_runner
    from velfield.detection.registry import shipped_detector
    from velfield.pipeline.configuration import resolve_config
    from velfield.run.flight_record import read_flight_record
    from velfield.run.tables import read_tables
    from velfield.sources.geo import read_base_raster
    from velfield.sources.labels.labels import read_detections, read_labels
    from velfield.sources.source import probe
    from velfield.sources.telemetry.image_tags import read_image_telemetry
    from velfield.sources.telemetry.read import read_telemetry_file
    from velfield.sources.tracks.read import read_tracks

    frames = list(drifting(FRAMES, WIDTH, HEIGHT))
    names = write_images(folder / "frames", frames)
    info = probe(folder / "frames", frames=FPS)
    write_images(folder / "jpeg", frames[:2], name="j{}.jpg")
    write_images(folder / "tiff", frames[:2], name="t{}.tif")
    videos = [write_video(folder / f"a{suffix}", frames) for suffix in (".mp4", ".ts", ".mkv")]
    times = write_times(folder / "times.csv", [(name, 0.2 * k) for k, name in enumerate(names)]).read_bytes()
    images = [next((folder / kind).iterdir()).read_bytes() for kind in ("frames", "jpeg", "tiff")]
    csv = b"frame,x_px,y_px,orientation_rad,length_px,width_px\n" + b"".join(
        f"{name},{10 + k},{20.5 + k},0.3,16,7\n".encode() for k, name in enumerate(names)
    )
    yolo = b"0 0.5 0.5 0.1 0.1\n0 0.2 0.2 0.1 0.05 0.3\n"
    config = yaml.safe_dump(FlightConfig().model_dump(mode="json")).encode()
    shipped = json.loads(shipped_detector().to_json())
    detectors = tuple(json.dumps(shipped | {"onnx": b64encode(model).decode()}).encode() for model in _onnx_files())
    table = folder / "table.parquet"
    pd.DataFrame({"frame": np.arange(50, dtype=np.int32), "x_px": np.linspace(0, 1, 50)}).to_parquet(
        table, write_page_checksum=True
    )
    columns = {"frame": "int32", "x_px": "float64"}

    def one_frame(path: Path) -> int:
        return read_frames(path.parent)

    def run_folder(path: Path) -> object:
        return read_flight_record(path.parent)

    record = {"format_version": 1, "code_version": "0", "config": FlightConfig().model_dump(mode="json")}
    source = {"path": "a", "kind": "folder", "digest": "d", "width": 9, "height": 9, "frame_count": 9}
    flight = json.dumps(record | {"inputs": {"source": source}, "keys": {}}).encode()
    return [
        Kind("configuration", (config,), "flight.yaml", lambda path: resolve_config(file=path), 2),
        Kind(
            "settings",
            (b"tracking.max_speed_m_per_s=20", b"detection.method=paper", b"field.time_intervals=0-3"),
            "setting.txt",
            lambda path: resolve_config(settings=path.read_text(errors="replace").split("\n")[:3]),
            2,
        ),
        Kind("labels (CSV)", (csv,), "labels.csv", lambda path: read_labels(path, info), 2),
        Kind("labels (JSON)", _annotation_files(names), "labels.json", lambda path: read_labels(path, info), 3),
        Kind("labels (YOLO)", (yolo,), "f1.txt", lambda p: read_labels(p, info)),
        Kind("detections", (csv,), "boxes.csv", lambda path: read_detections(path, info), 2),
        Kind("time stamps", (times,), "times.csv", lambda path: read_frames(folder / "frames", path), 2),
        Kind("detector", detectors, "detector.json", read_detector, 2),
        Kind("base image", tuple(images), "base.tif", lambda path: read_base_raster(path, FPS), 2),
        Kind("frame (PNG)", (images[0],), "frame.png", one_frame),
        Kind("frame (JPEG)", (images[1],), "frame.jpg", one_frame),
        Kind("frame (TIFF)", (images[2],), "frame.tif", one_frame),
        Kind("video (MP4)", (videos[0].read_bytes(),), "video.mp4", read_frames),
        Kind("video (TS)", (videos[1].read_bytes(),), "video.ts", read_frames),
        Kind("video (MKV)", (videos[2].read_bytes(),), "video.mkv", read_frames),
        Kind("cluster", (b"cluster_class: a.B\ncluster_kwargs: {n: 1}\nworkers: 3\n",), "cluster.yaml", read_runner),
        Kind("flight record", (flight,), "flight.json", run_folder),
        Kind("table of a run", (table.read_bytes(),), "unit.parquet", lambda path: read_tables([path], columns)),
        Kind("tracks", (b"any seed",), "seed.bin", link_detections),
        Kind("tracks (CSV)", (TRACKS, IMAGE_TRACKS), "tracks.csv", lambda path: read_tracks(path, fps=5.0), 2),
        Kind("tracks (Parquet)", (parquet_bytes(pd.read_csv(io.BytesIO(TRACKS))),), "tracks.parquet", read_tracks),
        Kind("tracks (FCD)", (FCD,), "tracks.xml", read_tracks),
        Kind("tags (JPEG)", (_tagged("JPEG"),), "x.jpg", read_image_telemetry),
        Kind("tags (PNG)", (_tagged("PNG"), _tagged("PNG", late=True)), "x.png", read_image_telemetry),
        Kind("subtitles", (SUBTITLES,), "x.srt", lambda path: read_telemetry_file(path, info), 2),
        Kind("KLV", (b"".join(KLV),), "x.klv", lambda path: read_telemetry_file(path, info), 2),
        Kind("KLV, a set with its checksum", tuple(packet[:-2] for packet in KLV), "x.klv", read_klv_summed, 2),
    ]


TRACKS = b"track_id,time_s,x_m,y_m\n" + b"".join(b"%d,%.1f,%d,3\n" % (k % 3, 0.2 * k, k) for k in range(12))
IMAGE_TRACKS = b"id;frame;x_px;y_px\n" + b"".join(b"7;%d;%d;3.5\n" % (k, k) for k in range(12))
FCD = b'<fcd-export><timestep time="0.0"><vehicle id="a" x="1" y="2"/></timestep></fcd-export>'
SUBTITLES = b"".join(
    b"%d\n00:00:0%d,000 --> 00:00:0%d,500\n[focal_len: 24.00] [latitude: 52.5] [longitude: 13.4] "
    b"[rel_alt: 100.2 abs_alt: 134.1] [gb_yaw: -12.3 gb_pitch: -90.0 gb_roll: 0.0]\n\n" % (k, k, k)
    for k in range(1, 6)
)

KLV = tuple(
    encode_set(
        {2: 1.7e9 + k, 5: 30, 6: 1, 7: 1, 13: 52, 14: 13, 15: 500, 16: 40, 18: 0, 19: -90, 20: 0, 21: 400, 25: 90}
    )
    for k in range(3)
)


def read_klv_summed(path: Path) -> object:
    """One set of KLV, given the checksum that its bytes have: what is wrong in it reaches the reader of values."""
    from velfield.sources.telemetry.klv import parse_klv

    return parse_klv(with_checksum(path.read_bytes()), path.name)


def _tagged(kind: str, *, late: bool = False) -> bytes:
    """An image with EXIF and XMP; `late`: a PNG's EXIF behind its pixels."""
    exif, out = Image.Exif(), io.BytesIO()
    exif[0x010F] = "maker"
    exif.get_ifd(0x8825).update({1: "N", 2: (52.0, 30.0, 0.0), 3: "W", 4: (13.0, 24.0, 0.0)})
    exif.get_ifd(0x8769).update({0xA405: 24, 0x9003: "2024:05:01 12:00:00"})
    xmp = {"xmp": b'<x drone-dji:RelativeAltitude="+80.2" Camera:Pitch="1/2"/>'} if kind == "JPEG" else {}
    Image.new("L", (16, 12), 90).save(out, kind, exif=exif, **xmp)
    data = out.getvalue()
    if not late:
        return data
    start = data.index(b"eXIf") - 4
    stop = start + 12 + int.from_bytes(data[start : start + 4])
    return data[:start] + data[stop:-12] + data[start:stop] + data[-12:]


def _annotation_files(names: list[str]) -> tuple[bytes, ...]:
    coco = {
        "images": [{"id": 1, "file_name": names[0]}],
        "annotations": [{"image_id": 1, "category_id": 1, "bbox": [10, 10, 20, 8]}],
        "categories": [{"id": 1, "name": "car"}],
    }
    shape = {"label": "car", "points": [[1, 1], [20, 9]], "shape_type": "rectangle"}
    labelme = {"imagePath": names[0], "shapes": [shape]}
    region = {"shape_attributes": {"name": "rect", "x": 4, "y": 4, "width": 9, "height": 5}, "region_attributes": {}}
    via = {"a": {"filename": names[0], "regions": [region]}}
    point = {"type": "Point", "coordinates": [10, 20]}
    feature = {"type": "Feature", "properties": {"frame": names[0]}, "geometry": point}
    geojson = {"type": "FeatureCollection", "features": [feature]}
    return tuple(json.dumps(one).encode() for one in (coco, labelme, via, geojson))


@contextmanager
def _time_limit() -> Any:
    """Seconds of work, which other processes do not lengthen; and of waiting, many more."""

    def late(number: int, _frame: FrameType | None) -> None:
        raise TooLong(f"more than {LIMIT_S} s of work" if number == signal.SIGPROF else f"more than {WAIT_S} s")

    timers = {
        signal.SIGPROF: (signal.ITIMER_PROF, LIMIT_S),
        signal.SIGALRM: (signal.ITIMER_REAL, WAIT_S),
    }
    before = {number: signal.signal(number, late) for number in timers}
    for timer, limit_s in timers.values():
        signal.setitimer(timer, limit_s)
    try:
        yield
    finally:
        for number, (timer, _limit) in timers.items():
            signal.setitimer(timer, 0)
            signal.signal(number, before[number])


def problem_of_case(kind: Kind, data: bytes, folder: Path) -> str:
    """Fault of the answer to a case; empty if the case is accepted, or rejected as it should be."""
    place = folder / "case"
    place.mkdir(exist_ok=True)
    file = place / kind.file
    file.write_bytes(data)
    before = {path for path in folder.rglob("*") if path.is_file()}
    try:
        with _time_limit(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            kind.read(file)
        problem = ""
    except (InputError, StoreError) as error:
        message = str(error)
        problem = "" if "\n" not in message and len(message) < 2000 else f"a message of many lines: {message[:200]!r}"
    except Exception as error:
        problem = f"{type(error).__name__}: {str(error)[:200]}"
    written = {path for path in folder.rglob("*") if path.is_file()} - before
    file.unlink(missing_ok=True)
    return problem or (f"wrote {sorted(written)[:3]}" if written else "")


def try_cases(folder: Path, cases: int, seed: int) -> tuple[Counter[str], list[str]]:
    """Cases by kind, and the problems, each with the seed and the number of its case."""
    found = kinds(folder)
    (folder / "warm").write_bytes(b"compiles what the first case would have to wait for")
    link_detections(folder / "warm")
    weights = np.array([kind.weight for kind in found], float)
    tried: Counter[str] = Counter()
    problems = []
    for number in range(cases):
        rng = np.random.default_rng([seed, number])
        kind = found[int(rng.choice(len(found), p=weights / weights.sum()))]
        data = mutate(kind.good[int(rng.integers(len(kind.good)))], kind.good, rng)
        tried[kind.name] += 1
        problem = problem_of_case(kind, data, folder)
        if problem:
            problems.append(f"{kind.name}, seed {seed}, case {number}: {problem}")
    return tried, problems


def main() -> None:
    """Try so many cases; print counts and problems."""
    from flows.launch import limit_threads, prepare_process

    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    limit_threads()
    prepare_process(verbose=False)
    os.environ["OPENCV_LOG_LEVEL"] = "OFF"
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="velfield-bad-input-") as folder:
        tried, problems = try_cases(Path(folder), given.cases, given.seed)
    for problem in problems:
        print(problem)
    for name, count in sorted(tried.items()):
        print(f"{count:>6} {name}")
    print(f"{sum(tried.values())} cases, {len(problems)} problems, {time.monotonic() - started:.0f} s")


if __name__ == "__main__":
    main()
