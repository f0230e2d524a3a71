"""Makes the detector that ships: ``make detector DATA=FOLDER``, where the folder holds ``songdo`` and ``kit_ais``.

Learnt on pictures of two licensed sets and on simulated cities; numbers alone go into the file, no picture does.
Deterministic by its seeds. What it says of each real place by a detector that never saw it is told, and T follows.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.flight import DetectionConfig
from tools.leave_one_site_out import Place, train_on_places
from tools.train_long_vehicles import learn_long_vehicles
from velfield.bench.scenes import simulated_image
from velfield.detection.detector import Detector, save_detector
from velfield.detection.evaluation import Evidence, joined
from velfield.detection.label_orientation import with_axes
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError
from velfield.parallel import each
from velfield.sources.labels.yolo import length_from_upright_box, shape_of_upright_box

ATTRIBUTION = (
    "Songdo Vision (R. Fonod and others), CC-BY 4.0: three frames, scaled to cars of 16 px",
    "KIT AIS Vehicle Data Set (DLR, KIT; 3K camera, Munich), CC-BY 3.0: frames of two sequences, scaled likewise",
    "cities simulated by velfield",
)
CONFIG = DetectionConfig(rounds=400, feature_pool=4000, seed=7)
"""Of the classifier of what is long."""
STEPS, SEED = 2500, 7
SIMULATED_SEEDS = range(9001, 9061)
LORRY_SEEDS, LORRY_SEEDS_LEFT_OUT = range(9101, 9181), range(9201, 9225)
_LORRIES_IN = (1280, 960)
_LARGE_SHARE = 0.35
"""Of the simulated traffic that lorries and buses are learnt from: in a city's own there are too few."""
_KIT_FRAMES = 4
"""Of each sequence, to try on: neighbours show the same cars."""
_KIT_EVERY = 3
_MIXES = 7
"""So many other greys of each colour picture: what is as dark as the road to one sensor is bright to another."""
_MIXED = (1.5, 3.0, 1.5)
"""How much blue, green and red go into them: parameters of a Dirichlet distribution."""
_TONES = ((1.7, 0.7, 0.0), (0.6, 0.0, 4.0))
"""Other sensors: exponent of grey, blur in px, noise in grey levels."""


def read_pictures(files: Sequence[Path], *, car_length_px: float = 16.0, mixes: int = 0) -> list[LabelledImage]:
    """Pictures with a YOLO file each beside them, all scaled by one factor that makes the usual car so long; each
    as grey, then in so many other mixtures of its colours.

    Raises
    ------
    InputError
        No such pictures, or one that cannot be read.
    """
    if not files:
        raise InputError(
            "found no labelled pictures, expected the folders songdo and kit_ais; give their parent folder"
        )
    parts = [boxes_of(file) for file in files]
    usual = np.median(np.concatenate([boxes[boxes[:, 0] == 0, 5] for _, boxes in parts]))
    rng = np.random.default_rng(SEED)
    return [
        _scaled(grey, boxes, car_length_px / float(usual))
        for colours, boxes in parts
        for grey in (_grey(colours), *(_mixed(colours, rng) for _ in range(mixes)))
    ]


