"""Tracks of other programs: CSV in metres or pixels, geo-trax, highD and its kin, SUMO's FCD.

All become one table: ``track_id, frame, time_s``, and ``x_m, y_m`` or ``x_px, y_px``; y downwards as in an image, so
that an axis that points north is turned.
"""

import csv
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from velfield.errors import InputError

_NAMES: dict[str, tuple[str, ...]] = {
    "track": ("track_id", "vehicle_id", "trackid", "track", "id", "vehicle", "object_id", "recording_track_id"),
    "frame": ("frame", "frame_id", "frame_num", "frame_number"),
    "time_s": ("time_s", "time", "timestamp", "timestep_time", "timestamp_s", "global_time_s"),
    "time_ms": ("time_ms", "timestamp_ms"),
    "x_m": ("x_m", "xcenter", "local_x", "ortho_x", "utm_x", "x_utm", "east_m"),
    "y_m": ("y_m", "ycenter", "local_y", "ortho_y"),
    "y_up_m": ("north_m", "utm_y", "y_utm"),
    "x_px": ("x_px", "x_base_px", "x_image", "pixel_x"),
    "y_px": ("y_px", "y_base_px", "y_image", "pixel_y"),
    "x": ("x", "vehicle_x", "x_center"),
    "y": ("y", "vehicle_y", "y_center"),
    "width": ("width",),
    "height": ("height",),
    "length_m": ("length_m", "vehicle_length_m", "vehicle_length"),
    "width_m": ("width_m", "vehicle_width_m", "vehicle_width"),
}
Unit = Literal["m", "px"]
_SIZES_M = (0.3, 40.0)
"""A length or width beyond these is not one in metres: it is left out."""


def read_tracks(path: Path, *, fps: float | None = None, unit: Unit | None = None) -> pd.DataFrame:
    """Tracks of a file.

    Parameters
    ----------
    path
        CSV with a header (or ``.csv.gz``), Parquet with the same columns, or SUMO's FCD (``.xml``).
    fps
        Frames a second, where the file has frames and no times.
    unit
        Of columns named ``x`` and ``y``: metres or pixels.

    Returns
    -------
    DataFrame
        ``track_id`` (int) and ``source_id``, its name in the file, ``frame`` (int), ``time_s`` from 0 on, ``x_m, y_m``
        or ``x_px, y_px``; ``length_m, width_m`` of the vehicle where the file has them (NaN: not known); by track and
        time.

    Raises
    ------
    InputError
        A column is missing, a value is not a number, or the unit is not known.
    """
    if not path.is_file():
        raise InputError(f"{path}: not found; give a CSV, a Parquet file or SUMO's FCD with tracks")
    if path.suffix == ".xml":
        return _finish(_read_fcd(path), path)
    table = _read_parquet(path) if path.suffix == ".parquet" else _read_csv(path)
    columns = {_normal(name): str(name) for name in table.columns}
    found = {key: next((columns[n] for n in names if n in columns), None) for key, names in _NAMES.items()}
    out = pd.DataFrame({"track": _need(table, found["track"], "a column of the track", path)})
    out["time_s"], out["frame"] = _times(table, found, fps, path)
    _positions(table, found, unit, out, path)
    for name in ("length_m", "width_m"):
        if found[name] is not None:  # empty where it was not measured
            values = pd.to_numeric(table[found[name]], errors="coerce")
            out[name] = values.where((values > _SIZES_M[0]) & (values < _SIZES_M[1]))
    return _finish(out, path)


def _normal(name: object) -> str:
    return str(name).strip().lower().replace(" ", "_").replace("(m)", "m").replace("(px)", "px").strip("#")


def _read_parquet(path: Path) -> pd.DataFrame:
    try:
        return pd.read_parquet(path)
    except Exception as error:  # pyarrow's own kinds, some of which are OSError
        what = " ".join(str(error).split())[:160]
        raise InputError(f"{path}: this is no Parquet file that can be read ({what}); write it again") from None


def _read_csv(path: Path) -> pd.DataFrame:
    try:
        return pd.read_csv(path, sep=None, engine="python", skipinitialspace=True)
    except (ValueError, pd.errors.ParserError, csv.Error) as error:
        raise InputError(f"{path}: no table of tracks ({error}); expected a CSV with a header") from None


def _need(table: pd.DataFrame, name: str | None, what: str, path: Path) -> pd.Series:
    if name is None:
        raise InputError(
            f"{path}: found the columns {', '.join(map(str, table.columns[:12]))}, expected {what}; "
            "name them track_id, time_s (or frame), x_m, y_m (or x_px, y_px)"
        )
    return table[name]


