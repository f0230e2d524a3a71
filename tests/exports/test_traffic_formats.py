"""Files that engineers pass on: turning counts as a workbook, moving features, each read back by another reader."""

import io
import re
import zipfile
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from tests.analysis.test_traffic_analysis import analysis
from tests.field_runs import field_run, tracklets_along
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.errors import InputError
from velfield.exports.export import export_run
from velfield.exports.turning_counts import junction_rows, peak_hour_factor, turning_workbook

__all__ = ["analysis"]


def test_counts_are_those_of_the_crossroads(analysis: TrafficAnalysis) -> None:
    found = next(m for m in analysis.movements if m.junction.kind == "intersection")
    rows = {str(row[0]): row for row in junction_rows(analysis, found)}
    head = rows["From the start, min"]
    counted = dict(zip(head[1:], rows["Counted"][1:], strict=True))
    assert counted == {"EB R": 12, "EB T": 48, "SB T": 48, "All": 108}
    total = counted["All"] + rows["Inferred of cut tracks"][-1]
    assert total == pytest.approx(sum(m.seen + m.inferred for m in found.movements), abs=0.2)
    assert "an hour is needed" in rows["Peak-hour factor"][1]
    assert set(rows["Heavy vehicles, %"][1:]) == {"not known"}


def test_the_peak_hour_is_the_busiest_one() -> None:
    assert peak_hour_factor(np.array([1, 1, 10, 10, 10, 20])) == pytest.approx(50 / 80)
    assert peak_hour_factor(np.array([5, 5, 5])) is None
    assert peak_hour_factor(np.zeros(4, np.int64)) is None


def test_the_workbook_holds_the_counts(analysis: TrafficAnalysis) -> None:
    data = turning_workbook(analysis)
    with zipfile.ZipFile(io.BytesIO(data)) as book:
        names = re.findall(r'sheet name="([^"]+)"', book.read("xl/workbook.xml").decode())
        words = [e.text for e in ET.fromstring(book.read("xl/sharedStrings.xml")).iter() if e.tag.endswith("}t")]
        numbers = re.findall(r"<v>([\d.]+)</v>", book.read("xl/worksheets/sheet1.xml").decode())
    assert all(name.startswith("junction ") for name in names)
    assert {"EB T", "EB R", "SB T"} <= set(words)
    assert "108" in numbers


def test_no_junction_is_one_line() -> None:
    from tests.analysis.test_traffic_analysis import drive, gather

    alone = TrafficAnalysis(gather([drive(np.array([[0.0, 10.0], [100.0, 10.0]]), 0.0)]))
    with pytest.raises(InputError, match="no junction with movements was found"):
        turning_workbook(alone)


@pytest.mark.filterwarnings("ignore:The inplace keyword", "ignore:Time zone information dropped")  # of the reader
def test_moving_pandas_reads_the_trajectories(tmp_path: Path) -> None:
    movingpandas = pytest.importorskip("movingpandas")
    rng = np.random.default_rng(0)
    paths = [np.column_stack([np.arange(0, 390, 6.0), 50 + rng.normal(0, 0.1, 65)]) for _ in range(3)]
    run = field_run(tmp_path / "run", tracklets_along(paths), shape=(100, 400), gsd_m=0.25)
    file = export_run(run, "moving_features", tmp_path / "t.json")
    read = movingpandas.read_mf_json(str(file), traj_id_property="track_id")
    trajectories = run.analysis.trajectories
    assert len(read.trajectories) == len(trajectories) == 3
    rows = next(iter(trajectories))
    first = read.trajectories[0]
    assert len(first.df) == rows.stop - rows.start
    length = np.hypot(*np.diff(trajectories.xy_m[rows], axis=0).T).sum()
    steps = np.diff(np.array([(point.x, point.y) for point in first.df.geometry]), axis=0)
    assert np.hypot(*steps.T).sum() == pytest.approx(length, rel=0.02)
    assert first.get_duration().total_seconds() == pytest.approx(np.ptp(trajectories.time_s[rows]), abs=0.01)
