"""Tracks of other programs: what is read, and what is said of the rest."""

from pathlib import Path

import pytest

from velfield.errors import InputError
from velfield.sources.trajectories import read_tracks


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_metres_with_times(tmp_path: Path) -> None:
    path = written(tmp_path / "t.csv", "track_id,time_s,x_m,y_m\nb,10.0,1,2\nb,10.5,2,2\na,10.0,5,5\n")
    table = read_tracks(path)
    assert table["time_s"].tolist() == [0.0, 0.5, 0.0]
    assert table["track_id"].tolist() == [0, 0, 1]
    assert table["x_m"].tolist() == [1.0, 2.0, 5.0]


def test_pixels_with_frames(tmp_path: Path) -> None:
    path = written(tmp_path / "t.csv", "Vehicle_ID;Frame_Number;x;y\n1;100;10;20\n1;105;12;20\n")
    table = read_tracks(path, fps=25.0, unit="px")
    assert table["time_s"].tolist() == pytest.approx([0.0, 0.2])
    assert table["frame"].tolist() == [0, 5]
    with pytest.raises(InputError, match="--fps"):
        read_tracks(path, unit="px")
    with pytest.raises(InputError, match="--unit"):
        read_tracks(path, fps=25.0)


def test_highd_gives_corners_of_boxes(tmp_path: Path) -> None:
    text = "frame,id,x,y,width,height,xVelocity,yVelocity\n1,1,10,20,4,2,30,0\n2,1,11,20,4,2,30,0\n"
    assert read_tracks(written(tmp_path / "t.csv", text), fps=25.0)["x_m"].tolist() == [12.0, 13.0]


def test_fcd_of_sumo_has_y_to_the_north(tmp_path: Path) -> None:
    text = (
        '<fcd-export><timestep time="0.00"><vehicle id="v.1" x="1.0" y="5.0" speed="3"/></timestep>'
        '<timestep time="0.50"><vehicle id="v.1" x="2.0" y="6.0" speed="3"/></timestep></fcd-export>'
    )
    table = read_tracks(written(tmp_path / "fcd.xml", text))
    assert table[["time_s", "x_m", "y_m"]].to_numpy().tolist() == [[0.0, 1.0, -5.0], [0.5, 2.0, -6.0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "expected a column of the track"),
        ("id,time,x_m,y_m\n1,0,hello,2\n", "'hello' in column x_m, row 2"),
        ("id,time,x_m,y_m\n", "no tracks in it"),
    ],
)
def test_bad_files(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_tracks(written(tmp_path / "t.csv", text))


def test_files_that_are_no_tables_are_one_line(tmp_path: Path) -> None:
    damaged = tmp_path / "t.parquet"
    damaged.write_bytes(b"PAR1 and no more")
    with pytest.raises(InputError, match="no Parquet file that can be read") as error:
        read_tracks(damaged)
    assert "\n" not in str(error.value)
    endless = written(tmp_path / "t.csv", "track_id,frame,x_px,y_px\n1,1,2,3\n1,inf,2,3\n")
    with pytest.raises(InputError, match="found inf in column frame, row 3, expected a number"):
        read_tracks(endless, fps=5.0)
    with pytest.raises(InputError, match="expected"):
        read_tracks(written(tmp_path / "e.csv", "\x00\n"))
