"""Comparison of two run folders: figures, layers for GIS, and a line of summary for each quantity."""

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from velfield.analysis.changes import find_changes
from velfield.analysis.intervals import Estimate
from velfield.exports.gis.cog import write_cog
from velfield.field.comparison import FDR_LEVEL, MIN_COUNT, Change, compare_fields
from velfield.field.segments import stationary_speed_px_per_s
from velfield.report.figures import MapScale, change_figure, png_bytes
from velfield.report.traffic.before_after import before_after_html
from velfield.run.commits import write_atomically
from velfield.run.field_algebra import check_same_grid
from velfield.run.frame_transforms import north_direction_rad
from velfield.run.run import Run, open_run
from velfield.run.stores import FieldStore
from velfield.viewer.record import write_change_layers


def compare_runs(before: Path, after: Path, out: Path, *, min_count: int = MIN_COUNT) -> list[str]:
    """Write ``direction_change.png``, ``speed_change.png``, ``volume_change.png`` and ``change.tif`` into ``out``; of
    runs with tracks ``before_after.html`` and ``traffic_change.csv``, too.

    The later run's page shows the changes too.

    Returns
    -------
    list of str
        For people: for each quantity, the part of the map that changed.

    Raises
    ------
    InputError
        The fields are on different grids.
    """
    runs = open_run(before), open_run(after)
    check_same_grid(before, after)
    stores = [FieldStore(run.layout.field) for run in runs]
    seconds = [float(store.attributes["observed_s"]) for store in stores]
    changes = compare_fields(
        stores[0].layer,
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
    traffic = _traffic_lines(runs[0], runs[1], out)
    written = "figures, tables and before_after.html" if traffic else "figures and change.tif"
    return [
        *(_line(name, changes[name], *shown[name]) for name in changes),
        *traffic,
        f"significant: false discovery rate {FDR_LEVEL:.0%}; {written} in {out}",
    ]


def _traffic_lines(before: Run, after: Run, out: Path) -> list[str]:
    """Write the page and the table of what differs in shares, flows, delays, cycles and free-flow speeds.

    Returns a line on each that does; none of a merged or subtracted field, which has no tracks.
    """
    if before.made_from or after.made_from:
        return []
    changes = find_changes(before.analysis.traffic, after.analysis.traffic)
    maps = [(f"Change of {name}", f"{name}_change.png") for name in ("volume", "speed", "direction")]
    page = before_after_html(before.analysis.traffic, after.analysis.traffic, changes, maps=maps)
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
    real = [c for c in changes if c.significant]
    lines = [f"traffic    {len(real)} of {len(changes)} quantities of junctions and roads changed"]
    return lines + [
        f"           {c.what}: {c.before.value:.3g} to {c.after.value:.3g} {c.unit}".rstrip() for c in real[:20]
    ]


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
