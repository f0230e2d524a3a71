"""Statistics of a pixel, the whole map, and the prior."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from velfield.errors import InputError
from velfield.field.accumulate import FieldTile
from velfield.field.segments import SEGMENT_DTYPE, Segments, VelocityBins
from velfield.field.view import VelocityField

GSD_M = 0.25
BINS = VelocityBins(width_px_per_s=2 / GSD_M, reach=18, kernel_sigma_px_per_s=0.7 / GSD_M, gsd_m=GSD_M)


def drive(velocities: np.ndarray, y0: float = 50.0) -> Segments:
    """One track a velocity (px/s) through (80, y0), half a second long, of one segment."""
    out = np.zeros(len(velocities), SEGMENT_DTYPE)
    out["track"], out["duration_s"] = np.arange(len(velocities)), 0.5
    out["vx_px_per_s"], out["vy_px_per_s"] = velocities[:, 0], velocities[:, 1]
    for axis, centre in (("x", 80.0), ("y", y0)):
        out[f"{axis}0_px"] = centre - out[f"v{axis}_px_per_s"] * 0.25
        out[f"{axis}1_px"] = centre + out[f"v{axis}_px_per_s"] * 0.25
    return out


def field(segments: Segments, shape: tuple[int, int] = (100, 160), bins: VelocityBins = BINS) -> VelocityField:
    return VelocityField.from_segments(
        segments, shape=shape, tile_size=64, bins=bins, radius_px=3.5, stationary_speed_px_per_s=1.15 / GSD_M
    )


def polar(speed_m_per_s: np.ndarray, direction_deg: np.ndarray) -> np.ndarray:
    angle = np.radians(direction_deg)
    return np.column_stack([np.cos(angle), np.sin(angle)]) * np.asarray(speed_m_per_s)[..., None] / GSD_M


def test_modes_have_sub_bin_accuracy() -> None:
    """At any speed and direction: bins of 2 m/s alone would be 1 m/s and 5 degrees off."""
    rng = np.random.default_rng(0)
    for speed, direction in zip(rng.uniform(3, 30, 40), rng.uniform(-180, 180, 40), strict=True):
        velocity = polar(np.array([speed]), np.array([direction]))
        mode = field(drive(velocity)).at(80, 50).modal_velocity_px_per_s
        assert np.hypot(*(mode - velocity[0])) * GSD_M < 0.12


def test_mode_of_many_is_their_most_frequent_velocity() -> None:
    rng = np.random.default_rng(1)
    velocities = polar(rng.normal(13, 1.5, 60), rng.normal(-30, 4, 60))
    found = field(drive(velocities)).at(80, 50)
    assert found.n == 60
    assert np.degrees(np.arctan2(*found.modal_velocity_px_per_s[::-1])) == pytest.approx(-30, abs=3)
    assert np.hypot(*found.modal_velocity_px_per_s) * GSD_M == pytest.approx(13, abs=1)
    assert found.direction_se_rad == pytest.approx(np.radians(4) / np.sqrt(60), rel=0.5)


def test_percentiles_are_those_of_the_speeds() -> None:
    speeds = np.random.default_rng(2).normal(12, 2.5, 400)
    found = field(drive(polar(speeds, np.full(400, 75.0)))).at(80, 50)
    for percent, value in found.percentiles_px_per_s.items():
        assert value * GSD_M == pytest.approx(np.percentile(speeds, percent), abs=0.35)
    median_se = 1.2533 * 2.5 / np.sqrt(400)
    assert found.speed_se_px_per_s * GSD_M == pytest.approx(median_se, rel=0.35)


def test_speeds_in_km_per_h_need_the_scale() -> None:
    """The ground sample distance times 3.6, and one clear error at each of them where it is not known."""
    segments = drive(polar(np.array([9.0, 10.0, 11.0]), np.full(3, 40.0)))
    known = field(segments)
    found = known.at(80, 50)
    assert found.modal_speed_km_per_h == pytest.approx(36, abs=2)
    assert found.percentiles_km_per_h[50] == pytest.approx(36, abs=1.5)
    low, high = found.median_speed_interval_km_per_h
    assert low < found.percentiles_km_per_h[50] < high
    assert np.arctan2(*found.modal_velocity_km_per_h[::-1]) == pytest.approx(np.radians(40), abs=0.05)
    assert known.modal_speed_km_per_h()[50, 80] == pytest.approx(found.modal_speed_km_per_h, rel=1e-5)
    unknown = field(segments, bins=replace(BINS, gsd_m=None))
    names = ("modal_speed", "modal_velocity", "percentiles", "median_speed_interval")
    asked = [partial(getattr, unknown.at(80, 50), f"{name}_km_per_h") for name in names]
    for ask in (*asked, unknown.modal_speed_km_per_h):
        with pytest.raises(InputError, match=r"no scale.*--gsd-m.*px/s"):
            ask()


def test_two_directions_are_two_modes_with_their_weights() -> None:
    velocities = np.vstack([polar(np.full(30, 12.0), np.full(30, 0.0)), polar(np.full(10, 9.0), np.full(10, 90.0))])
    modes = field(drive(velocities)).at(80, 50).modes
    assert len(modes) == 2
    np.testing.assert_allclose(modes[:, 2], [0.75, 0.25], atol=0.01)
    np.testing.assert_allclose(modes[:, :2] * GSD_M, [[12, 0], [0, 9]], atol=0.15)


def test_circular_variance_and_entropy() -> None:
    one_direction = field(drive(polar(np.full(8, 12.0), np.zeros(8)))).at(80, 50)
    all_directions = field(drive(polar(np.full(8, 12.0), np.arange(8) * 45.0))).at(80, 50)
    assert one_direction.circular_variance < 0.01
    assert all_directions.circular_variance > 0.99
    assert all_directions.entropy_nats > one_direction.entropy_nats + 1.5
    assert np.isnan(field(drive(np.zeros((3, 2)))).at(80, 50).circular_variance)


def test_maps_are_empty_without_tracks_and_stationary_pixels_have_no_direction() -> None:
    segments = drive(np.array([[48.0, 0.0], [0.0, 0.0]]))
    segments["x0_px"][1] = segments["x1_px"][1] = 20.0
    map_ = field(segments)
    direction, speed, count = map_.modal_direction_rad(), map_.modal_speed_px_per_s(), map_.count()
    assert count.sum() > 100
    assert np.isnan(speed[count == 0]).all()
    assert np.isfinite(speed[count > 0]).all()
    assert np.isnan(direction[50, 20])
    assert speed[50, 20] < 1
    assert direction[50, 80] == pytest.approx(0, abs=0.01)
    np.testing.assert_array_equal(
        map_.at(80, 50).modal_velocity_px_per_s.astype(np.float32), map_.modal_velocity()[50, 80]
    )


def test_whole_map_statistics_are_those_of_its_pixels() -> None:
    map_ = field(drive(polar(np.array([8.0, 9.0, 12.0]), np.array([10.0, 20.0, 15.0]))))
    whole, one = map_.statistics(), map_.at(85, 52)
    np.testing.assert_array_equal(whole.n, map_.count())
    np.testing.assert_allclose(
        whole.speed_percentiles_px_per_s[52, 85], list(one.percentiles_px_per_s.values()), rtol=1e-6
    )
    assert whole.entropy_nats[52, 85] == pytest.approx(one.entropy_nats)


def test_a_pixel_that_is_not_on_the_map_is_refused() -> None:
    with pytest.raises(InputError, match="not on the map"):
        field(drive(np.array([[48.0, 0.0]]))).at(160, 0)


@pytest.mark.parametrize(("x", "y"), [(np.array([3, 4]), np.array([3, 4])), (float("nan"), 3), (3, float("inf"))])
def test_what_is_not_one_pixel_is_refused(x: float, y: float) -> None:
    with pytest.raises(InputError, match=r"one finite pixel.*found.*log_density"):
        field(drive(np.array([[48.0, 0.0]]))).at(x, y)


def test_one_position_with_many_velocities_says_what_to_do() -> None:
    with pytest.raises(InputError, match=r"\(1, 2\) and \(3, 2\); repeat a position"):
        field(drive(np.array([[48.0, 0.0]]))).log_density(np.zeros((1, 2)), np.zeros((3, 2)))


def test_a_density_reads_the_tiles_about_its_places_once() -> None:
    """A place inside a tile needs that tile alone; places all over the map need each tile once a row of tiles."""
    size, rows, columns, read = 16, 6, 9, []
    bins = replace(BINS, reach=2)

    def tile(ty: int, tx: int) -> FieldTile:
        read.append((ty, tx))
        histogram = np.random.default_rng([ty, tx]).integers(0, 9, (size, size, bins.n, bins.n), np.int32)
        nothing = np.zeros((size, size), np.int32)
        return FieldTile(histogram, np.full((size, size), 3, np.int32), nothing, nothing)

    every = [(ty, tx) for ty in range(rows) for tx in range(columns)]
    map_ = VelocityField(
        tile, tiles=every, shape=(rows * size, columns * size), tile_size=size, bins=bins, stationary_speed_px_per_s=1.0
    )
    places = np.array([[x, y] for y in range(0, rows * size, 5) for x in range(0, columns * size, 5)], float)
    v = np.broadcast_to([9.0, 2.0], places.shape)
    single = np.concatenate([map_.log_density(place, v[:1]) for place in places])
    read.clear()
    map_.log_density(np.array([[1.5 * size, 1.5 * size]]), v[:1])
    assert read == [(1, 1)]
    read.clear()
    np.testing.assert_array_equal(map_.log_density(places, v), single)
    assert len(read) <= 3 * len(every)  # those above and below a row of tiles with it; every window anew: 9


def test_queries_on_an_empty_map() -> None:
    empty = field(drive(np.array([[48.0, 0.0]]))[:0])
    assert np.isnan(empty.modal_velocity()).all()
    assert empty.at(3, 3).n == 0
    assert np.isfinite(empty.log_density(np.array([[5.0, 5.0]]), np.array([[1.0, 1.0]]))).all()


@pytest.mark.parametrize(
    "place", [(80.0, 50.0), (80.0, 20.0), (-900.0, 0.0)], ids=["known", "near none", "off the map"]
)
def test_density_integrates_to_one(place: tuple[float, float]) -> None:
    map_ = field(drive(polar(np.array([8.0, 12.0]), np.array([10.0, 15.0]))))
    axis = np.arange(-110.0, 110.5, 1.0) / GSD_M  # the peak at zero velocity is half a m/s wide
    v = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    density = np.exp(map_.log_density(np.tile(place, (len(v), 1)), v))
    assert density.sum() / GSD_M**2 == pytest.approx(1, abs=0.01)


def test_density_is_highest_for_velocities_of_the_pixel_and_never_zero() -> None:
    north = drive(polar(np.full(20, 12.0), np.full(20, -90.0)), y0=30.0)
    map_ = field(np.concatenate([drive(polar(np.full(20, 12.0), np.zeros(20)), y0=70.0), north]))
    xy = np.array([[80.0, 70.0]] * 4)
    v = np.array([[48.0, 0.0], [0.0, -48.0], [-48.0, 0.0], [900.0, 0.0]])
    here, elsewhere, nowhere, absurd = map_.log_density(xy, v)
    assert here > elsewhere > nowhere > absurd
    assert np.isfinite(absurd)
    assert np.isnan(map_.log_density(xy[:1], np.array([[np.nan, 0.0]]))).all()
