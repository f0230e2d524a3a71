"""Labelled pictures that the shipped detector is trained on and evaluated on, at its working scale: a car of 16 px.

Each set keeps parts out of training (`Site.held_out`), by place where the set has several places. A picture's cars are
(x, y, axis, length, width); sizes that a set does not measure are NaN and train no size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, GreyImage, RGBImage
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError
from velfield.sources.labels.shapes import car_in_upright_box, length_from_upright_box

CAR_LENGTH_PX = 16.0
CHANNEL_MIXES = 5
"""Grey images of each colour image besides the usual one, for sensors of other spectra."""
_MIX_CONCENTRATION = (1.5, 3.0, 1.5)
"""Weights of blue, green and red in them: parameters of a Dirichlet distribution."""
_LARGE_WIDTH_RATIO = 0.5
"""Width of a bus or lorry in an upright box, as a fraction of a car's length (2.25 m over 4.5 m)."""
_IGNORE_RADIUS_PX = 8.0
_SEED = 7

ATTRIBUTION = (
    "Songdo Vision (R. Fonod, H. Cho, H. Yeo, N. Geroliminis; Zenodo, DOI 10.5281/zenodo.13828408), CC-BY 4.0: five "
    "frames, scaled to cars of 16 px; oriented boxes of two by R. Fonod (hbb2obb), MIT",
    "KIT AIS Vehicle Data Set (DLR, KIT; 3K camera, Munich), CC-BY 3.0: frames of two sequences, scaled likewise",
    "HIT-UAV (J. Suo, T. Wang, X. Zhang, H. Chen, W. Zhou, W. Shi; Scientific Data 10, 227 (2023), DOI "
    "10.1038/s41597-023-02066-6), CC-BY 4.0: frames seen from above, scaled likewise",
    "SWISSIMAGE. Source: Federal Office of Topography swisstopo: tiles of the canton of Bern, scaled likewise",
    "Brighton Beach drone data set (P. Toffanin), BSD 2-Clause, Copyright (c) 2017, Piero Toffanin: six frames, scaled "
    "likewise",
    "cities simulated by velfield",
)


@dataclass(frozen=True)
class Site:
    """A set of pictures: to train on with a sampling weight, and held out of training."""

    name: str
    training: Sequence[LabelledImage]
    held_out: Sequence[LabelledImage] = field(default_factory=tuple)
    weight: float = 1.0


def read_picture(file: Path) -> RGBImage:
    """A picture (h, w, 3) as BGR.

    Raises
    ------
    InputError
        It cannot be read.
    """
    colours = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if colours is None:
        raise InputError(f"{file}: cannot be read as an image; download it again")
    return np.asarray(colours, np.uint8)


def to_grey_images(colours: RGBImage, mixes: int, rng: np.random.Generator) -> list[GreyImage]:
    """The grey image, then random mixtures of the channels."""
    mixed = [cv2.transform(colours, rng.dirichlet(_MIX_CONCENTRATION)[None]) for _ in range(mixes)]
    grey = cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY)
    return [np.asarray(image, np.uint8).reshape(colours.shape[:2]) for image in (grey, *mixed)]


def read_upright(files: Sequence[Path], *, mixes: int = 0) -> list[LabelledImage]:
    """Pictures, each with a YOLO file of upright boxes beside it: 0 a car, 1 and 2 buses and lorries, else ignored.

    All are scaled by one factor that brings the median car to `CAR_LENGTH_PX`.

    Raises
    ------
    InputError
        There are no such pictures, or one cannot be read.
    """
    if not files:
        raise InputError("found no labelled images, expected the folders songdo and kit_ais; give their parent folder")
    rng, parts = np.random.default_rng(_SEED), [read_boxes(file) for file in files]
    factor = CAR_LENGTH_PX / float(np.median(np.concatenate([boxes[boxes[:, 0] == 0, 5] for _, boxes in parts])))
    return [
        _scaled(grey, factor, *_shapes_of_upright(boxes[:, :5], factor, colours.shape))
        for colours, boxes in parts
        for grey in to_grey_images(colours, mixes, rng)
    ]


def read_boxes(file: Path) -> tuple[RGBImage, FloatArray]:
    """An image (h, w, 3) as BGR, and (n, 6): class, x, y, width, height of the upright box, length of its car, px."""
    colours = read_picture(file)
    size = [colours.shape[1], colours.shape[0]] * 2
    boxes = np.loadtxt(file.with_suffix(".txt"), ndmin=2)[:, :5] * [1, *size] - [0, 0.5, 0.5, 0, 0]
    lengths = [length_from_upright_box(w, h) for w, h in boxes[:, 3:]]
    return colours, np.column_stack([boxes, lengths])


