"""Scores on constructed truths and results, with exact expectations."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from schemas.arrays import FloatArray
from velfield.synthetic.camera import Camera, Waves
from velfield.synthetic.city.relief import Relief
from velfield.synthetic.score import (
    BORDER_PX,
    MATCH_PX,
    _match,
    _true_triples,
    apply_homography,
    fit_homography,
    score_detections,
    score_field,
    score_registration,
    score_tracklets,
)
from velfield.synthetic.truth import CAR_COLUMNS, LANE_WIDTH_M, LanePath, Truth, load_truth, save_truth

GSD_M = 0.25
WIDTH, HEIGHT = 200, 160
KM_PER_H = GSD_M * 3.6


def waves(channels: int) -> Waves:
    return Waves(*np.zeros((3, channels, 1)))


def camera(frames: int) -> Camera:
    """A pinhole camera looking down: raw and base pixels are the same."""
    return Camera(
        WIDTH, HEIGHT, 300.0, 0.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2,
        np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2, -300.0]), 0.0, waves(6), waves(2), 0.0, 0.2 * np.arange(frames),
        Relief(np.zeros((2, 2)), np.array([0.0, 0.0, 400.0])),
    )  # fmt: skip


def car(frame: int, vehicle: int, x: float, y: float, vx: float = 0.0, **changes: object) -> dict[str, object]:
    """A car along x in one frame."""
    row: dict[str, object] = {
        "frame": frame, "vehicle_id": vehicle, "time_s": 0.2 * frame, "x_raw_px": x, "y_raw_px": y,
        "x_base_px": x, "y_base_px": y, "orientation_rad": 0.0, "direction_rad": 0.0, "vx_px_per_s": vx,
        "vy_px_per_s": 0.0, "length_px": 18.0, "width_px": 8.0, "moving": vx != 0, "visible": True,
    }  # fmt: skip
    return row | changes


def truth(cars: list[dict[str, object]], lanes: list[LanePath] | None = None, frames: int = 4) -> Truth:
    table = pd.DataFrame(cars).astype(CAR_COLUMNS)
    return Truth(camera(frames), 0.2 * np.arange(frames), GSD_M, (HEIGHT, WIDTH), table, lanes or [])


def detections(*rows: tuple[int, float, float, float]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["frame", "x_px", "y_px", "orientation_rad"])


def test_precision_and_recall_of_detections_are_counts() -> None:
    """Three cars, one moving; two found (one 3 px off, one rotated by 0.1), one false positive."""
    made = truth([car(0, 0, 50, 50), car(0, 1, 90, 50, 40.0), car(0, 2, 130, 50)])
    found = detections((0, 53.0, 50.0, 0.0), (0, 90.0, 50.0, np.pi - 0.1), (0, 90.0, 120.0, 0.0))
    score = score_detections(made, found)
    assert (score.precision, score.recall) == (pytest.approx(2 / 3), pytest.approx(2 / 3))
    assert score.f1 == pytest.approx(2 / 3)
    assert score.recall_moving == 1.0
    assert (score.detections, score.cars) == (3, 3)
    assert score.position_error_px == pytest.approx(1.5)  # the median of 3 and 0
    assert score.axis_error_median_rad == pytest.approx(0.05)


def test_a_car_near_the_border_or_hidden_is_neither_missed_nor_a_false_positive() -> None:
    made = truth([car(0, 0, 50, 50), car(0, 1, BORDER_PX - 1, 50), car(0, 2, 90, 90, visible=False)])
    score = score_detections(made, detections((0, 50.0, 50.0, 0.0), (0, BORDER_PX, 50.0, 0.0), (0, 90.0, 90.0, 0.0)))
    assert (score.precision, score.recall, score.detections, score.cars) == (1.0, 1.0, 1, 1)


def test_a_detection_beyond_the_match_distance_is_false_and_the_car_missed() -> None:
    made = truth([car(0, 0, 50, 50)])
    near, far = (score_detections(made, detections((0, 50.0 + d, 50.0, 0.0))) for d in (MATCH_PX - 0.1, MATCH_PX + 0.1))
    assert (near.precision, near.recall) == (1.0, 1.0)
    assert (far.precision, far.recall) == (0.0, 0.0)


def test_detections_are_scored_in_the_frames_and_on_the_grid_of_the_truth() -> None:
    """The run's frame 0 is the flight's frame 2; its base image is rotated by 90 degrees and half as large."""
    made = truth([car(2, 0, 60, 50)])
    to_truth = np.array([[0.0, -2.0, 180.0], [2.0, 0.0, 10.0], [0.0, 0.0, 1.0]])
    run_xy = apply_homography(np.asarray(np.linalg.inv(to_truth)), np.array([[60.0, 50.0]]))[0]
    found = detections((0, *run_xy, np.pi / 2))
    score = score_detections(made, found, frame_of={0: 2}, to_truth=to_truth)
    assert (score.precision, score.recall) == (1.0, 1.0)
    assert score.axis_error_median_rad == pytest.approx(0.0, abs=1e-9)
    assert score.position_error_px == pytest.approx(0.0, abs=1e-9)


def test_matching_is_one_to_one_with_the_smallest_total_distance() -> None:
    """Greedily, 0 would take the car at 4 and leave 6 without one within reach."""
    found, true = np.array([[0.0, 0.0], [6.0, 0.0]]), np.array([[4.0, 0.0], [-3.0, 0.0]])
    assert _match(found, true).tolist() == [[0, 1], [1, 0]]
    assert _match(found[:0], true).shape == (0, 2)
    assert _match(found, true + 100.0).shape == (0, 2)


def test_a_homography_is_applied_with_its_division_and_none_is_the_identity() -> None:
    matrix = np.array([[2.0, 0.0, 1.0], [0.0, 2.0, -3.0], [0.0, 0.01, 1.0]])
    assert apply_homography(matrix, np.array([[10.0, 100.0]]))[0] == pytest.approx([21 / 2, 197 / 2])
    assert apply_homography(None, np.array([[10.0, 100.0]])).tolist() == [[10.0, 100.0]]


def test_registration_errors_are_those_of_the_shift_and_its_change() -> None:
    made = truth([car(0, 0, 50, 50)], frames=10)
    steady = score_registration(made, lambda _, xy: xy + np.array([3.0, 4.0]), range(10))
    assert (steady.mean_px, steady.median_px, steady.p95_px) == pytest.approx((5.0, 5.0, 5.0))
    assert (steady.jitter_px, steady.drift_px) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert steady.frames == 10
    drifting = score_registration(made, lambda frame, xy: xy + np.array([0.1 * frame, 0.0]), range(10))
    assert drifting.drift_px == pytest.approx(0.9)
    assert drifting.worst_frame_px == pytest.approx(0.9)
    assert drifting.frame_mean_px == pytest.approx(0.1 * np.arange(10))
    assert drifting.jitter_px == pytest.approx(0.1 * np.std(np.arange(10)))


def test_points_without_a_transform_or_outside_the_base_image_are_not_scored() -> None:
    made = truth([car(0, 0, 50, 50)])

    def half(frame: int, xy: FloatArray) -> FloatArray:
        return np.where(xy[:, :1] < 100, xy, np.nan) + (1.0 if frame == 0 else 2.0)

    assert score_registration(made, half, range(2)).mean_px == pytest.approx(1.5 * np.sqrt(2))
    small = replace(made, base_shape=(HEIGHT // 2, WIDTH))
    shifted = score_registration(small, lambda _, xy: xy + np.where(xy[:, 1:] > 80, 50.0, 0.0), range(2))
    assert shifted.mean_px == pytest.approx(0.0, abs=1e-9)


def test_a_frame_that_is_not_registered_answers_nothing() -> None:
    made = truth([car(0, 0, 50, 50)])
    score = score_registration(made, lambda _, xy: xy, [0, 1, 3], asked=range(4))
    assert (score.answered, score.frames, score.mean_px) == (0.75, 3, pytest.approx(0.0, abs=1e-9))
    assert score_registration(made, lambda _, xy: xy, [0, 1, 3]).answered == 1.0


def test_the_fitted_homography_ignores_points_without_a_transform() -> None:
    made = truth([car(0, 0, 50, 50)])
    matrix = np.array([[1.1, 0.05, 4.0], [-0.04, 0.95, -7.0], [1e-4, 0.0, 1.0]])
    inverse = np.asarray(np.linalg.inv(matrix))

    def run(frame: int, xy: FloatArray) -> FloatArray:
        return np.where(xy[:, :1] > 20, apply_homography(inverse, made.to_base(frame, xy)), np.nan)

    fitted = fit_homography(made, run, range(3))
    assert fitted / fitted[2, 2] == pytest.approx(matrix, abs=1e-4)


def tracklet(vehicle_rows: list[tuple[float, float]], track: int, speed: float = 40.0) -> dict[str, float]:
    """A tracklet in frames 0 to 2 at these positions, along x."""
    row: dict[str, float] = {"track_id": track}
    for k, (x, y) in enumerate(vehicle_rows):
        row |= {f"frame_{k}": k, f"x_{k}_px": x, f"y_{k}_px": y}
    for link in ("01", "12"):
        row |= {f"vx_{link}_px_per_s": speed, f"vy_{link}_px_per_s": 0.0}
    return row


def driving(vehicle: int, x0: float, y: float, speed: float = 40.0, **changes: object) -> list[dict[str, object]]:
    return [car(frame, vehicle, x0 + 0.2 * speed * frame, y, speed, **changes) for frame in range(3)]


def positions(x0: float, y: float, speed: float = 40.0) -> list[tuple[float, float]]:
    return [(x0 + 0.2 * speed * k, y) for k in range(3)]


def test_tracklets_are_correct_if_all_three_detections_are_of_one_vehicle() -> None:
    """Two correct ones, one that changes vehicles, one of nothing; of three moving vehicles two are found."""
    made = truth([*driving(0, 50, 40), *driving(1, 50, 80), *driving(2, 50, 120)])
    mixed = [positions(50, 120)[0], positions(50, 120)[1], positions(50, 80)[2]]
    table = pd.DataFrame(
        [
            tracklet(positions(50, 40), 7),
            tracklet(positions(51, 80), 8),
            tracklet(mixed, 9),
            tracklet(positions(150, 20), 10),
        ]
    )
    score = score_tracklets(made, table)
    assert score.precision == pytest.approx(2 / 4)
    assert score.recall_moving == pytest.approx(2 / 3)
    assert score.tracklets == 4
    assert score.tracks_per_vehicle == 1.0
    assert (score.speed_error_mean_km_per_h, score.direction_error_mean_rad) == pytest.approx((0.0, 0.0))


def test_speed_errors_are_absolute_means_and_biases_signed_means_in_km_per_h() -> None:
    made = truth([*driving(0, 50, 40), *driving(1, 50, 80)])
    table = pd.DataFrame([tracklet(positions(50, 40), 0, 44.0), tracklet(positions(50, 80), 1, 38.0)])
    score = score_tracklets(made, table)
    assert score.speed_error_mean_km_per_h == pytest.approx(3.0 * KM_PER_H)
    assert score.speed_bias_km_per_h == pytest.approx(1.0 * KM_PER_H)


def test_a_vehicle_with_two_tracks_is_counted_twice() -> None:
    made = truth([*driving(0, 50, 40), *driving(1, 50, 80)])
    rows = [tracklet(positions(50, 40), 3), tracklet(positions(50, 40), 4), tracklet(positions(50, 80), 5)]
    assert score_tracklets(made, pd.DataFrame(rows)).tracks_per_vehicle == pytest.approx(1.5)


def test_detections_along_a_long_vehicle_count_for_precision_on_vehicle_only() -> None:
    made = truth(driving(0, 60, 40, length_px=48.0))
    off_centre = [(x + 14.0, y) for x, y in positions(60, 40)]
    score = score_tracklets(made, pd.DataFrame([tracklet(off_centre, 0)]))
    assert (score.precision, score.precision_on_vehicle) == (0.0, 1.0)
    beyond = [(x + 33.0, y) for x, y in positions(60, 40)]
    assert score_tracklets(made, pd.DataFrame([tracklet(beyond, 0)])).precision_on_vehicle == 0.0


def test_velocities_are_transformed_to_the_grid_of_the_truth() -> None:
    """A run whose base image is half as large: its velocities are half as large in px/s."""
    made = truth(driving(0, 60, 40))
    table = pd.DataFrame([tracklet([(x / 2, y / 2) for x, y in positions(60, 40)], 0, 20.0)])
    score = score_tracklets(made, table, to_truth=np.diag([2.0, 2.0, 1.0]))
    assert score.precision == 1.0
    assert score.speed_error_mean_km_per_h == pytest.approx(0.0, abs=1e-6)


def test_recall_is_of_vehicles_that_move_and_are_evaluated_in_all_three_frames() -> None:
    hidden = [*driving(1, 50, 80)[:2], driving(1, 50, 80)[2] | {"visible": False}]
    made = truth([*driving(0, 50, 40), *hidden, *[car(k, 2, 100.0, 120.0) for k in range(3)]])
    assert _true_triples(made, [(0, 1, 2)]) == {(1, 0)}


EAST = LanePath("avenue", np.array([[0.0, 60.0], [199.0, 60.0]]), 50.0)
NORTH = LanePath("street", np.array([[100.0, 159.0], [100.0, 0.0]]), 50.0)


def test_the_direction_error_is_the_angle_to_the_closest_lane_within_half_a_lane() -> None:
    made = truth([car(0, 0, 50, 50)], [EAST, NORTH])
    half = (LANE_WIDTH_M + 1.0) / GSD_M / 2
    xy = np.array([[40.0, 60.0], [40.0, 60.0], [40.0, 60.0 + half - 1], [40.0, 60.0 + half + 1], [100.0, 61.0]])
    angle = np.array([0.2, np.pi, -0.1, 0.0, -np.pi / 2 + 0.3])
    assert made.direction_error_rad(xy, angle) == pytest.approx([0.2, np.pi, 0.1, np.pi, 0.3])


def test_the_field_score_counts_pixels_with_enough_tracks() -> None:
    """20 pixels along the lane, 5 of them against it; 4 of too few tracks; 3 without a direction."""
    made = truth([car(0, 0, 50, 50)], [EAST])
    velocity, count = np.full((HEIGHT, WIDTH, 2), np.nan), np.zeros((HEIGHT, WIDTH), int)
    velocity[60, 20:40], count[60, 20:40] = [40.0, 1.0], 5
    velocity[60, 20:25] = [-40.0, 0.0]
    velocity[60, 50:54], count[60, 50:54] = [0.0, 40.0], 4
    count[60, 70:73] = 9
    score = score_field(made, velocity, count)
    assert (score.pixels, score.undirected) == (20, 3)
    assert score.fraction_within == pytest.approx(15 / 20)
    assert score.median_error_rad == pytest.approx(np.arctan2(1, 40))
    strict = score_field(made, velocity, count, within_rad=0.01)
    assert strict.fraction_within == 0.0
    empty = score_field(made, np.full_like(velocity, np.nan), count)
    assert (empty.pixels, empty.fraction_within) == (0, 0.0)


def test_truth_is_read_back_as_written_also_with_the_old_name_of_the_position(tmp_path: Path) -> None:
    made = truth([*driving(0, 50, 40)], [EAST, NORTH])
    save_truth(made, tmp_path / "truth")
    read = load_truth(tmp_path)
    pd.testing.assert_frame_equal(read.cars, made.cars)
    assert [lane.kind for lane in read.lanes] == ["avenue", "street"]
    assert read.lanes[0].path_px.tolist() == EAST.path_px.tolist()
    assert (read.gsd_m, read.base_shape) == (GSD_M, (HEIGHT, WIDTH))
    record = (tmp_path / "truth" / "camera.json").read_text()
    assert "position_px" in record
    (tmp_path / "truth" / "camera.json").write_text(record.replace("position_px", "place_px"))
    assert load_truth(tmp_path / "truth").camera.position_px.tolist() == made.camera.position_px.tolist()
