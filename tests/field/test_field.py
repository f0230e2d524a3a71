"""Accumulation of the field: the weight of a track at a pixel, independence of order and tiling, and the definition."""

from math import erf, hypot, sqrt

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.flight import FieldConfig
from schemas.tables import TRACKLET_COLUMNS
from velfield.errors import InputError
from velfield.field.accumulate import KERNEL_RADIUS_SIGMAS, UNIT, VARIANCE_UNIT, FieldTile, accumulate_tile
from velfield.field.algebra import merge_tiles, subtract_tile
from velfield.field.segments import (
    SEGMENT_DTYPE,
    Segments,
    VelocityBins,
    band_radius_px,
    segment_table,
    segments_by_tile,
    stationary_speed_px_per_s,
)

BINS = VelocityBins(width_px_per_s=10.0, reach=6, kernel_sigma_px_per_s=3.5)


def tracks(seed: int, n: int = 6, size: float = 40.0) -> Segments:
    """Vehicles that turn, slow down and stop, of a few segments each."""
    rng = np.random.default_rng(seed)
    rows = []
    for track in range(n):
        position, heading = rng.uniform(0, size, 2), rng.uniform(-np.pi, np.pi)
        for k in range(int(rng.integers(1, 6))):
            speed = rng.choice([0.0, 3.0, 30.0, 55.0])
            heading += rng.normal(0, 0.2)
            velocity = speed * np.array([np.cos(heading), np.sin(heading)])
            duration = rng.uniform(0.1, 0.4)
            there = position + velocity * duration
            rows.append(
                (
                    track,
                    k * 1.0,
                    duration,
                    *position,
                    *there,
                    *velocity,
                    track * 100 + k,
                    track * 100 + k + 1,
                    k + 1.0,
                )
            )
            position = there
    return np.array(rows, SEGMENT_DTYPE)


def tile_of(segments: Segments, radius_px: float | None = 2.0, weight: str = "track", size: int = 40) -> FieldTile:
    return accumulate_tile(
        segments, origin_xy=(0, 0), shape=(size, size), bins=BINS, radius_px=radius_px, weight=weight
    )


def plain_tile(segments: Segments, radius: float, weight: str, size: int) -> tuple[np.ndarray, ...]:
    """The tile by its definition: float64, every pixel against every segment."""
    histogram, count = np.zeros((size, size, BINS.n, BINS.n)), np.zeros((size, size), int)
    variance_sum = np.zeros((size, size))
    for track in np.unique(segments["track"]):
        mine = segments[segments["track"] == track]
        for y in range(size):
            for x in range(size):
                dwell = np.array([_dwell(s, x, y, radius) for s in mine])
                if not dwell.any():
                    continue
                count[y, x] += 1
                variance_sum[y, x] += dwell @ (mine["sd_px_per_s"] / BINS.width_px_per_s) ** 2 / dwell.sum()
                fractions = {"track": dwell / dwell.sum(), "segment": 1.0 * (dwell > 0), "time": dwell}[weight]
                for segment, part in zip(mine, fractions, strict=True):
                    histogram[y, x] += part * _kernel(segment["vx_px_per_s"], segment["vy_px_per_s"])
    return histogram, count, variance_sum


def _dwell(segment: np.void, x: int, y: int, radius: float) -> float:
    """Dwell time within the radius of a pixel, s."""
    a = np.array([segment["x0_px"] - x, segment["y0_px"] - y])
    d = np.array([segment["x1_px"] - segment["x0_px"], segment["y1_px"] - segment["y0_px"]])
    if hypot(*a) > hypot(*d) + radius:
        return 0.0
    if hypot(*d) < 1e-9:
        return float(segment["duration_s"]) if a @ a < radius**2 else 0.0
    roots = np.roots([d @ d, 2 * a @ d, a @ a - radius**2])
    if abs(roots.imag).max() > 0:
        return 0.0
    low, high = np.clip(np.sort(roots.real), 0, 1)
    return float((high - low) * segment["duration_s"])