def boxes_of(file: Path) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A picture (h, w, 3), and (n, 6): class, x, y, width, height of the upright box, length of the car in it, px."""
    colours = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if colours is None:
        raise InputError(f"{file}: cannot be read as a picture; fetch it again")
    size = [colours.shape[1], colours.shape[0]] * 2
    boxes = np.loadtxt(file.with_suffix(".txt"), ndmin=2)[:, :5] * [1, *size] - [0, 0.5, 0.5, 0, 0]
    lengths = [length_from_upright_box(w, h) for w, h in boxes[:, 3:]]
    return np.asarray(colours, np.uint8), np.column_stack([boxes, lengths])


def _grey(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY), np.uint8)


def _mixed(colours: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    return np.asarray(cv2.transform(colours, rng.dirichlet(_MIXED)[None]), np.uint8).reshape(colours.shape[:2])


def _scaled(grey: NDArray[np.uint8], boxes: NDArray[np.float64], factor: float) -> LabelledImage:
    size = round(grey.shape[1] * factor), round(grey.shape[0] * factor)
    image = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
    xy, sides = (boxes[:, 1:3] + 0.5) * factor - 0.5, boxes[:, 3:5] * factor
    car = boxes[:, 0] == 0
    shapes = np.array([shape_of_upright_box(w, h) for w, h in sides[car]]).reshape(-1, 4)
    left_alone = np.column_stack([xy, np.maximum(sides.max(axis=1) / 2, 8.0)])[~car]
    cars = np.column_stack([xy[car], shapes[:, :3]])
    return LabelledImage(image=image, cars=cars, ignore=left_alone, tilts=shapes[:, 3])


def places_of(data: Path) -> list[Place]:
    """The sites of songdo and the sequences of kit_ais."""
    songdo = sorted((data / "songdo").glob("*.jpg"))
    learnt = read_pictures(songdo, mixes=_MIXES)
    places = [
        Place(f"songdo {file.stem}", learnt[k : k + _MIXES + 1], learnt[k : k + 1])
        for k, file in zip(range(0, len(learnt), _MIXES + 1), songdo, strict=True)
    ]
    for folder in sorted((data / "kit_ais").glob("MOS*")):
        files = sorted(
            (f for f in folder.glob("*.png") if f.with_suffix(".txt").exists()), key=lambda f: int(f.stem[3:])
        )
        tried = np.unique(np.linspace(0, len(files) - 1, _KIT_FRAMES).round().astype(int))
        learnt = read_pictures(files[::_KIT_EVERY], mixes=_MIXES)
        places.append(Place(f"kit_ais {folder.name}", learnt, read_pictures([files[k] for k in tried])))
    return places


def _toned(sample: LabelledImage, exponent: float, blur_px: float, noise_grey: float) -> LabelledImage:
    """The picture as another sensor would have taken it."""
    tone = 255 * (sample.image / 255) ** exponent
    if blur_px:
        tone = cv2.GaussianBlur(tone, (0, 0), blur_px)
    noise = np.random.default_rng(0).normal(0, 1, tone.shape) * noise_grey
    return replace(sample, image=np.clip(tone + noise, 0, 255).astype(np.uint8))


def ship_long_vehicles(data: Path, out: Path) -> str:
    """Train and write the classifier of what is long; a line that tells of it."""
    seen = each(partial(simulated_image, size=_LORRIES_IN, large_share=_LARGE_SHARE), LORRY_SEEDS)
    samples = [sample if k % 3 == 0 else _toned(sample, *_TONES[k % 3 - 1]) for k, sample in enumerate(seen)]
    for place in places_of(data):
        toned = [*place.tried, *(_toned(sample, *tone) for sample in place.tried for tone in _TONES)]
        samples += [replace(sample, cars=with_axes(sample.image, sample.cars, sample.tilts)) for sample in toned]
    left_out = each(partial(simulated_image, size=_LORRIES_IN), LORRY_SEEDS_LEFT_OUT)
    record = learn_long_vehicles(samples, left_out, CONFIG, ATTRIBUTION)
    out.write_text(record.model_dump_json())
    return f"what is long: {len(record.rounds)} rounds, threshold {record.threshold:.3f}"


def ship(data: Path, out: Path, steps: int = STEPS) -> list[str]:
    """Train and write the detector that ships; lines that tell what is measured on places left out."""
    places, always = places_of(data), each(simulated_image, SIMULATED_SEEDS)
    detector, found = train_on_places(places, always, seed=SEED, steps=steps)
    save_detector(Detector(detector.record.model_copy(update={"attribution": ATTRIBUTION})), out)
    return [_told(*one, detector.threshold) for one in (*found.items(), ("all", joined(list(found.values()))))]


def _told(name: str, evidence: Evidence, threshold: float) -> str:
    above = evidence.score > threshold
    right = int(evidence.right[above].sum())
    precision, recall = right / max(int(above.sum()), 1), right / evidence.cars
    return f"{name:28} {evidence.cars:4} cars  precision {precision:.3f}  recall {recall:.3f}"
