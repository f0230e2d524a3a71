"""Double tracks: a shadow, or a load, that keeps its place beside a vehicle; and vehicles that do not."""

import numpy as np
import pandas as pd
import pytest

from velfield.tracking.recovery import find_doubles

GSD_M = 0.25


def track(
    number: int, speed: float, ahead_m: float = 0.0, aside_m: float = 0.0, frames: range = range(15), sd_m: float = 0.2
) -> pd.DataFrame:
    """Positions along x, from ``ahead_m``."""
    rng, frame = np.random.default_rng(number), np.array(frames)
    x, y = ahead_m + speed * 0.2 * frame, np.full(len(frame), aside_m)
    xy = np.column_stack([x, y]) + rng.normal(0, sd_m, (len(frame), 2))
    columns = {"track_id": number, "frame": frame, "time_s": 0.2 * frame}
    return pd.DataFrame({**columns, "x_px": xy[:, 0] / GSD_M, "y_px": xy[:, 1] / GSD_M})


def doubles(*tracks: pd.DataFrame, grey: dict[int, float] | None = None) -> list[int]:
    return find_doubles(pd.concat(tracks), pd.Series(grey or {1: 120.0, 2: 60.0, 3: 60.0}), GSD_M).tolist()


@pytest.mark.parametrize("ahead_m", [1.5, 4.5, -4.5])
def test_a_shadow_is_a_double_of_its_vehicle(ahead_m: float) -> None:
    assert doubles(track(1, 12.0), track(2, 12.0, ahead_m)) == [2]
    assert doubles(track(1, 12.0), track(2, 12.0, ahead_m), grey={1: 60.0, 2: 120.0}) == [1]
    assert doubles(track(1, 12.0), track(2, 12.0, ahead_m, frames=range(5, 12)), track(3, 12.0, ahead_m + 30)) == [2]


def test_a_shadow_to_the_side_is_nearer_than_the_next_lane() -> None:
    assert doubles(track(1, 12.0), track(2, 12.0, 0.5, 2.2)) == [2]


def test_a_shadow_keeps_its_place_in_the_world_round_a_bend() -> None:
    angle = np.linspace(0, np.pi / 2, 15)
    car = track(1, 0.0).assign(x_px=80 * np.sin(angle), y_px=80 * (1 - np.cos(angle)))
    shadow = car.assign(track_id=2, x_px=car["x_px"] + 6, y_px=car["y_px"] + 3)
    assert doubles(car, shadow) == [2]


@pytest.mark.parametrize(
    ("speed", "other", "ahead_m", "aside_m"),
    [
        (12.0, 12.0, 14.0, 0.0),  # follows at a second
        (4.0, 4.0, 7.0, 0.0),  # a queue that discharges
        (12.0, 12.0, 1.0, 3.3),  # in the next lane
        (12.0, 9.0, 4.0, 0.5),  # overtakes
        (0.0, 0.0, 2.6, 0.0),  # parked beside each other
        (12.0, -12.0, 20.0, 1.5),  # oncoming
    ],
)
def test_two_vehicles_are_none(speed: float, other: float, ahead_m: float, aside_m: float) -> None:
    assert doubles(track(1, speed), track(2, other, ahead_m, aside_m)) == []


def test_who_is_near_for_a_moment_is_none() -> None:
    assert doubles(track(1, 12.0), track(2, 12.0, 4.5, frames=range(3))) == []
    later = pd.concat([track(2, 12.0, 4.5, frames=range(5)), track(2, 12.0, 40.0, frames=range(5, 15))])
    assert doubles(track(1, 12.0), later) == []
    assert doubles(track(1, 12.0).iloc[:0]) == []