def _kernel(vx: float, vy: float) -> np.ndarray:
    def fractions(v: float) -> np.ndarray:
        sigma, position = BINS.kernel_sigma_px_per_s / BINS.width_px_per_s, v / BINS.width_px_per_s + BINS.reach
        position = min(max(position, 0), BINS.n - 1)
        edges = np.arange(BINS.n + 1) - 0.5
        below = np.array([0.5 * (1 + erf((e - position) / sigma / sqrt(2))) for e in edges])
        reach = KERNEL_RADIUS_SIGMAS * sigma
        first = max(int(np.floor(position - reach + 0.5)), 0)
        last = min(int(np.floor(position + reach + 0.5)), BINS.n - 1)
        below[: first + 1], below[last + 1 :] = 0, 1
        return np.diff(below)

    return np.outer(fractions(vy), fractions(vx))


@pytest.mark.parametrize("weight", ["track", "segment", "time"])
def test_kernel_agrees_with_the_definition(weight: str) -> None:
    segments = tracks(seed=3, n=9, size=20.0)
    fast = tile_of(segments, weight=weight, size=20)
    plain, count, variance_sum = plain_tile(segments, radius=2.0, weight=weight, size=20)
    assert (count > 1).any()
    np.testing.assert_array_equal(fast.count, count)
    np.testing.assert_allclose(fast.histogram / UNIT, plain, atol=2e-3)
    np.testing.assert_allclose(fast.variance_sum / VARIANCE_UNIT, variance_sum, atol=1e-3 * count.max())


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_a_track_weighs_one_at_each_pixel(seed: int) -> None:
    """Slow or fast, of one segment or of many: ``histogram.sum((2, 3)) == count * UNIT``."""
    tile = tile_of(tracks(seed))
    assert (tile.histogram >= 0).all()
    np.testing.assert_array_equal(tile.histogram.sum(axis=(2, 3)), tile.count * UNIT)


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), radius=st.sampled_from([None, 0.75, 2.0]))
def test_the_histogram_does_not_depend_on_the_order_of_tracks_nor_on_the_tiling(
    seed: int, radius: float | None
) -> None:
    segments = tracks(seed)
    whole = tile_of(segments, radius)
    shuffled = np.concatenate([segments[segments["track"] == p] for p in np.random.default_rng(seed).permutation(6)])
    np.testing.assert_array_equal(tile_of(shuffled, radius).histogram, whole.histogram)
    rows = segments_by_tile(segments, shape=(40, 40), tile_size=16, radius_px=radius)
    joined = np.zeros_like(whole.histogram)
    for (ty, tx), part in rows.items():
        height, width = min(16, 40 - 16 * ty), min(16, 40 - 16 * tx)
        tile = accumulate_tile(
            segments[part], origin_xy=(16 * tx, 16 * ty), shape=(height, width), bins=BINS, radius_px=radius
        )
        joined[16 * ty : 16 * ty + height, 16 * tx : 16 * tx + width] = tile.histogram
    np.testing.assert_array_equal(joined, whole.histogram)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_disjoint_sets_of_tracks_add_up_to_the_whole_and_subtract_again(seed: int) -> None:
    segments = tracks(seed, n=10)
    whole = tile_of(segments)
    parts = [tile_of(segments[segments["track"] % 5 == k]) for k in range(5)]
    for merged, expected in zip(merge_tiles(parts), whole, strict=True):
        np.testing.assert_array_equal(merged, expected)
    for left, expected in zip(subtract_tile(whole, parts[0]), merge_tiles(parts[1:]), strict=True):
        np.testing.assert_array_equal(left, expected)


def test_subtracting_a_field_that_is_no_part_is_refused() -> None:
    small, large = tile_of(tracks(1, n=2)), tile_of(tracks(2, n=8))
    with pytest.raises(InputError, match="no part of it"):
        subtract_tile(small, large)


def test_a_stationary_vehicle_weighs_by_its_dwell_time_with_weight_time() -> None:
    """One car is stationary for 20 s, one drives past: equal weights by track; by time the stationary one has more."""
    stationary = [(0, t, 1.0, 20.0, 20.0, 20.0, 20.0, 0.0, 0.0, t, t + 1, 0.0) for t in range(20)]
    moves = [(1, t, 1.0, 40 * t - 20.0, 20.0, 40 * t + 20.0, 20.0, 40.0, 0.0, 100 + t, 101 + t, 0.0) for t in range(2)]
    segments = np.array(stationary + moves, SEGMENT_DTYPE)
    by_track, by_time = tile_of(segments), tile_of(segments, weight="time")
    at_rest = np.s_[20, 20, :, BINS.reach - 1 : BINS.reach + 2]
    assert by_track.count[20, 20] == 2
    assert by_track.histogram[at_rest].sum() == pytest.approx(UNIT, rel=1e-3)
    assert by_time.histogram[at_rest].sum() == pytest.approx(20 * UNIT, rel=1e-3)
    assert by_track.occupancy_ms[20, 20] == pytest.approx(20_000 + 2 * 2 / 40 * 1000, abs=2)


