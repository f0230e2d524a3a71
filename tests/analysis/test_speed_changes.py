"""How vehicles set off and stop tells a frame rate of twice or half the true one, and not the true one."""

from collections.abc import Sequence

import numpy as np
import pytest

from schemas.arrays import FloatArray
from velfield.analysis.speed_changes import MIN_VEHICLES, USUAL_M_PER_S2, TimeCheck, check_times, speed_changes
from velfield.analysis.trajectories import Trajectories, make_trajectories


def path_m(acceleration: float, speed: float, since_s: FloatArray) -> FloatArray:
    """Distance of a vehicle that sets off at 0 s and then drives at a constant speed."""
    rising = np.clip(since_s, 0.0, speed / acceleration)
    return 0.5 * acceleration * rising**2 + speed * np.clip(since_s - speed / acceleration, 0.0, None)


def street(
    seed: int, *, fps: float = 5.0, claimed: float = 1.0, stopping: int = 20, driving: int = 30, noise_m: float = 0.12
) -> Trajectories:
    """Vehicles that set off from a red light or stop at it, and others that pass; ``claimed`` times the true rate."""
    rng = np.random.default_rng(seed)
    times_s = np.arange(0, 14, 1 / fps)
    tracks = []
    for k in range(stopping):
        acceleration, speed = USUAL_M_PER_S2 * np.exp(rng.normal(0, 0.25)), rng.uniform(8, 16)
        since = times_s - rng.uniform(1, 4)
        tracks.append(path_m(acceleration, speed, since if k % 2 else since[::-1]) * (1 if k % 2 else -1))
    tracks += [rng.uniform(9, 16) * times_s for _ in range(driving)]
    along = np.concatenate(tracks)
    xy = np.column_stack([along, np.repeat(3.5 * np.arange(len(tracks)), len(times_s))])
    count = len(times_s)
    return make_trajectories(
        np.repeat(np.arange(len(tracks)), count),
        np.tile(np.arange(count), len(tracks)),
        np.tile(times_s / claimed, len(tracks)),
        xy + rng.normal(0, noise_m, xy.shape),
        gsd_m=0.23,
    )


@pytest.mark.parametrize("fps", [3.0, 5.0, 30.0])
def test_true_times_are_plausible_and_wrong_ones_are_told_with_their_factor(fps: float) -> None:
    checks: dict[float, Sequence[TimeCheck]] = {
        claimed: [check_times(street(seed, fps=fps, claimed=claimed)) for seed in range(10)]
        for claimed in (0.5, 1.0, 2.0, 5.0)
    }
    for claimed, found in checks.items():
        assert all(one.known for one in found)
        assert all(one.plausible == (claimed == 1.0) for one in found), (claimed, found)
        np.testing.assert_allclose([one.factor for one in found], claimed, rtol=0.2)


def test_vehicles_that_neither_set_off_nor_stop_say_nothing() -> None:
    assert len(speed_changes(street(1, stopping=0))) == 0
    few = check_times(street(1, stopping=MIN_VEHICLES - 1))
    assert few.vehicles == MIN_VEHICLES - 1
    assert not few.known
    assert few.plausible
