"""Tracklets of named scenes: precise, few missed, and the same however the flight is cut into parts."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from schemas.flight import TrackingConfig
from schemas.tables import TRACKLET_COLUMNS
from tests.tracking_scenes import SCENES, Detector, Watched, car, crossing, platoon, score, two_lanes_opposed, watch
from velfield.errors import InputError
from velfield.tracking.association import FrameTable, window_frames
from velfield.tracking.gates import GateLog
from velfield.tracking.tracklets import link_windows

PAIRWISE = TrackingConfig(linking="pairwise", min_confidence=0.0, refine=False)
ALL = range(10**6)


def uneven_times(rng: np.random.Generator, n: int, interval_s: float = 0.2) -> list[float]:
    return (np.arange(n) * interval_s + rng.uniform(-0.1, 0.1, n) * interval_s).tolist()


def scene(name: str, seed: int = 0, frames: int = 16, **how: object) -> Watched:
    rng = np.random.default_rng(seed)
    cars = SCENES[name](rng)
    return watch(cars, uneven_times(rng, frames), rng=rng, **how)


@pytest.mark.parametrize("name", list(SCENES))
def test_tracklets_follow_one_car(name: str) -> None:
    seen = scene(name)
    found, _ = link_windows(seen.tables, TrackingConfig(), gsd_m=None, starts=ALL)
    result = score(seen, found)
    assert result.moving_precision >= 0.99, result
    assert result.precision >= 0.99, result
    assert result.recall >= 0.9, result
    assert result.moving_recall >= 0.85, result
    assert result.speed_rms_px_per_s <= 1.5, result  # 1.2 km/h at 0.23 m; the detections alone: 2.5 px/s


def test_at_25_frames_a_second_too() -> None:
    rng = np.random.default_rng(4)
    seen = watch(two_lanes_opposed(rng), uneven_times(rng, 16, 0.04), rng=rng)
    result = score(seen, link_windows(seen.tables, TrackingConfig(), gsd_m=None, starts=ALL)[0])
    assert result.precision >= 0.99
    assert result.recall >= 0.9


@pytest.mark.parametrize("speed", [25.0, 62.5, 125.0])
def test_a_platoon_is_not_linked_each_to_the_one_behind(speed: float) -> None:
    """At 125 px/s a car moves just its spacing in a frame: standing still is as smooth a motion as the true one."""
    rng = np.random.default_rng(7)
    seen = watch(platoon(rng, speed_px_per_s=speed), uneven_times(rng, 12), rng=rng)
    found, _ = link_windows(seen.tables, TrackingConfig(), gsd_m=None, starts=ALL)
    result = score(seen, found)
    assert result.precision >= 0.99, result
    assert result.recall >= 0.9, result
    assert np.median(found["vx_01_px_per_s"]) == pytest.approx(speed, abs=1)


def test_joint_linking_finds_tracklets_of_similar_cars_where_pairwise_linking_loses_half() -> None:
    rng = np.random.default_rng(8)
    seen = watch(platoon(rng, similarity=0.8), uneven_times(rng, 16), rng=rng)
    joint = score(seen, link_windows(seen.tables, TrackingConfig(), gsd_m=None, starts=ALL)[0])
    pairwise = score(seen, link_windows(seen.tables, PAIRWISE, gsd_m=None, starts=ALL)[0])
    assert joint.precision >= 0.98
    assert joint.recall >= 0.85
    assert pairwise.recall < 0.7


def test_identical_cars_get_few_tracklets() -> None:
    rng = np.random.default_rng(9)
    seen = watch(platoon(rng, similarity=1.0), uneven_times(rng, 16), rng=rng)
    assert score(seen, link_windows(seen.tables, TrackingConfig(), gsd_m=None, starts=ALL)[0]).recall < 0.4


def test_pairwise_linking_as_in_the_paper() -> None:
    seen = scene("queue at red")
    found, log = link_windows(seen.tables, PAIRWISE, gsd_m=None, starts=ALL)
    assert score(seen, found).precision >= 0.95
    assert log["appearance"] > 0


def test_precision_rises_with_confidence() -> None:
    """More of the tracklets of low confidence are wrong than of those of high confidence."""
    rng = np.random.default_rng(10)
    poor = Detector(jitter_px=1.2, axis_sd_rad=0.12, recall=0.8, false_alarms=12.0, noise_grey=5.0)
    seen = watch(crossing(rng), uneven_times(rng, 24), rng=rng, detector=poor)
    found, _ = link_windows(seen.tables, TrackingConfig(min_confidence=0.0), gsd_m=None, starts=ALL)
    confident = found["confidence"] >= 0.9
    assert score(seen, found[confident]).precision >= 0.97
    assert score(seen, found[~confident]).precision < 0.9
    assert found["confidence"].between(0, 1).all()


def test_columns_and_keys() -> None:
    found, _ = link_windows(scene("crossing").tables, TrackingConfig(), gsd_m=None, starts=ALL)
    assert {name: str(kind) for name, kind in found.dtypes.items()} == TRACKLET_COLUMNS
    assert found["tracklet_id"].is_unique
    assert (found["tracklet_id"] == found["detection_id_1"]).all()
    assert (found["track_id"] == -1).all()
    for k in range(3):  # a detection has one role in one tracklet only
        assert found[f"detection_id_{k}"].is_unique


def test_a_shared_link_has_one_displacement() -> None:
    found, _ = link_windows(scene("two lanes opposed").tables, TrackingConfig(), gsd_m=None, starts=ALL)
    both = found.merge(
        found, left_on=["detection_id_1", "detection_id_2"], right_on=["detection_id_0", "detection_id_1"]
    )
    assert len(both) > 20
    assert (both["vx_12_px_per_s_x"] == both["vx_01_px_per_s_y"]).all()
    assert (both["sad_12_x"] == both["sad_01_y"]).all()


SHORT = scene("two lanes opposed", seed=3, frames=12, dropped=(4, 8, 9))
FLAGS = [t.registered for t in SHORT.tables]
TIMES = [t.time_s for t in SHORT.tables]
WHOLE = link_windows(SHORT.tables, TrackingConfig(), gsd_m=None, starts=ALL)


@settings(max_examples=30)
@given(st.sets(st.integers(1, 11), max_size=8))
def test_any_chunking_gives_the_same_tracklets(cuts: set[int]) -> None:
    """link(parts, each with the frames of `window_frames`) == link(whole), to the bit, and their logs add up."""
    bounds = [0, *sorted(cuts), len(TIMES)]
    tables, log = [], GateLog()
    for start, stop in pairwise(bounds):
        starts = range(start, stop)
        reads = window_frames(FLAGS, TIMES, starts, TrackingConfig().max_interval_s)
        part = [SHORT.tables[i] for i in reads]
        rows, counts = link_windows(part, TrackingConfig(), gsd_m=None, starts=starts)
        tables.append(rows)
        log.update(counts)
    pd.testing.assert_frame_equal(pd.concat(tables, ignore_index=True), WHOLE[0], check_exact=True)
    assert {k: v for k, v in log.items() if v} == {k: v for k, v in WHOLE[1].items() if v}


def test_a_dropped_frame_breaks_by_time_not_by_index() -> None:
    rng = np.random.default_rng(1)
    perfect = Detector(recall=1.0, false_alarms=0.0)
    cars = [car(rng, (60.0, 60.0), (50.0, 0.0))]
    at_5_fps = watch(cars, [0.0, 0.2, 0.4, 0.6], rng=rng, detector=perfect, dropped=(1,))
    found, log = link_windows(at_5_fps.tables, TrackingConfig(), gsd_m=None, starts=ALL)
    assert found[["frame_0", "frame_1", "frame_2"]].to_numpy().tolist() == [[0, 2, 3]]
    assert found["vx_01_px_per_s"].item() == pytest.approx(50, abs=1.5)
    assert log["frames_not_registered"] == 1
    at_3_fps = watch(cars, [0.0, 0.3, 0.6, 0.9], rng=rng, detector=perfect, dropped=(1,))
    found, log = link_windows(at_3_fps.tables, TrackingConfig(), gsd_m=None, starts=ALL)
    assert found.empty
    assert log["gaps_too_long"] == 1


@settings(max_examples=30)
@given(steps=st.lists(st.sampled_from([0.0, 0.1, 0.2, 0.3]), min_size=2, max_size=5))
@example(steps=[0.2, 0.0, 0.2])
def test_an_interval_of_zero_never_divides(steps: list[float]) -> None:
    rng = np.random.default_rng(1)
    seen = watch([car(rng, (60.0, 60.0), (50.0, 0.0))], np.cumsum([0.0, *steps]), rng=rng)
    with np.errstate(divide="raise", invalid="raise"):
        found, _ = link_windows(seen.tables, TrackingConfig(), gsd_m=None, starts=ALL)
    assert np.isfinite(found[[f"v{axis}_{link}_px_per_s" for axis in "xy" for link in ("01", "12")]].to_numpy()).all()
    windows = [k for k in range(len(steps) - 1) if steps[k] > 0 and steps[k + 1] > 0]
    assert set(found["frame_0"]) <= set(windows)


def test_frames_out_of_time_order_are_refused() -> None:
    seen = scene("platoon", frames=3)
    with pytest.raises(InputError, match="time order"):
        link_windows(seen.tables[::-1], TrackingConfig(), gsd_m=None, starts=ALL)


@pytest.mark.parametrize("frames", [0, 1, 2, 5])
def test_frames_without_detections_have_no_tracklets(frames: int) -> None:
    rng = np.random.default_rng(0)
    seen = watch([], np.arange(frames) * 0.2, rng=rng, detector=Detector(false_alarms=0.0))
    found, _ = link_windows(seen.tables, TrackingConfig(), gsd_m=None, starts=ALL)
    assert found.empty
    assert list(found.columns) == list(TRACKLET_COLUMNS)


def test_positions_alone_give_tracklets() -> None:
    """External detections may have neither axes nor crops."""
    rng = np.random.default_rng(6)
    cars = [car(rng, (x, y), (50.0, 0.0)) for x, y in [(20.0, 30.0), (80.0, 60.0), (140.0, 90.0), (60.0, 120.0)]]
    seen = watch(cars, uneven_times(rng, 8), rng=rng, detector=Detector(recall=1.0, false_alarms=0.0))
    unknown = {"crops": None, "x_work": None, "y_work": None}
    bare = [
        replace(t, orientation_rad=t.x_px * np.nan, orientation_sd_rad=t.x_px * np.nan, **unknown) for t in seen.tables
    ]
    found, log = link_windows(bare, TrackingConfig(), gsd_m=None, starts=ALL)
    result = score(seen, found)
    assert result.precision == 1.0
    assert result.recall >= 0.9
    assert found["sad_01"].isna().all()
    assert log["links_refined"] == 0


def _split(seen: Watched, weak_cars: set[int]) -> tuple[list[FrameTable], list[FrameTable]]:
    """Detections, and weak candidates: those of some cars, and all that are of none."""
    sure, weak = [], []
    for table in seen.tables:
        is_weak = np.array([seen.car_of[one] in weak_cars for one in table.detection_id.tolist()], bool)
        sure.append(table.take(np.flatnonzero(~is_weak)))
        weak.append(replace(table.take(np.flatnonzero(is_weak)), score=np.full(is_weak.sum(), 0.01)))
    return sure, weak


def test_weak_candidates_that_move_as_a_vehicle_make_tracklets_and_change_no_other() -> None:
    rng = np.random.default_rng(9)
    cars = [car(rng, (20, 140), (60, 0)), car(rng, (200, 20), (0, 0)), *two_lanes_opposed(rng)]
    seen = watch(cars, uneven_times(rng, 12), rng=rng, detector=Detector(recall=1.0, false_alarms=12.0))
    sure, weak = _split(seen, {-1, 0, 1})
    config = TrackingConfig()
    alone, _ = link_windows(sure, config, gsd_m=None, starts=ALL)
    both, log = link_windows(sure, config, gsd_m=None, starts=ALL, weak=weak)
    added = both[~both["tracklet_id"].isin(alone["tracklet_id"])]
    pd.testing.assert_frame_equal(both.drop(added.index).reset_index(drop=True), alone)
    assert log["moving_candidates"] == len(added)
    owner = np.array([[seen.car_of[one] for one in added[f"detection_id_{k}"]] for k in range(3)])
    of_mover = (owner == 0).all(axis=0)
    assert of_mover.sum() >= 7, "of ten windows"
    assert of_mover.mean() >= 0.9, "neither the car that stands nor what is no car"
    assert np.median(added["vx_01_px_per_s"][of_mover]) == pytest.approx(60, abs=2)


def test_a_row_of_like_things_of_which_each_is_seen_now_and_then_is_nothing_that_moves() -> None:
    """Skylights at a roof's edge: one that is seen here, the next one there, look like a vehicle at their distance."""
    found = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        row = [car(rng, (40.0 + 14 * k, 80.0), (0.0, 0.0), similarity=1.0) for k in range(8)]
        row = [replace(one, heading=lambda t: 0.0) for one in row]
        seen = watch(row, np.arange(10) * 0.2, rng=rng, detector=Detector(recall=0.5, false_alarms=0.0))
        sure, weak = _split(seen, set(range(8)))
        tracklets, _ = link_windows(sure, TrackingConfig(), gsd_m=None, starts=ALL, weak=weak)
        found += len(tracklets)
    assert found < 20, "of 160 windows"
