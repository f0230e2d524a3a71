"""The estimators of the field against their textbook definitions: quantiles, modes, intervals, tests, prior."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from schemas.arrays import FloatArray
from schemas.flight import FieldConfig
from tests.field.test_field_statistics import BINS, GSD_M, drive, field, polar
from velfield.errors import InputError
from velfield.field.accumulate import FieldTile
from velfield.field.algebra import merge_tiles
from velfield.field.comparison import compare_fields
from velfield.field.gate import make_gate
from velfield.field.heldout import heldout_log_likelihood
from velfield.field.modes import (
    BANDWIDTH_BINS,
    CELLS_PER_BIN,
    MIN_BANDWIDTH_BINS,
    bandwidth_bins,
    deconvolution_factor,
    kernel_variance,
    max_cells,
    occupied_box,
    quantile,
    speed_cells,
    speed_variance,
    velocity_modes,
)
from velfield.field.segments import SEGMENT_DTYPE
from velfield.field.statistics import SPEED_CORRELATION, _half_width, _student_t95
from velfield.field.time_intervals import assign_intervals, parse_time_intervals

REACH = 18


def gaussian_histogram(mean: tuple[float, float], sigma: float, weight: float = 1e6) -> np.ndarray:
    """A Gaussian in velocity bins, mean as (vx, vy) in bins from zero."""
    y, x = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1]
    density = np.exp(-0.5 * ((x - mean[0]) ** 2 + (y - mean[1]) ** 2) / sigma**2)
    return np.asarray(np.rint(weight * density / density.sum()), np.int32)


def test_the_speed_histogram_conserves_the_weight_and_its_quantiles_are_the_speeds() -> None:
    h = gaussian_histogram((8.0, 6.0), 1.2)
    cells = np.zeros(max_cells(REACH))
    total = speed_cells(h, occupied_box(h), cells)
    assert cells.sum() == pytest.approx(total)
    y, x = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1]
    speed = np.repeat(np.hypot(x, y).ravel(), h.ravel() // 10)
    speed += np.random.default_rng(0).uniform(-0.5, 0.5, speed.size)  # a bin is spread over its width
    for p in (0.15, 0.5, 0.85):
        assert quantile(cells, total, p) == pytest.approx(np.quantile(speed, p), abs=0.03)
    assert quantile(cells, total, 0.0) <= quantile(cells, total, 1.0) <= len(cells) / CELLS_PER_BIN


@pytest.mark.parametrize("filled", [0, 1, 2, 7])
def test_the_occupied_box_holds_the_bins_that_are_not_zero(filled: int) -> None:
    rng = np.random.default_rng(filled)
    for _ in range(20):
        h = np.zeros((11, 11), np.int32)
        h[rng.integers(0, 11, filled), rng.integers(0, 11, filled)] = rng.integers(1, 2**31 - 1, filled)
        y, x = np.nonzero(h)
        expected = (y.min(), y.max() + 1, x.min(), x.max() + 1) if filled else (0, 0, 0, 0)
        assert occupied_box(h) == expected


@pytest.mark.parametrize("true_sd", [0.5, 1.0, 2.0])
def test_the_deconvolution_factor_is_the_ratio_of_standard_deviations(true_sd: float) -> None:
    """Speeds of a standard deviation along x, blurred by the kernel and the bins."""
    kernel = 0.35
    blurred = np.sqrt(true_sd**2 + kernel**2 + 1 / 12)
    y, x = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1]
    h = np.rint(1e5 * np.exp(-0.5 * ((x - 10) / blurred) ** 2) * (y == 0)).astype(np.int32)
    cells = np.zeros(max_cells(REACH))
    total = speed_cells(h, occupied_box(h), cells)
    variance = speed_variance(cells, total)
    assert deconvolution_factor(variance, kernel_variance(kernel)) == pytest.approx(
        true_sd / np.hypot(blurred, 12**-0.5), rel=0.03
    )
    assert deconvolution_factor(variance, 1e9) == 0.0


def test_the_bandwidth_follows_scotts_rule_down_to_its_minimum() -> None:
    assert bandwidth_bins(1) == BANDWIDTH_BINS
    assert bandwidth_bins(8) == pytest.approx(BANDWIDTH_BINS * 8 ** (-1 / 6))
    assert bandwidth_bins(10**6) == MIN_BANDWIDTH_BINS
    assert bandwidth_bins(0) == BANDWIDTH_BINS


@settings(max_examples=20)
@given(x=st.floats(-12, 12), y=st.floats(-12, 12), sigma=st.floats(0.6, 2.0))
def test_mean_shift_finds_the_centre_of_a_gaussian(x: float, y: float, sigma: float) -> None:
    modes = velocity_modes(gaussian_histogram((x, y), sigma)[None, None], np.array([[50]], np.int32), bins=BINS)
    found = modes[0, 0, 0, :2] / BINS.width_px_per_s
    assert found == pytest.approx([x, y], abs=0.03)


def test_modes_have_the_weights_of_their_basins_and_the_largest_comes_first() -> None:
    h = gaussian_histogram((10.0, 0.0), 1.0, 2e5) + gaussian_histogram((-8.0, 4.0), 1.0, 6e5)
    modes = velocity_modes(h[None, None], np.array([[80]], np.int32), bins=BINS, k=3)[0, 0]
    assert modes[:2, 2] == pytest.approx([0.75, 0.25], abs=0.01)
    assert modes[0, :2] / BINS.width_px_per_s == pytest.approx([-8.0, 4.0], abs=0.1)
    assert np.isnan(modes[2]).all()


def test_a_ring_about_an_empty_bin_has_one_mode_that_holds_all_the_weight() -> None:
    """The smoothed histogram is highest at the bin in the middle, which no vehicle filled."""
    h = np.zeros((2 * REACH + 1, 2 * REACH + 1), np.int32)
    h[REACH + 4 : REACH + 7, REACH + 7 : REACH + 10] = 5
    h[REACH + 5, REACH + 8] = 0
    modes = velocity_modes(h[None, None], np.array([[1_000_000]], np.int32), bins=BINS)[0, 0]
    assert np.isfinite(modes[0]).all()
    assert np.isnan(modes[1:]).all()
    np.testing.assert_allclose(modes[0, :2], BINS.from_bins(np.array([REACH + 8.0, REACH + 5.0])), atol=0.1)
    assert modes[0, 2] == 1.0


@pytest.mark.parametrize("dof", [3.0, 5.5, 12.0, 60.0, 1000.0])
def test_students_quantile_is_that_of_scipy(dof: float) -> None:
    assert _student_t95(dof) == pytest.approx(stats.t.ppf(0.95, dof), rel=0.003)


def test_the_half_width_is_students_interval_and_grows_with_the_design_effect() -> None:
    n, variance = 30.0, 4.0
    plain = _half_width(variance, 0.0, 0.0, n, 0.0)
    assert plain == pytest.approx(stats.t.ppf(0.95, n - 1) * np.sqrt(variance / (n - 1)), rel=0.003)
    clustered = _half_width(variance, 0.0, 0.0, n, SPEED_CORRELATION)
    effect = 1 + SPEED_CORRELATION * 19
    assert clustered / plain > 0.95 * np.sqrt(effect)
    assert _half_width(0.0, 1.0, 3.0, n, 0.0) > 0  # a typical variance keeps it from zero


def layers(**values: float) -> dict[str, np.ndarray]:
    """Layers of one pixel."""
    base = {"modal_vx": 40.0, "modal_vy": 0.0, "count": 50.0, "speed_p50": 40.0}
    base |= {"direction_ci90_half_width": 0.05, "speed_p50_ci90_lower": 38.0, "speed_p50_ci90_upper": 42.0}
    return {name: np.full((1, 1), value) for name, value in (base | values).items()}


def compared(before: dict[str, np.ndarray], after: dict[str, np.ndarray], hours: tuple[float, float] = (1.0, 1.0)):
    return compare_fields(
        before.__getitem__,
        after.__getitem__,
        observed_s=(3600 * hours[0], 3600 * hours[1]),
        stationary_speed_px_per_s=5.0,
    )


def test_a_change_of_direction_is_tested_against_both_intervals_across_pi() -> None:
    before = layers(modal_vx=-40.0, modal_vy=2.0)
    after = layers(modal_vx=-40.0, modal_vy=-2.0)
    change = compared(before, after)["direction"]
    assert change.change[0, 0] == pytest.approx(2 * np.arctan2(2, 40))
    z = 2 * np.arctan2(2, 40) * 1.6449 / np.hypot(0.05, 0.05)
    assert change.p_value[0, 0] == pytest.approx(2 * stats.norm.sf(z))
    assert np.isnan(compared(before, layers(modal_vx=1.0))["direction"].p_value[0, 0])  # stationary: no direction
    assert np.isnan(compared(layers(count=4), after)["direction"].change[0, 0])  # too few tracks


def test_a_change_of_speed_is_tested_against_the_facing_ends_of_the_intervals() -> None:
    change = compared(layers(), layers(speed_p50=50.0, speed_p50_ci90_lower=47.0, speed_p50_ci90_upper=90.0))["speed"]
    assert change.change[0, 0] == 10.0
    assert change.p_value[0, 0] == pytest.approx(2 * stats.norm.sf(10 * 1.6449 / np.hypot(2, 3)))
    assert change.significant[0, 0]
    assert change.summary() == (1, 1)
    assert compared(layers(), layers())["speed"].p_value[0, 0] == 1.0


@pytest.mark.parametrize(("n", "m", "hours"), [(50, 90, (1.0, 1.0)), (40, 90, (1.0, 2.0)), (12, 15, (0.5, 0.5))])
def test_a_change_of_volume_is_a_binomial_test_of_equal_rates(n: int, m: int, hours: tuple[float, float]) -> None:
    change = compared(layers(count=n), layers(count=m), hours)["volume"]
    assert change.change[0, 0] == pytest.approx(m / hours[1] - n / hours[0])
    exact = stats.binomtest(m, n + m, hours[1] / sum(hours)).pvalue
    assert change.p_value[0, 0] == pytest.approx(exact, abs=0.04)
    assert np.isnan(compared(layers(count=0), layers(count=0))["volume"].change[0, 0])


def test_the_gate_of_a_known_gaussian_has_its_moments_and_its_highest_density_region() -> None:
    """A Gaussian of 2 bins: the region of 99 % is a disc of 3.03 standard deviations."""
    sigma = 2.0 * BINS.width_px_per_s
    mean = np.array([20.0, -12.0])

    def density(_: FloatArray, v: FloatArray) -> FloatArray:
        return np.asarray(np.exp(-0.5 * ((v - mean) ** 2).sum(axis=1) / sigma**2) / (2 * np.pi * sigma**2))

    gate = make_gate(density, np.zeros(2), np.zeros((2, 2)), BINS, 0.99)
    assert gate.mean_px_per_s == pytest.approx(mean, abs=0.05)
    assert gate.covariance == pytest.approx(np.eye(2) * sigma**2, rel=0.01, abs=0.5)
    assert gate.expected_log_density == pytest.approx(-1 - np.log(2 * np.pi * sigma**2), abs=0.01)
    radius = np.sqrt(stats.chi2.ppf(0.99, 2)) * sigma
    ring = mean + radius * np.array([[0.95, 0.0], [0.0, -0.95], [1.05, 0.0], [0.0, 1.05]])
    assert gate.accepts(ring).tolist() == [True, True, False, False]


def test_a_positions_covariance_mixes_the_distributions_around_it() -> None:
    """Sigma points at sqrt(3) standard deviations: densities to the left and right of x = 0 differ."""
    left, right = np.array([-30.0, 0.0]), np.array([30.0, 0.0])

    def density(xy: FloatArray, v: FloatArray) -> FloatArray:
        centre = left if xy[0] < 0 else right
        return np.asarray(np.exp(-0.5 * ((v - centre) ** 2).sum(axis=1) / 8.0**2))

    sharp = make_gate(density, np.array([0.2, 0.0]), np.zeros((2, 2)), BINS, 0.9)
    wide = make_gate(density, np.array([0.2, 0.0]), np.diag([9.0, 0.0]), BINS, 0.9)
    assert sharp.accepts(np.array([left, right])).tolist() == [False, True]
    assert wide.accepts(np.array([left, right])).tolist() == [True, True]
    assert wide.mean_px_per_s[0] == pytest.approx((1 / 3 + 3 / 6) * 30 - 30 / 6, abs=1.0)


def test_the_field_beats_a_map_and_a_gaussian_where_directions_are_two() -> None:
    """At one pixel two directions at right angles: a mixture, which a single Gaussian does not fit."""
    rng = np.random.default_rng(0)
    n = 60
    east, south = polar(rng.normal(12, 1, n), np.zeros(n)), polar(rng.normal(9, 1, n), np.full(n, 90.0))
    segments = drive(np.vstack([east, south]))
    segments["start_s"] = rng.permutation(2 * n)
    result = heldout_log_likelihood(segments, FieldConfig(), gsd_m=GSD_M, shape=(100, 160))
    assert result.tracks == n
    assert result.field > result.gaussian + 0.5
    assert result.field >= result.whole_map - 0.1


def test_tracks_belong_to_the_interval_of_their_midpoint() -> None:
    segments = np.zeros(6, SEGMENT_DTYPE)
    segments["track"] = [1, 1, 2, 2, 3, 3]
    segments["start_s"], segments["duration_s"] = [0, 8, 4, 30, 100, 101], 2.0
    intervals = parse_time_intervals("0-10,10-20", 0.0, 200.0)
    assert assign_intervals(segments, intervals).tolist() == [0, 0, 1, 1, 2, 2]
    assert assign_intervals(segments[:0], intervals).size == 0


def test_sums_beyond_32_bits_and_unequal_shapes_are_refused() -> None:
    half = np.full((1, 1), 2**30, np.int32)
    tile = FieldTile(half[..., None, None], half, half, half)
    with pytest.raises(InputError, match="exceeds 2147483647"):
        merge_tiles([tile, tile])
    other = FieldTile(np.zeros((1, 2, 1, 1), np.int32), *np.zeros((3, 1, 2), np.int32))
    with pytest.raises(InputError, match="share grid and bins"):
        merge_tiles([tile, other])


def test_tiles_are_read_once_while_they_are_cached() -> None:
    made = field(drive(polar(np.array([12.0]), np.array([0.0]))))
    read = []
    source = made._source
    made._source = lambda ty, tx: read.append((ty, tx)) or source(ty, tx)
    for x in (70, 75, 80):
        assert made.at(x, 50).n == 1
    assert read == [(0, 1)]
