"""Pictures of unusual tracks: the vehicle is where the ring is, in frames drawn for the purpose."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.arrays import GreyImage
from tests.analysis.test_traffic_analysis import EAST, STEP_S, drive, gather
from tests.scenes import frame_map
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.errors import StoreError
from velfield.exports.georeference import Georeference
from velfield.pipeline.analysis.analyse import write_analysis
from velfield.pipeline.analysis.clips import Frames, unusual_clips

WIDTH, HEIGHT, GSD_M = 1310, 700, 0.2
GROUND, CAR = 90, 230


@pytest.fixture(scope="module")
def analysis() -> TrafficAnalysis:
    """Twelve vehicles to the east, and one that drives the wrong way."""
    return TrafficAnalysis(gather([drive(EAST, 4.0 * k) for k in range(12)] + [drive(EAST[::-1], 20.0)]))


def frames(analysis: TrafficAnalysis, *, registered: bool = True) -> Frames:
    """Frames with a bright square at the wrong-way vehicle's place alone."""
    tracks = analysis.trajectories
    times = np.arange(0.0, 70.0, STEP_S)
    rows = slice(int(tracks.first[12]), int(tracks.first[13]))

    def read(frame: int) -> GreyImage:
        image = np.full((HEIGHT, WIDTH), GROUND, np.uint8)
        if tracks.time_s[rows][0] <= times[frame] <= tracks.time_s[rows][-1]:
            x, y = (int(np.interp(times[frame], tracks.time_s[rows], tracks.xy_m[rows][:, k]) / GSD_M) for k in (0, 1))
            image[y - 6 : y + 7, x - 12 : x + 13] = CAR
        return image

    identity = frame_map(np.eye(3), (HEIGHT, WIDTH))
    return Frames(times, read, lambda frame: identity if registered else None)


def test_the_vehicle_is_in_the_middle_and_moves_through_the_strip(analysis: TrafficAnalysis) -> None:
    ((number, data),) = unusual_clips(analysis, frames(analysis))
    assert number == 0
    strip = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert strip.shape == (220, 5 * 220 + 4 * 4)
    parts = [strip[:, k * 224 : k * 224 + 220] for k in range(5)]
    # a car of 25 x 13 px at 220 px for 50 m, of which the ring takes no part
    xs = [
        np.flatnonzero(cv2.erode((part > 180).astype(np.uint8), np.ones((7, 11))).any(axis=0)).mean() for part in parts
    ]
    assert xs[2] == pytest.approx(110, abs=3)
    assert np.diff(xs) == pytest.approx(-12.0 * 220 / 50, abs=3)  # westwards, 12 m in a second


def test_without_frames_there_is_no_strip(analysis: TrafficAnalysis) -> None:
    assert list(unusual_clips(analysis, frames(analysis, registered=False))) == []

    def gone(frame: int) -> GreyImage:
        raise StoreError("gone")

    there = frames(analysis)
    assert list(unusual_clips(analysis, Frames(there.times_s, gone, there.transform))) == []


def test_the_report_and_the_table_show_it(analysis: TrafficAnalysis, tmp_path: Path) -> None:
    place = Georeference((HEIGHT, WIDTH), gsd_m=GSD_M)
    list(
        write_analysis(
            analysis, tmp_path, place, about="a flight", gsd_known=True, picture=None, frames=frames(analysis)
        )
    )
    assert (tmp_path / "clips" / "unusual-000.jpg").is_file()
    assert "clips/unusual-000.jpg" in (tmp_path / "analysis.json").read_text()
    text = (tmp_path / "report.html").read_text()
    assert text.count("<figure>") == 1
    assert "wrong way, track 12" in text
    list(write_analysis(analysis, tmp_path, place, about="a flight", gsd_known=True, picture=None))
    assert not (tmp_path / "clips").exists()
    assert "<figure>" not in (tmp_path / "report.html").read_text()
