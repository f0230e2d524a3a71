"""Paths of a run folder (the contract of outputs).

Paths of a run folder, on a disk or on S3: the operations that differ between the two.

By hand, as neither pathlib, fsspec nor universal-pathlib has them: renaming a tree of objects with a chosen one last,
copying many objects in one call, and files for libraries that open by name. The S3 paths are `velfield.run.s3`.
"""

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, TypeGuard, cast

from velfield.errors import InputError

if TYPE_CHECKING:
    from velfield.run.s3 import S3ObjectPath


def to_path(path: str | Path) -> Path:
    """The path to work with: of ``s3://``, a `velfield.run.s3.S3ObjectPath`, typed as the `Path` whose methods it has.

    Raises
    ------
    InputError
        It is on S3, and the extra is not installed.
    """
    text = str(path)
    if not text.startswith("s3:/"):
        return Path(path)
    if find_spec("s3fs") is None or find_spec("upath") is None:
        raise InputError(f"{text}: a run folder on s3:// needs s3fs; pip install 'velfield[s3]'")
    from velfield.run.s3 import s3_path  # the extra

    return cast(Path, s3_path(text))


def is_remote(path: object) -> "TypeGuard[S3ObjectPath]":
    """Whether a path is not on this machine."""
    return not isinstance(path, Path)


def check_store(path: Path) -> None:
    """Refuse a path in a bucket that is not there, before anything is read or written; on a disk all paths pass.

    Raises
    ------
    InputError
        There is no such bucket.
    """
    if not is_remote(path):
        return
    bucket, _, prefix = path.path.partition("/")
    try:
        path.fs.call_s3("list_objects_v2", Bucket=bucket, Prefix=prefix, MaxKeys=1)
    except FileNotFoundError:
        raise InputError(
            f"{path}: the bucket {bucket} does not exist; create it (`aws s3 mb s3://{bucket}`) or correct the address"
        ) from None


def remove_tree(path: Path) -> None:
    """Remove a folder and all in it, if it exists."""
    if not is_remote(path):
        shutil.rmtree(path, ignore_errors=True)
    elif path.exists():
        path.fs.rm(path.path, recursive=True)


def copy_objects(pairs: Sequence[tuple[Path, Path]]) -> None:
    """Copy objects within the store, many at once: no byte of them comes to this machine."""
    remote = [(source, target) for source, target in pairs if is_remote(source) and is_remote(target)]
    if remote:
        sources, targets = zip(*((source.path, target.path) for source, target in remote), strict=True)
        remote[0][0].fs.copy(list(sources), list(targets))


def rename_tree(source: Path, target: Path, *, last: str) -> None:
    """Rename a folder: on a disk in one step, on S3 object by object.

    There ``last``, a file of the folder, is copied after all others: a folder that has it is whole.
    """
    if not is_remote(source):
        source.rename(target)
        return
    names = [key.removeprefix(f"{source.path}/") for key in source.fs.find(source.path)]
    pairs = {name: (cast(Path, source / name), target / name) for name in names}
    final = pairs.pop(last)
    copy_objects(list(pairs.values()))
    copy_objects([final])
    remove_tree(cast(Path, source))


@contextmanager
def local_copy(path: Path) -> Iterator[Path]:
    """A file that libraries can open by name: the path itself, or a copy of the object while the context lasts."""
    if not is_remote(path):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        local = Path(folder) / path.name
        local.write_bytes(path.read_bytes())
        yield local


@contextmanager
def local_output(path: Path) -> Iterator[Path]:
    """A file that libraries can write by name; at the end of the context the object is written from it, whole."""
    if not is_remote(path):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        local = Path(folder) / path.name
        yield local
        path.write_bytes(local.read_bytes())


@dataclass(frozen=True)
class RunLayout:
    """Paths inside one run folder.

    Examples
    --------
    >>> RunLayout(Path("RUN")).camera.as_posix()
    'RUN/camera.json'
    """

    root: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "root", to_path(self.root))

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
    def map_lens(self) -> Path:
        """The lens by matches with the given base image, where they decide for another than ``camera.json``."""
        return self.base / "lens.json"

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
    def base_features(self) -> Path:
        """Key points and patches of the image that frames are registered to: each process would detect them again."""
        return self.base / "features.npz"

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
    def georeference(self) -> Path:
        """Scale, north and place of the base image, and where each is from."""
        return self.base / "georeference.json"

    @property
    def scale(self) -> Path:
        """`georeference` once more, when the lengths of vehicles are known: it takes its place."""
        return self.base / "scale.json"

    @property
    def control_points(self) -> Path:
        """Ground control points, where `velfield georeference` was given some."""
        return self.base / "control_points.json"

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
    def weak_detections(self) -> Path:
        """Candidates of a lower score than a detection's, which tracks can confirm."""
        return self.detections / "weak"

    @property
    def dimensions(self) -> Path:
        """Dimensions of the vehicles, a row a track."""
        return self.tracks / "dimensions.parquet"

    @property
    def track_positions(self) -> Path:
        """Where each track's vehicle was in each frame, by unit."""
        return self.tracks / "positions"

    @property
    def joins(self) -> Path:
        """Joins of tracks over a gap, with their probabilities."""
        return self.tracks / "joins.parquet"

    @property
    def tracklets(self) -> Path:
        """Tracklets by unit, before those that share detections are chained into tracks."""
        return self.root / "tracklets"

    @property
    def tracks(self) -> Path:
        """Tracklets by unit, each with the track of the vehicle that it belongs to."""
        return self.root / "tracks"

    @property
    def field(self) -> Path:
        return self.root / "field.zarr"

    @property
    def intervals(self) -> Path:
        """Fields of time intervals, a store each."""
        return self.root / "intervals"

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
    def analysis(self) -> Path:
        """Results of `velfield analyse`."""
        return self.root / "analysis"

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
    def preview(self) -> Path:
        """Run folder of a map made before the run is through, while it is being made (`velfield.pipeline.preview`)."""
        return self.root / ".preview"

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
