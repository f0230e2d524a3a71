"""Run folders with a field only: tracklets of simulated or constructed traffic, without images."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from schemas.arrays import FloatArray
from schemas.flight import FieldConfig, FlightConfig
from schemas.records import FlightRecord, GridRecord, InputsRecord, SourceRecord
from schemas.simulation import SimulationConfig
from schemas.tables import TRACKLET_COLUMNS
from velfield.field.time_intervals import parse_time_intervals
from velfield.pipeline.stages.field import accumulate_block, create_field_stores, field_blocks
from velfield.run.layout import RunLayout
from velfield.run.run import Run, open_run
from velfield.run.tables import write_tracks
from velfield.synthetic.flight import Flight
from velfield.synthetic.observed import observed_tracklets

GSD_M = 0.23


@cache
def flight(seed: int, frames: int = 50) -> Flight:
    """A small simulated flight; no image of it is rendered."""
    return Flight(SimulationConfig(seed=seed, frames=frames, width=240, height=180))


@cache
def traffic_tracklets(seed: int, frames: int = 50) -> pd.DataFrame:
    """Its tracklets, with the errors of the pipeline."""
    simulated = flight(seed, frames)
    return observed_tracklets(
        simulated.city.traffic,
        simulated.times_s,
        simulated.city.to_px,
        shape=simulated.base_shape,
        rng=np.random.default_rng(seed),
    )


def tracklets_along(paths: Sequence[FloatArray], *, interval_s: float = 0.2) -> pd.DataFrame:
    """Tracklets without errors along paths (n, 2), a position an interval; the low 20 bits of an id are the path's."""
    rows = []
    for number, path in enumerate(paths):
        for frame, window in enumerate(sliding_window_view(path, 3, axis=0).transpose(0, 2, 1)):
            row: dict[str, float] = {"confidence": 1.0, "track_id": number}
            for k, (x, y) in enumerate(window):
                row |= {
                    f"frame_{k}": frame + k,
                    f"time_{k}_s": (frame + k) * interval_s,
                    f"x_{k}_px": x,
                    f"y_{k}_px": y,
                }
                row[f"detection_id_{k}"] = ((frame + k) << 20) + number
            for k, (vx, vy) in enumerate(np.diff(window, axis=0) / interval_s):
                row |= {f"vx_{k}{k + 1}_px_per_s": vx, f"vy_{k}{k + 1}_px_per_s": vy}
            rows.append(row | {"tracklet_id": row["detection_id_1"]})
    table = pd.DataFrame(rows)
    missing = {name: 0 for name in TRACKLET_COLUMNS if name not in table}
    return table.assign(**missing)[list(TRACKLET_COLUMNS)].astype(TRACKLET_COLUMNS)


def field_run(
    root: Path,
    tracklets: pd.DataFrame,
    *,
    shape: tuple[int, int],
    config: FieldConfig | None = None,
    gsd_m: float = GSD_M,
    seconds: float = 10.0,
) -> Run:
    """Write what a field needs, build it as the pipeline does, open it."""
    layout = RunLayout(root)
    for folder in (layout.tracks, layout.base):
        folder.mkdir(parents=True)
    write_tracks(layout.tracks / "unit-00000.parquet", tracklets)
    grid = GridRecord(width_px=shape[1], height_px=shape[0], gsd_m=gsd_m, base_source="given", reference_frame=0)
    layout.grid.write_text(grid.model_dump_json())
    cv2.imwrite(str(layout.base_image), np.full(shape, 90, np.uint8))
    flight_config = FlightConfig(gsd_m=gsd_m, field=config or FieldConfig())
    asked = flight_config.field.time_intervals
    source = SourceRecord(path="none", kind="folder", digest="0", width=shape[1], height=shape[0], frame_count=60)
    record = FlightRecord(code_version="0", config=flight_config, inputs=InputsRecord(source=source))
    layout.flight.write_text(record.model_dump_json())
    plan = SimpleNamespace(
        layout=layout,
        config=flight_config,
        keys={"field": "test"},
        info=SimpleNamespace(times_s=np.array([0.0, seconds])),
        indices=np.arange(2),
        time_intervals=[] if asked is None else parse_time_intervals(asked, 0.0, seconds),
    )
    create_field_stores(plan)  # all of a plan that the field reads
    for group in field_blocks(plan):
        accumulate_block(plan, group)
    return open_run(root)
