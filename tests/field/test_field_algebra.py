"""Fields of run folders added, subtracted, compared: `velfield merge`, `subtract`, `compare`."""

import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import rasterio
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.errors import NotGeoreferencedWarning

from schemas.flight import FieldConfig
from tests.field_runs import field_run, flight, traffic_tracklets
from velfield.errors import InputError
from velfield.field.comparison import FDR_LEVEL, significant
from velfield.field.time_intervals import DAY_S, parse_time_intervals
from velfield.pipeline.compare import compare_runs
from velfield.run.field_algebra import merge_fields, subtract_fields
from velfield.run.field_reader import known_tiles
from velfield.run.run import open_run
from velfield.run.stores import FieldStore

COARSE = FieldConfig(bin_width_m_per_s=3.0)
"""Half of the usual bins, in less of the time; still coarser ones shift the percentiles that changes are found by."""


def everything(root: Path) -> dict[str, np.ndarray]:
    """The histogram and all layers."""
    store = FieldStore(root / "field.zarr")
    tiles = known_tiles(store.layer("count"), store.tile)
    histograms = {f"{name} {tile}": store.read_tile(*tile, name) for tile in tiles for name in store.histogram_names()}
    return histograms | {name: store.layer(name) for name in store.layer_names()}


def assert_equal(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> None:
    assert a.keys() == b.keys()
    for name, values in a.items():
        np.testing.assert_array_equal(values, b[name], err_msg=name)


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    return traffic_tracklets(3)


@pytest.fixture(scope="module")
def shape() -> tuple[int, int]:
    return flight(3).base_shape


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, table: pd.DataFrame, shape: tuple[int, int]) -> Path:
    return field_run(tmp_path_factory.mktemp("whole") / "run", table, shape=shape, config=COARSE).layout.root


def test_four_disjoint_sets_added_equal_the_field_of_all_to_the_bit(
    tmp_path: Path, table: pd.DataFrame, shape: tuple[int, int], whole: Path
) -> None:
    parts = []
    tracks = np.unique(table["track_id"])
    for k in range(4):
        mine = table[table["track_id"].isin(tracks[k::4])]
        parts.append(field_run(tmp_path / f"part{k}", mine, shape=shape, config=COARSE).layout.root)
    merge_fields(parts, tmp_path / "sum")
    found = everything(tmp_path / "sum")
    assert found["count"].max() >= 3
    assert_equal(found, everything(whole))
    subtract_fields(whole, parts[0], tmp_path / "left")
    merge_fields([tmp_path / "left", parts[0]], tmp_path / "again")
    assert_equal(everything(tmp_path / "again"), found)
    merged = open_run(tmp_path / "sum")
    y, x = np.unravel_index(int(merged.field.count().argmax()), merged.field.shape)
    assert merged.field.at(int(x), int(y)).n == merged.field.count().max()


def test_fields_on_different_grids_are_refused_in_one_line(
    tmp_path: Path, table: pd.DataFrame, shape: tuple[int, int], whole: Path
) -> None:
    smaller = field_run(tmp_path / "smaller", table, shape=(shape[0] - 8, shape[1]), config=COARSE).layout.root
    finer = field_run(tmp_path / "finer", table, shape=shape).layout.root
    for other, what in ((smaller, "size"), (finer, "bin_width")):
        for attempt in (
            lambda other=other: merge_fields([whole, other], tmp_path / "out"),
            lambda other=other: subtract_fields(whole, other, tmp_path / "out"),
            lambda other=other: compare_runs(whole, other, tmp_path / "out"),
        ):
            with pytest.raises(InputError, match=what) as caught:
                attempt()
            assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_something_is_not_written_over(whole: Path) -> None:
    with pytest.raises(InputError, match="give a new folder"):
        merge_fields([whole, whole], whole)


def slowed(table: pd.DataFrame, factor: float) -> pd.DataFrame:
    """The same tracks at a fraction of their speed."""
    out = table.copy()
    out[[name for name in out if name.startswith("v")]] *= factor
    return out


def test_comparison_finds_a_change_and_none_in_a_random_split(
    tmp_path: Path, table: pd.DataFrame, shape: tuple[int, int], whole: Path
) -> None:
    """Half of the tracks against the other half: no change. All at 40 % of their speed: a change of that size."""
    tracks = np.random.default_rng(0).permutation(np.unique(table["track_id"]))
    halves = [
        field_run(tmp_path / name, table[table["track_id"].isin(tracks[k::2])], shape=shape, config=COARSE).layout.root
        for k, name in enumerate(("even", "odd"))
    ]
    lines = compare_runs(*halves, tmp_path / "chance", min_count=2)
    assert sum("no significant change" in line for line in lines[:3]) >= 2, lines
    slow = field_run(tmp_path / "slow", slowed(table, 0.4), shape=shape, config=COARSE).layout.root
    assert "before_after.html" in lines[-1]
    lines = compare_runs(whole, slow, tmp_path / "change", min_count=2)
    assert "no significant" not in lines[1]
    assert "no significant" in lines[0]
    assert "no significant" in lines[2]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        dataset = rasterio.open(tmp_path / "change" / "change.tif")
    with dataset:
        assert dataset.descriptions[2] == "speed change"
        change, chance = dataset.read(3), dataset.read(4)
    before = open_run(whole).field.statistics().speed_percentiles_px_per_s[..., 1] * 0.23 * 3.6
    fast = (before > 30) & np.isfinite(change)
    assert np.nanmedian(change[fast] / before[fast]) == pytest.approx(-0.6, abs=0.05)
    assert (chance[np.isfinite(chance)] >= 0).all()
    merge_fields(halves, tmp_path / "sum")
    lines = compare_runs(tmp_path / "sum", slow, tmp_path / "fields")
    assert lines[-1].endswith(f"figures and change.tif in {tmp_path / 'fields'}")
    assert sorted(path.name for path in (tmp_path / "fields").iterdir()) == [
        "change.tif", "direction_change.png", "speed_change.png", "volume_change.png",
    ]  # fmt: skip
    assert sorted(path.name for path in (tmp_path / "change").glob("*.png")) == [
        "direction_change.png",
        "speed_change.png",
        "volume_change.png",
    ]


