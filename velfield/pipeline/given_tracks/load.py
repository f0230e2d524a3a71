"""`load_tracks`: tracks of another program, checked, smoothed and laid on base pixels, for `run` and `analyse`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from rasterio.crs import CRS

from schemas.arrays import FloatArray, IntArray
from schemas.flight import FlightConfig
from velfield.analysis.speed_changes import PLAUSIBLE_M_PER_S2, check_times
from velfield.analysis.trajectories import make_trajectories
from velfield.errors import InputError
from velfield.sources.geo import BaseRaster, read_base_raster, reconcile_gsd, true_north_rad
from velfield.sources.tracks.checks import check_motion, check_speeds, check_standing_gaps, split_reused
from velfield.sources.tracks.read import GivenPositions, read_tracks
from velfield.tracking.smoothing import LEAST_ERROR_M, clean_tracks

GSD_M = 0.2
"""Base pixels of tracks given in metres, where --gsd-m does not say."""
MARGIN_M = 10.0
"""Least margin around the positions, where no base image is given."""
LATTICE_PX = 50
"""Maps of tracks in metres begin and end at multiples of so many pixels from x = y = 0: two files of one place lie on
one grid."""
_STEP_S = 0.2
_CHECKED_TRACKS = 500
SIZE_SD_M = 0.1
"""Standard deviation of lengths and widths that a file gives."""
_INSIDE = 0.5
"""Fewer positions within the base image are of another image."""


@dataclass(frozen=True)
class LoadedTracks:
    """Tracks of a file on a grid of base pixels."""

    table: pd.DataFrame
    """``track_id, frame, time_s, x_px, y_px``, smoothed, by track and time; and ``length_m``, ``width_m`` where the
    file has them."""
    names: pd.Series
    """Name of each track in the file, by ``track_id``; ``NAME (2)`` of the second part of one that was cut."""
    shape: tuple[int, int]
    gsd_m: float
    """(height, width) of the grid, px, and metres a pixel."""
    origin_px: tuple[float, float] | None
    """Pixels from x = y = 0 of the file to base pixel (0, 0), to the right and down; None of positions in pixels."""
    base: BaseRaster | None
    """The base image that was given."""
    crs_wkt: str | None
    affine: tuple[float, float, float, float, float, float] | None
    """Reference system of the grid and (column, row) of pixel corners to its coordinates: a UTM zone where the file has
    degrees, else that of the base image; None without one."""
    north_rad: float | None
    """Direction of north on the grid, from x towards y (down): of true north by the reference system, else of the grid
    of the file's map, up to some 3 degrees from it; None: not known."""
    position_sd_m: float
    displacement_sd_m: float
    """Standard deviations of a smoothed position, and of a displacement from one position to the next, along one
    axis."""
    notes: tuple[str, ...]
    """Notes on what was read and done, one line each."""

    def sizes_m(self, track_id: IntArray) -> FloatArray:
        """Length and width (n, 2), m, medians over each of the tracks (n,); NaN where the file does not have them."""
        by_track = self.table.groupby("track_id")
        known = [by_track[name].median() for name in ("length_m", "width_m") if name in self.table]
        columns = [one.reindex(track_id).to_numpy(np.float64) for one in known]
        return np.column_stack([*columns, *[np.full(len(track_id), np.nan)] * (2 - len(columns))])

    @property
    def xy_m(self) -> FloatArray:
        """(n, 2) positions, m, from the centre of base pixel (0, 0) to the right and down."""
        return self.table[["x_px", "y_px"]].to_numpy(np.float64) * self.gsd_m


def load_tracks(path: Path, config: FlightConfig, *, base: Path | None = None) -> LoadedTracks:
    """Read tracks of another program, check and smooth them, and lay them on base pixels.

    Parameters
    ----------
    path
        See `velfield.sources.tracks.read.read_tracks`.
    config
        ``gsd_m``, ``position_unit``, ``position_y_axis`` and ``frames.fps`` are used.
    base
        The image whose pixels the positions are.

    Raises
    ------
    InputError
        No tracks, no scale, positions outside the base image, or speeds that contradict the file or the vehicles.
    """
    unit = config.position_unit or ("px" if base else None)
    given = read_tracks(path, fps=config.frames.fps, unit=unit, y_axis=config.position_y_axis)
    raster = read_base_raster(base, config.frames) if base else None
    if given.unit == "m" and raster is not None:
        raise InputError(f"{path}: found metres and --base, expected positions in the pixels of that image")
    gsd_m = _gsd_m(path, given, config.gsd_m, raster)
    corner = origin_px = np.zeros(2)
    if given.unit == "m":
        lowest = given.table[["x", "y"]].to_numpy(np.float64).min(axis=0) - MARGIN_M
        origin_px = np.floor(lowest / (gsd_m * LATTICE_PX)) * LATTICE_PX
        corner = origin_px * gsd_m
    to_px = 1 / gsd_m if given.unit == "m" else 1.0
    table = given.table.rename(columns={"x": "x_px", "y": "y_px"})
    table[["x_px", "y_px"]] = (table[["x_px", "y_px"]] - corner) * to_px
    xy_m = table[["x_px", "y_px"]].to_numpy(np.float64) * gsd_m
    notes = [*given.notes, *check_speeds(path, table, xy_m, given.speed, config.position_unit)]
    table, more = split_reused(table, xy_m)
    notes += [*more, *check_motion(path, table, xy_m, config.position_unit)]
    if raster is None:
        shape = _shape(path, given.unit, table, gsd_m)
    else:
        shape = (raster.grey.shape[0], raster.grey.shape[1])
        table = _inside(path, table, shape)
    xy_m = table[["x_px", "y_px"]].to_numpy(np.float64) * gsd_m
    clean = clean_tracks(table["track_id"].to_numpy(np.int64), table["time_s"].to_numpy(np.float64), xy_m)
    x_px, y_px = (clean.xy_m / gsd_m).T
    table = table.assign(track_id=clean.track, x_px=x_px, y_px=y_px)
    names = _names(table)
    notes += check_standing_gaps(table, clean.xy_m) + _check_accelerations(table, clean.xy_m, gsd_m)
    displacement_sd_m = max(LEAST_ERROR_M, clean.velocity_sd_m_per_s * own_step_s(table))
    crs_wkt, affine = (raster.crs_wkt, raster.affine) if raster is not None else (None, None)
    if given.crs_wkt is not None:
        east, north = float(corner[0] - gsd_m / 2), float(-corner[1] + gsd_m / 2)
        crs_wkt, affine = given.crs_wkt, (gsd_m, 0.0, east, 0.0, -gsd_m, north)
    notes += [*_place(given, corner, gsd_m), *(() if raster is None else raster.notes), *clean.notes]
    errors = (clean.position_sd_m, displacement_sd_m)
    north_rad = -np.pi / 2 if given.y_is_north else None
    if crs_wkt is not None and affine is not None:
        north_rad = true_north_rad(crs_wkt, affine, shape, name=path.name)
    table = table.drop(columns="source_id")
    origin = None if given.unit != "m" else (float(origin_px[0]), float(origin_px[1]))
    return LoadedTracks(table, names, shape, gsd_m, origin, raster, crs_wkt, affine, north_rad, *errors, tuple(notes))


