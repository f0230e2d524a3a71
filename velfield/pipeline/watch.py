"""Watched folders: flights and base images that arrive, complete when they no longer change.

A flight is a video, a folder of images, or a folder that holds ``frames/`` or one video and, beside it, the optional
inputs of `velfield run`, by name: ``base.*``, ``labels.csv`` or ``labels/``, ``timestamps.csv``, ``detector.json``,
``flight.yaml``. That is also what `velfield simulate` writes.
"""

import re
from collections.abc import Callable
from pathlib import Path

from schemas.job import Inputs
from velfield.errors import InputError
from velfield.sources.frames import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from velfield.sources.telemetry.find import TELEMETRY_SUFFIXES


def run_name(drop: Path) -> str:
    """Name of the run folder of a flight.

    Examples
    --------
    >>> run_name(Path("incoming/Main St. 4.mp4"))
    'Main-St-4'
    """
    stem = drop.stem if drop.suffix.lower() in VIDEO_SUFFIXES else drop.name
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", stem).strip("-")
    if not name:
        raise InputError(f"{drop}: its name has no letter or digit, and the run is named after it; rename it")
    return name


def is_flight(drop: Path) -> bool:
    """Whether what arrived is processed: a folder, or a file that is a video by its suffix.

    Examples
    --------
    >>> is_flight(Path("incoming/DJI_0001.MP4")), is_flight(Path("incoming/DJI_0001.SRT"))
    (True, False)
    """
    return drop.is_dir() or drop.suffix.lower() in VIDEO_SUFFIXES


def is_telemetry(drop: Path) -> bool:
    """Whether what arrived is a drone's metadata, which `velfield run` reads with the video of the same name.

    Examples
    --------
    >>> is_telemetry(Path("incoming/DJI_0001.SRT")), is_telemetry(Path("incoming/DJI_0001.LRF"))
    (True, False)
    """
    return drop.suffix.lower() in TELEMETRY_SUFFIXES


def inputs_of(drop: Path) -> tuple[Inputs, Path | None]:
    """The inputs of `velfield run` for a flight, and its configuration file.

    Raises
    ------
    InputError
        It is neither a video nor a folder of images.
    """
    if drop.is_file():
        return Inputs(source=str(drop)), None
    if not drop.is_dir():
        raise InputError(f"{drop} does not exist; drop a video or a folder")
    source = _source_in(drop)
    if source == drop:
        return Inputs(source=str(drop)), None
    beside = {
        "base": [path for path in sorted(drop.glob("base.*")) if path.suffix.lower() in IMAGE_SUFFIXES],
        "labels": [drop / "labels.csv", drop / "labels"],
        "timestamps": [drop / "timestamps.csv"],
        "detector": [drop / "detector.json"],
    }
    found = {name: [str(path) for path in paths if path.exists()] for name, paths in beside.items()}
    given, config = {name: paths[0] for name, paths in found.items() if paths}, drop / "flight.yaml"
    return Inputs.model_validate({"source": str(source), **given}), config if config.exists() else None


def _source_in(drop: Path) -> Path:
    if (drop / "frames").is_dir():
        return drop / "frames"
    videos = [path for path in sorted(drop.iterdir()) if path.suffix.lower() in VIDEO_SUFFIXES]
    if len(videos) > 1:
        raise InputError(f"{drop}: found {len(videos)} videos; drop one flight at a time")
    return videos[0] if videos else drop


def run_folders(runs: Path, name: str = "") -> list[Path]:
    """Finished runs in a folder of run folders; only that of a name where one is given.

    Raises
    ------
    InputError
        The name is no plain name, or no run of that name is there.
    """
    if name:
        root = _inside(runs, name)
        if not (root / "flight.json").exists():
            raise InputError(f"{root} is not a run folder; the runs are {', '.join(p.name for p in run_folders(runs))}")
        return [root]
    return sorted(path.parent for path in runs.glob("*/flight.json") if (path.parent / "index.html").exists())


def find_image(folder: Path, name: str) -> Path:
    """The path of an image that arrived in a folder, by its name.

    Raises
    ------
    InputError
        It is not in that folder.
    """
    path = _inside(folder, name)
    if not path.is_file():
        raise InputError(f"{path} does not exist; base images are taken from {folder} only")
    return path


def newest_image(folder: Path) -> Path | None:
    """The image that arrived last; none where there is none."""
    found = [path for path in folder.glob("*") if path.is_file() and path.suffix.lower() in IMAGE_SUFFIXES]
    return max(found, key=lambda path: (path.stat().st_mtime, path.name), default=None)


def _inside(folder: Path, name: str) -> Path:
    """The path in a folder by its name or in full; never outside of it, by ``..`` or by a link."""
    path = (folder / name).resolve()
    if path.parent != folder.resolve():
        raise InputError(f"{name!r} is not in {folder}; give the name of a file or folder in it")
    return path


class FolderWatcher:
    """Calls back for each entry of a folder when it has not changed for a while, and again after it was replaced."""

    def __init__(
        self, folder: Path, settle_s: float, callback: Callable[[Path], None], *, include_existing: bool
    ) -> None:
        self._folder, self._settle_s, self._callback = folder, settle_s, callback
        self._done = {} if include_existing else {path: _changed_at(path) for path in self._entries()}
        self._seen: dict[Path, tuple[tuple[int, int, int], float]] = {}

    def poll(self, now_s: float) -> None:
        """Check the folder once; ``now_s`` is any monotonic clock."""
        for path in self._entries():
            changed_at = _changed_at(path)
            if changed_at == self._done.get(path):
                continue
            state = _state(path)
            before, since_s = self._seen.get(path, (None, now_s))
            if state != before:
                self._seen[path] = (state, now_s)
            elif now_s - since_s >= self._settle_s:
                self._done[path] = changed_at
                self._callback(path)

    def _entries(self) -> list[Path]:
        return sorted(path for path in self._folder.iterdir() if not path.name.startswith("."))


def _changed_at(path: Path) -> tuple[int, int]:
    """Which file or folder this is, and its last change, of a folder by what is directly in it."""
    found = path.stat()
    return found.st_ino, found.st_mtime_ns


def _state(path: Path) -> tuple[int, int, int]:
    """Number, bytes and last change of the files of an entry: what grows while it is being copied."""
    files = [found.stat() for found in (path.rglob("*") if path.is_dir() else (path,)) if found.is_file()]
    return len(files), sum(stat.st_size for stat in files), max((stat.st_mtime_ns for stat in files), default=0)
