"""A run in the formats of other programs: `velfield export`.

A format is a module of the format's name, in one of the packages here, with what `ExportModule` lists; one whose files
do not fit into memory has ``write(run, path, options, progress)`` in place of ``encode``. A new one is that module and
its line in `schemas.export`.
"""

import io
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, cast

from schemas.export import EXPORT_FORMATS, ExportOptions
from velfield.errors import InputError
from velfield.run.commits import write_atomically
from velfield.run.layout import is_remote, to_path
from velfield.run.run import Run

_PACKAGES = ("gis", "junctions", "pictures", "roads", "tracks")


class ExportModule(Protocol):
    """An export format."""

    FILE_NAME: str
    """Its usual file name."""

    def encode(self, run: Run, path: Path, options: ExportOptions) -> bytes:
        """The file's content.

        Parameters
        ----------
        run
            A finished run.
        path
            The file that will be written, for formats that refer to others by relative paths.
        options
            The user's options.

        Raises
        ------
        InputError
            The format needs what the run does not have: metres, coordinates.
        """


Progress = Callable[[int, int], None]
"""Called with the steps done and their number."""


def zip_bytes(texts: Mapping[str, str]) -> bytes:
    """Texts by the names of their files as a ZIP archive, the same bytes for the same texts."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), text, zipfile.ZIP_DEFLATED)
    return out.getvalue()


def start_time(run: Run, options: ExportOptions) -> datetime:
    """When the flight began: by ``--start``, else by what the camera wrote, else 1970."""
    return options.start or (run.start.time if run.start else datetime(1970, 1, 1, tzinfo=UTC))


def export_module(format_name: str) -> ExportModule:
    """The module of a format.

    Raises
    ------
    InputError
        There is no such format.
    """
    if format_name not in EXPORT_FORMATS:
        raise InputError(f"--format {format_name}: not known; expected one of {', '.join(EXPORT_FORMATS)}")
    names = (f"velfield.exports.{package}.{format_name}" for package in _PACKAGES)
    return cast(ExportModule, import_module(next(name for name in names if find_spec(name))))


def export_run(
    run: Run,
    format_name: str,
    out: Path | None = None,
    options: ExportOptions | None = None,
    progress: Progress = lambda done, total: None,
) -> Path:
    """Write one export, whole or not at all; returns its path, by default in the run folder's ``exports/``.

    Raises
    ------
    InputError
        There is no such format, it needs what the run does not have, or a file is where a folder is expected.
    """
    module = export_module(format_name)
    path = run.layout.root / "exports" / module.FILE_NAME if out is None else to_path(out)
    if not is_remote(path) and (files := [above for above in path.parents if above.is_file()]):
        raise InputError(f"--out {path}: {files[0]} is a file, expected a folder")
    write = getattr(module, "write", None)
    if write is None:
        write_atomically(path, module.encode(run, path, options or ExportOptions()))
    else:
        _write_stream(write, run, path, options or ExportOptions(), progress)
    return path


def _write_stream(write: Any, run: Run, path: Path, options: ExportOptions, progress: Progress) -> None:
    """Write a file that is too large for memory: beside its place, which it takes when it is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=None if is_remote(path) else path.parent) as folder:
        partial = Path(folder) / path.name
        write(run, partial, options, progress)
        if is_remote(path):
            path.write_bytes(partial.read_bytes())
        else:
            partial.replace(path)
