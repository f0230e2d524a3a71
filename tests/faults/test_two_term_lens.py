"""A lens that one term cannot describe, its centre off: what is answered is right, and nothing comes from elsewhere.

The flight's lens is drawn by the seed (``two_term_lens``); nothing of it is given to the run.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.ndimage import grey_dilation

from schemas.arrays import FloatArray, Mask
from tests.small_flight import job
from velfield import open_run
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.pipeline.stage import stages_before
from velfield.run.run import Run
from velfield.synthetic.cases import two_term_lens
from velfield.synthetic.run_score import RunScore, score_run
from velfield.synthetic.truth import load_truth
from velfield.synthetic.write import write_flight

SEED = 731
FRAMES = 4
WIDTH, HEIGHT = 960, 720


class LensFlight(NamedTuple):
    run: Run
    score: RunScore
    supported: Mask
    """Base pixels (frames, h, w) that a raw pixel which has a position is brought to, by the truth; to 5 px."""


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> LensFlight:
    folder = tmp_path_factory.mktemp("lens")
    write_flight(folder / "flight", two_term_lens(width=WIDTH, height=HEIGHT, frames=FRAMES, seed=SEED))
    settings = ("lens.calibrate=auto", "registration.max_keypoints=6000")
    plan = make_plan(job(folder / "flight", folder / "run", *settings))
    write_flight_record(plan)
    compute_stages(plan, stages_before("maps"))
    run = open_run(folder / "run")
    score = score_run(folder / "run", folder / "flight", min_count=2)
    return LensFlight(run, score, supported_pixels(run, folder / "flight"))


def supported_pixels(run: Run, flight: Path) -> Mask:
    truth = load_truth(flight)
    h, w = truth.base_shape
    raw = np.stack(np.meshgrid(np.arange(0.0, WIDTH, 4), np.arange(0.0, HEIGHT, 4)), axis=-1).reshape(-1, 2)
    supported = np.zeros((FRAMES, h, w), dtype=bool)
    for frame in range(FRAMES):
        x, y = np.rint(truth.to_base(frame, raw[has_position(run, frame, raw)])).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < w) & (y < h)
        supported[frame, y[inside], x[inside]] = True
    return grey_dilation(supported, (1, 9, 9))


def has_position(run: Run, frame: int, xy_raw: FloatArray) -> Mask:
    return np.isfinite(run.to_base(frame, xy_raw)).all(axis=1)


def test_some_corner_of_every_frame_has_no_position(flight: LensFlight) -> None:
    """Else what follows would show nothing."""
    x, y = np.arange(0.0, WIDTH, 4), np.arange(0.0, HEIGHT, 4)
    xy_raw = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    shares = [has_position(flight.run, frame, xy_raw).mean() for frame in range(FRAMES)]
    assert 0.97 < min(shares) <= max(shares) < 1


def test_positions_are_right_wherever_there_are_any(flight: LensFlight) -> None:
    registration = flight.score.registration
    assert registration.frames == FRAMES
    assert registration.p95_px <= 0.8
    assert registration.answered >= 0.97


def test_detections_and_tracklets_lie_where_there_are_positions(flight: LensFlight) -> None:
    detections, tracklets = flight.run.detections(), flight.run.tracklets()
    tables = [detections[["frame", "x_px", "y_px"]]]
    tables += [tracklets[[f"frame_{k}", f"x_{k}_px", f"y_{k}_px"]] for k in range(3)]
    assert min(len(table) for table in tables) > 200
    for table in tables:
        frame, x, y = np.rint(table.to_numpy()).astype(int).T
        assert flight.supported[frame, y, x].all()


def test_vehicles_are_where_the_truth_has_them(flight: LensFlight) -> None:
    assert flight.score.detection.precision > 0.9
    assert flight.score.tracking.precision > 0.9
    assert flight.score.tracking.speed_error_mean_km_per_h < 1.5


def test_the_field_counts_where_there_are_positions(flight: LensFlight) -> None:
    counted = flight.run.field.count() > 0
    assert counted.sum() > 5000
    assert not (counted & ~flight.supported.any(axis=0)).any()
