"""Raw pixels of each frame <-> base pixels: the transforms that registration stored in the run folder, composed.

A frame is registered to the flight's own base image (same camera, same light: a tenth of a pixel). Where a base image
was given, the own one is registered to it once, and each frame's transform is the composition: images are resampled
only once.

The base image of a run and the grid of its pixels.
"""

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
from schemas.camera import CameraRecord, PolynomialLensRecord
from schemas.flight import FlightConfig, FramesConfig, RegistrationConfig
from schemas.georeference import GeoreferenceRecord
from schemas.model import Model
from schemas.records import (
    GridRecord,
    OwnToBaseRecord,
    PolyprojectiveRecord,
    RebaseRecord,
    WorkingRecord,
)
from velfield.camera.lens import Lens, lens_from_record
from velfield.errors import InputError
from velfield.registration.intersensor.base_mesh import BaseMesh
from velfield.registration.mesh import Support, sample_cells
from velfield.registration.transforms import (
    ComposedTransform,
    FrameMap,
    FrameTransform,
    MeshedTransform,
    PlaneTransform,
    PolyprojectiveTransform,
    as_points,
)
from velfield.run.layout import RunLayout, local_copy
from velfield.run.stores import FrameStore, RegistrationStore

_MAX_MAPS = 64
R = TypeVar("R", bound=Model)


def read_grid(layout: RunLayout) -> GridRecord:
    """The grid of base pixels: ``base/grid.json``, with scale, north and place by `read_georeference`.

    Raises
    ------
    InputError
        There is no base image yet.
    """
    grid, record = read_own_grid(layout), read_georeference(layout)
    return grid if record is None else _apply_georeference(grid, record)


def read_first_grid(layout: RunLayout) -> GridRecord:
    """The grid of base pixels as it is known before vehicles are tracked: for the stages up to the tracks.

    Their results may not depend on `read_grid`, whose scale may rest on them.
    """
    grid = read_own_grid(layout)
    record = read_first_georeference(layout)
    return grid if record is None else _apply_georeference(grid, record)


def read_tracking_gsd(layout: RunLayout) -> float | None:
    """Metres a base pixel for the limits of tracking: of `read_first_grid`, else by the size of the cars that the
    detector was trained on; None where neither is known."""
    gsd_m = read_first_grid(layout).gsd_m
    return read_working(layout).vehicle_gsd_m if gsd_m is None and layout.working.exists() else gsd_m


def read_own_grid(layout: RunLayout) -> GridRecord:
    """``base/grid.json`` alone: what the base image itself gives."""
    return _read(layout.grid, GridRecord)


def read_georeference(layout: RunLayout) -> GeoreferenceRecord | None:
    """``base/scale.json``; before its stage, and in runs that had none, `read_first_georeference`."""
    return _read(layout.scale, GeoreferenceRecord) if layout.scale.exists() else read_first_georeference(layout)


def read_first_georeference(layout: RunLayout) -> GeoreferenceRecord | None:
    """``base/georeference.json``, without the lengths of vehicles; None before its stage, and in runs that had none."""
    return _read(layout.georeference, GeoreferenceRecord) if layout.georeference.exists() else None


def _read(path: Path, model: type[R]) -> R:
    """A record of the run folder, which is refused where it is not there yet."""
    if not path.exists():
        raise InputError(f"{path} does not exist: run `velfield run` on this folder first")
    found: R = _parse(model, path.read_bytes())
    return found


@lru_cache(maxsize=32)
def _parse(model: type[R], data: bytes) -> R:
    return model.model_validate_json(data)


@lru_cache(maxsize=8)
def _apply_georeference(grid: GridRecord, record: GeoreferenceRecord) -> GridRecord:
    return grid.model_copy(update=georeference_update(record))


