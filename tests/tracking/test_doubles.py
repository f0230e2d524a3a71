"""Double tracks: a shadow, or a load, that keeps its place beside a vehicle; parts of one vehicle's track; and vehicles
that are neither."""

import numpy as np
import pandas as pd
import pytest

from velfield.tracking.doubles import find_doubles, find_split_tracks

GSD_M = 0.25


def track(
    number: int, speed: float, ahead_m: float = 0.0, aside_m: float = 0.0, frames: range = range(15), sd_m: float = 0.2
) -> pd.DataFrame:
    """Positions along x, from ``ahead_m``."""
    rng, frame = np.random.default_rng(number), np.array(frames)
    x, y = ahead_m + speed * 0.2 * frame, np.full(len(frame), aside_m)
    xy = np.column_stack([x, y]) + rng.normal(0, sd_m, (len(frame), 2))
    columns = {"track_id": number, "frame": frame, "time_s": 0.2 * frame, "source": 0}
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


def test_the_shadow_of_a_van_in_a_low_sun_is_further_to_the_side_and_black() -> None:
    van, shadow = track(1, 12.0), track(2, 12.0, 0.3, 3.0)
    assert doubles(van, shadow, grey={1: 240.0, 2: 30.0}) == [2]
    assert doubles(van, shadow, grey={1: 240.0, 2: 90.0}) == []
    assert doubles(van, track(2, 12.0, 0.3, 3.5), grey={1: 240.0, 2: 30.0}) == []


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


def inferred(positions: pd.DataFrame, *frames: range) -> pd.DataFrame:
    """A track of which so many frames are not seen."""
    hidden = positions["frame"].isin([frame for part in frames for frame in part])
    return positions.assign(source=np.where(hidden, 2, 0))


def parts(*tracks: pd.DataFrame) -> dict[int, int]:
    return find_split_tracks(pd.concat(tracks), GSD_M).to_dict()


def test_a_lorry_that_is_seen_now_at_its_cab_now_at_its_load_is_one_track() -> None:
    cab = inferred(track(1, 12.0, 3.0), range(4, 9))
    load = inferred(track(2, 12.0, frames=range(3, 15)), range(10, 13))
    assert parts(cab, load, track(3, 12.0, 20.0)) == {1: 1, 2: 1}


def test_a_vehicle_that_is_detected_twice_for_a_moment_is_one_track() -> None:
    one, other = track(1, 8.0, frames=range(12)), track(2, 8.0, 1.0, 0.5, range(2, 20))
    assert parts(inferred(one, range(4, 10)), inferred(other, range(11, 14))) == {1: 1, 2: 1}


@pytest.mark.parametrize(
    ("speed", "other", "ahead_m", "aside_m"),
    [
        (12.0, 12.0, 7.0, 0.0),  # follows close
        (12.0, 12.0, 1.0, 3.3),  # in the next lane
        (12.0, 9.0, 4.0, 0.5),  # overtakes
        (12.0, -12.0, 20.0, 1.5),  # oncoming
    ],
)
def test_two_vehicles_of_which_one_is_not_seen_for_a_while_are_two(
    speed: float, other: float, ahead_m: float, aside_m: float
) -> None:
    assert parts(inferred(track(1, speed), range(4, 12)), track(2, other, ahead_m, aside_m)) == {}


def test_what_is_inferred_for_long_is_too_uncertain_to_be_joined() -> None:
    hidden = inferred(track(1, 8.0, frames=range(40)), range(4, 36))
    assert parts(hidden, track(2, 8.0, 1.0, frames=range(10, 20))) == {}
