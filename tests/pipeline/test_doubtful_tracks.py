"""A doubtful thing is in one table of a run; detections are read with it and without."""

from pathlib import Path

import pandas as pd

from schemas.tables import TRACK_POSITION_COLUMNS
from tests.small_flight import job
from velfield import open_run
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import make_plan
from velfield.run.run import Run
from velfield.run.tables import read_tables


def ids(table: pd.DataFrame, name: str = "track_id") -> set[int]:
    return set(table[name].tolist())


def apart(run: Run, tracks: set[int]) -> pd.DataFrame:
    """Positions of some doubtful tracks."""
    table = read_tables(run.layout.unit_files(run.layout.doubtful_positions), TRACK_POSITION_COLUMNS)
    return table[table["track_id"].isin(tracks)]


def test_a_doubtful_thing_is_set_apart_and_kept_where_none_is_to_be_doubted(
    whole: Path, copy: Path, flight: Path
) -> None:
    run = open_run(whole)
    vehicles = run.vehicles(doubtful=True)
    doubtful = ids(vehicles[vehicles["doubtful"]])
    assert doubtful
    assert ids(run.tracklets()) == ids(run.track_positions()) == ids(run.vehicles()) == ids(vehicles) - doubtful
    every, sure = run.detections(doubtful=True), run.detections()
    its = ids(every, "detection_id") - ids(sure, "detection_id")
    assert doubtful <= its  # a track is named after its first detection
    assert not its & ids(run.track_positions(), "detection_id")
    assert its - ids(apart(run, doubtful), "detection_id")  # in no track
    compute_stages(make_plan(job(flight, copy, "tracking.doubt=false")), ["tracks"])
    again = open_run(copy)
    assert not again.vehicles(doubtful=True)["doubtful"].any()
    assert doubtful <= ids(again.tracklets())
    assert ids(again.detections(), "detection_id") == ids(every, "detection_id")
