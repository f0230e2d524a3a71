"""Moving, stopped in a lane, or parked: by hand-made tracks beside a lane that is driven."""

import numpy as np
import pandas as pd
import pytest

from velfield.analysis.vehicles import count_states, find_vehicles

GSD_M = 0.25
INTERVAL_S = 0.2


class Flight:
    """Tracks made by hand, positions in metres."""

    def __init__(self) -> None:
        self.tracklets: list[dict[str, float]] = []
        self.detections: list[dict[str, float]] = []

    def add(self, track: int, x_m: np.ndarray, y_m: float, axis_rad: float = 0.0, sd_px: float = 0.3) -> None:
        ids = track * 1000 + np.arange(len(x_m))
        self.detections += [{"detection_id": one, "orientation_rad": axis_rad, "score": 0.3} for one in ids]
        for k in range(len(x_m) - 2):
            row: dict[str, float] = {"track_id": track, "displacement_sd_01_px": sd_px, "displacement_sd_12_px": sd_px}
            for j in range(3):
                row |= {
                    f"frame_{j}": k + j,
                    f"time_{j}_s": INTERVAL_S * (k + j),
                    f"detection_id_{j}": int(ids[k + j]),
                    f"x_{j}_px": x_m[k + j] / GSD_M,
                    f"y_{j}_px": y_m / GSD_M,
                }
            self.tracklets.append(row)

    def find(self) -> pd.DataFrame:
        return find_vehicles(pd.DataFrame(self.tracklets), pd.DataFrame(self.detections), gsd_m=GSD_M)


def test_states_are_counted_and_of_what_is_parked_what_the_detector_is_sure_of() -> None:
    made = pd.DataFrame({"state": ["moving", "parked", "parked", "parked"], "score": [0.01, 0.15, 0.3, 0.14]})
    assert count_states(made) == {"moving": 1, "stopped": 0, "parked": 3, "parked_sure": 2}


def with_lane() -> Flight:
    """Vehicle 1 drives along y = 50 m at 10 m/s, from x = 20 to 60 m."""
    made = Flight()
    made.add(1, 20 + 2.0 * np.arange(21), 50.0)
    return made


def standing(x_m: float, frames: int = 10) -> np.ndarray:
    jitter = np.random.default_rng(0).normal(0, 0.08, frames)
    return x_m + jitter


@pytest.mark.parametrize(
    ("x_m", "y_m", "axis_rad", "state"),
    [
        (40.0, 50.3, 0.1, "stopped"),  # in the lane
        (40.0, 50.3, np.pi - 0.1, "stopped"),  # an axis has no sense
        (65.0, 50.0, 0.0, "parked"),  # beyond where anybody drove, by more than half of its reach
        (60.0, 50.0, 0.0, "stopped"),  # the last in a queue that others join
        (40.0, 52.5, 0.0, "parked"),  # at the kerb
        (40.0, 50.3, np.pi / 2, "parked"),  # across the lane
        (40.0, 80.0, 0.0, "parked"),
        (40.0, 50.3, np.nan, "parked"),  # nothing tells which way it looks
    ],
)
def test_what_stands_is_stopped_where_others_drive_along_its_axis(
    x_m: float, y_m: float, axis_rad: float, state: str
) -> None:
    made = with_lane()
    made.add(2, standing(x_m), y_m, axis_rad)
    assert made.find()["state"].tolist() == ["moving", state]


def test_the_head_of_a_queue_that_another_joins_is_stopped() -> None:
    """Red for all of the clip: nobody drives past the first ones. A row at the kerb beside them is parked."""
    made = Flight()
    made.add(1, np.minimum(20 + 1.0 * np.arange(30), 40.0), 50.0)  # comes up, and stops at 40 m
    for k, x_m in enumerate((47.0, 55.0, 62.0)):
        made.add(2 + k, standing(x_m, 30 - k), 50.3, 0.05)  # missed in the last frames
        made.add(12 + k, standing(x_m, 30), 52.6, 0.05)
    made.add(5, standing(76.0, 30), 50.0)  # beyond a gap
    made.add(6, standing(33.0, 30), 54.0)  # behind it
    found = made.find().set_index("track_id")["state"]
    assert found.loc[[2, 3, 4]].tolist() == ["stopped"] * 3
    assert found.loc[[5, 6, 12, 13, 14]].tolist() == ["parked"] * 5


def test_who_passes_by_makes_no_queue_of_what_is_gone() -> None:
    made = Flight()
    made.add(1, np.minimum(20 + 1.0 * np.arange(30), 40.0), 50.0)
    made.add(2, standing(47.0, 10), 50.0)  # seen until 1.8 s; vehicle 1 stops after 4 s
    assert made.find()["state"].tolist() == ["moving", "parked"]


@pytest.mark.parametrize(
    ("step_m", "frames", "sd_px", "state"),
    [
        (2.0, 3, 0.3, "moving"),  # three detections are all that was seen of it
        (0.4, 3, 0.3, "moving"),  # 0.8 m at 2 m/s
        (0.04, 21, 0.3, "parked"),  # 0.8 m at 0.2 m/s: no vehicle drives so
        (0.4, 3, 2.0, "parked"),  # 0.8 m, with an error of 0.5 m
        (0.15, 21, 2.0, "moving"),  # 3 m
    ],
)
def test_a_small_displacement_counts_where_it_is_certain(step_m: float, frames: int, sd_px: float, state: str) -> None:
    made = Flight()
    made.add(1, step_m * np.arange(frames), 10.0, sd_px=sd_px)
    assert made.find()["state"].tolist() == [state]


def test_a_row_tells_when_and_where() -> None:
    row = with_lane().find().iloc[0]
    assert (row["track_id"], row["first_frame"], row["last_frame"], row["detections"]) == (1, 0, 20, 21)
    assert row["last_time_s"] - row["first_time_s"] == pytest.approx(4.0)
    assert (row["x_px"] * GSD_M, row["y_px"] * GSD_M) == pytest.approx((40.0, 50.0))
    assert row["orientation_rad"] == pytest.approx(0.0)
    assert row["displacement_m"] == pytest.approx(36.0)  # between the means of three positions at each end


def test_no_tracks_no_rows() -> None:
    made = with_lane()
    none = pd.DataFrame(made.tracklets).iloc[:0]
    assert len(find_vehicles(none, pd.DataFrame(made.detections), gsd_m=None)) == 0
