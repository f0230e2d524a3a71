"""A camera on a mast over a quiet road: a run of it gives detections, tracks and a field, without a warning."""

import numpy as np
import pytest

from schemas.simulation import CameraSimulation, SimulationConfig, TrafficSimulation
from tests.small_flight import job
from velfield import open_run
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.pipeline.stage import stages_before
from velfield.run.commits import read_commits
from velfield.run.layout import RunLayout
from velfield.run.stores import RegistrationStore
from velfield.synthetic.write import write_flight

STILL = CameraSimulation(drift_m=0, climb_share=0, turn_deg=0, tilt_deg=0, vibration_px=0)
FRAMES = 10


@pytest.fixture(scope="module")
def layout(tmp_path_factory: pytest.TempPathFactory) -> RunLayout:
    """A run without labels, in which few vehicles move."""
    folder = tmp_path_factory.mktemp("mast")
    quiet = TrafficSimulation(flow_veh_per_h=500)
    config = SimulationConfig(frames=FRAMES, width=560, height=420, seed=11, camera=STILL, traffic=quiet)
    write_flight(folder / "flight", config)
    work = job(folder / "flight", folder / "run")
    plan = make_plan(work.model_copy(update={"inputs": work.inputs.model_copy(update={"labels": None})}))
    write_flight_record(plan)
    compute_stages(plan, stages_before("maps"))
    return plan.layout


def test_every_frame_is_registered(layout: RunLayout) -> None:
    assert RegistrationStore(layout.registration).statuses() == ["ok"] * FRAMES


def test_vehicles_are_detected_tracked_and_counted(layout: RunLayout) -> None:
    run = open_run(layout.root)
    tracklets = run.tracklets()
    moving = np.hypot(tracklets["vx_12_px_per_s"], tracklets["vy_12_px_per_s"]) > 10
    assert set(run.detections()["frame"]) == set(range(FRAMES))
    assert moving.sum() > 20
    assert (run.field.count() > 0).sum() > 500


def test_nothing_is_warned_of(layout: RunLayout) -> None:
    stages = [*stages_before("maps")]
    warnings = {line for stage in stages for record in read_commits(layout, stage) for line in record.warnings}
    assert warnings == set()
