"""Raw pixels of each frame <-> base pixels: the transforms that registration stored in the run folder, composed.

A frame is registered to the flight's own base image (same camera, same light: a tenth of a pixel). Where a base image
was given, the own one is registered to it once, and each frame's transform is the composition: images are resampled
only once.
"""

from dataclasses import dataclass

import numpy as np

from schemas.camera import CameraRecord
from schemas.flight import FlightConfig, RegistrationConfig
from schemas.records import PolyprojectiveRecord, RebaseRecord
from velfield.camera.lens import Lens, lens_from_record
from velfield.errors import InputError
from velfield.registration.transforms import FrameMap, FrameTransform, PolyprojectiveTransform
from velfield.run.layout import RunLayout
from velfield.run.stores import RegistrationStore, open_frames, open_registration


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
