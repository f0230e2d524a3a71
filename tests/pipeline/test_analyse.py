"""`velfield analyse`: what it writes from another program's tracks, and what it says of bad ones."""

import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from flows.commands.analyse import analyse
from schemas.analysis import AnalysisRecord, LanesRecord
from tests.analysis.test_traffic_analysis import crossroads
from velfield.errors import InputError
from velfield.pipeline.analysis.workbook import can_write_workbook


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
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
    width, height = 260 / record.gsd_m, 220 / record.gsd_m
    for x, y in (point for lane in lanes.lanes for point in lane.xy_px):
        assert -20 < x < width + 20
        assert -20 < y < height + 20


def test_the_report_says_where_data_is_too_little(folder: Path) -> None:
    text = (folder / "report.html").read_text()
    assert "too little data" in text
    assert "Highway Capacity Manual" in text


@pytest.mark.skipif(not can_write_workbook(), reason="needs the extra velfield[excel]")
def test_the_workbook_has_a_sheet_a_table(folder: Path) -> None:
    record = AnalysisRecord.model_validate_json((folder / "analysis.json").read_text())
    with zipfile.ZipFile(folder / "analysis.xlsx") as book:
        sheets = [name for name in book.namelist() if name.startswith("xl/worksheets/")]
    assert len(sheets) == len(record.tables)


def test_bad_input_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="one of them"):
        analyse()
    with pytest.raises(InputError, match="--out"):
        analyse(tracks=tmp_path / "t.csv")
    pixels = tmp_path / "t.csv"
    pixels.write_text("track_id,time_s,x_px,y_px\n1,0,1,1\n1,1,2,2\n")
    with pytest.raises(InputError, match="--gsd-m"):
        analyse(tracks=pixels, out=tmp_path / "out")
    with pytest.raises(InputError, match="no track that moves"):
        analyse(tracks=pixels, out=tmp_path / "out", gsd_m=0.1)
