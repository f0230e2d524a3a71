"""Coverage of the 90 % intervals of a pixel, and their widths."""

import numpy as np
import pytest

from schemas.flight import FieldConfig
from schemas.simulation import SimulationConfig
from velfield.field.accumulate import FieldTile, accumulate_tile
from velfield.field.modes import modal_velocity
from velfield.field.segments import (
    SEGMENT_DTYPE,
    Segments,
    VelocityBins,
    band_radius_px,
    segment_table,
    stationary_speed_px_per_s,
)
from velfield.field.statistics import TileStatistics, tile_statistics
from velfield.synthetic.flight import Flight
from velfield.synthetic.observed import NO_ERRORS, observed_tracklets
from velfield.synthetic.traffic.traffic import Traffic, simulate_traffic

GSD_M = 0.23
CONFIG = FieldConfig()
BINS = VelocityBins.from_config(CONFIG, GSD_M)
RADIUS = band_radius_px(CONFIG, GSD_M)
STATIONARY_SPEED = stationary_speed_px_per_s(CONFIG, GSD_M)
SECTION_M = 40.0
REPEATS = 10


def passing(
    speed_m_per_s: np.ndarray, direction_rad: np.ndarray, *, sd_m_per_s: float = 0.0
) -> tuple[FieldTile, TileStatistics]:
    """One pixel with a track at each of these velocities, measured with a standard deviation."""
    n = len(speed_m_per_s)
    out = np.zeros(n, SEGMENT_DTYPE)
    out["track"], out["duration_s"], out["sd_px_per_s"] = np.arange(n), 0.2, sd_m_per_s / GSD_M
    out["vx_px_per_s"] = speed_m_per_s * np.cos(direction_rad) / GSD_M
    out["vy_px_per_s"] = speed_m_per_s * np.sin(direction_rad) / GSD_M
    for axis in "xy":
        out[f"{axis}0_px"], out[f"{axis}1_px"] = -0.1 * out[f"v{axis}_px_per_s"], 0.1 * out[f"v{axis}_px_per_s"]
    return tile_of(out, 0, 0)


def tile_of(segments: Segments, x: int, y: int) -> tuple[FieldTile, TileStatistics]:
    """One pixel's tile and its statistics."""
    tile = accumulate_tile(segments, origin_xy=(x, y), shape=(1, 1), bins=BINS, radius_px=RADIUS)
    return tile, tile_statistics(*tile[:2], tile.variance_sum, bins=BINS, stationary_speed_px_per_s=STATIONARY_SPEED)


def width_m_per_s(statistics: TileStatistics) -> float:
    """Width of the median speed's interval, m/s."""
    return float((statistics.median_speed_high_px_per_s - statistics.median_speed_low_px_per_s)[0, 0] * GSD_M)


