"""Paths of a run folder (the contract of outputs)."""

from dataclasses import dataclass
from pathlib import Path

from schemas.records import FORMAT_VERSION
from schemas.renames import OLD_FOLDERS
from velfield.run.paths import to_path


@dataclass(frozen=True)
class RunLayout:
    """Paths inside one run folder.

    Examples
    --------
    >>> RunLayout(Path("RUN")).camera.as_posix()
    'RUN/camera.json'
    """

    root: Path
    format_version: int = FORMAT_VERSION
    """Of the folder: in format 1 some folders have other names (`schemas.renames.OLD_FOLDERS`)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "root", to_path(self.root))

    def stored_name(self, name: str) -> str:
        """The name that this folder's format has for a stage or a folder.

        Examples
        --------
        >>> RunLayout(Path("RUN")).stored_name("tracks"), RunLayout(Path("RUN"), 1).stored_name("tracks")
        ('tracks', 'tracklets')
        """
        return name if self.format_version == FORMAT_VERSION else OLD_FOLDERS.get(name, name)

    @property
    def flight(self) -> Path:
        return self.root / "flight.json"

    @property
    def frames(self) -> Path:
        return self.root / "frames.zarr"

    @property
    def camera(self) -> Path:
        return self.root / "camera.json"

    @property
    def base(self) -> Path:
        return self.root / "base"

    @property
    def base_image(self) -> Path:
        return self.base / "base_image.png"

    @property
    def base_image_tif(self) -> Path:
        return self.base / "base_image.tif"

    @property
    def own_base_image(self) -> Path:
        """Median of the flight's own frames in the reference frame's grid; every frame is registered to it."""
        return self.base / "own_base_image.png"

    @property
    def own_base_mask(self) -> Path:
        """Valid pixels of the own base image."""
        return self.base / "own_base_mask.png"

    @property
    def base_error_map(self) -> Path:
        """Cross-validated error of the registration to a given base image."""
        return self.base / "error_map.png"

    @property
    def own_to_base(self) -> Path:
        """Own base pixels -> base pixels, where a base image was given."""
        return self.base / "own_to_base.json"

    @property
    def rebased(self) -> Path:
        """Pixels of the base image before -> base pixels, where a result was mapped onto a new base image."""
        return self.base / "rebased.json"

    @property
    def grid(self) -> Path:
        return self.base / "grid.json"

    @property
    def background(self) -> Path:
        return self.base / "background.npz"

    @property
    def working(self) -> Path:
        """The grid that cars are detected on."""
        return self.base / "working.json"

    @property
    def registration(self) -> Path:
        return self.root / "registration.zarr"

    @property
    def detector(self) -> Path:
        return self.root / "detector.json"

    @property
    def detections(self) -> Path:
        return self.root / "detections"

    @property
    def tracklets(self) -> Path:
        """Tracklets by unit, before those that share detections are chained into tracks."""
        return self.root / self.stored_name("tracklets")

    @property
    def tracks(self) -> Path:
        """Tracklets by unit, each with the track of the vehicle that it belongs to."""
        return self.root / self.stored_name("tracks")

    @property
    def field(self) -> Path:
        return self.root / "field.zarr"

    @property
    def intervals(self) -> Path:
        """Fields of time intervals, a store each."""
        return self.root / self.stored_name("intervals")

    @property
    def maps(self) -> Path:
        return self.root / "maps"

    @property
    def report(self) -> Path:
        return self.root / "index.html"

    @property
    def view(self) -> Path:
        """Data of the viewer page beside the field's tiles."""
        return self.root / "view"

    @property
    def view_record(self) -> Path:
        return self.view / "run.json"

    @property
    def view_segments(self) -> Path:
        """Segments of tracks, from one frame to the next."""
        return self.view / "segments.zarr"

    @property
    def view_changes(self) -> Path:
        """Layers of the change since another run, written by `velfield compare`."""
        return self.view / "change.zarr"

    @property
    def report_record(self) -> Path:
        """The report's content, from which it is rendered."""
        return self.view / "report.json"

    @property
    def results(self) -> Path:
        """Results on other base images, a run folder each, by name."""
        return self.root / "results"

    @property
    def results_index(self) -> Path:
        """Names of all results, this folder's own first."""
        return self.root / "results.json"

    @property
    def commits(self) -> Path:
        return self.root / "commits"

    @property
    def lock(self) -> Path:
        return self.root / ".lock"

    def unit_file(self, folder: Path, unit: int, suffix: str) -> Path:
        """File of one unit of frames in ``folder``.

        Examples
        --------
        >>> layout = RunLayout(Path("RUN"))
        >>> layout.unit_file(layout.detections, 3, ".parquet").as_posix()
        'RUN/detections/unit-00003.parquet'
        """
        return folder / f"unit-{unit:05d}{suffix}"
