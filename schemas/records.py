"""Records that a run leaves: a commit a finished unit, the resolved flight, the grid of the base image."""

from typing import Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from schemas.flight import FlightConfig
from schemas.job import Inputs
from schemas.model import Model

FORMAT_VERSION = 1
"""Version of the run folder's layout."""


class SealedRecord(Model):
    """A record that its file holds together with a digest of it, so that a damaged one is known."""

    digest: str | None = None
    """BLAKE2b digest of all other keys."""


class CommitRecord(SealedRecord):
    """A finished unit of work: written last of all, so that what it names is whole."""

    stage: str
    unit: str
    key: str
    """Content key: digests of the inputs, the parameters that the stage reads, the version of the stage's code."""
    outputs: dict[str, str] = Field(default_factory=dict)
    """Path in the run folder -> BLAKE2b digest, of every file and every chunk of a store that the unit wrote."""
    counts: dict[str, float] = Field(default_factory=dict)
    """Counts of the unit: frames, cars, tracklets, pixels."""
    notes: tuple[str, ...] = ()
    """Remarks on the unit, one line each."""
    warnings: tuple[str, ...] = ()
    """Warnings, one line each."""
    seconds: float = Field(0.0, ge=0)
    code_version: str


class SourceRecord(Model):
    """Where the frames came from."""

    path: str
    kind: str
    digest: str
    width: PositiveInt
    height: PositiveInt
    frame_count: NonNegativeInt

    @property
    def of_tracks(self) -> bool:
        """Whether it is a file of tracks (`velfield run --tracks`), which has no frames."""
        return self.kind == "tracks"


class InputsRecord(Model):
    """Digests of what the user gave; ``None`` where nothing was given."""

    source: SourceRecord
    base: str | None = None
    labels: str | None = None
    detector: str | None = None
    detections: str | None = None
    timestamps: str | None = None
    telemetry: str | None = None


class FlightRecord(SealedRecord):
    """``flight.json``: the resolved configuration, the inputs' digests, the version of the code."""

    format_version: PositiveInt = FORMAT_VERSION
    code_version: str
    config: FlightConfig
    inputs: InputsRecord
    given: Inputs | None = None
    """Where the inputs were, absolute: what ``verify --repair`` and ``reprocess`` work on again."""
    keys: dict[str, str] = Field(default_factory=dict)
    """Content key of each stage, in the order of the work."""


class GridRecord(Model):
    """``base/grid.json``: the grid of base pixels and how it came about."""

    width_px: PositiveInt
    height_px: PositiveInt
    origin_x_px: float = 0.0
    """Column that base pixel (0, 0) has on the reference frame's undistorted grid, or of tracks in metres on the grid
    whose pixel (0, 0) is at x = y = 0; 0 where a base image was given."""
    origin_y_px: float = 0.0
    gsd_m: PositiveFloat | None = None
    """Metres a base pixel; none: not known, all stays in px/s."""
    crs_wkt: str | None = None
    affine: tuple[float, float, float, float, float, float] | None = None
    """Base pixel (column, row) -> CRS coordinates, GDAL's corner convention, as rasterio's ``Affine``."""
    north_rad: float | None = None
    """Direction of true north, from +x towards +y (down), where it is known without a reference system."""
    base_source: Literal["flight", "given", "tracks"]
    """``flight``: the base image is built from the flight; ``given``: it is the image given as ``--base``; ``tracks``:
    it is drawn from tracks in metres."""
    registered_to: Literal["flight", "given"] = "flight"
    """Image that frames are registered to: the base image built from the flight, or directly the given one."""
    reference_frame: NonNegativeInt
    intersensor_error_px: float | None = None
    """Mean error at left-out points of the registration to the given picture."""
    intersensor_points: NonNegativeInt | None = None


class PolyprojectiveRecord(Model):
    """A second-order polyprojective transform: three rows of six coefficients on normalised coordinates."""

    coefficients: tuple[tuple[float, float, float, float, float, float], ...] = Field(min_length=3, max_length=3)
    source: tuple[float, float, float]
    """Normalisation of what goes in: centre x, y, and scale."""
    target: tuple[float, float, float]
    """Normalisation of what comes out."""


class OwnToBaseRecord(PolyprojectiveRecord):
    """``base/own_to_base.json``: the flight's own base image to the given one, polyprojective and mesh."""

    mesh: tuple[tuple[tuple[float, float], ...], ...] = ()
    """Displacement at the centres of cells of the own base image, rows of (x, y), px of the given one; none: zero."""
    mesh_cell_px: PositiveInt = 1
    """Side of a cell, px of the own base image."""
    position_sd_px: tuple[tuple[float | None, ...], ...] = ()
    """Standard deviation of the map in cells over the own base image, px of the given one; null where it has no control
    points."""
    own_width_px: PositiveInt = 1
    own_height_px: PositiveInt = 1


class RebaseRecord(Model):
    """``base/rebased.json``: how a run's result was mapped onto a new base image."""

    transform: PolyprojectiveRecord
    """Old base pixels -> new base pixels."""
    added_error_px: float
    """Mean error of that map at control points left out of its fit, px of the new base image."""
    added_error_95_px: float
    """95 of 100 left-out points are nearer than this."""
    points: NonNegativeInt
    scale: PositiveFloat
    """New base pixels an old one, at the middle."""
    rotation_rad: float
    old_base: str
    """Content key of the base image that it was mapped from."""
    gsd_m: PositiveFloat | None = None
    """Metres a pixel of the new base image."""

    def text(self) -> str:
        """How it was done, and what error that adds, in one line."""
        return (
            f"mapped from the base image before, no frame looked at again; adds {self.added_error_px:.2f} px of error "
            f"(95 % below {self.added_error_95_px:.2f} px, {self.points} left-out points)"
        )


class ResultRecord(Model):
    """One result of a run folder."""

    name: str
    path: str
    """Its run folder, from the first one's."""
    base: str | None
    """The base image's path as given; none: built from the flight."""
    base_digest: str | None
    how: Literal["run", "mapped", "registered again"]
    added_error_px: float | None = None
    created: str


class ResultsRecord(SealedRecord):
    """``results.json``: the results of one flight on several base images, the first one first."""

    results: tuple[ResultRecord, ...]


class WorkingRecord(Model):
    """``base/working.json``: the detection grid, and what the detector was trained on."""

    scale: PositiveFloat
    """Working pixels a base pixel: a car is about ``working_car_length_px`` long on that grid."""
    training_source: str
    """``labels``, ``file`` (a detector file), ``shipped`` or ``detections`` (another detector's boxes)."""
    labels: NonNegativeInt = 0
    """Training labels of the detector."""
    vehicle_gsd_m: PositiveFloat | None = None
    """Metres a base pixel by the median length of labels or boxes, or by the scale at which the detector finds cars,
    where nothing else gives it:
    good enough for the limits of tracking."""
