"""Run folders that hold no more than a field: simulated traffic's tracklets, without pictures."""

from functools import cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd

from schemas.flight import FieldConfig, FlightConfig
from schemas.records import FlightRecord, GridRecord, InputsRecord, SourceRecord
from schemas.simulation import SimulationConfig
from schemas.tables import TRACKLET_COLUMNS
from velfield.field.time_intervals import parse_time_intervals
from velfield.pipeline.stages.field import accumulate_group, field_groups, lay_out_field
from velfield.run.layout import RunLayout
from velfield.run.run import Run, open_run
from velfield.run.tables import write_table
from velfield.synthetic.flight import Flight
from velfield.synthetic.observed import observed_tracklets

GSD_M = 0.23


@cache
def flight(seed: int, frames: int = 50) -> Flight:
    """A small simulated flight, of which no picture is ever drawn."""
    return Flight(SimulationConfig(seed=seed, frames=frames, width=240, height=180))


@cache
def traffic_tracklets(seed: int, frames: int = 50) -> pd.DataFrame:
    """Its tracklets, as the pipeline would see them."""
    simulated = flight(seed, frames)
    return observed_tracklets(
        simulated.city.traffic,
        simulated.times_s,
        simulated.city.to_px,
        shape=simulated.base_shape,
        rng=np.random.default_rng(seed),
    )


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
    write_table(layout.tracks / "unit-00000.parquet", tracklets, TRACKLET_COLUMNS)
    grid = GridRecord(width_px=shape[1], height_px=shape[0], gsd_m=gsd_m, how="given", reference_frame=0)
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
    lay_out_field(plan)  # type: ignore[arg-type]  # all of a plan that the field reads
    for group in field_groups(plan):  # type: ignore[arg-type]
        accumulate_group(plan, group)  # type: ignore[arg-type]
    return open_run(root)
