"""`velfield analyse`: what it writes from another program's tracks, and what it says of bad ones."""

import re
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from flows.commands.analyse import analyse
from flows.commands.run import _has_tracks
from schemas.analysis import AnalysisRecord, LanesRecord
from schemas.records import CommitRecord
from tests.analysis.test_traffic_analysis import crossroads
from tests.field_runs import field_run, tracklets_along
from velfield.errors import InputError
from velfield.pipeline.given_tracks.load import MARGIN_M
from velfield.run.commits import sealed_json, write_atomically, write_commit
from velfield.run.flight_record import read_flight_record
from velfield.run.layout import RunLayout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight minutes at a crossroads with a signal."""
    root = tmp_path_factory.mktemp("analyse")
    tracks = crossroads()
    owner = np.repeat(np.arange(len(tracks)), [len(times) for times, _ in tracks])
    xy = np.concatenate([xy for _, xy in tracks])
    times = np.concatenate([times for times, _ in tracks])
    table = pd.DataFrame({"track_id": owner, "time_s": times, "x_m": xy[:, 0], "y_m": xy[:, 1]})
    table.to_csv(root / "tracks.csv", index=False)
    assert analyse(tracks=root / "tracks.csv", out=root / "out") == 0
    return root / "out"


def test_tables_and_lanes_are_valid_and_agree(folder: Path) -> None:
    record = AnalysisRecord.model_validate_json((folder / "analysis.json").read_text())
    lanes = LanesRecord.model_validate_json((folder / "lanes.json").read_text())
    tables = {table.name: table for table in record.tables}
    assert len(tables["lanes"].rows) == len(lanes.lanes) == 5
    assert [j.signalised for j in lanes.junctions if j.kind == "intersection"] == [True]
    assert {(row.cells["from"], row.cells["to"]) for row in tables["movements"].rows} >= {("W", "E"), ("W", "S")}
    for table in record.tables:
        names = {column.name for column in table.columns}
        assert all(set(row.cells) == names for row in table.rows), table.name
    # base pixel (0, 0) lies outside the tracks by a margin; lanes end where vehicles drove: 0 to 260 m, 0 to 220 m
    for lane in lanes.lanes:
        x, y = np.array(lane.xy_px).T * record.gsd_m - MARGIN_M
        assert -1 < x.min() <= x.max() < 261
        assert -1 < y.min() <= y.max() < 221


def test_the_map_of_the_page_has_the_names_that_the_tables_use(folder: Path) -> None:
    record = AnalysisRecord.model_validate_json((folder / "analysis.json").read_bytes())
    junctions = LanesRecord.model_validate_json((folder / "lanes.json").read_bytes()).junctions
    places = {name.name: (name.x_px, name.y_px) for name in record.names}
    assert {f"J{j.junction}": (j.x_px, j.y_px) for j in junctions}.items() <= places.items()
    origins = next(table for table in record.tables if table.name == "origins")
    assert {row.cells["from"] for row in origins.rows} <= set(places)


def test_the_report_says_where_data_is_too_little(folder: Path) -> None:
    text = (folder / "report.html").read_text()
    assert "too little data" in text
    assert "Highway Capacity Manual" in text


def test_the_workbook_has_a_sheet_a_table(folder: Path) -> None:
    record = AnalysisRecord.model_validate_json((folder / "analysis.json").read_text())
    with zipfile.ZipFile(folder / "analysis.xlsx") as book:
        sheets = [name for name in book.namelist() if name.startswith("xl/worksheets/")]
    assert len(sheets) == len(record.tables)


def test_bad_input_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="either a run folder or --tracks"):
        analyse()
    with pytest.raises(InputError, match="--out"):
        analyse(tracks=tmp_path / "t.csv")
    pixels = tmp_path / "t.csv"
    pixels.write_text("track_id,time_s,x_px,y_px\n1,0,1,1\n1,1,2,2\n")
    with pytest.raises(InputError, match="--gsd-m"):
        analyse(tracks=pixels, out=tmp_path / "out")
    with pytest.raises(InputError, match="no track that moves"):
        analyse(tracks=pixels, out=tmp_path / "out", gsd_m=0.1)


def test_the_answers_are_printed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    analyse(tracks=folder.parent / "tracks.csv", out=folder.parent / "again")
    text = capsys.readouterr().out
    assert re.search(r"signal +junction \d: cycle 40.0 s \(\d", text)
    assert re.search(r"junction \d, W to E: \d+ vehicles, \d+ % \(\d+ to \d+\) of those from W", text)
    assert re.search(r"delay +junction \d from W: mean \d+ s \(\d+ to \d+, n \d+\), level of service [A-F]", text)
    assert re.search(r"u-turns +none in \d.* min, so fewer than \d", text)
    assert "directions  north is not known: N is the top of the image, W its left\n" in text


def test_the_time_is_that_of_all_rows_where_few_vehicles_drive_for_a_part_of_it(tmp_path: Path) -> None:
    """Vehicles an hour of a minute in which some drive would be twice what two minutes show."""
    rows = [(0, t, 50.0, 30.0) for t in np.arange(0.0, 120.0, 0.5)]  # it stands
    rows += [(k, 30 + 5 * k + t, 10 * t, 0.0) for k in range(1, 6) for t in np.arange(0.0, 10.0, 0.5)]
    lines = [f"{k},{t:.1f},{x:.2f},{y:.2f}" for k, t, x, y in rows]
    (tmp_path / "tracks.csv").write_text("\n".join(["track_id,time_s,x_m,y_m", *lines]))
    analyse(tracks=tmp_path / "tracks.csv", out=tmp_path / "out")
    record = AnalysisRecord.model_validate_json((tmp_path / "out" / "analysis.json").read_text())
    assert (record.tracks, record.duration_s) == (5, 119.5)


def test_arms_have_the_names_that_are_given(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tracks, out = folder.parent / "tracks.csv", folder.parent / "named"
    junctions = LanesRecord.model_validate_json((folder / "lanes.json").read_text()).junctions
    found = [k for k, junction in enumerate(junctions) if junction.signalised]
    analyse(tracks=tracks, out=out, arm=(f"{found[0]}.W=Mill Road", "W = West end"))
    text = capsys.readouterr().out
    assert re.search(rf"junction {found[0]}, Mill Road to E: \d+ vehicles, \d+ % .* from Mill Road", text)
    assert re.search(r"through +West end to E", text)
    assert "from Mill Road" in (out / "report.html").read_text()
    with pytest.raises(InputError, match=rf"--arm 9.W: there is no such arm; there are .*{found[0]}\.W"):
        analyse(tracks=tracks, out=out, arm=("9.W=Mill Road",))
    with pytest.raises(InputError, match="two arms would be 'E'"):
        analyse(tracks=tracks, out=out, arm=(f"{found[0]}.W=E",))
    with pytest.raises(InputError, match="expected DIRECTION=NAME"):
        analyse(tracks=tracks, out=out, arm=("Mill Road",))


def test_lengths_and_widths_of_a_file_give_classes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = pd.read_csv(folder.parent / "tracks.csv")
    path = folder.parent / "sizes.csv"
    is_bus = table["track_id"] % 4 == 0
    table.assign(length_m=np.where(is_bus, 12.0, 4.4), width_m=np.where(is_bus, 2.5, 1.8)).to_csv(path, index=False)
    analyse(tracks=path, out=folder.parent / "sizes")
    found = re.search(r"car or van ([\d.]+) % .* lorry or bus ([\d.]+) %", capsys.readouterr().out)
    assert [float(share) for share in found.groups()] == pytest.approx([75, 25], abs=1)


def test_milliseconds_taken_for_seconds_are_refused(folder: Path) -> None:
    table = pd.read_csv(folder.parent / "tracks.csv")
    path = folder.parent / "milliseconds.csv"
    table.assign(time_s=table["time_s"] * 1000).to_csv(path, index=False)
    with pytest.raises(InputError, match="check that times are in seconds"):
        analyse(tracks=path, out=folder.parent / "milliseconds")


def test_a_short_clip_is_said_to_be_short(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [(k, 0.2 * t, 10.0 * 0.2 * t, 5.0 + k) for k in range(4) for t in range(30)]
    pd.DataFrame(rows, columns=["track_id", "time_s", "x_m", "y_m"]).to_csv(tmp_path / "t.csv", index=False)
    analyse(tracks=tmp_path / "t.csv", out=tmp_path / "out")
    text = capsys.readouterr().out
    assert "4 vehicles that drive 6 m or more, in 6 s: too few" in text
    assert re.search(r"u-turns +none was seen in 6 s, too short a time to say how rare they are", text)
    assert "an hour" not in text
    tables = AnalysisRecord.model_validate_json((tmp_path / "out" / "analysis.json").read_text()).tables
    assert next(t for t in tables if t.name == "signals").note.startswith(
        "Too little data: 4 vehicles that drive 6 m or more, in 6 s."
    )


@pytest.mark.parametrize("gsd_m", [0.25, None])
def test_that_the_size_of_a_pixel_is_not_known_is_said(
    gsd_m: float | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [np.column_stack([np.arange(0, 390, 6.0), np.full(65, 50.0 + k)]) for k in range(8)]
    run = field_run(tmp_path / "run", tracklets_along(paths), shape=(100, 400), gsd_m=gsd_m)
    write_commit(run.layout, CommitRecord(stage="tracks", unit="all", key="k", code_version="1"))
    assert analyse(tmp_path / "run") == 0
    assert ("the paper's 0.23 m a pixel" in capsys.readouterr().out) is (gsd_m is None)
    report = (tmp_path / "run" / "analysis" / "report.html").read_text()
    assert ("those of 0.23 m" in report) is (gsd_m is None)


@pytest.mark.parametrize("tracks", [0.0, 7.0])
def test_a_run_without_tracks_does_not_offer_answers(tmp_path: Path, tracks: float) -> None:
    layout = RunLayout(tmp_path)
    write_commit(layout, CommitRecord(stage="tracks", unit="all", key="k", code_version="1", counts={"tracks": tracks}))
    assert _has_tracks(tmp_path) is (tracks > 0)


def test_tracks_older_than_the_settings_are_said_to_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    paths = [np.column_stack([np.arange(0, 390, 6.0), 50 + rng.normal(0, 0.1, 65)]) for _ in range(8)]
    run = field_run(tmp_path / "run", tracklets_along(paths), shape=(100, 400), gsd_m=0.25)
    with pytest.raises(InputError, match="has no tracks yet"):
        analyse(tmp_path / "run")
    record = CommitRecord(stage="tracks", unit="all", key="old", code_version="1")
    write_commit(run.layout, record)
    flight = read_flight_record(run.layout.root)
    for key, stale in (("old", False), ("new", True)):
        write_atomically(run.layout.flight, sealed_json(flight.model_copy(update={"keys": {"tracks": key}})))
        assert analyse(tmp_path / "run") == 0
        assert ("older than its settings" in capsys.readouterr().out) is stale