def georeference_update(record: GeoreferenceRecord) -> dict[str, object]:
    """The fields of a `GridRecord` that a georeference sets."""
    update: dict[str, object] = {"north_rad": record.north_rad}
    if record.scale.used is not None:
        update["gsd_m"] = record.scale.used.gsd_m
    if record.crs_wkt is not None:
        update |= {"crs_wkt": record.crs_wkt, "affine": record.affine}
    return update


def read_working(layout: RunLayout) -> WorkingRecord:
    """``base/working.json``.

    Raises
    ------
    InputError
        There is no detector yet.
    """
    return _read(layout.working, WorkingRecord)


def read_base_image(layout: RunLayout, config: FramesConfig) -> GreyImage:
    """The base image, (y, x) grey uint8: the GeoTIFF where the run has one, else the PNG."""
    from velfield.sources.images import read_grey_image  # opening a run loads no rasterio

    path = layout.base_image_tif if layout.base_image_tif.exists() else layout.base_image
    with local_copy(path) as local:
        return read_grey_image(local, config.max_pixels)


def north_direction_rad(grid: GridRecord) -> float | None:
    """Direction of true north in the middle of the image, from +x towards +y (down); None where it is not known."""
    if grid.crs_wkt is None or grid.affine is None:
        return grid.north_rad
    from velfield.sources.geo import true_north_rad  # opening a run loads no rasterio

    return true_north_rad(grid.crs_wkt, grid.affine, (grid.height_px, grid.width_px), name="the base image")


def heading_deg(direction_rad: FloatArray, north_rad: float | None) -> FloatArray:
    """Compass heading of directions of motion in [0, 360), clockwise from north; from the image's top if None.

    Examples
    --------
    >>> heading_deg(np.array([0.0, np.pi / 2]), None).tolist()
    [90.0, 180.0]
    """
    return np.mod(np.degrees(direction_rad - (-np.pi / 2 if north_rad is None else north_rad)), 360.0)


def read_lens(layout: RunLayout) -> Lens:
    """The lens of ``camera.json``, or that by the given base image.

    Raises
    ------
    InputError
        The lens was not calibrated yet.
    """
    camera = _read(layout.camera, CameraRecord)
    return lens_from_record(_read(layout.map_lens, PolynomialLensRecord) if layout.map_lens.exists() else camera.lens)


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


def base_mesh_to_record(mesh: BaseMesh) -> OwnToBaseRecord:
    """The map from the own base image to the given one as a record for JSON."""
    transform, support = mesh.transform, mesh.support
    return OwnToBaseRecord(
        **polyprojective_to_record(transform.polyprojective).model_dump(),
        mesh=tuple(tuple((float(x), float(y)) for x, y in row) for row in transform.mesh),
        mesh_cell_px=transform.cell_size_px,
        position_sd_px=tuple(
            tuple(float(sd) if np.isfinite(sd) else None for sd in row) for row in np.round(support.sd_px, 4)
        ),
        own_width_px=support.width,
        own_height_px=support.height,
    )


@dataclass(frozen=True)
class BaseMap:
    """A map from one base image to the next, and its accuracy.

    ``sd_px`` is one figure, of the whole image, where it is not known by cell.
    """

    transform: PlaneTransform
    support: Support | None = None
    sd_px: float = 0.0

    def position_sd_px(self, xy: FloatArray) -> FloatArray:
        """Standard deviation (n,) of the mapped position of points (n, 2), px of the next image; NaN beyond support."""
        return np.full(len(xy), self.sd_px) if self.support is None else self.support.at(xy)


def _own_to_base(record: OwnToBaseRecord) -> BaseMap:
    polyprojective = polyprojective_from_record(record)
    if not record.mesh:
        return BaseMap(polyprojective)
    sd_px = np.array([[np.nan if sd is None else sd for sd in row] for row in record.position_sd_px], np.float32)
    return BaseMap(
        MeshedTransform(polyprojective, np.array(record.mesh), record.mesh_cell_px),
        Support(sd_px, record.own_width_px, record.own_height_px),
    )