def drivers(n: int, seed: int = 0, sd: float = 1.4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(14, sd, n), rng.normal(0.3, 0.01, n)


def test_more_tracks_make_narrower_intervals() -> None:
    widths = [np.median([width_m_per_s(passing(*drivers(n, seed))[1]) for seed in range(9)]) for n in (3, 10, 40, 160)]
    assert widths[1] > 1.1 * widths[2] > 1.3 * widths[3]
    assert widths[0] > 2.5 * widths[3]
    halves = [float(passing(*drivers(n))[1].direction_half_width_rad[0, 0]) for n in (3, 40)]
    assert halves[0] > 1.5 * halves[1]


def test_measurement_variance_widens_the_intervals_of_few_tracks() -> None:
    """Two vehicles measured at one speed: the interval is as wide as the measurement error of either."""
    speed, direction = np.full(2, 14.0), np.full(2, 0.3)
    precise, noisy = (passing(speed, direction, sd_m_per_s=sd) for sd in (0.05, 2.0))
    assert noisy[0].variance_sum[0, 0] == pytest.approx(2 * (2.0 / 2.0) ** 2 * 4096, rel=0.01)
    assert width_m_per_s(noisy[1]) > 1.5 * width_m_per_s(precise[1])
    assert noisy[1].direction_half_width_rad[0, 0] > 3 * precise[1].direction_half_width_rad[0, 0]


def test_the_median_of_half_stationary_traffic_may_be_either_speed() -> None:
    speed = np.array([0.0] * 6 + [14.0] * 6)
    _, s = passing(speed, np.zeros(12))
    assert s.median_speed_low_px_per_s[0, 0] * GSD_M < 1.5
    assert s.median_speed_high_px_per_s[0, 0] * GSD_M > 13.0


def test_stationary_traffic_has_no_direction_and_an_empty_pixel_no_interval() -> None:
    _, stationary = passing(np.zeros(4), np.zeros(4))
    assert np.isnan(stationary.direction_half_width_rad[0, 0])
    assert stationary.median_speed_low_px_per_s[0, 0] * GSD_M < 1.0
    _, empty = tile_of(np.zeros(0, SEGMENT_DTYPE), 0, 0)
    assert np.isnan(empty.median_speed_low_px_per_s[0, 0])


def sections(flight: Flight) -> list[tuple[int, int]]:
    """A pixel every 40 m along every lane."""
    found = []
    for edge in flight.city.plan.road_network.edges:
        along = np.concatenate([[0.0], np.hypot(*np.diff(edge.path, axis=0).T).cumsum()])
        for s in np.arange(min(SECTION_M, along[-1]) / 2, along[-1], SECTION_M):
            position = np.array([[np.interp(s, along, edge.path[:, k]) for k in (0, 1)]])
            x, y = np.rint(flight.city.to_px(position)[0]).astype(int)
            if 20 < x < flight.base_shape[1] - 20 and 20 < y < flight.base_shape[0] - 20:
                found.append((int(x), int(y)))
    return found


def segments_of(flight: Flight, traffic: Traffic, seed: int, **errors: object) -> Segments:
    tracklets = observed_tracklets(
        traffic,
        flight.times_s,
        flight.city.to_px,
        shape=flight.base_shape,
        rng=np.random.default_rng(seed),
        **errors,
    )
    return segment_table(tracklets, CONFIG)


def near(segments: Segments, x: int, y: int) -> Segments:
    reach = (RADIUS or 0.0) + 1
    keep = np.ones(len(segments), bool)
    for axis, at in (("x", x), ("y", y)):
        a, b = segments[f"{axis}0_px"], segments[f"{axis}1_px"]
        keep &= (np.minimum(a, b) <= at + reach) & (np.maximum(a, b) >= at - reach)
    return segments[keep]


def covered(seed: int) -> np.ndarray:
    """(sections, 2) whether the intervals of one flight cover the truth: median speed, modal direction (NaN: none)."""
    flight = Flight(SimulationConfig(seed=seed, frames=300, width=640, height=480))
    seen = segments_of(flight, flight.city.traffic, seed)
    design_effect = []
    for k in range(REPEATS):  # the same hour of other days
        rng = np.random.default_rng(1000 * seed + k)
        duration_s = float(flight.times_s[-1]) + 1
        other = simulate_traffic(flight.city.plan.road_network, flight.config.traffic, duration_s=duration_s, rng=rng)
        part = segments_of(flight, other, k, errors=NO_ERRORS)
        part["track"] += k << 40
        design_effect.append(part)
    truth = np.concatenate(design_effect)
    rows = []
    for x, y in sections(flight):
        tile, s = tile_of(near(seen, x, y), x, y)
        long, true = tile_of(near(truth, x, y), x, y)
        if tile.count[0, 0] == 0 or long.count[0, 0] < 30:
            continue
        median = true.speed_percentiles_px_per_s[0, 0, 1]
        low, high = s.median_speed_low_px_per_s[0, 0], s.median_speed_high_px_per_s[0, 0]
        mode = modal_velocity(long.histogram, long.count, bins=BINS)[0, 0]
        found, half = s.modal_velocity_px_per_s[0, 0], s.direction_half_width_rad[0, 0]
        error = abs(np.angle(np.exp(1j * (np.arctan2(*found[::-1]) - np.arctan2(*mode[::-1])))))
        moves = np.isfinite(half) and np.hypot(*mode) > STATIONARY_SPEED
        rows.append((float(low <= median <= high), float(error <= half) if moves else np.nan))
    return np.array(rows)


def test_intervals_cover_the_truth_of_simulated_traffic() -> None:
    """Unseen seeds; a handful of flights, so the margin is wide: the figures of many are in docs/field.md."""
    rows = np.concatenate([covered(seed) for seed in (41, 42, 43)])
    speed, direction = np.nanmean(rows, axis=0)
    assert len(rows) > 60
    assert 0.80 <= speed <= 0.99
    assert 0.83 <= direction <= 0.99