def test_band_is_half_a_lane_wide_and_the_papers_line_one_pixel() -> None:
    segment = np.array([(0, 0, 0.5, 5.0, 20.0, 35.0, 20.0, 60.0, 0.0, 0, 1, 0.0)], SEGMENT_DTYPE)
    config = FieldConfig(lane_width_m=3.6)
    radius = band_radius_px(config, gsd_m=0.2)
    assert radius == pytest.approx(4.5)
    assert (tile_of(segment, radius).count[:, 20] > 0).sum() == 9
    line = tile_of(segment, band_radius_px(config.model_copy(update={"path_width": "pixel"}), 0.2))
    assert (line.count[:, 20] > 0).sum() == 1
    assert (line.count > 0).sum() == 31


def test_speeds_beyond_the_last_bin_are_in_the_last_bin() -> None:
    segment = np.array([(0, 0, 0.1, 5.0, 20.0, 35.0, 20.0, 300.0, 0.0, 0, 1, 0.0)], SEGMENT_DTYPE)
    assert tile_of(segment).histogram[20, 20, :, -2:].sum() == UNIT


def tracklets(n: int) -> pd.DataFrame:
    """Tracklets of one track at 50 px/s along x, five frames a second."""
    k = np.arange(n)
    table: dict[str, object] = {name: np.zeros(n) for name in TRACKLET_COLUMNS}
    table |= {"tracklet_id": k + 1, "track_id": np.zeros(n, int)}
    for i in range(3):
        table |= {f"frame_{i}": k + i, f"detection_id_{i}": k + i, f"time_{i}_s": (k + i) / 5}
        table |= {f"x_{i}_px": 10.0 * (k + i), f"y_{i}_px": np.full(n, 20.0)}
    table |= {"vx_01_px_per_s": np.full(n, 50.0), "vx_12_px_per_s": np.full(n, 50.0)}
    return pd.DataFrame(table).astype(TRACKLET_COLUMNS)


def test_shared_segments_count_once_or_twice_as_in_the_paper() -> None:
    once = segment_table(tracklets(4), FieldConfig())
    twice = segment_table(tracklets(4), FieldConfig(shared_segment_weight=2))
    assert len(once) == 5
    assert len(twice) == 8
    np.testing.assert_array_equal(np.diff(once["x0_px"]), 10.0)
    np.testing.assert_array_equal(tile_of(twice).count, tile_of(once).count)


def test_segment_table_does_not_depend_on_the_order_of_tracklets() -> None:
    table = tracklets(6)
    shuffled = table.sample(frac=1, random_state=3)
    np.testing.assert_array_equal(segment_table(table, FieldConfig()), segment_table(shuffled, FieldConfig()))


def test_averaging_halves_the_error_of_positions_and_is_unbiased_under_acceleration() -> None:
    """Positions accurate to 1 px: their error enters neighbouring segments with opposite signs."""
    table = tracklets(60)
    t = np.arange(62) / 5
    true_x = 20 * t + 0.5 * 9 * t**2
    seen_x = true_x + np.random.default_rng(0).normal(0, 1, 62)
    for k, pair in enumerate(("01", "12")):
        table[f"vx_{pair}_px_per_s"] = np.diff(seen_x)[k : k + 60] * 5
    truth = np.diff(true_x) * 5
    error = {
        span: segment_table(table, FieldConfig(velocity_span_s=span))["vx_px_per_s"] - truth for span in (0.0, 0.6)
    }
    assert error[0.6].std() < 0.45 * error[0.0].std()
    assert abs(error[0.6][1:-1].mean()) < 0.5


