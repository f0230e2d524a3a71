"""``velfield lineage``: the lineage of a run, or of one pixel of its field."""

from typing import Annotated

from cyclopts import Parameter

from flows.options import RunFolder
from velfield.errors import InputError


def lineage(
    run_folder: RunFolder,
    x: str | None = None,
    y: int | None = None,
    /,
    *,
    pixel: str | None = None,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> int:
    """Print the tracklets, frames, detector and base image behind a pixel; without a pixel, the stages of the run.

    Parameters
    ----------
    x
        Column of the pixel, base pixels; or X,Y.
    y
        Row of the pixel, base pixels.
    pixel
        The pixel as X,Y.
    as_json
        Print JSON instead of text.
    """
    from velfield.run.lineage import describe_lineage, describe_pixel, pixel_lineage, stage_lineage
    from velfield.run.run import open_run

    where = _pixel(x, y, pixel)
    run = open_run(run_folder)
    run.require_frames()
    if where is None:
        print(_json(stage_lineage(run)) if as_json else describe_lineage(run))
    else:
        found = pixel_lineage(run, *where)
        print(_json(found) if as_json else describe_pixel(run, found))
    return 0


def _pixel(x: str | None, y: int | None, text: str | None) -> tuple[int, int] | None:
    given = [str(part) for part in (x, y, text) if part is not None]
    if not given:
        return None
    parts = ",".join(given).split(",")
    if len(parts) != 2 or not all(part.strip().removeprefix("-").isdigit() for part in parts):
        raise InputError(f"{' '.join(given)}: not a pixel; give two whole numbers, X Y or X,Y")
    return int(parts[0]), int(parts[1])


def _json(found: object) -> str:
    import dataclasses
    import json

    return json.dumps(found, default=lambda value: dataclasses.asdict(value), indent=1)
