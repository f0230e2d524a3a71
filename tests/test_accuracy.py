"""A flight long enough for five vehicles a pixel, held to the figures that the long one reached."""

from pathlib import Path

import pytest

from flows.console import Console
from flows.runners import RunnerConfig
from schemas.job import Inputs, Job
from schemas.simulation import SimulationConfig
from velfield.pipeline.configuration import resolve_config
from velfield.synthetic.write import write_flight

FRAMES = 64


@pytest.mark.slow
def test_a_flight_with_base_image_and_labels_is_near_the_truth(server: None, tmp_path: Path) -> None:
    from flows.process_flight import run_flight
    from velfield.synthetic.run_score import score_run

    flight = tmp_path / "flight"
    write_flight(flight, SimulationConfig(frames=FRAMES, width=960, height=720, seed=33))
    inputs = Inputs(
        source=str(flight / "frames"),
        timestamps=str(flight / "timestamps.csv"),
        base=str(flight / "base.png"),
        labels=str(flight / "labels.csv"),
    )
    settings = [
        "detection.fine_tune_steps=20",
        "registration.max_keypoints=1500",
    ]
    config = resolve_config(settings=settings, overrides={"gsd_m": 0.23})
    run_flight(Job(root=str(tmp_path / "run"), inputs=inputs, config=config), RunnerConfig(), Console("quiet"))
    score = score_run(tmp_path / "run", flight)
    assert score.registration.mean_px <= 1
    assert score.tracking.precision >= 0.95
    assert score.field.pixels >= 1000
    assert score.field.fraction_within >= 0.95
