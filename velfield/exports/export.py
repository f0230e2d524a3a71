"""A run in the formats of other programs: `velfield export`.

A format is a module of this package, of the format's name, with what `ExportModule` lists. A new one is that module and
its line in `schemas.export`.
"""

from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from schemas.export import EXPORT_FORMATS, ExportOptions
from velfield.errors import InputError
from velfield.run.commits import write_atomically
from velfield.run.layout import to_path
from velfield.run.run import Run


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


def export_module(format_name: str) -> ExportModule:
    """The module of a format.

    Raises
    ------
    InputError
        There is no such format.
    """
    if format_name not in EXPORT_FORMATS:
        raise InputError(f"--format {format_name}: not known; expected one of {', '.join(EXPORT_FORMATS)}")
    return cast(ExportModule, import_module(f"velfield.exports.{format_name}"))


def export_run(run: Run, format_name: str, out: Path | None = None, options: ExportOptions | None = None) -> Path:
    """Write one export, whole or not at all; returns its path, by default in the run folder's ``exports/``.

    Raises
    ------
    InputError
        There is no such format, or it needs what the run does not have.
    """
    module = export_module(format_name)
    path = run.layout.root / "exports" / module.FILE_NAME if out is None else to_path(out)
    write_atomically(path, module.encode(run, path, options or ExportOptions()))
    return path