def test_few_of_many_tests_under_the_null_hypothesis_are_significant() -> None:
    rng = np.random.default_rng(5)
    assert significant(rng.uniform(size=100_000)).mean() < 1e-3
    mixed = np.concatenate([rng.uniform(size=90_000), rng.uniform(0, 1e-5, 10_000)])
    found = significant(mixed)
    assert found[90_000:].mean() > 0.99
    assert found[:90_000].sum() < 0.08 * found.sum()


@settings(max_examples=60)
@given(seed=st.integers(0, 10_000), n=st.integers(0, 300), scale=st.sampled_from([1.0, 0.1, 0.01]))
def test_significance_is_benjamini_and_hochbergs_step_up_rule(seed: int, n: int, scale: float) -> None:
    """All p-values up to the largest with p_(k) <= level * k / n; NaN never, and not counted in n."""
    rng = np.random.default_rng(seed)
    p_value = np.where(rng.uniform(size=n) < 0.5, rng.uniform(size=n), rng.uniform(0, scale, n))
    p_value[rng.uniform(size=n) < 0.1] = np.nan
    ranked = np.sort(p_value[np.isfinite(p_value)])
    below = np.flatnonzero(ranked <= FDR_LEVEL * np.arange(1, ranked.size + 1) / max(ranked.size, 1))
    limit = ranked[below[-1]] if below.size else -1.0
    assert significant(p_value).tolist() == (np.nan_to_num(p_value, nan=2.0) <= limit).tolist()


@pytest.mark.parametrize("text", ["4s", "2-5,7-9"])
def test_slices_of_time_add_up_to_the_whole(
    tmp_path: Path, table: pd.DataFrame, shape: tuple[int, int], whole: Path, text: str
) -> None:
    config = COARSE.model_copy(update={"time_intervals": text})
    run = field_run(tmp_path / "run", table, shape=shape, config=config)
    assert_equal(everything(run.layout.root), everything(whole))
    intervals = run.field_intervals
    assert list(intervals) == {"4s": ["0-4", "4-8", "8-12"], "2-5,7-9": ["2-5", "7-9", "rest"]}[text]
    assert sum(part.field.count() for part in intervals.values()).tolist() == run.field.count().tolist()
    assert min(int(part.field.count().sum()) for part in list(intervals.values())[:2]) > 0
    y, x = np.unravel_index(int(run.field.count().argmax()), shape)
    parts = [part.field.at(int(x), int(y)) for part in intervals.values()]
    mixed = sum(part.weights * part.n for part in parts) / sum(part.n for part in parts)
    np.testing.assert_allclose(mixed, run.field.at(int(x), int(y)).weights, atol=1e-12)
    data = xr.open_zarr(run.layout.intervals / "000.zarr", consolidated=False)
    assert data.attrs["time_interval"] == next(iter(intervals))
    assert data["velocity_histogram"].dims == ("y", "x", "vy", "vx")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("fortnight", "not understood"),
        ("5-2", "ends before"),
        ("0-10,5-20", "overlap"),
        ("0.01s", "at most"),
        ("0s", "no length"),
    ],
)
def test_invalid_slices_are_refused(text: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        parse_time_intervals(text, 0.0, 60.0)


def test_time_of_day_is_that_of_the_flights_day() -> None:
    morning, rest = parse_time_intervals("07:30-09:00", 3 * DAY_S + 20_000.0, 3 * DAY_S + 40_000.0)
    assert (morning.start_s, morning.stop_s) == (3 * DAY_S + 27_000.0, 3 * DAY_S + 32_400.0)
    assert rest.name == "rest"


def test_both_weights_are_kept_and_named(whole: Path) -> None:
    """By track every vehicle has the same weight; by time slow ones have more, so that speeds are lower."""
    run = open_run(whole)
    by_track, time_weighted = run.field, run.field_time_weighted
    passing, watched = by_track.statistics(), time_weighted.statistics()
    speed = np.hypot(*np.moveaxis(passing.mean_velocity_px_per_s, -1, 0))
    in_time = np.hypot(*np.moveaxis(watched.mean_velocity_px_per_s, -1, 0))
    busy = passing.n >= 3
    assert busy.sum() > 50
    assert np.mean(in_time[busy] <= speed[busy] + 0.5) > 0.95
    data = xr.open_zarr(run.layout.field, consolidated=False)
    assert data["velocity_histogram"].attrs["weighted_by"] == "track"
    assert data["velocity_histogram_time_weighted"].attrs["weighted_by"] == "time"
    y, x = np.unravel_index(int(by_track.count().argmax()), by_track.shape)
    seconds = int(data["velocity_histogram_time_weighted"][y, x].sum()) / data.attrs["weight_unit"]
    assert seconds == pytest.approx(int(data["occupancy_ms"][y, x]) / 1000, rel=0.02)
