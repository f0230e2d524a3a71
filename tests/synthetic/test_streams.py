"""Seeds, times, observation errors and camera motion: independence, statistics, bounds."""

from dataclasses import fields, replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.arrays import FloatArray
from schemas.simulation import CameraSimulation, SimulationConfig, TimesSimulation, TrafficSimulation
from schemas.tables import TRACKLET_COLUMNS
from tests.field_runs import flight as small_city
from velfield.synthetic.camera import motion_waves, shake_waves
from velfield.synthetic.cases import PINHOLE, small_flight
from velfield.synthetic.flight import Flight, frame_times
from velfield.synthetic.observed import NO_ERRORS, Errors, observed_detections, observed_tracklets
from velfield.synthetic.random_streams import RandomStream, random_generator
from velfield.synthetic.write import frame_name, labelled_frames


def test_streams_of_one_seed_are_reproducible_and_independent() -> None:
    draws = {s: random_generator(7, s).standard_normal(500) for s in RandomStream}
    for stream, draw in draws.items():
        assert np.array_equal(draw, random_generator(7, stream).standard_normal(500))
        assert not np.array_equal(draw, random_generator(8, stream).standard_normal(500))
    correlation = np.corrcoef(np.array(list(draws.values())))
    assert np.abs(correlation[~np.eye(len(draws), dtype=bool)]).max() < 0.2
    frames = [random_generator(7, RandomStream.FRAME, k).standard_normal() for k in range(3)]
    assert len(set(frames)) == 3


def small(**sections: object) -> Flight:
    return small_flight(frames=2, width=96, height=64, seed=4, **sections)


def test_changing_one_effect_leaves_the_random_numbers_of_the_others() -> None:
    plain = small()
    traffic = small(traffic=TrafficSimulation(flow_veh_per_h=300))
    assert np.array_equal(plain.city.scene.mosaic, traffic.city.scene.mosaic)
    assert np.array_equal(plain.base_image, traffic.base_image)
    assert not np.array_equal(plain.city.traffic.distance_m[:50], traffic.city.traffic.distance_m[:50])
    late = small(times=TimesSimulation(late_half_share=0.5))
    assert np.array_equal(plain.camera.motion.phase_rad, late.camera.motion.phase_rad)
    shaken = small(camera=CameraSimulation(vibration_px=3.0))
    assert np.array_equal(plain.times_s, shaken.times_s)
    assert np.array_equal(plain.camera.motion.amplitude, shaken.camera.motion.amplitude)


@pytest.mark.parametrize(("half", "whole"), [(0.0, 0.0), (0.3, 0.0), (0.1, 0.2)])
def test_late_frames_have_their_fractions_and_delays(half: float, whole: float) -> None:
    config = TimesSimulation(fps=5.0, late_half_share=half, late_whole_share=whole, jitter_s=0.0)
    times = frame_times(config, 4001, np.random.default_rng(0))
    steps = np.diff(times)
    assert times[0] == 0.0
    for step, fraction in ((0.2, 1 - half - whole), (0.3, half), (0.4, whole)):
        assert np.isclose(steps, step).mean() == pytest.approx(fraction, abs=0.03)
    assert np.isclose(steps[:, None], [0.2, 0.3, 0.4]).any(axis=1).all()


@settings(max_examples=25)
@given(seed=st.integers(0, 1000), jitter=st.floats(0, 0.02), fps=st.floats(2, 60))
def test_times_ascend_for_any_jitter_and_rate(seed: int, jitter: float, fps: float) -> None:
    config = TimesSimulation(fps=fps, jitter_s=jitter)
    steps = np.diff(frame_times(config, 200, np.random.default_rng(seed)))
    assert steps.min() > 0.5 / fps
    assert steps.max() < 2.5 / fps


def test_jitter_has_its_standard_deviation() -> None:
    config = TimesSimulation(late_half_share=0, late_whole_share=0, jitter_s=0.004)
    steps = np.diff(frame_times(config, 5000, np.random.default_rng(1)))
    assert steps.std() == pytest.approx(0.004, rel=0.05)
    assert np.abs(steps - 0.2).max() <= 3 * 0.004 + 1e-12
    assert len(frame_times(config, 1, np.random.default_rng(1))) == 1


@settings(max_examples=20)
@given(seed=st.integers(0, 1000))
def test_motion_never_exceeds_its_amplitudes_and_is_smooth(seed: int) -> None:
    amplitudes = np.array([8.0, 3.0, 0.0])
    waves = motion_waves(amplitudes, period_s=40.0, rng=np.random.default_rng(seed))
    value = waves(np.linspace(0, 300, 3001))
    assert (np.abs(value).max(axis=1) <= amplitudes + 1e-9).all()
    assert (value[2] == 0).all()
    fastest = 2 * np.pi / (0.6 * 40.0)
    assert (np.abs(np.diff(value, axis=1)).max(axis=1) <= amplitudes * fastest * 0.1 + 1e-9).all()


