"""The simulated camera: exact in both directions, each effect alone, and consistent with rendered frames."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.arrays import FloatArray
from schemas.simulation import (
    CameraSimulation,
    OtherSensorSimulation,
    SceneSimulation,
    SimulationConfig,
    TrafficSimulation,
)
from velfield.errors import InputError
from velfield.synthetic.cases import (
    FLAT,
    PINHOLE,
    homography_only,
    lens_and_wobble,
    lens_only,
    small_flight,
    two_term_lens,
    vibration_and_drift,
)
from velfield.synthetic.flight import Flight

EMPTY = TrafficSimulation(flow_veh_per_h=0, warm_up_s=0)
SAME_SENSOR = OtherSensorSimulation(same_sensor=True, noise_grey=0)


def raw_points(config: SimulationConfig, n: int = 400, seed: int = 0) -> FloatArray:
    rng = np.random.default_rng(seed)
    return rng.uniform([0, 0], [config.width - 1, config.height - 1], (n, 2))


@pytest.mark.parametrize("case", [homography_only, lens_only, lens_and_wobble, vibration_and_drift, two_term_lens])
def test_to_raw_inverts_to_base(case) -> None:
    flight = Flight(case(width=640, height=480, frames=4))
    xy = raw_points(flight.config)
    for frame in range(4):
        base = flight.camera.to_base(frame, xy)
        assert np.isfinite(base).all()
        assert np.abs(flight.camera.to_raw(frame, base) - xy).max() < 1e-6


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), a=st.floats(-0.3, 0.4), wobble=st.floats(0, 4), tilt=st.floats(0, 4))
def test_to_raw_inverts_to_base_for_any_camera(seed: int, a: float, wobble: float, tilt: float) -> None:
    camera = CameraSimulation(lens_a=a, vibration_px=wobble, vibration_cycles=6.0, tilt_deg=tilt)
    flight = small_flight(frames=2, width=320, height=240, seed=seed, camera=camera)
    xy = raw_points(flight.config, 50, seed)
    assert np.abs(flight.camera.to_raw(1, flight.camera.to_base(1, xy)) - xy).max() < 1e-6


def test_without_lens_shutter_and_relief_the_map_is_a_homography() -> None:
    flight = Flight(homography_only(width=640, height=480, frames=3))
    xy = raw_points(flight.config)
    base = flight.camera.to_base(2, xy)
    matrix, _ = cv2.findHomography(xy, base, 0)
    back = cv2.perspectiveTransform(xy[None], matrix)[0]
    assert np.abs(back - base).max() < 1e-4


def test_wobble_moves_rows_by_its_amplitude_and_cycles() -> None:
    camera = PINHOLE.model_copy(update={"vibration_px": 4.0, "vibration_cycles": 6.0, "readout_s": 0.1})
    steady = PINHOLE.model_copy(update={"readout_s": 0.1})
    shaken, quiet = (small_flight(frames=2, camera=c, scene=FLAT).camera for c in (camera, steady))
    rows = np.arange(480.0)
    shift = (shaken.row_table(1, rows) - quiet.row_table(1, rows))[:, 12]
    assert np.abs(shift).max() == pytest.approx(4.0, abs=0.01)
    assert np.sum(np.diff(np.sign(shift)) != 0) in (11, 12, 13)
    column = np.column_stack([np.full(480, 320.0), rows])
    moved = shaken.to_base(1, column)[:, 0] - quiet.to_base(1, column)[:, 0]
    assert np.ptp(moved) == pytest.approx(8.0, abs=0.7)


def test_relief_shifts_points_away_from_the_nadir() -> None:
    flat, hilly = (
        small_flight(frames=1, camera=PINHOLE, scene=FLAT.model_copy(update={"relief_m": h})) for h in (0.0, 2.0)
    )
    xy = raw_points(flat.config)
    origin = hilly.camera.position_px[:2] - flat.camera.position_px[:2]
    shift = hilly.camera.to_base(0, xy) - flat.camera.to_base(0, xy) - origin
    assert 0.3 < np.hypot(*shift.T).max() < 2.0 / 0.23 * 0.6


@pytest.mark.parametrize(
    ("camera", "limit_px"),
    [
        (PINHOLE, 0.1),
        (CameraSimulation(lens_a=0.2, vibration_px=4.0, vibration_cycles=6.0), 0.1),
        (CameraSimulation(lens_a=0.15, vibration_px=2.0), 0.1),
    ],
    ids=["pinhole", "lens and wobble", "lens and vibration"],
)
def test_rendered_features_are_where_the_truth_has_them(camera: CameraSimulation, limit_px: float) -> None:
    quiet = camera.model_copy(
        update={"noise_grey": 0.0, "vignetting": 0.0, "exposure_share": 0.0, "motion_blur_px": 0.0}
    )
    scene = SceneSimulation(building_height_m=0, tree_height_m=0, parked_share=0, sun_length=0)
    base = SAME_SENSOR.model_copy(update={"blur_px": camera.optics_blur_px})
    flight = small_flight(frames=3, camera=quiet, scene=scene, base=base, traffic=EMPTY)
    frame = flight.frame(2).astype(np.float32)
    y, x = np.mgrid[0:480, 0:640]
    where = flight.camera.to_base(2, np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)).astype(np.float32)
    maps = where[:, 0].reshape(480, 640), where[:, 1].reshape(480, 640)
    expected = cv2.remap(flight.base_image.astype(np.float32), *maps, cv2.INTER_CUBIC)
    window = cv2.createHanningWindow((64, 64), cv2.CV_32F)
    shifts = np.array(
        [
            cv2.phaseCorrelate(frame[i : i + 64, j : j + 64], expected[i : i + 64, j : j + 64], window)[0]
            for i in range(0, 416, 64)
            for j in range(0, 576, 64)
        ]
    )
    assert np.abs(shifts.mean(axis=0)).max() < 0.02
    assert np.median(np.hypot(*shifts.T)) < limit_px


def test_a_lens_that_folds_within_the_frame_is_refused() -> None:
    config = small_flight().config.model_copy(update={"camera": CameraSimulation(lens_terms=(-0.5,))})
    with pytest.raises(InputError, match="found a lens that folds"):
        Flight(config)
