"""Rendered frames, the base image, written and reread flights, and scores of simulated flights."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from schemas.simulation import CameraSimulation, SimulationConfig, TrafficSimulation
from velfield.errors import InputError
from velfield.synthetic.cases import FLAT, small_flight
from velfield.synthetic.score import score_field
from velfield.synthetic.truth import LanePath, Truth, load_truth, make_truth
from velfield.synthetic.write import write_flight

STEADY = CameraSimulation(noise_grey=0, motion_blur_px=0, exposure_share=0)


@pytest.fixture(scope="module")
def truth() -> Truth:
    return make_truth(small_flight(frames=12))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("flight") / "sim"
    calls: list[tuple[int, int]] = []
    config = SimulationConfig(frames=6, width=320, height=240, labelled_frames=2)
    write_flight(out, config, lambda done, total: calls.append((done, total)))
    assert calls == [(k, 6) for k in range(1, 7)]
    return out


def test_a_seed_determines_the_images() -> None:
    first, again, other = (small_flight(frames=2, width=320, height=240, seed=s) for s in (5, 5, 6))
    assert np.array_equal(first.frame(1), again.frame(1))
    assert np.array_equal(first.base_image, again.base_image)
    assert not np.array_equal(first.frame(1), other.frame(1))


def test_frames_do_not_depend_on_the_order_of_rendering() -> None:
    forward, backward = small_flight(frames=3, width=320, height=240), small_flight(frames=3, width=320, height=240)
    first = [forward.frame(k) for k in range(3)]
    second = [backward.frame(k) for k in (2, 1, 0)][::-1]
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_cars_are_drawn_at_their_labels() -> None:
    scene = FLAT.model_copy(update={"sun_length": 0.0})
    flight = small_flight(frames=3, camera=STEADY, scene=scene)
    empty = small_flight(
        frames=3,
        camera=STEADY,
        scene=scene.model_copy(update={"parked_share": 0.0}),
        traffic=TrafficSimulation(flow_veh_per_h=0, warm_up_s=0),
    )
    painted = np.abs(flight.frame(2).astype(int) - empty.frame(2).astype(int)) > 1
    labels = flight.labels(2)
    inside = labels["x_px"].between(25, 614) & labels["y_px"].between(25, 454)
    alone = labels[inside & (labels["length_px"] < 30)]
    assert len(alone) > 15
    offsets = []
    for car in alone.itertuples():
        box = cv2.boxPoints(
            ((car.x_px, car.y_px), (car.length_px + 3, car.width_px + 3), np.degrees(car.orientation_rad))
        )
        mask = np.zeros(painted.shape, np.uint8)
        cv2.fillPoly(mask, [np.rint(box).astype(np.int32)], 1)
        y, x = np.nonzero(painted & (mask > 0))
        assert len(x) > 0.6 * car.length_px * car.width_px
        offsets.append((x.mean() - car.x_px, y.mean() - car.y_px))
    assert np.abs(np.median(offsets, axis=0)).max() < 0.3
    assert np.median(np.hypot(*np.array(offsets).T)) < 0.8


def test_the_base_image_is_of_another_sensor_and_has_no_traffic() -> None:
    flight = small_flight(frames=2)
    frame, base = flight.frame(0), flight.base_image
    y, x = np.mgrid[0:480:4, 0:640:4]
    at = flight.camera.to_base(0, np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)).astype(np.float32)
    seen = cv2.remap(base, at[:, 0].reshape(y.shape), at[:, 1].reshape(y.shape), cv2.INTER_LINEAR)
    correlation = np.corrcoef(frame[::4, ::4].ravel(), seen.ravel())[0, 1]
    assert 0.4 < correlation < 0.97
    inside = (at > 0).all() and (at < base.shape[::-1]).all()
    assert inside


def test_the_written_files_are_a_users_input(written: Path) -> None:
    frames = sorted((written / "frames").glob("*.png"))
    times = pd.read_csv(written / "timestamps.csv")
    assert [f.name for f in frames] == times["frame"].tolist()
    assert (np.diff(times["time_s"]) > 0).all()
    assert cv2.imread(str(frames[0]), cv2.IMREAD_UNCHANGED).shape == (240, 320)
    labels = pd.read_csv(written / "labels.csv")
    assert list(labels.columns) == ["frame", "x_px", "y_px", "orientation_rad", "length_px", "width_px"]
    assert set(labels["frame"]) == {"00000.png", "00003.png"}
    assert labels["orientation_rad"].between(0, np.pi).all()
    base = cv2.imread(str(written / "base.png"), cv2.IMREAD_UNCHANGED)
    assert base.shape == load_truth(written).base_shape


def test_another_flight_is_not_overwritten(written: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="another configuration"):
        write_flight(written, SimulationConfig(frames=6, width=320, height=240, seed=9))
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="other files"):
        write_flight(tmp_path, SimulationConfig(frames=1, width=64, height=64))
    with pytest.raises(InputError, match="no truth"):
        load_truth(tmp_path)
    assert json.loads((written / "simulation.json").read_text())["seed"] == 0


def test_cars_of_the_truth_agree_with_its_transform(truth: Truth) -> None:
    cars = truth.cars[(truth.cars["frame"] == 7) & truth.cars["visible"]]
    raw, base = cars[["x_raw_px", "y_raw_px"]].to_numpy(), cars[["x_base_px", "y_base_px"]].to_numpy()
    assert np.abs(truth.to_base(7, raw) - base).max() < 0.02


def test_a_field_along_the_lanes_scores_perfectly_and_one_across_does_not(truth: Truth) -> None:
    h, w = truth.base_shape
    velocity, count = np.full((h, w, 2), np.nan), np.zeros((h, w), int)
    cars = truth.cars[truth.cars["visible"] & truth.cars["moving"]]
    at = np.rint(cars[["x_base_px", "y_base_px"]].to_numpy()).astype(int)
    inside = (at >= 0).all(axis=1) & (at < [w, h]).all(axis=1)
    velocity[at[inside, 1], at[inside, 0]] = cars.loc[inside, ["vx_px_per_s", "vy_px_per_s"]].to_numpy()
    count[at[inside, 1], at[inside, 0]] = 5
    assert score_field(truth, velocity, count).fraction_within > 0.99
    across = np.stack([-velocity[..., 1], velocity[..., 0]], axis=-1)
    assert score_field(truth, across, count).fraction_within < 0.2
    half = np.diag([0.5, 0.5, 1.0])
    shrunk, few = velocity[::2, ::2], count[::2, ::2]
    assert score_field(truth, shrunk, few, to_truth=np.linalg.inv(half)).fraction_within > 0.97


def test_the_direction_in_a_tight_turn_is_that_of_the_lane_at_the_pixel(truth: Truth) -> None:
    """A roundabout of 9 m: no error along the lane, on either side of its centre line, nor before or behind."""
    angle = np.linspace(0, 1.5 * np.pi, 60)
    path = 150 + 40 * np.column_stack([np.cos(angle), np.sin(angle)])
    turn = replace(truth, lanes=[LanePath("turn", path, 20.0)])
    y, x = np.mgrid[: truth.base_shape[0], : truth.base_shape[1]].astype(float) - 150
    error = turn.direction_error_rad(np.stack([x, y], axis=-1).reshape(-1, 2) + 150, np.arctan2(x, -y).ravel())
    error = error.reshape(x.shape)
    here = (np.abs(np.hypot(x, y) - 40) < 9) & (np.mod(np.arctan2(y, x), 2 * np.pi) < 1.45 * np.pi)
    assert np.degrees(error[here].max()) < 4.0
    assert (error[np.abs(np.hypot(x, y) - 40) > 11] == np.pi).all()
