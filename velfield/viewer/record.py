"""Data of the viewer page beside the field's own tiles: ``view/``.

run.json         sizes, units, the list of layers, which chunks are stored
base/            the base image as JPEG tiles
segments.zarr    vehicles from one frame to the next, for the line tool and the tracks under the cursor
replay/          positions of the vehicles, ten seconds a file, for the replay
flow.bin         velocities drawn from the field, for the flow animation
change.zarr      the change since another run, written by `velfield compare`
"""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray
from schemas.records import FlightRecord, GridRecord
from schemas.view import ViewArray, ViewBase, ViewFlow, ViewLayer, ViewRecord, ViewReplay, ViewSegments
from velfield.analysis.coverage import low_coverage_note
from velfield.analysis.crossings import hysteresis_px
from velfield.analysis.intervals import vehicles_for_quantile
from velfield.analysis.vehicle_classes import CLASS_NAMES
from velfield.analysis.vehicles import STATES, count_states
from velfield.field.segments import Segments, band_radius_px, stationary_speed_px_per_s
from velfield.field.statistics import PERCENTILES
from velfield.run.commits import record_page, write_atomically, write_record
from velfield.run.frame_transforms import north_direction_rad
from velfield.run.layout import RunLayout, remove_tree
from velfield.run.run import Run, open_run
from velfield.run.stores import (
    HISTOGRAM,
    FieldStore,
    read_segment_tracks,
    write_extra_layers,
    write_segments,
)
from velfield.viewer.flow import DRAWS, cell_side, flow_bytes
from velfield.viewer.layers import view_layers
from velfield.viewer.pyramid import OVERLAP_PX, TILE_PX, pyramid_levels, pyramid_tiles
from velfield.viewer.replay import CHUNK_S, chunk_count, position_step, replay_chunks, vehicle_paths

_LINE_RADIUS_PX = 1.5
"""Around a path that is one pixel wide."""


def write_view_data(layout: RunLayout) -> tuple[list[Path], dict[str, float]]:
    """Write the tiles of the base image, the segments and the animations.

    Returns
    -------
    The files, and the number of vehicles by state (`count_states`).
    """
    run = open_run(layout.root)
    remove_tree(layout.view / "base")  # tiles of an earlier, larger base image
    written = []
    for name, data in pyramid_tiles(run.base_image):
        path = layout.view / "base" / name
        write_atomically(path, data)
        written.append(path)
    vehicles = run.vehicles()  # before the segments: the tables of both at once fill the memory
    segments = run.segments()
    write_segments(layout.view_segments, _columns(segments))
    written += sorted(path for path in layout.view_segments.rglob("*") if path.is_file())
    return written + _write_animations(run, segments, vehicles), count_states(vehicles)


def _write_animations(run: Run, segments: Segments, vehicles: pd.DataFrame) -> list[Path]:
    """Write what the page animates: the tracks, and draws from the field."""
    vehicles = vehicles.set_index("track_id").loc[np.unique(segments["track"])]
    grid, view = run.grid, run.layout.view
    first_s, last_s = _span(run.times_s)
    chunks = replay_chunks(
        vehicle_paths(segments, (vehicles["state"] == "parked").to_numpy()),
        vehicles,
        first_time_s=first_s,
        duration_s=last_s - first_s,
        step_px=position_step(grid.width_px, grid.height_px),
    )
    remove_tree(view / "replay")  # of an earlier, longer run
    files = {view / "replay" / f"{k}.bin": content for k, content in enumerate(chunks)}
    slow = stationary_speed_px_per_s(run.record.config.field, grid.gsd_m)
    files[view / "flow.bin"] = flow_bytes(
        FieldStore(run.layout.field), gsd_m=grid.gsd_m, stationary_speed_px_per_s=slow
    )
    for path, content in files.items():
        write_atomically(path, content)
    return list(files)


def _span(times_s: FloatArray) -> tuple[float, float]:
    """First and last known time; zeros where none is."""
    known_s = times_s[np.isfinite(times_s)]
    return (float(known_s[0]), float(known_s[-1])) if len(known_s) else (0.0, 0.0)