def _names(table: pd.DataFrame) -> pd.Series:
    """Unique names of tracks, by ``track_id``: parts of one track of the file are numbered in the order of time."""
    names = table.drop_duplicates("track_id").set_index("track_id")["source_id"]
    part = names.groupby(names).cumcount() + 1
    return names.where(part == 1, names + " (" + part.astype(str) + ")")


def _check_accelerations(table: pd.DataFrame, xy_m: FloatArray, gsd_m: float) -> list[str]:
    """A warning where vehicles set off and stop as nobody drives: positions in another unit, or wrong times."""
    ids = table["track_id"].to_numpy(np.int64)
    some = np.isin(ids, np.unique(ids)[:_CHECKED_TRACKS])
    frames, time_s = (table[name].to_numpy()[some] for name in ("frame", "time_s"))
    check = check_times(make_trajectories(ids[some], frames, time_s, xy_m[some], gsd_m=gsd_m))
    if check.plausible:
        return []
    low, high = PLAUSIBLE_M_PER_S2
    return [
        f"warning: {check.vehicles} vehicles set off and stop with {check.median_m_per_s2:.2g} m/s2 (median), expected "
        f"{low:g} to {high:g}: check the unit of positions (--unit, --gsd-m) and the times (--fps)"
    ]


def _gsd_m(path: Path, given: GivenPositions, gsd_m: float | None, raster: BaseRaster | None) -> float:
    if given.unit == "m":
        return gsd_m or GSD_M
    known = reconcile_gsd(raster.gsd_m if raster else None, gsd_m)
    if known is None:
        raise InputError(f"{path}: found positions in pixels, expected their size; give --gsd-m, metres a pixel")
    return known


def _place(given: GivenPositions, corner: FloatArray, gsd_m: float) -> list[str]:
    """Where the grid lies in the file's axes."""
    if given.unit != "m":
        return []
    x, y = float(corner[0]), float(-corner[1] if given.y_axis == "up" else corner[1])
    where = "m of the tracks" if given.crs_wkt is None else f"m of {CRS.from_wkt(given.crs_wkt).to_string()}"
    return [f"base pixel (0, 0) is at x = {x:.3f}, y = {y:.3f} {where}; a pixel is {gsd_m:g} m"]


def _shape(path: Path, unit: str, table: pd.DataFrame, gsd_m: float) -> tuple[int, int]:
    xy = table[["x_px", "y_px"]].to_numpy(np.float64)
    low, far = xy.min(axis=0), xy.max(axis=0) + MARGIN_M / gsd_m * (unit == "m")
    if (low < 0).any():
        raise InputError(f"{path}: found pixels down to {low.min():.0f}, expected none below 0; give them from 0 on")
    if unit == "m":
        far = np.ceil(far / LATTICE_PX) * LATTICE_PX - 1
    return int(np.ceil(far[1])) + 1, int(np.ceil(far[0])) + 1


def _inside(path: Path, table: pd.DataFrame, shape: tuple[int, int]) -> pd.DataFrame:
    height, width = shape
    xy = table[["x_px", "y_px"]].to_numpy(np.float64)
    inside = ((xy >= 0) & (xy <= [width - 1, height - 1])).all(axis=1)
    if inside.mean() < _INSIDE:
        raise InputError(
            f"{path}: found {inside.mean():.0%} of the positions within --base of {width} x {height} px, expected "
            "most; give the image whose pixels they are"
        )
    return table.iloc[np.flatnonzero(inside)].reset_index(drop=True)


def own_step_s(table: pd.DataFrame) -> float:
    """Median time from one position of a track to the next, s, of a table sorted by track and time."""
    same = table["track_id"].to_numpy()[1:] == table["track_id"].to_numpy()[:-1]
    steps = np.diff(table["time_s"].to_numpy(np.float64))[same]
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else _STEP_S
