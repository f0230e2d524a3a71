"""A run folder and a detector file that velfield 1.0 wrote open, and give the values that they held."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from tests.run.make_format_1 import FOLDER
from velfield.detection.registry import load_detector
from velfield.errors import InputError
from velfield.run.flight_record import check_format
from velfield.run.run import Run, open_run


@pytest.fixture
def run(tmp_path: Path) -> Run:
    with zipfile.ZipFile(FOLDER / "run.zip") as archive:
        archive.extractall(tmp_path / "run")
    return open_run(tmp_path / "run")


def test_the_record_and_the_grid_are_read(run: Run) -> None:
    check_format(run.layout.root)
    assert run.record.format_version == 1
    assert run.record.config.gsd_m == 0.23
    assert (run.grid.width_px, run.grid.height_px, run.grid.gsd_m) == (80, 64, 0.23)


def test_the_field_has_its_values(run: Run) -> None:
    east, south = run.field.at(40, 14), run.field.at(60, 40)
    assert (east.n, south.n) == (2, 1)
    np.testing.assert_allclose(east.modal_velocity_px_per_s, (35, 0), atol=0.5)
    np.testing.assert_allclose(south.modal_velocity_px_per_s, (0, 28), atol=0.5)
    assert np.isnan(run.field.modal_velocity()[2, 2]).all()
    density = run.field.log_density(np.array([[40.0, 14.0]] * 2), np.array([[35.0, 0.0], [-35.0, 0.0]]))
    assert density[0] > density[1] + 3


def test_the_tracks_are_read(run: Run) -> None:
    table = run.tracklets()
    assert len(table) == 27
    assert table["vx_01_px_per_s"].max() == pytest.approx(35, abs=0.1)


def test_a_later_format_is_refused_in_one_line(run: Run) -> None:
    path = run.layout.flight
    path.write_text(path.read_text().replace('"format_version":1', '"format_version":2'))
    with pytest.raises(InputError, match=r"run folder of format 2, this velfield reads format 1"):
        open_run(run.layout.root)


def test_a_detector_file_is_read() -> None:
    detector = load_detector(FOLDER / "detector.json")
    assert (detector.method, detector.threshold, detector.record.cars) == ("paper", 1.25, 40)
    assert detector.record.working_car_length_px == 16
    assert [one.leaf_high for one in detector.record.rounds] == [0.75]