def test_vibration_is_a_sine_of_its_cycles_a_readout_or_within_its_band() -> None:
    tone = shake_waves(
        CameraSimulation(vibration_px=2.0, vibration_cycles=6.0, readout_s=0.1), np.random.default_rng(0)
    )
    assert tone.omega_rad_per_s / (2 * np.pi) == pytest.approx(np.full((2, 1), 60.0))
    value = tone(np.linspace(0, 0.1, 2001))
    assert np.abs(value).max(axis=1) == pytest.approx([2.0, 2.0], abs=1e-3)
    assert value[:, 0] == pytest.approx(value[:, -1], abs=1e-6)
    band = shake_waves(CameraSimulation(vibration_px=2.0), np.random.default_rng(0))
    assert band.amplitude.sum(axis=1) == pytest.approx([2.0, 2.0])
    hz = band.omega_rad_per_s / (2 * np.pi)
    assert 14 <= hz.min() <= hz.max() <= 29


@pytest.mark.parametrize("scale", [0.8, 1.0, 1.5])
def test_the_camera_has_its_scale_and_heading_at_the_centre(scale: float) -> None:
    still = PINHOLE.model_copy(
        update={
            "scale": scale,
            "heading_deg": 30.0,
            "turn_deg": 0.0,
            "tilt_deg": 0.0,
            "drift_m": 0.0,
            "climb_share": 0.0,
        }
    )
    camera = small_flight(frames=1, width=96, height=64, camera=still, scene={"relief_m": 0.0}).camera
    centre = np.array([[47.5, 31.5], [48.5, 31.5]])
    base = camera.to_base(0, centre)
    assert base[0] == pytest.approx(camera.position_px[:2])
    step = base[1] - base[0]
    assert np.hypot(*step) == pytest.approx(1 / scale)
    assert np.degrees(np.arctan2(step[1], step[0])) == pytest.approx(30.0)
    assert camera.undistort(camera.distort(centre)) == pytest.approx(centre)


def test_rows_are_exposed_one_after_the_other() -> None:
    camera = small_flight(frames=2, width=96, height=64, camera=CameraSimulation(readout_s=0.1)).camera
    rows = camera.row_time_s(1, np.array([0.0, 31.5, 63.0]))
    assert rows - camera.times_s[1] == pytest.approx([0.0, 0.05, 0.1])
    rotation = camera.row_table(1, np.arange(64.0))[:, :9].reshape(-1, 3, 3)
    assert np.einsum("nij,nkj->nik", rotation, rotation) == pytest.approx(np.tile(np.eye(3), (64, 1, 1)))


@pytest.mark.parametrize("height_px", [0.0, 15.0])
def test_projection_of_raised_points_is_consistent_with_rays(height_px: float) -> None:
    """A point at a height lies on the ray of its raw pixel: it hides the ground where that ray meets it."""
    camera = small_flight(
        frames=1, width=320, height=240, camera=CameraSimulation(tilt_deg=3.0), scene={"relief_m": 0.0}
    ).camera
    ground = camera.to_base(0, np.random.default_rng(0).uniform([40, 40], [280, 200], (50, 2)))
    raw = camera.to_raw(0, ground, above_px=height_px)
    hit = camera.to_base(0, raw)
    pose = camera.row_table(0, raw[:, 1])
    eye, up = pose[:, 9:11], -pose[:, 11]
    on_ray = eye + (hit - eye) * ((up - height_px) / up)[:, None]
    assert on_ray == pytest.approx(ground, abs=1e-6)


def observed(errors: Errors, seed: int = 0) -> tuple[pd.DataFrame, Flight]:
    made = small_city(3, 60)
    rng = np.random.default_rng(seed)
    table = observed_tracklets(
        made.city.traffic, made.times_s, made.city.to_px, shape=made.base_shape, rng=rng, errors=errors
    )
    return table, made


def true_positions(made: Flight, ids: FloatArray, times_s: FloatArray) -> FloatArray:
    return made.city.to_px(made.city.traffic.at(ids.astype(np.int64) & (2**20 - 1), times_s)[0])


