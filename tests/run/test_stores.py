"""The stores: what is written is read, and damage is an error."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr

from velfield.errors import InputError, StoreError
from velfield.run.shards import decode_tile, encode_tile
from velfield.run.stores import (
    HISTOGRAM,
    FieldStore,
    FrameStore,
    RegistrationStore,
    create_field,
    create_frames,
    create_registration,
    is_cut_as,
    store_key,
)


def frame_store(path: Path, frames: np.ndarray) -> FrameStore:
    count, height, width = frames.shape
    create_frames(path, key="k", count=count, height=height, width=width, unit_frames=2, source={})
    store = FrameStore(path, "r+")
    for k, frame in enumerate(frames):
        store.write(k, frame)
    return store


def noise(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def test_frames_come_back(tmp_path: Path) -> None:
    frames = noise(1, 5, 24, 32)
    store = frame_store(tmp_path / "f.zarr", frames)
    store.write_columns(2, {"time_s": np.array([1.5, 1.75]), "decoding_flags": np.array([4, 1], np.uint16)})
    store = FrameStore(tmp_path / "f.zarr")
    assert store.count == 5
    assert store.shape == (24, 32)
    assert all(np.array_equal(store.read(k), frames[k]) for k in range(5))
    np.testing.assert_array_equal(store.column("time_s"), [np.nan, np.nan, 1.5, 1.75, np.nan])
    np.testing.assert_array_equal(store.column("decoding_flags"), [2, 2, 4, 1, 2])
    np.testing.assert_array_equal(store.column("flags"), [2] * 5)  # unreadable until written


def test_flags_are_one_chunk_even_where_all_are_the_fill_value(tmp_path: Path) -> None:
    store = frame_store(tmp_path / "f.zarr", noise(1, 5, 24, 32))
    for flags in (np.full(5, 2), np.array([0, 16, 0, 0, 32])):
        assert store.write_flags(flags).exists()
        np.testing.assert_array_equal(FrameStore(tmp_path / "f.zarr").column("flags"), flags)


@pytest.mark.parametrize("bit", range(0, 4000, 97))
def test_a_flipped_bit_is_never_read_as_an_image(tmp_path: Path, bit: int) -> None:
    frames = noise(2, 1, 24, 32)
    store = frame_store(tmp_path / "f.zarr", frames)
    chunk = store.path / "raw" / "c" / "0" / "0" / "0"
    data = bytearray(chunk.read_bytes())
    data[(bit // 8) % len(data)] ^= 1 << (bit % 8)
    chunk.write_bytes(data)
    with pytest.raises(StoreError, match="frame 0 is damaged"):
        store.read(0)


def test_a_chunk_that_is_gone_is_not_read_as_black(tmp_path: Path) -> None:
    store = frame_store(tmp_path / "f.zarr", noise(3, 2, 24, 32))
    (store.path / "raw" / "c" / "1" / "0" / "0").unlink()
    with pytest.raises(StoreError, match="frame 1 is missing"):
        store.read(1)


def test_a_store_that_is_not_there_says_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="run `velfield run`"):
        FrameStore(tmp_path / "none.zarr")
    assert store_key(tmp_path / "none.zarr") is None


def test_registration_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "r.zarr"
    create_registration(path, key="k", count=5, vector_length=3, unit_frames=2)
    statuses = ["ok", "failed:12 control points, 40 needed"]
    columns = {"heldout_px": np.array([0.25, np.nan], np.float32), "n_inliers": np.array([900, 12], np.int32)}
    RegistrationStore(path, "r+").write(2, np.arange(6.0).reshape(2, 3), statuses, columns)
    store = RegistrationStore(path)
    assert store.statuses() == ["", "", *statuses, ""]
    np.testing.assert_array_equal(store.column("vector")[3], [3, 4, 5])
    assert np.isnan(store.column("vector")[0]).all()
    np.testing.assert_array_equal(store.column("n_inliers"), [0, 0, 900, 12, 0])


def test_the_field_opens_with_xarray_labelled(tmp_path: Path) -> None:
    path = tmp_path / "field.zarr"
    centres = np.array([-10.0, 0, 10])
    create_field(
        path,
        key="k",
        height=20,
        width=30,
        tile=8,
        group_tiles=2,
        velocities_px_per_s=centres,
        attributes={"gsd_m": 0.5, "crs_wkt": "LOCAL_CS[]"},
        histograms={HISTOGRAM: {}},
        layers={"count": ("int32", {"units": "1"}), "modal_vx": ("float32", {"units": "px s-1"})},
    )
    tile = np.arange(4 * 6 * 9, dtype=np.int32).reshape(4, 6, 3, 3)
    store = FieldStore(path, "r+")
    store.write_tile(2, 3, tile, np.ones((4, 6), np.int32))
    np.testing.assert_array_equal(store.read_tile(2, 3), tile)
    assert store.has_tile(2, 3)
    assert not store.has_tile(0, 0)
    with xr.open_zarr(path, consolidated=False) as field:
        assert field[HISTOGRAM].dims == ("y", "x", "vy", "vx")
        assert field[HISTOGRAM].attrs["grid_mapping"] == "crs"
        np.testing.assert_array_equal(field["vx"], centres)
        assert field["vx"].attrs["units"] == "px s-1"
        np.testing.assert_array_equal(field["vx_m_per_s"], centres / 2)
        assert field[HISTOGRAM].sel(y=17, x=25, vy=0, vx=10) == tile[1, 1, 1, 2]
        assert int(field["count"].sum()) == 0


@pytest.mark.parametrize("group", [(0, 0), (1, 1)], ids=["whole", "at the map's edge"])
def test_layers_are_read_by_zarr_as_written(tmp_path: Path, group: tuple[int, int]) -> None:
    path = tmp_path / "field.zarr"
    layers = {"count": ("int32", {"units": "1"}), "modal_vx": ("float32", {"units": "px s-1"})}
    create_empty_field(path, side=20, tile=8, bins=3, layers=layers)
    store, (y, x) = FieldStore(path, "r+"), (16 * group[0], 16 * group[1])
    window = np.s_[y : y + 16, x : x + 16]
    for name, fill in (("count", 0), ("modal_vx", np.nan)):
        written = zarr.open_array(path / name, mode="r")
        values = np.full(written[window].shape, fill, written.dtype)
        file = path / name / "c" / str(group[0]) / str(group[1])
        store.write_layer(name, group, values)
        assert not file.exists()  # nothing to keep
        values[1, 2:] = -7
        store.write_layer(name, group, values)
        expected = np.full(written.shape, fill, written.dtype)
        expected[window] = values
        np.testing.assert_array_equal(written[:], expected)
        store.write_layer(name, group, np.full_like(values, fill))
        assert not file.exists()


def create_empty_field(
    path: Path, *, side: int, tile: int, bins: int, layers: dict[str, tuple[str, dict[str, str]]] | None = None
) -> None:
    """A field of a square map, by default without layers."""
    create_field(
        path,
        key="k",
        height=side,
        width=side,
        tile=tile,
        group_tiles=min(side // tile, 8),
        velocities_px_per_s=np.arange(float(bins)),
        attributes={},
        histograms={HISTOGRAM: {}},
        layers=layers or {},
    )


def test_a_flipped_bit_of_a_tile_changes_no_value_in_silence(tmp_path: Path) -> None:
    count = np.zeros((16, 16), np.int32)
    count[2:5, 9:] = 1
    tile = np.where(count[..., None, None] > 0, noise(4, 16, 16, 5, 5), 0).astype(np.int32)
    shard = encode_tile(tile, count, 16)
    np.testing.assert_array_equal(decode_tile(shard, tile.shape, 16), tile)
    path = tmp_path / "field.zarr"
    create_empty_field(path, side=16, tile=16, bins=5)
    store = FieldStore(path, "r+")
    store.write_tile(0, 0, tile, count)
    np.testing.assert_array_equal(zarr.open_array(path / HISTOGRAM, mode="r")[:], tile)  # by zarr's own codec
    file = path / HISTOGRAM / "c" / "0" / "0" / "0" / "0"
    refused = 0
    for at in range(len(shard)):
        file.write_bytes(shard[:at] + bytes([shard[at] ^ 1 << at % 8]) + shard[at + 1 :])
        try:
            read = store.read_tile(0, 0)
        except StoreError:
            refused += 1
        else:
            np.testing.assert_array_equal(read, tile)  # a bit that Zstandard does not use
    assert refused > 0.99 * len(shard)


def test_untouched_tiles_take_no_space(tmp_path: Path) -> None:
    path = tmp_path / "field.zarr"
    create_empty_field(path, side=2048, tile=64, bins=37)
    assert sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) < 100_000


def test_a_column_that_never_was_is_not_called_damaged(tmp_path: Path) -> None:
    frames = frame_store(tmp_path / "f.zarr", noise(1, 2, 24, 32))
    with pytest.raises(InputError, match="found no column 'bogus'; it has time_s, source_index"):
        frames.column("bogus")
    create_registration(tmp_path / "r.zarr", key="k", count=2, vector_length=3, unit_frames=2)
    with pytest.raises(InputError, match=r"found no column 'bogus'; it has .*heldout_px"):
        RegistrationStore(tmp_path / "r.zarr").column("bogus")


def test_a_store_of_units_of_another_length_is_not_taken_for_one_of_ours(tmp_path: Path) -> None:
    frame_store(tmp_path / "f.zarr", noise(1, 5, 24, 32))
    create_registration(tmp_path / "r.zarr", key="k", count=5, vector_length=3, unit_frames=2)
    for path in (tmp_path / "f.zarr", tmp_path / "r.zarr"):
        assert is_cut_as(path, "k", 2)
        assert not is_cut_as(path, "other", 2)
        assert not is_cut_as(path, "k", 3)
    frame_store(tmp_path / "g.zarr", noise(1, 1, 24, 32))
    assert is_cut_as(tmp_path / "g.zarr", "k", 32)  # one unit that is not full
    assert not is_cut_as(tmp_path / "none.zarr", "k", 2)
