"""``flight.json``: the resolved flight of a run folder, of the present format."""

import json
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from schemas.records import FORMAT_VERSION, FlightRecord
from velfield.errors import InputError, one_line
from velfield.run.commits import read_sealed
from velfield.run.layout import RunLayout, check_store, is_remote

_MAX_ENTRIES = 1000


def suggest_run(root: Path) -> str:
    """Suggest what to do with a folder that is not a run: use the runs inside it, else make one."""
    folders = sorted(root.iterdir())[:_MAX_ENTRIES] if not is_remote(root) and root.is_dir() else []
    runs = [str(folder) for folder in folders if RunLayout(folder).flight.exists()]
    if runs:
        return f"it holds {'a run' if len(runs) == 1 else 'runs'}: give {' or '.join(runs[:3])}"
    return f"make one with `velfield run ... --out {root}`"


def read_flight_record(root: Path) -> FlightRecord:
    """The flight of a run folder.

    Raises
    ------
    InputError
        The folder is not a run folder, or one of another format.
    """
    layout = RunLayout(root)
    if not layout.flight.exists():
        raise InputError(f"{root} is not a run folder: it has no flight.json; {suggest_run(root)}")
    record = _parse(layout.flight)
    version = record.get("format_version")
    if version != FORMAT_VERSION:
        raise InputError(
            f"{root} is a run folder of format {version}, this velfield reads format {FORMAT_VERSION}; run the flight "
            "again into a new folder"
        )
    try:
        return FlightRecord.model_validate_json(json.dumps(record))
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(
            f"{layout.flight}: {'.'.join(map(str, first['loc']))} is not valid in this version of velfield "
            f"({first['msg'].lower()}); run the flight again with the same command"
        ) from None


def check_format(root: Path) -> None:
    """Refuse to work on a run folder of another format; a folder that is none, or not there, passes, and so does one
    whose record is damaged: it is written again, and what is finished is known by content keys.

    Raises
    ------
    InputError
        One line: the format found, or the bucket that is not there, and what to do.
    """
    path = RunLayout(root).flight
    check_store(path)
    if not path.exists():
        return
    try:
        version = _parse(path).get("format_version")
    except InputError:
        return
    if version == FORMAT_VERSION:
        return
    raise InputError(
        f"{root} is a run folder of format {version}; this velfield continues runs of format {FORMAT_VERSION} only: "
        "give another --out"
    )


def _parse(path: Path) -> dict[str, Any]:
    try:
        return read_sealed(path.read_bytes())
    except ValueError as error:
        raise InputError(
            f"{path} is damaged ({one_line(error)}), expected the record that `velfield run` wrote; the "
            "same `velfield run` command writes it again and keeps what is finished"
        ) from None


def source_name(path: str, kind: str) -> str:
    """The name of a video; of a folder, or of a list of clips, with its parent's: it may well be called ``frames``.

    Examples
    --------
    >>> source_name("/flights/street.mp4", "video"), source_name("/flights/street/frames", "folder")
    ('street.mp4', 'street/frames')
    """
    source = Path(path)
    parts = [part for part in source.parts if part != source.anchor]
    return "/".join(parts[-2:] if kind == "folder" or source.suffix == ".clips" else parts[-1:])