def write_view_record(layout: RunLayout) -> None:
    """Write ``view/run.json``: after `write_view_data`, and after each change of the field's layers."""
    run = open_run(layout.root)
    stores = {"field.zarr": FieldStore(layout.field)}
    if layout.view_changes.exists():
        stores["view/change.zarr"] = FieldStore(layout.view_changes)
    record = view_record(run.record, run.grid, stores, read_segment_tracks(layout.view_segments), run.times_s)
    write_record(layout.view_record, record, indent=None)


def write_change_layers(layout: RunLayout, layers: Mapping[str, tuple[FloatArray, Mapping[str, str]]]) -> None:
    """Write layers of change into a run's view: name -> (y, x) values, NaN where not significant, and attributes."""
    write_extra_layers(layout.view_changes, layers)
    write_view_record(layout)
    record_page(layout)


def view_record(
    flight: FlightRecord,
    grid: GridRecord,
    stores: Mapping[str, FieldStore],
    segment_tracks: IntArray,
    times_s: np.ndarray,
) -> ViewRecord:
    """``view/run.json`` of a run with these stores of layers, by their paths, of which the field is the first; and with
    these tracks (segments,) of its segments."""
    store = next(iter(stores.values()))
    count = store.layer("count")
    first_s, last_s = _span(times_s)
    return ViewRecord(
        width_px=grid.width_px,
        height_px=grid.height_px,
        gsd_m=grid.gsd_m,
        north_rad=north_direction_rad(grid),
        stationary_speed_px_per_s=stationary_speed_px_per_s(flight.config.field, grid.gsd_m),
        first_time_s=first_s,
        last_time_s=last_s,
        bin_width_px_per_s=float(store.attributes["bin_width_px_per_s"]),
        bins=len(store.velocities()),
        base=ViewBase(levels=pyramid_levels(grid.height_px, grid.width_px), tile=TILE_PX, overlap=OVERLAP_PX),
        layers=tuple(layer for each in stores.values() for layer in _layers(each)),
        arrays={name: array for path, each in stores.items() for name, array in _arrays(path, each).items()},
        segments=ViewSegments(
            count=len(segment_tracks),
            tracks=len(np.unique(segment_tracks)),
            hysteresis_px=hysteresis_px(grid.gsd_m),
            band_radius_px=band_radius_px(flight.config.field, grid.gsd_m) or _LINE_RADIUS_PX,
        ),
        replay=ViewReplay(
            chunk_s=CHUNK_S,
            chunks=chunk_count(last_s - first_s),
            step_px=position_step(grid.width_px, grid.height_px),
            states=STATES,
            classes=CLASS_NAMES,
        ),
        flow=ViewFlow(cell_px=cell_side(store.shape, grid.gsd_m), draws=DRAWS),
        vehicles_for_percentile={round(percent): vehicles_for_quantile(percent / 100) for percent in PERCENTILES},
        low_coverage_note=low_coverage_note(int((count > 0).sum()), int((count >= 5).sum())),
    )


def _layers(store: FieldStore) -> list[ViewLayer]:
    return view_layers({name: store.layer_attributes(name) for name in sorted(store.layer_names())}, store.layer)


def _arrays(path: str, store: FieldStore) -> dict[str, ViewArray]:
    histogram = [HISTOGRAM] if (store.path / HISTOGRAM).exists() else []
    return {
        name: ViewArray(
            store=path,
            chunk=store.chunk_shape(name),
            stored=tuple(index for chunk in store.stored_chunks(name) for index in chunk),
            units=str(store.layer_attributes(name).get("units", "1")),
            metadata=json.loads((store.path / name / "zarr.json").read_bytes()),
        )
        for name in [*sorted(store.layer_names()), *histogram]
    }


def _columns(segments: Segments) -> dict[str, np.ndarray]:
    """Columns for the page: tracks numbered from 0, positions and velocities in float32 (a thousandth of a pixel)."""
    numbers = np.unique(segments["track"], return_inverse=True)[1]
    names = ("duration_s", "x0_px", "y0_px", "x1_px", "y1_px", "vx_px_per_s", "vy_px_per_s")
    return {
        "track": numbers.astype(np.int32),
        "start_s": segments["start_s"].astype(np.float64),
        **{name: segments[name].astype(np.float32) for name in names},
    }
