"""Raw pixels of each frame <-> base pixels: the transforms that registration stored in the run folder, composed.

A frame is registered to the flight's own base image (same camera, same light: a tenth of a pixel). Where a base image
was given, the own one is registered to it once, and each frame's transform is the composition: images are resampled
only once.

The base image of a run and the grid of its pixels.
"""

import json
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from schemas.arrays import FloatArray, GreyImage
from schemas.camera import CameraRecord
from schemas.flight import FlightConfig, FramesConfig, RegistrationConfig
from schemas.records import FORMAT_VERSION, GridRecord, PolyprojectiveRecord, RebaseRecord, WorkingRecord
from schemas.renames import upgrade_record
from velfield.camera.lens import Lens, lens_from_record
from velfield.errors import InputError
from velfield.registration.transforms import FrameMap, FrameTransform, PolyprojectiveTransform
from velfield.run.layout import RunLayout, local_copy
from velfield.run.stores import RegistrationStore, open_frames, open_registration


def read_grid(layout: RunLayout) -> GridRecord:
    """``base/grid.json``.

    Raises
    ------
    InputError
        There is no base image yet.
    """
    if not layout.grid.exists():
        raise InputError(f"{layout.grid} is not there: run `velfield run` on this folder first")
    return _parse_grid(layout.grid.read_bytes(), layout.format_version)


def read_working(layout: RunLayout) -> WorkingRecord:
    """``base/working.json``.

    Raises
    ------
    InputError
        There is no detector yet.
    """
    if not layout.working.exists():
        raise InputError(f"{layout.working} is not there: run `velfield run` on this folder first")
    data = layout.working.read_bytes()
    if layout.format_version == FORMAT_VERSION:
        return WorkingRecord.model_validate_json(data)
    return WorkingRecord.model_validate(upgrade_record("working", json.loads(data)))


def read_base_image(layout: RunLayout, config: FramesConfig) -> GreyImage:
    """The base image, (y, x) grey uint8: the GeoTIFF where the run has one, else the PNG."""
    from velfield.sources.images import read_grey_image  # opening a run loads no rasterio

    path = layout.base_image_tif if layout.base_image_tif.exists() else layout.base_image
    with local_copy(path) as local:
        return read_grey_image(local, config.max_pixels)


def north_direction_rad(grid: GridRecord) -> float | None:
    """Direction of north in the image, from +x towards +y (down); None without a georeference."""
    if grid.affine is None:
        return None
    a, b, _, d, e, _ = grid.affine
    # One step north in the CRS, as a step of pixels: the inverse of [[a, b], [d, e]] times (0, 1).
    determinant = a * e - b * d
    return float(np.arctan2(a / determinant, -b / determinant))


def heading_deg(direction_rad: FloatArray, north_rad: float | None) -> FloatArray:
    """Compass heading of directions of motion in [0, 360), clockwise from north; from the image's top if None.

    Examples
    --------
    >>> heading_deg(np.array([0.0, np.pi / 2]), None).tolist()
    [90.0, 180.0]
    """
    return np.mod(np.degrees(direction_rad - (-np.pi / 2 if north_rad is None else north_rad)), 360.0)


@lru_cache(maxsize=8)
def _parse_grid(data: bytes, format_version: int) -> GridRecord:
    if format_version == FORMAT_VERSION:
        return GridRecord.model_validate_json(data)
    return GridRecord.model_validate(upgrade_record("grid", json.loads(data)))


def read_lens(layout: RunLayout) -> Lens:
    """The lens of ``camera.json``.

    Raises
    ------
    InputError
        The lens was not calibrated yet.
    """
    if not layout.camera.exists():
        raise InputError(f"{layout.camera} is not there: run `velfield run` on this folder first")
    return lens_from_record(CameraRecord.model_validate_json(layout.camera.read_bytes()).lens)


def polyprojective_to_record(transform: PolyprojectiveTransform) -> PolyprojectiveRecord:
    """The transform as a record for JSON."""
    return PolyprojectiveRecord(
        coefficients=tuple(tuple(map(float, row)) for row in np.reshape(transform.coefficients, (3, 6))),
        source=tuple(map(float, transform.source)),
        target=tuple(map(float, transform.target)),
    )


def polyprojective_from_record(record: PolyprojectiveRecord) -> PolyprojectiveTransform:
    """The inverse of `polyprojective_to_record`."""
    return PolyprojectiveTransform(np.array(record.coefficients), np.array(record.source), np.array(record.target))


def _base_transforms(layout: RunLayout) -> tuple[PolyprojectiveTransform, ...]:
    """Transforms from the image that frames are registered to on to base pixels, in order; mostly none."""
    records = []
    if layout.own_to_base.exists():
        records.append(PolyprojectiveRecord.model_validate_json(layout.own_to_base.read_bytes()))
    if layout.rebased.exists():
        records.append(RebaseRecord.model_validate_json(layout.rebased.read_bytes()).transform)
    return tuple(polyprojective_from_record(record) for record in records)


@dataclass(frozen=True)
class FrameTransforms:
    """The transforms of all frames of a run, each read on demand."""

    width: int
    height: int
    lens: Lens
    base_transforms: tuple[PolyprojectiveTransform, ...]
    """Applied after a frame's own: to a given base image, and from that to a newer one."""
    store: RegistrationStore
    config: RegistrationConfig

    @classmethod
    def open(cls, layout: RunLayout, config: FlightConfig) -> "FrameTransforms":
        """The transforms of a run folder."""
        height, width = open_frames(layout.frames).shape
        return cls(
            width=width,
            height=height,
            lens=read_lens(layout),
            base_transforms=_base_transforms(layout),
            store=open_registration(layout.registration),
            config=config.registration,
        )

    def transform(self, frame: int) -> FrameMap | None:
        """The transform of one frame; None where it is not registered."""
        vector = self.store.vector(frame)
        if not np.isfinite(vector).all():
            return None
        transform: FrameMap = FrameTransform.from_vector(
            vector, width=self.width, height=self.height, lens=self.lens, config=self.config
        )
        for following in self.base_transforms:
            transform = transform.then(following)
        return transform
