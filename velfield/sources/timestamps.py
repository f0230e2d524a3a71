"""Frame times from a CSV: ``frame,time_s``."""

from pathlib import Path

import numpy as np

from schemas.arrays import FloatArray
from velfield.errors import InputError
from velfield.sources.table import number_cell, read_csv_rows

Times = dict[str, float]


def read_timestamps(path: Path) -> Times:
    """Read the time of each frame, s, of a CSV: ``frame`` (an image's name, or a video's 0-based index), ``time_s``.

    Raises
    ------
    InputError
        Other columns, a time that is no finite number, a frame named twice, an empty file.
    """
    times: Times = {}
    for line, row in read_csv_rows(path, required=("frame", "time_s"), what="time stamps"):
        name = row["frame"]
        if name in times:
            raise InputError(
                f"{path.name}: line {line}: found frame {name!r} a second time, expected each once; drop one"
            )
        times[name] = number_cell(path, line, row, "time_s")
    if not times:
        raise InputError(f"{path.name}: found no rows, expected one `frame,time_s` a frame; fill it, or give --fps")
    return times


def check_against_container(side_s: FloatArray, container_s: FloatArray, path: Path) -> None:
    """Refuse a CSV's times (n,) whose intervals disagree with those of the container's (n,) of the same frames, s.

    A constant offset is allowed: a CSV often counts from take-off.

    Raises
    ------
    InputError
        Some frame's time since the first differs by more than half of the median interval.
    """
    if side_s.size < 2:
        return
    difference = (side_s - side_s[0]) - (container_s - container_s[0])
    limit = 0.5 * float(np.median(np.abs(np.diff(container_s))))
    worst = int(np.argmax(np.abs(difference)))
    if limit > 0 and abs(difference[worst]) > limit:
        raise InputError(
            f"{path.name}: found frame {worst} {side_s[worst] - side_s[0]:.3f} s after the first, expected "
            f"{container_s[worst] - container_s[0]:.3f} s by the video's own times; omit --timestamps or fix it"
        )