def test_without_errors_tracklets_are_the_true_trajectories() -> None:
    table, made = observed(NO_ERRORS)
    assert {name: str(kind) for name, kind in table.dtypes.items()} == TRACKLET_COLUMNS
    for k in range(3):
        true = true_positions(made, table[f"detection_id_{k}"].to_numpy(), table[f"time_{k}_s"].to_numpy())
        assert np.abs(table[[f"x_{k}_px", f"y_{k}_px"]].to_numpy() - true).max() < 1e-6
    for a, b, link in ((0, 1, "01"), (1, 2, "12")):
        interval = (table[f"time_{b}_s"] - table[f"time_{a}_s"]).to_numpy()
        for axis in "xy":
            moved = (table[f"{axis}_{b}_px"] - table[f"{axis}_{a}_px"]).to_numpy()
            assert table[f"v{axis}_{link}_px_per_s"].to_numpy() == pytest.approx(moved / interval, abs=1e-6)
    vehicle = table["detection_id_1"].to_numpy() & (2**20 - 1)
    assert pd.Series(table["track_id"].to_numpy()).groupby(vehicle).nunique().max() == 1


def test_errors_have_their_standard_deviations() -> None:
    errors = Errors(recall=1.0, position_sd_px=0.9, displacement_sd_px=0.2, claimed_sd_px=0.3, unaligned_fraction=0.1)
    table, made = observed(errors)
    true = [
        true_positions(made, table[f"detection_id_{k}"].to_numpy(), table[f"time_{k}_s"].to_numpy()) for k in range(3)
    ]
    offset = table[["x_1_px", "y_1_px"]].to_numpy() - true[1]
    assert offset.std() == pytest.approx(0.9, rel=0.05)
    interval = (table["time_1_s"] - table["time_0_s"]).to_numpy()
    moved = table[["vx_01_px_per_s", "vy_01_px_per_s"]].to_numpy() * interval[:, None]
    aligned = table["displacement_sd_01_px"].to_numpy() < 0.5
    assert aligned.mean() == pytest.approx(0.9, abs=0.03)
    assert (moved - (true[1] - true[0]))[aligned].std() == pytest.approx(0.2, rel=0.05)
    assert (moved - (true[1] - true[0]))[~aligned].std() == pytest.approx(0.9 * np.sqrt(2), rel=0.15)
    assert table.loc[~aligned, "displacement_sd_01_px"].to_numpy() == pytest.approx(0.9 * np.sqrt(2))


@pytest.mark.parametrize("recall", [0.5, 0.9])
def test_detections_have_their_recall(recall: float) -> None:
    made = small_city(3, 60)
    counts = [
        len(
            observed_detections(
                made.city.traffic, made.times_s, made.city.to_px, shape=made.base_shape, rng=np.random.default_rng(1),
                errors=replace(NO_ERRORS, recall=r),
            )
        )
        for r in (1.0, recall)
    ]  # fmt: skip
    assert counts[1] / counts[0] == pytest.approx(recall, abs=0.04)
    assert {field.name for field in fields(NO_ERRORS)} >= {"recall", "position_sd_px"}


def test_a_missed_detection_ends_a_track() -> None:
    full, _ = observed(NO_ERRORS)
    missed, _ = observed(replace(NO_ERRORS, recall=0.7))
    assert missed["track_id"].nunique() > 1.3 * full["track_id"].nunique()
    assert len(missed) == pytest.approx(0.7**3 * len(full), rel=0.15)


def test_labelled_frames_are_spread_and_names_sort() -> None:
    config = SimulationConfig(frames=30, labelled_frames=4)
    assert labelled_frames(config) == [0, 7, 15, 22]
    assert labelled_frames(config.model_copy(update={"labelled_frames": 0})) == []
    assert labelled_frames(SimulationConfig(frames=2, labelled_frames=9)) == [0, 1]
    names = [frame_name(k, config) for k in (2, 10, 100)]
    assert names == sorted(names)
    assert frame_name(3, config.model_copy(update={"picture_format": "jpg"})) == "00003.jpg"


def test_cars_of_a_frame_are_at_the_exposure_time_of_their_row_and_move_with_their_velocity() -> None:
    made = small_flight(
        frames=2, width=320, height=240, seed=3, camera=CameraSimulation(readout_s=0.15), traffic={"warm_up_s": 40}
    )
    cars = made.cars(1)
    assert cars["time_s"].to_numpy() == pytest.approx(made.camera.row_time_s(1, cars["y_raw_px"].to_numpy()), abs=2e-4)
    moving = cars[cars["moving"] & cars["visible"]]
    assert len(moving) >= 3
    vehicle, times = moving["vehicle_id"].to_numpy(), moving["time_s"].to_numpy()
    ahead, behind = (made.city.to_px(made.city.traffic.at(vehicle, times + d)[0]) for d in (0.01, -0.01))
    velocity = moving[["vx_px_per_s", "vy_px_per_s"]].to_numpy()
    assert np.median(np.abs((ahead - behind) / 0.02 - velocity)) < 0.05
    assert moving["orientation_rad"].between(0, np.pi).all()
    parked = cars[~cars["moving"]]
    assert (parked[["vx_px_per_s", "vy_px_per_s"]].abs().to_numpy() < 0.5 / made.config.gsd_m).all()