def _shapes_of_upright(
    boxes: FloatArray, factor: float, shape: tuple[int, ...]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Vehicles (n, 5), |angle| of their boxes (n,) and circles to ignore (k, 3), px of the picture.

    Widths are NaN: lengths follow from a width that is assumed.
    """
    vehicles, angles, ignore = [], [], []
    for kind, x, y, w, h in boxes:
        cut = min(x - w / 2, y - h / 2) < 1 or x + w / 2 > shape[1] - 2 or y + h / 2 > shape[0] - 2
        if kind == 0:
            axis, length, _, angle = car_in_upright_box(w, h)
            vehicles.append((x, y, axis, np.nan if cut else length, np.nan))
            angles.append(angle)
        elif kind in (1, 2) and not cut:
            length, _, angle = large_in_upright_box(w, h, _LARGE_WIDTH_RATIO * CAR_LENGTH_PX / factor)
            upright = min(angle, np.pi / 2 - angle) < 0.05
            vehicles.append((x, y, round(angle / (np.pi / 2)) * np.pi / 2 if upright else np.nan, length, np.nan))
            angles.append(np.nan if upright else angle)
        else:
            ignore.append((x, y, max(w, h, 2 * _IGNORE_RADIUS_PX / factor) / 2))
    return np.reshape(vehicles, (-1, 5)).astype(float), np.array(angles), np.reshape(ignore, (-1, 3)).astype(float)


def large_in_upright_box(w: float, h: float, width: float) -> tuple[float, float, float]:
    """Length, width and |angle| to the rows of a long vehicle of a known width in its upright box of w x h.

    With c, s >= 0 the cosine and the sine: w = L c + W s, h = L s + W c.

    Examples
    --------
    >>> [round(v, 2) for v in large_in_upright_box(100 * 0.8 + 30 * 0.6, 100 * 0.6 + 30 * 0.8, 30)]
    [100.0, 30.0, 0.64]
    """
    width = min(width, w, h)
    angles = np.linspace(0, np.pi / 2, 1801)
    c, s = np.cos(angles), np.sin(angles)
    length = np.maximum(c * (w - width * s) + s * (h - width * c), 0)
    error = np.hypot(length * c + width * s - w, length * s + width * c - h)
    best = int(error.argmin())
    return float(length[best]), float(width), float(angles[best])


def read_oriented(
    folder: Path,
    *,
    car_length_px: float | None,
    mixes: int = 0,
    nominal_length_px: float | None = None,
) -> dict[str, list[LabelledImage]]:
    """Pictures of a folder by name, labelled with oriented boxes in its ``labels.csv``.

    Parameters
    ----------
    car_length_px
        Length of a car in the pictures, px; None: the median length of the labelled cars.
    nominal_length_px
        A length that stands for not measured.
    """
    labels = pd.read_csv(folder / "labels.csv")
    if car_length_px is None:
        car_length_px = float(labels.loc[labels["class"] == "car", "length_px"].median())
    factor, rng, found = CAR_LENGTH_PX / car_length_px, np.random.default_rng(_SEED), {}
    labels = labels[~labels["class"].isin(["person", "bicycle"])]  # background
    for file in sorted([*folder.glob("*.jpg"), *folder.glob("*.png")]):
        rows = labels[labels["file"] == file.name]
        doubtful = rows["class"].isin(["ignore", "motorcycle"])
        columns = ["x_px", "y_px", "orientation_rad", "length_px", "width_px"]
        vehicles = rows.loc[~doubtful, columns].to_numpy(float, copy=True)
        if nominal_length_px is not None:
            vehicles[vehicles[:, 3] == nominal_length_px, 3:] = np.nan
        ignore = rows.loc[doubtful, ["x_px", "y_px", "length_px"]].to_numpy(float, copy=True)
        ignore[:, 2] = np.maximum(ignore[:, 2], 2 * _IGNORE_RADIUS_PX / factor) / 2
        angles = np.full(len(vehicles), np.nan)
        greys = to_grey_images(read_picture(file), mixes, rng)
        found[file.name] = [_scaled(grey, factor, vehicles, angles, ignore) for grey in greys]
    return found


def _scaled(
    grey: GreyImage, factor: float, vehicles: FloatArray, angles: FloatArray, ignore: FloatArray
) -> LabelledImage:
    size = round(grey.shape[1] * factor), round(grey.shape[0] * factor)
    image = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
    vehicles, ignore = vehicles.copy(), ignore.copy()
    for rows in (vehicles, ignore):
        rows[:, :2] = (rows[:, :2] + 0.5) * factor - 0.5
    vehicles[:, 3:] *= factor
    ignore[:, 2] *= factor
    return LabelledImage(image=image, cars=vehicles, ignore=ignore, abs_box_angle_rad=angles)


def read_songdo(data: Path) -> list[Site]:
    """Three frames with upright boxes, and two with oriented ones, of which ``00164`` is held out.

    ``00164`` probably shows the junction of ``00972``, which is trained on, at another time.
    """
    oriented = read_oriented(data / "songdo_obb", car_length_px=None, mixes=CHANNEL_MIXES)
    sites = [
        Site(f"songdo {file.stem}", read_upright([file], mixes=CHANNEL_MIXES))
        for file in sorted((data / "songdo").glob("*.jpg"))
    ]
    return [*sites, Site("songdo_obb", oriented["04433.jpg"], oriented["00164.jpg"][:1], weight=2.5)]


def read_kit_ais(data: Path) -> list[Site]:
    """Every third frame of each sequence."""
    sites = []
    for folder in sorted((data / "kit_ais").glob("MOS*")):
        files = [file for file in folder.glob("*.png") if file.with_suffix(".txt").exists()]
        files.sort(key=lambda file: int(file.stem[3:]))
        sites.append(Site(f"kit_ais {folder.name}", read_upright(files[::3], mixes=CHANNEL_MIXES)))
    return sites


THERMAL_HELD_OUT = ((8000, 8600), (9100, 9500))
"""Numbers of the frames of two flights, one by day and one by night."""


def read_hit_uav(data: Path) -> Site:
    """Thermal pictures, scaled by the median car of each height of flight."""
    folder = data / "hit_uav_nadir"
    labels = pd.read_csv(folder / "labels.csv")
    cars = labels[labels["class"] == "car"]
    lengths = cars.groupby(cars["file"].str.split("_").str[1])["length_px"].median()
    training: list[LabelledImage] = []
    held_out: list[LabelledImage] = []
    for height, length in lengths.items():
        for name, images in read_oriented(folder, car_length_px=float(length)).items():
            if name.split("_")[1] != height:
                continue
            number = int(name.rsplit("_", 1)[1].split(".")[0])
            (held_out if any(a <= number < b for a, b in THERMAL_HELD_OUT) else training).extend(images)
    return Site("hit_uav", training, held_out, weight=2.0)


_SWISS_CAR_PX, _SWISS_BLOCK_M = 22.0, 2000
"""A car of 4.5 m at 0.2 m a pixel, and the label of one that was not measured."""


def read_swissimage(data: Path) -> Site:
    """Tiles with roofs and parked cars; those in every fourth block of the national grid are held out."""
    tiles = read_oriented(
        data / "swissimage_bern", car_length_px=_SWISS_CAR_PX, mixes=CHANNEL_MIXES, nominal_length_px=_SWISS_CAR_PX
    )
    held_out = {name for name in tiles if _swiss_block(name) % 4 == 0}
    return Site(
        "swissimage_bern",
        [image for name, images in tiles.items() if name not in held_out for image in images],
        [images[0] for name, images in tiles.items() if name in held_out],
        weight=4.0,
    )


def _swiss_block(name: str) -> int:
    east, north = (int(part) for part in name.split(".")[0].split("_")[1:3])
    return east // _SWISS_BLOCK_M + 3 * (north // _SWISS_BLOCK_M)


def read_swissimage_unlabelled(data: Path) -> list[LabelledImage]:
    """Further tiles, nothing known in any; `tools.pretraining.label_tiles` labels what is certain."""
    nobody, rng = np.empty((0, 5)), np.random.default_rng(_SEED)
    return [
        _scaled(grey, CAR_LENGTH_PX / _SWISS_CAR_PX, nobody, np.empty(0), np.empty((0, 3)))
        for file in sorted((data / "swissimage_bern_unlabelled").glob("*.jpg"))
        for grey in to_grey_images(read_picture(file), 0, rng)
    ]


def read_brighton(data: Path) -> Site:
    """A park: nearly all background."""
    pictures = read_oriented(data / "brighton_beach", car_length_px=None, mixes=CHANNEL_MIXES)
    return Site("brighton_beach", [image for images in pictures.values() for image in images], weight=0.5)


def read_sites(data: Path) -> list[Site]:
    """All sets of real pictures."""
    return [
        *read_songdo(data), *read_kit_ais(data), read_hit_uav(data), read_swissimage(data), read_brighton(data)
    ]  # fmt: skip
