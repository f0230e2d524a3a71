"""A flight long enough for five vehicles a pixel, held to the figures that the long one reached."""

from pathlib import Path

import pytest

from schemas.job import Inputs, Job
from schemas.simulation import SimulationConfig
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.synthetic.run_score import score_run
from velfield.synthetic.write import write_flight

FRAMES = 44


@pytest.mark.slow
def test_a_flight_with_base_image_and_labels_is_near_the_truth(tmp_path: Path) -> None:
    flight = tmp_path / "flight"
    write_flight(flight, SimulationConfig(frames=FRAMES, width=560, height=420, seed=33))
    settings = ["detection.fine_tune_steps=20", "registration.max_keypoints=1500"]
    config = resolve_config(settings=settings, overrides={"gsd_m": 0.23})
    plan = make_plan(Job(root=str(tmp_path / "run"), inputs=Inputs.from_simulated_flight(flight), config=config))
    write_flight_record(plan)
    compute_stages(plan)
    score = score_run(tmp_path / "run", flight)
    assert score.registration.mean_px <= 1
    assert score.tracking.precision >= 0.95
    assert score.field.pixels >= 1000
    assert score.field.fraction_within >= 0.95
