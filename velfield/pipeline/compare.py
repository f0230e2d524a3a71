"""Comparison of two run folders: figures, layers for GIS, and a line of summary for each quantity."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from velfield.analysis.changes import find_changes
from velfield.analysis.intervals import Estimate
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.exports.gis.cog import write_cog
from velfield.field.comparison import FDR_LEVEL, MIN_COUNT, Change, Layer, compare_fields
from velfield.field.segments import stationary_speed_px_per_s
from velfield.report.figures import MapScale, change_figure, png_bytes
from velfield.report.traffic.before_after import NOTHING_COMPARED, before_after_html
from velfield.run.commits import write_atomically
from velfield.run.field_algebra import common_offset
from velfield.run.frame_transforms import north_direction_rad
from velfield.run.run import Run, open_run
from velfield.run.stores import FieldStore
from velfield.viewer.record import write_change_layers


def compare_runs(before: Path, after: Path, out: Path, *, min_count: int = MIN_COUNT) -> list[str]:
    """Write ``direction_change.png``, ``speed_change.png``, ``volume_change.png`` and ``change.tif`` into ``out``; of
    runs with tracks ``before_after.html`` and ``traffic_change.csv``, too.

    Fields on one grid of different extents, as of tracks in metres, are compared where both lie. The later run's page
    shows the changes too.

    Returns
    -------
    list of str
        For people: for each quantity, the part of the map that changed.

    Raises
    ------
    InputError
        The fields are on different grids, or have no place in common.
    """
    runs = open_run(before), open_run(after)
    offset = common_offset(before, after)
    stores = [FieldStore(run.layout.field) for run in runs]
    seconds = [float(store.attributes["observed_s"]) for store in stores]
    changes = compare_fields(
        _moved_layer(stores[0], offset, stores[1].shape),
        stores[1].layer,
        observed_s=(seconds[0], seconds[1]),
        stationary_speed_px_per_s=stationary_speed_px_per_s(runs[0].record.config.field, runs[0].grid.gsd_m),
        min_count=min_count,
    )
    shown = {name: _to_display_units(name, change, runs[1]) for name, change in changes.items()}
    scale = MapScale(gsd_m=runs[1].grid.gsd_m, north_rad=north_direction_rad(runs[1].grid))
    for name, (values, unit) in shown.items():
        real = np.where(changes[name].significant, values, np.nan)
        figure = change_figure(runs[1].base_image, real, scale, title=f"Change of {name}, {unit}")
        write_atomically(out / f"{name}_change.png", png_bytes(figure))
    _write_layers(out / "change.tif", changes, shown, runs[1])
    _show_in_the_viewer(changes, before, runs[1])
    pixels = [_line(name, changes[name], *shown[name]) for name in changes]
    changed = [name for name in changes if changes[name].significant.any()]
    traffic = _traffic_lines(runs[0], runs[1], offset, out, pixels, changed)
    written = "figures, tables and before_after.html" if traffic else "figures and change.tif"
    return [
        *pixels,
        *traffic,
        f"significant: false discovery rate {FDR_LEVEL:.0%}; {written} in {out}",
    ]


def _traffic_lines(
    before: Run, after: Run, offset: tuple[int, int], out: Path, pixels: list[str], changed: list[str]
) -> list[str]:
    """Write the page and the table of what differs in shares, flows, delays, cycles and free-flow speeds.

    The page has the lines on the ``pixels``, and the maps of those quantities that ``changed``. Returns a line on each
    that does; none of a merged or subtracted field, which has no tracks.
    """
    if before.made_from or after.made_from:
        return []
    old, new = _moved(before.analysis.traffic, offset), after.analysis.traffic
    changes = find_changes(old, new)
    maps = [(f"Change of {name}", f"{name}_change.png") for name in changed]
    page = before_after_html(old, new, changes, pixels=pixels, maps=maps)
    write_atomically(out / "before_after.html", page.encode())
    rows = [
        {
            "what": c.what,
            "unit": c.unit,
            **_columns("before", c.before),
            **_columns("after", c.after),
            "p_value": c.p_value,
            "significant": c.significant,
        }
        for c in changes
    ]
    write_atomically(out / "traffic_change.csv", pd.DataFrame(rows).to_csv(index=False).encode())
    if not changes:
        return [f"traffic    {NOTHING_COMPARED}"]
    real = [c for c in changes if c.significant]
    lines = [f"traffic    {len(real)} of {len(changes)} quantities of junctions and roads changed"]
    return lines + [
        f"           {c.what}: {c.before.value:.3g} to {c.after.value:.3g} {c.unit}".rstrip() for c in real[:20]
    ]


def _moved_layer(store: FieldStore, offset: tuple[int, int], shape: tuple[int, int]) -> Layer:
    """The layers of a field on a grid of (height, width) ``shape`` on which it begins at (column, row) ``offset``; NaN
    where it does not reach."""
    if offset == (0, 0) and store.shape == shape:
        return store.layer
    low = np.maximum(offset[::-1], 0)
    high = np.minimum(np.add(offset[::-1], store.shape), shape)
    begin, end = low - offset[::-1], high - offset[::-1]

    def layer(name: str) -> NDArray[np.generic]:
        out = np.full(shape, np.nan)
        out[low[0] : high[0], low[1] : high[1]] = store.layer(name)[begin[0] : end[0], begin[1] : end[1]]
        return out

    return layer


def _moved(traffic: TrafficAnalysis, offset: tuple[int, int]) -> TrafficAnalysis:
    """An analysis on the grid on which its own begins at (column, row) ``offset``."""
    if offset == (0, 0):
        return traffic
    tracks, by_m = traffic.trajectories, np.array(offset) * traffic.trajectories.gsd_m
    parked = None if traffic.parked is None else traffic.parked + np.array([*by_m, 0.0])
    return replace(traffic, trajectories=replace(tracks, xy_m=tracks.xy_m + by_m), parked=parked)


def _columns(name: str, estimate: Estimate) -> dict[str, float]:
    return {
        name: estimate.value,
        f"{name}_low": estimate.low,
        f"{name}_high": estimate.high,
        f"{name}_n": estimate.n,
    }


def _show_in_the_viewer(changes: dict[str, Change], before: Path, run: Run) -> None:
    """Write significant changes as layers of the later run's page, where it has one, in the units
    of its field."""
    if not run.layout.view_record.exists():
        return
    units = {"direction": "rad", "speed": "px s-1", "volume": "vehicles h-1"}
    layers = {
        f"{name}_change": (
            np.where(change.significant, change.change, np.nan),
            {"long_name": f"change of {name} since {before.name}", "units": units[name]},
        )
        for name, change in changes.items()
    }
    write_change_layers(run.layout, layers)


def _to_display_units(name: str, change: Change, run: Run) -> tuple[NDArray[np.float64], str]:
    """A change in display units, and the unit."""
    gsd_m = run.grid.gsd_m
    if name == "direction":
        return np.degrees(change.change), "degrees"
    if name == "speed":
        return (change.change * gsd_m * 3.6, "km/h") if gsd_m else (change.change, "px/s")
    return change.change, "vehicles an hour"


def _line(name: str, change: Change, values: NDArray[np.float64], unit: str) -> str:
    compared, real = change.summary()
    if not compared:
        return f"{name:10} nothing could be compared: no pixel has vehicles enough in both"
    if not real:
        return f"{name:10} no significant change at {compared} pixels compared"
    middle = float(np.median(values[change.significant]))
    return f"{name:10} changed at {real} of {compared} pixels compared, by {middle:+.1f} {unit} (median)"


def _write_layers(
    path: Path, changes: dict[str, Change], shown: dict[str, tuple[NDArray[np.float64], str]], run: Run
) -> None:
    layers, names, units = [], [], []
    for name, (values, unit) in shown.items():
        layers += [values.astype(np.float32), changes[name].p_value.astype(np.float32)]
        names += [f"{name} change", f"p-value of the {name} change"]
        units += [unit, "1"]
    write_cog(path, layers, names=names, units=units, crs_wkt=run.grid.crs_wkt, affine=run.grid.affine)