def _base_maps(layout: RunLayout) -> tuple[BaseMap, ...]:
    """Maps from the image that frames are registered to on to base pixels, in order; mostly none."""
    maps = []
    if layout.own_to_base.exists():
        maps.append(_own_to_base(_read(layout.own_to_base, OwnToBaseRecord)))
    if layout.rebased.exists():
        record = _read(layout.rebased, RebaseRecord)
        maps.append(BaseMap(polyprojective_from_record(record.transform), sd_px=record.added_error_px))
    return tuple(maps)


@dataclass(frozen=True)
class FrameTransforms:
    """The transforms of all frames of a run, each read on demand."""

    width: int
    height: int
    lens: Lens
    base_maps: tuple[BaseMap, ...]
    """Applied after a frame's own: to a given base image, and from that to a newer one."""
    store: RegistrationStore
    config: RegistrationConfig
    _units: dict[str, tuple[int, NDArray[Any]]] = field(default_factory=dict, repr=False, compare=False)
    """By column, number of a unit of frames and its values: those read last."""
    _maps: dict[int, FrameMap] = field(default_factory=dict, repr=False, compare=False)
    """The transforms of the frames asked for last, of which a stage asks for each several times."""

    @classmethod
    def open(cls, layout: RunLayout, config: FlightConfig) -> "FrameTransforms":
        """The transforms of a run folder."""
        height, width = FrameStore(layout.frames).shape
        return cls(
            width=width,
            height=height,
            lens=read_lens(layout),
            base_maps=_base_maps(layout),
            store=RegistrationStore(layout.registration),
            config=config.registration,
        )

    def transform(self, frame: int) -> FrameMap | None:
        """The transform of one frame; None where it is not registered."""
        transform = self._maps.get(frame)
        if transform is None and (transform := self._read(frame)) is not None:
            if len(self._maps) >= _MAX_MAPS:
                self._maps.clear()
            self._maps[frame] = transform
        return transform

    def _read(self, frame: int) -> FrameMap | None:
        vector = self._vector(frame)
        if not np.isfinite(vector).all():
            return None
        transform: FrameMap = FrameTransform.from_vector(
            vector, width=self.width, height=self.height, lens=self.lens, config=self.config
        )
        for following in self.base_maps:
            transform = ComposedTransform(transform, following.transform)
        return transform

    def position_sd_px(self, frame: int, xy_raw: FloatArray) -> FloatArray:
        """Standard deviation (n,) of the base position of raw pixels (n, 2), base px.

        NaN where the frame is not registered, or no control points support its map: there it is an extrapolation.
        """
        points = as_points(xy_raw)
        vector = self._vector(frame)
        if not np.isfinite(vector).all():
            return np.full(len(points), np.nan)
        sd_px = sample_cells(self._of_frame("position_sd_px", frame), points, self.width, self.height)
        if not self.base_maps:
            return sd_px
        xy = FrameTransform.from_vector(
            vector, width=self.width, height=self.height, lens=self.lens, config=self.config
        ).to_base(points)
        for following in self.base_maps:
            scale = np.sqrt(np.abs(np.linalg.det(following.transform.jacobian(xy))))
            sd_px = np.hypot(sd_px * scale, following.position_sd_px(xy))
            xy = following.transform(xy)
        return sd_px

    def _vector(self, frame: int) -> FloatArray:
        return self._of_frame("vector", frame)

    def _of_frame(self, name: str, frame: int) -> NDArray[Any]:
        """A frame's values of a column, of which a unit is read at once."""
        unit, at = divmod(self.store.check_frame(frame), self.store.unit_frames)
        known = self._units.get(name)
        if known is None or known[0] != unit:
            start = unit * self.store.unit_frames
            known = self._units[name] = unit, self.store.column(name, start, start + self.store.unit_frames)
        return np.asarray(known[1][at])
