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


class _Inside:
    """A path of a run folder, from its root."""

    def __init__(self, path: str) -> None:
        self._path = path
        self.top = path.partition("/")[0]

    def __get__(self, layout: "RunLayout", owner: type) -> Path:
        return layout.root / self._path


@dataclass(frozen=True)
class RunLayout:
    """Paths inside one run folder.

    Examples
    --------
    >>> RunLayout(Path("RUN")).camera.as_posix()
    'RUN/camera.json'
    """

    root: Path

    flight = _Inside("flight.json")
    frames = _Inside("frames.zarr")
    camera = _Inside("camera.json")
    map_lens = _Inside("base/lens.json")
    """The lens by matches with the given base image, where they decide for another than ``camera.json``."""
    base = _Inside("base")
    base_image = _Inside("base/base_image.png")
    base_image_tif = _Inside("base/base_image.tif")
    own_base_image = _Inside("base/own_base_image.png")
    """Median of the flight's own frames in the reference frame's grid; every frame is registered to it."""
    own_base_mask = _Inside("base/own_base_mask.png")
    """Valid pixels of the own base image."""
    base_features = _Inside("base/features.npz")
    """Key points and patches of the image that frames are registered to: each process would detect them again."""
    base_error_map = _Inside("base/error_map.png")
    """Cross-validated error of the registration to a given base image."""
    own_to_base = _Inside("base/own_to_base.json")
    """Own base pixels -> base pixels, where a base image was given."""
    rebased = _Inside("base/rebased.json")
    """Pixels of the base image before -> base pixels, where a result was mapped onto a new base image."""
    grid = _Inside("base/grid.json")
    georeference = _Inside("base/georeference.json")
    """Scale, north and place of the base image, and where each is from."""
    scale = _Inside("base/scale.json")
    """`georeference` once more, when the lengths of vehicles are known: it takes its place."""
    control_points = _Inside("base/control_points.json")
    """Ground control points, where `velfield georeference` was given some."""
    working = _Inside("base/working.json")
    """The grid that cars are detected on."""
    registration = _Inside("registration.zarr")
    detector = _Inside("detector.json")
    detections = _Inside("detections")
    weak_detections = _Inside("detections/weak")
    """Candidates of a lower score than a detection's, which tracks can confirm."""
    dimensions = _Inside("tracks/dimensions.parquet")
    """Dimensions of the vehicles, a row a track."""
    source_ids = _Inside("tracks/source_ids.csv")
    """The id of each track in the user's file, of tracks that were given."""
    track_positions = _Inside("tracks/positions")
    """Where each track's vehicle was in each frame, by unit."""
    doubtful = _Inside("tracks/doubtful")
    """Tracklets of doubtful tracks, by unit: what is probably no vehicle is in none of the other tables of tracks."""
    doubtful_positions = _Inside("tracks/doubtful/positions")
    """Where each of them was, by unit; with track -1, detections of a low score in no track."""
    joins = _Inside("tracks/joins.parquet")
    """Joins of tracks over a gap, with their probabilities."""
    tracklets = _Inside("tracklets")
    """Tracklets by unit, before those that share detections are chained into tracks."""
    tracks = _Inside("tracks")
    """Tracklets by unit, each with the track of the vehicle that it belongs to."""
    field = _Inside("field.zarr")
    intervals = _Inside("intervals")
    """Fields of time intervals, a store each."""
    maps = _Inside("maps")
    report = _Inside("index.html")
    view = _Inside("view")
    """Data of the viewer page beside the field's tiles."""
    view_record = _Inside("view/run.json")
    view_segments = _Inside("view/segments.zarr")
    """Segments of tracks, from one frame to the next."""
    view_changes = _Inside("view/change.zarr")
    """Layers of the change since another run, written by `velfield compare`."""
    report_record = _Inside("view/report.json")
    """The report's content, from which it is rendered."""
    analysis = _Inside("analysis")
    """Results of `velfield analyse`."""
    results = _Inside("results")
    """Results on other base images, a run folder each, by name."""
    results_index = _Inside("results.json")
    """Names of all results, this folder's own first."""
    commits = _Inside("commits")
    preview = _Inside(".preview")
    """Run folder of a map made before the run is through, while it is being made (`velfield.pipeline.preview`)."""
    clips = _Inside("source.clips")
    """List of several clips, the source of their run."""
    lock = _Inside(".lock")

    def __post_init__(self) -> None:
        object.__setattr__(self, "root", to_path(self.root))

    def unit_file(self, folder: Path, unit: int) -> Path:
        """File of one unit of frames in ``folder``.

        Examples
        --------
        >>> layout = RunLayout(Path("RUN"))
        >>> layout.unit_file(layout.detections, 3).as_posix()
        'RUN/detections/unit-00003.parquet'
        """
        return folder / f"unit-{unit:05d}.parquet"

    def foreign_names(self) -> list[str]:
        """Names in a local folder that `velfield run` did not make, sorted; none where it is a run's, or not there.

        Hidden and partial files are not among them: they are a system's, or of a run that ended before it wrote
        ``flight.json``.
        """
        if is_remote(self.root) or not self.root.is_dir() or self.flight.exists():
            return []
        own = {inside.top for inside in vars(type(self)).values() if isinstance(inside, _Inside)}
        names = (path.name for path in self.root.iterdir())
        return sorted(
            name for name in names if name not in own and not name.startswith(".") and not name.endswith(".partial")
        )

    @staticmethod
    def unit_files(folder: Path) -> list[Path]:
        """The files of all units of frames that are in ``folder``, in their order."""
        return sorted(folder.glob("unit-*.parquet"))
