"""Trains the shipped detectors: ``make detector DATA=FOLDER``, where the folder holds ``songdo`` and ``kit_ais``.

They are trained on images of two licensed data sets and on simulated cities; only weights go into the files. Training
is deterministic by its seeds. The score threshold and the reported accuracy come from leave-one-site-out
cross-validation.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from schemas.arrays import FloatArray, GreyImage, RGBImage
from schemas.detector import CascadeConfig
from tools.leave_one_site_out import Site, train_leave_one_site_out
from tools.train_long_vehicles import train_long_vehicles
from velfield.bench.scenes import simulated_image
from velfield.detection.cnn.detector import CnnDetector
from velfield.detection.detector import load_detector
from velfield.detection.evaluation import HeldOutScores, merge_scores
from velfield.detection.orientation import fill_missing_orientation
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError
from velfield.parallel import parallel_map
from velfield.sources.labels.shapes import car_in_upright_box, length_from_upright_box

ATTRIBUTION = (
    "Songdo Vision (R. Fonod and others), CC-BY 4.0: three frames, scaled to cars of 16 px",
    "KIT AIS Vehicle Data Set (DLR, KIT; 3K camera, Munich), CC-BY 3.0: frames of two sequences, scaled likewise",
    "cities simulated by velfield",
)
CONFIG = CascadeConfig(seed=7)
"""Of the classifier of long vehicles."""
STEPS, SEED = 24_000, 7
SIMULATED_SEEDS = (*range(9001, 9061), *range(9301, 9501))
"""Every third of them with many long vehicles."""
LORRY_SEEDS, LORRY_SEEDS_HELD_OUT = range(9101, 9181), range(9201, 9225)
_LORRY_SCENE_SIZE = (1280, 960)
_LARGE_VEHICLE_FRACTION = 0.35
"""Of the simulated traffic that the classifier of long vehicles is trained on: a usual city has too few."""
_KIT_EVALUATION_FRAMES = 4
"""Of each sequence: neighbouring frames show the same cars."""
_KIT_TRAINING_STEP = 3
_CHANNEL_MIXES = 7
"""Channel augmentation: grey images of each colour image besides the usual one, for sensors of other spectra."""
_MIX_CONCENTRATION = (1.5, 3.0, 1.5)
"""Weights of blue, green and red in them: parameters of a Dirichlet distribution."""
_SENSORS = ((1.7, 0.7, 0.0), (0.6, 0.0, 4.0))
"""Photometric augmentation: gamma, blur in px, noise in grey levels."""


def read_images(files: Sequence[Path], *, car_length_px: float = 16.0, mixes: int = 0) -> list[LabelledImage]:
    """Read images, each with a YOLO file beside it.

    All are scaled by one factor that brings the median car to ``car_length_px``. Each gives its grey image, then
    ``mixes`` random mixtures of its channels.

    Raises
    ------
    InputError
        There are no such images, or one cannot be read.
    """
    if not files:
        raise InputError("found no labelled images, expected the folders songdo and kit_ais; give their parent folder")
    parts = [read_boxes(file) for file in files]
    median_length = np.median(np.concatenate([boxes[boxes[:, 0] == 0, 5] for _, boxes in parts]))
    rng = np.random.default_rng(SEED)
    return [
        _scale(grey, boxes, car_length_px / float(median_length))
        for colours, boxes in parts
        for grey in (_to_grey(colours), *(_mix_channels(colours, rng) for _ in range(mixes)))
    ]


def read_boxes(file: Path) -> tuple[RGBImage, FloatArray]:
    """An image (h, w, 3) as BGR, and (n, 6): class, x, y, width, height of the upright box, length of its car, px."""
    colours = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if colours is None:
        raise InputError(f"{file}: cannot be read as an image; download it again")
    size = [colours.shape[1], colours.shape[0]] * 2
    boxes = np.loadtxt(file.with_suffix(".txt"), ndmin=2)[:, :5] * [1, *size] - [0, 0.5, 0.5, 0, 0]
    lengths = [length_from_upright_box(w, h) for w, h in boxes[:, 3:]]
    return np.asarray(colours, np.uint8), np.column_stack([boxes, lengths])


def _to_grey(colours: RGBImage) -> GreyImage:
    return np.asarray(cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY), np.uint8)


def _mix_channels(colours: RGBImage, rng: np.random.Generator) -> GreyImage:
    return np.asarray(cv2.transform(colours, rng.dirichlet(_MIX_CONCENTRATION)[None]), np.uint8).reshape(
        colours.shape[:2]
    )


def _scale(grey: GreyImage, boxes: FloatArray, factor: float) -> LabelledImage:
    size = round(grey.shape[1] * factor), round(grey.shape[0] * factor)
    image = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
    xy, sides = (boxes[:, 1:3] + 0.5) * factor - 0.5, boxes[:, 3:5] * factor
    car = boxes[:, 0] == 0
    shapes = np.array([car_in_upright_box(w, h) for w, h in sides[car]]).reshape(-1, 4)
    ignore = np.column_stack([xy, np.maximum(sides.max(axis=1) / 2, 8.0)])[~car]
    cars = np.column_stack([xy[car], shapes[:, :3]])
    return LabelledImage(image=image, cars=cars, ignore=ignore, abs_box_angle_rad=shapes[:, 3])


def read_sites(data: Path) -> list[Site]:
    """The sites of songdo and the sequences of kit_ais."""
    songdo = sorted((data / "songdo").glob("*.jpg"))
    training = read_images(songdo, mixes=_CHANNEL_MIXES)
    sites = [
        Site(f"songdo {file.stem}", training[k : k + _CHANNEL_MIXES + 1], training[k : k + 1])
        for k, file in zip(range(0, len(training), _CHANNEL_MIXES + 1), songdo, strict=True)
    ]
    for folder in sorted((data / "kit_ais").glob("MOS*")):
        files = sorted(
            (f for f in folder.glob("*.png") if f.with_suffix(".txt").exists()), key=lambda f: int(f.stem[3:])
        )
        evaluation = np.unique(np.linspace(0, len(files) - 1, _KIT_EVALUATION_FRAMES).round().astype(int))
        training = read_images(files[::_KIT_TRAINING_STEP], mixes=_CHANNEL_MIXES)
        sites.append(Site(f"kit_ais {folder.name}", training, read_images([files[k] for k in evaluation])))
    return sites


def _simulate_sensor(sample: LabelledImage, gamma: float, blur_px: float, noise_grey: float) -> LabelledImage:
    """The image as another sensor might have taken it."""
    grey = 255 * (sample.image / 255) ** gamma
    if blur_px:
        grey = cv2.GaussianBlur(grey, (0, 0), blur_px)
    noise = np.random.default_rng(0).normal(0, 1, grey.shape) * noise_grey
    return replace(sample, image=np.clip(grey + noise, 0, 255).astype(np.uint8))


def make_shipped_long_vehicles(data: Path, out: Path) -> str:
    """Train and write the classifier of long vehicles; returns a line about it."""
    simulate = partial(simulated_image, size=_LORRY_SCENE_SIZE)
    scenes = parallel_map(partial(simulate, large_share=_LARGE_VEHICLE_FRACTION), LORRY_SEEDS)
    samples = [
        sample if k % 3 == 0 else _simulate_sensor(sample, *_SENSORS[k % 3 - 1]) for k, sample in enumerate(scenes)
    ]
    for site in read_sites(data):
        augmented = [_simulate_sensor(sample, *sensor) for sample in site.evaluation for sensor in _SENSORS]
        samples += [
            replace(sample, cars=fill_missing_orientation(sample.image, sample.cars, sample.abs_box_angle_rad))
            for sample in [*site.evaluation, *augmented]
        ]
    held_out = parallel_map(simulate, LORRY_SEEDS_HELD_OUT)
    record = train_long_vehicles(samples, held_out, CONFIG, ATTRIBUTION)
    out.write_text(record.model_dump_json())
    return f"long vehicles: {len(record.rounds)} rounds, threshold {record.threshold:.3f}"


def _simulate_city(seed: int) -> LabelledImage:
    return simulated_image(seed, large_share=_LARGE_VEHICLE_FRACTION if seed % 3 == 0 else None)


def make_shipped_detector(data: Path, out: Path, steps: int = STEPS) -> list[str]:
    """Train and write the detector; returns lines with the accuracy on each held-out site."""
    sites, simulated = read_sites(data), parallel_map(_simulate_city, SIMULATED_SEEDS)
    teacher = load_detector(out) if out.exists() else None
    network = teacher.network if isinstance(teacher, CnnDetector) else None
    detector, by_site = train_leave_one_site_out(sites, simulated, seed=SEED, steps=steps, teacher=network)
    CnnDetector(detector.record.model_copy(update={"attribution": ATTRIBUTION})).save(out)
    evaluations = {**by_site, "all": merge_scores(list(by_site.values()))}
    return [_accuracy_line(name, evaluation, detector.threshold) for name, evaluation in evaluations.items()]


def _accuracy_line(name: str, evaluation: HeldOutScores, threshold: float) -> str:
    above = evaluation.score > threshold
    correct = int(evaluation.correct[above].sum())
    precision, recall = correct / max(int(above.sum()), 1), correct / evaluation.car_count
    return f"{name:28} {evaluation.car_count:4} cars  precision {precision:.3f}  recall {recall:.3f}"