def _numbers(series: pd.Series, path: Path) -> pd.Series:
    values = pd.to_numeric(series, errors="coerce")
    bad = ~np.isfinite(values.to_numpy(np.float64, na_value=np.nan))
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        found = series.iloc[[row]].tolist()[0]
        raise InputError(f"{path}: found {found!r} in column {series.name}, row {row + 2}, expected a number")
    return values


def _times(
    table: pd.DataFrame, found: dict[str, str | None], fps: float | None, path: Path
) -> tuple[pd.Series, pd.Series]:
    if found["time_s"] is not None and not pd.api.types.is_numeric_dtype(table[found["time_s"]]):
        stamps = pd.to_datetime(table[found["time_s"]], errors="coerce")
        if stamps.isna().any():
            raise InputError(f"{path}: column {found['time_s']} holds neither seconds nor times of day")
        seconds = (stamps - stamps.min()).dt.total_seconds()
    elif found["time_s"] is not None:
        seconds = _numbers(table[found["time_s"]], path)
    elif found["time_ms"] is not None:
        seconds = _numbers(table[found["time_ms"]], path) / 1000
    elif fps is None:
        _need(table, found["frame"], "a column of the time or of the frame", path)
        raise InputError(f"{path}: found frames and no times; give the frames a second with --fps")
    else:
        seconds = _numbers(_need(table, found["frame"], "a column of the frame", path), path) / fps
    seconds = seconds - seconds.min()
    if found["frame"] is not None:
        frame = _numbers(table[found["frame"]], path).astype(np.int64)
    else:
        frame = pd.Series(np.unique(seconds.round(4), return_inverse=True)[1], index=seconds.index)
    return seconds, frame - frame.min()


def _positions(
    table: pd.DataFrame, found: dict[str, str | None], unit: Unit | None, out: pd.DataFrame, path: Path
) -> None:
    for kind in ("m", "px"):
        x, y = found[f"x_{kind}"], found[f"y_{kind}"]
        if x is not None and y is not None:
            out[f"x_{kind}"], out[f"y_{kind}"] = _numbers(table[x], path), _numbers(table[y], path)
            return
    if found["x_m"] is not None and found["y_up_m"] is not None:
        out["x_m"], out["y_m"] = _numbers(table[found["x_m"]], path), -_numbers(table[found["y_up_m"]], path)
        return
    x_of, y_of = _need(table, found["x"], "x and y", path), _need(table, found["y"], "x and y", path)
    highway = found["width"] is not None and found["height"] is not None and "xvelocity" in map(_normal, table.columns)
    if unit is None and not highway:
        raise InputError(f"{path}: found columns x and y without a unit; say --unit m or --unit px")
    kind = unit or "m"
    out[f"x_{kind}"], out[f"y_{kind}"] = _numbers(x_of, path), _numbers(y_of, path)
    if highway:  # highD gives the upper left corner of the box
        out[f"x_{kind}"] += _numbers(table[str(found["width"])], path) / 2
        out[f"y_{kind}"] += _numbers(table[str(found["height"])], path) / 2


def _read_fcd(path: Path) -> pd.DataFrame:
    """Floating car data of SUMO: vehicles by time step; its y points north."""
    rows: list[tuple[str, float, float, float]] = []
    time = 0.0
    try:
        for event, element in ElementTree.iterparse(path, events=("start", "end")):
            if event == "start" and element.tag == "timestep":
                time = float(element.attrib["time"])
            elif event == "end" and element.tag == "vehicle":
                rows.append((element.attrib["id"], time, float(element.attrib["x"]), -float(element.attrib["y"])))
                element.clear()
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise InputError(
            f"{path}: no FCD output of SUMO ({error}); expected <timestep time><vehicle id x y/>"
        ) from None
    table = pd.DataFrame(rows, columns=["track", "time_s", "x_m", "y_m"])
    table["frame"] = np.unique(table["time_s"], return_inverse=True)[1] if len(table) else np.empty(0, np.int64)
    return table


def _finish(table: pd.DataFrame, path: Path) -> pd.DataFrame:
    if not len(table):
        raise InputError(f"{path}: no tracks in it; expected a row for each track and time")
    codes, _ = pd.factorize(table["track"], sort=False)
    table = table.assign(track_id=codes, source_id=table["track"].astype(str)).drop(columns="track")
    table["time_s"] -= table["time_s"].min()
    return table.sort_values(["track_id", "time_s"], kind="stable", ignore_index=True)
