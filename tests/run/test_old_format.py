"""Run folders of format 1: read by the present names, and not continued."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import velfield
from schemas.flight import FieldConfig
from schemas.job import Inputs, Job
from schemas.records import FORMAT_VERSION, FlightRecord
from schemas.summary import RunSummary
from schemas.tables import TRACK_COLUMNS
from tests.field_runs import field_run, traffic_tracklets
from tests.field_runs import flight as simulated
from tests.old_format import to_format_1
from velfield.errors import InputError, OldNameWarning
from velfield.exports.export import ExportOptions, export_run
from velfield.pipeline.plan import check_inputs, make_plan
from velfield.pipeline.verify import verify_run
from velfield.run.commits import read_commits
from velfield.run.field_algebra import merge_fields
from velfield.run.flight_record import read_flight_record
from velfield.run.frame_transforms import read_working
from velfield.run.lineage import pixel_lineage, stage_lineage
from velfield.run.run import Run
from velfield.run.stores import open_field

DATA = Path(__file__).resolve().parents[1] / "data" / "format_1"


def open_old(root: Path) -> Run:
    with pytest.warns(OldNameWarning, match="format 1"):
        return velfield.open_run(root)


@pytest.fixture(scope="module")
def old_root(whole: tuple[Path, RunSummary], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return to_format_1(whole[0], tmp_path_factory.mktemp("old") / "run")


@pytest.fixture
def old(old_root: Path) -> Run:
    return open_old(old_root)


@pytest.fixture
def present(whole: tuple[Path, RunSummary]) -> Run:
    return velfield.open_run(whole[0])


def test_an_old_run_answers_as_the_present_one(old: Run, present: Run) -> None:
    assert old.record.config == present.record.config
    assert old.record.keys == present.record.keys
    assert old.grid == present.grid
    assert read_working(old.layout) == read_working(present.layout)
    assert old.registration_status == present.registration_status
    for name in ("n_matches_base", "n_matches_previous", "n_inliers", "coverage", "heldout_px", "error_px"):
        np.testing.assert_array_equal(old.registration.column(name), present.registration.column(name))
    pd.testing.assert_frame_equal(old.detections(), present.detections())
    pd.testing.assert_frame_equal(old.tracklets(), present.tracklets())
    np.testing.assert_array_equal(
        old.to_base(3, np.array([[10.0, 20.0]])), present.to_base(3, np.array([[10.0, 20.0]]))
    )


def test_an_old_field_has_the_layers_and_histograms_of_the_present_one(old: Run, present: Run) -> None:
    stores = [open_field(run.layout.field) for run in (old, present)]
    assert stores[0].layer_names() == stores[1].layer_names()
    assert stores[0].attributes["weighted_by"] == "track"
    for name in stores[0].layer_names():
        np.testing.assert_array_equal(stores[0].layer(name), stores[1].layer(name))
    y, x = np.unravel_index(int(present.field.count().argmax()), present.field.shape)
    for then, now in ((old.field, present.field), (old.field_time_weighted, present.field_time_weighted)):
        before, after = then.at(int(x), int(y)), now.at(int(x), int(y))
        for part in fields(after):
            np.testing.assert_equal(getattr(before, part.name), getattr(after, part.name))
    assert pixel_lineage(old, int(x), int(y)) == pixel_lineage(present, int(x), int(y))


def test_both_names_of_a_track_are_columns_with_the_same_values(old: Run, present: Run) -> None:
    for run in (old, present):
        table = run.tracklets()
        assert list(table.columns) == list(TRACK_COLUMNS)
        assert (table["track_id"] == table["passage_id"]).all()
    stored = pd.read_parquet(next(iter(present.layout.tracks.glob("*.parquet"))))
    assert list(stored.columns) == list(TRACK_COLUMNS)


def test_an_old_run_is_verified_and_exported(old: Run, present: Run, tmp_path: Path) -> None:
    assert stage_lineage(old) == stage_lineage(present)
    assert read_commits(old.layout, "tracks")[0].counts == read_commits(present.layout, "tracks")[0].counts
    assert verify_run(old.layout, old.record) == []
    for name in ("cog", "geoparquet", "report"):
        export_run(old, name, tmp_path / f"old.{name}", ExportOptions())


def test_no_run_continues_in_an_old_folder(old_root: Path, flight: Path) -> None:
    job = Job(root=str(old_root), inputs=Inputs(source=str(flight / "frames")))
    for work in (check_inputs, make_plan):
        with pytest.raises(InputError, match=r"is a run folder of format 1;.* give another --out") as caught:
            work(job)
        assert "\n" not in str(caught.value)


def test_a_format_to_come_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "flight.json").write_text('{"format_version": 3}')
    with pytest.raises(InputError, match="format 3, this velfield reads formats 1 and 2"):
        velfield.open_run(tmp_path)
    (tmp_path / "flight.json").write_text('{"format_ver')
    with pytest.raises(InputError, match="is damaged"):
        velfield.open_run(tmp_path)


def test_the_fields_of_time_intervals_were_slices(tmp_path: Path) -> None:
    run = field_run(
        tmp_path / "run", traffic_tracklets(3), shape=simulated(3).base_shape, config=FieldConfig(time_intervals="4s")
    )
    old = open_old(to_format_1(run.layout.root, tmp_path / "old"))
    assert (old.layout.root / "slices").is_dir()
    assert list(old.field_intervals) == list(run.field_intervals)
    for name, interval in run.field_intervals.items():
        np.testing.assert_array_equal(old.field_intervals[name].field.count(), interval.field.count())


def test_old_and_present_fields_merge_into_a_present_one(tmp_path: Path) -> None:
    run = field_run(tmp_path / "run", traffic_tracklets(3), shape=simulated(3).base_shape)
    old = to_format_1(run.layout.root, tmp_path / "old")
    merge_fields([old, run.layout.root], tmp_path / "both")
    both = velfield.open_run(tmp_path / "both")
    assert both.record.format_version == FORMAT_VERSION
    np.testing.assert_array_equal(both.field.count(), 2 * run.field.count())


@pytest.mark.parametrize(("name", "linking", "path_width"), [("best", "joint", "lane"), ("paper", "pairwise", "pixel")])
def test_a_flight_record_that_velfield_0_1_wrote(tmp_path: Path, name: str, linking: str, path_width: str) -> None:
    (tmp_path / "flight.json").write_bytes((DATA / f"flight_{name}.json").read_bytes())
    record = read_flight_record(tmp_path)
    assert isinstance(record, FlightRecord)
    assert (record.format_version, record.config.preset) == (1, name)
    assert (record.config.tracking.linking, record.config.field.path_width) == (linking, path_width)
    assert {"tracklets", "tracks"} <= set(record.keys)
    assert "links" not in record.keys