def test_unaligned_displacements_have_little_weight_beside_aligned_ones() -> None:
    table = tracklets(6)
    for pair in ("01", "12"):
        table[f"displacement_sd_{pair}_px"] = 0.1
    wrong = 3  # the segment from frame 3 to 4, 3 px too long, with a standard deviation of a pixel and a half
    table.loc[wrong, "vx_01_px_per_s"] = table.loc[wrong - 1, "vx_12_px_per_s"] = 65.0
    table.loc[wrong, "displacement_sd_01_px"] = table.loc[wrong - 1, "displacement_sd_12_px"] = 1.5
    segments = segment_table(table, FieldConfig(velocity_span_s=0.6))
    np.testing.assert_allclose(segments["vx_px_per_s"], 50.0, atol=0.2)
    assert segments["sd_px_per_s"].max() < 0.1 * 5  # less than of an aligned one alone


def test_averaging_stops_at_the_end_of_a_track() -> None:
    table = tracklets(6)
    table["track_id"] = [0, 0, 0, 1, 1, 1]
    table.loc[3:, ["vx_01_px_per_s", "vx_12_px_per_s"]] = -50.0
    velocity = segment_table(table, FieldConfig(velocity_span_s=2.0))["vx_px_per_s"]
    assert np.abs(velocity).tolist() == pytest.approx([50.0] * 8)


def test_velocities_do_not_depend_on_other_tracks() -> None:
    rng = np.random.default_rng(4)
    parts = []
    for track in range(5):
        part = tracklets(9)
        part["track_id"] = track
        part[[c for c in part if c.startswith("detection_id")]] += 100 * track
        part[[c for c in part if c.startswith("v")]] += rng.normal(0, 5, (9, 4))
        parts.append(part)
    whole = segment_table(pd.concat(parts), FieldConfig())
    alone = segment_table(parts[3], FieldConfig())
    np.testing.assert_array_equal(whole[whole["track"] == 3], alone)


def test_no_tracklets_give_no_segments() -> None:
    assert len(segment_table(tracklets(3).iloc[:0], FieldConfig())) == 0


def test_an_interval_of_zero_is_refused() -> None:
    table = tracklets(3)
    table["time_1_s"] = table["time_0_s"]
    with pytest.raises(InputError, match="intervals positive"):
        segment_table(table, FieldConfig())


def test_only_tiles_near_a_segment_are_listed() -> None:
    segments = segment_table(tracklets(4), FieldConfig())
    assert list(segments_by_tile(segments, shape=(200, 200), tile_size=64, radius_px=2.0)) == [(0, 0)]
    assert segments_by_tile(segments[:0], shape=(200, 200), tile_size=64, radius_px=2.0) == {}
    outside = segments.copy()
    outside["x0_px"] -= 500
    outside["x1_px"] -= 500
    assert segments_by_tile(outside, shape=(200, 200), tile_size=64, radius_px=2.0) == {}


def test_without_a_ground_sample_distance_the_papers_is_used() -> None:
    bins = VelocityBins.from_config(FieldConfig(), None)
    assert bins.width_px_per_s == pytest.approx(2 / 0.23)
    assert stationary_speed_px_per_s(FieldConfig(), None) == pytest.approx(5.0)
    metric = VelocityBins.from_config(FieldConfig(), 0.5)
    assert metric.centres_px_per_s[[0, 18, -1]] == pytest.approx([-72, 0, 72])
    assert metric.area_px2_per_s2 == pytest.approx(16)
    assert metric.blur_bins2 == pytest.approx(0.35**2 + 1 / 12)


def test_a_velocity_grid_covers_the_bins_and_round_trips() -> None:
    grid = BINS.grid_px_per_s(samples_per_bin=2)
    assert len(grid) == (2 * BINS.n - 1) ** 2
    np.testing.assert_allclose(grid[[0, 1, -1]], [[-60, -60], [-55, -60], [60, 60]])
    np.testing.assert_allclose(BINS.from_bins(BINS.to_bins(grid)), grid)
    np.testing.assert_allclose(BINS.to_bins(BINS.centres_px_per_s), np.arange(BINS.n))


def test_a_weight_beyond_32_bits_is_refused() -> None:
    long = np.array([(0, 0, 140_000.0, 20.0, 20.0, 20.0, 20.0, 0.0, 0.0, 0, 1, 0.0)], SEGMENT_DTYPE)
    with pytest.raises(InputError, match="into time intervals"):
        tile_of(long, weight="time")
