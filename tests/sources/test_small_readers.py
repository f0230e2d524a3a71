"""Paths, tables, times, frames chosen, boxes: the small readers of the sources, each with its refusals."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from pydantic import ValidationError

from schemas.flight import FramesConfig
from velfield.errors import InputError
from velfield.sources.frames import local_path
from velfield.sources.images import image_size
from velfield.sources.labels.classes import choose_cars
from velfield.sources.labels.shapes import CAR_ASPECT, car_in_upright_box, car_shape, tilt_of_upright_box
from velfield.sources.quality import (
    BLACK_LEVEL,
    FLAT_SD,
    find_cuts,
    flag_blurred,
    flag_outlier_frames,
    is_black,
    is_duplicate,
)
from velfield.sources.selection import select_frames
from velfield.sources.table import finite_cell, read_csv_rows, read_text
from velfield.sources.timestamps import check_against_container


def rows_of(path: Path, text: str, optional: tuple[str, ...] | None = None) -> list[tuple[int, dict[str, str]]]:
    path.write_text(text)
    return list(read_csv_rows(path, required=("frame", "x_px"), optional=optional, what="labels"))


def test_a_table_is_read_with_its_line_numbers_and_without_empty_lines(tmp_path: Path) -> None:
    found = rows_of(tmp_path / "t.csv", "\ufeffframe, x_px ,more\na.png, 1,2\n\n , ,\nb.png,3,4\n")
    assert found == [
        (2, {"frame": "a.png", "x_px": "1", "more": "2"}),
        (5, {"frame": "b.png", "x_px": "3", "more": "4"}),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,x_px\na.png,1\nb.png\n", r"line 3: found 1 cells, expected 2 \(frame,x_px\); fix line 3"),
        ("frame,y_px\n", r"found the columns 'frame,y_px', expected labels as CSV `frame,x_px.*`; fix line 1"),
        ("frame,x_px,x_px\n", "found the columns"),
        ("frame,x_px,colour\n", "found the columns"),
        ("", "found the columns ''"),
    ],
)
def test_a_table_of_another_form_is_refused_by_its_line(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        rows_of(tmp_path / "t.csv", text, optional=("score",))


def test_a_cell_is_a_finite_number_or_nothing(tmp_path: Path) -> None:
    row = {"x_px": "1.5", "y_px": "", "score": "inf", "length_px": "long"}
    assert finite_cell(tmp_path, 7, row, "x_px") == 1.5
    assert math.isnan(finite_cell(tmp_path, 7, row, "y_px"))
    assert math.isnan(finite_cell(tmp_path, 7, row, "width_px"))
    for name in ("score", "length_px"):
        with pytest.raises(InputError, match=rf"line 7: found {name} '\w+', expected a finite number; fix line 7"):
            finite_cell(tmp_path, 7, row, name)


def test_what_is_no_text_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "t.csv").write_bytes(b"frame\xff\n")
    with pytest.raises(InputError, match="found a file that is not UTF-8 text, expected labels"):
        read_text(tmp_path / "t.csv", "labels")
    with pytest.raises(InputError, match=r"could not be read \(Is a directory\)"):
        read_text(tmp_path, "labels")
    monkeypatch.setattr("velfield.sources.table.MAX_TABLE_BYTES", 3)
    with pytest.raises(InputError, match="found 7 bytes, expected labels of at most 3"):
        read_text(tmp_path / "t.csv", "labels")


@pytest.mark.parametrize("path", ["http://example.org/a.mp4", "s3://b/a", "concat:a|b", "file:/a"])
def test_an_address_is_refused_and_a_file_of_such_a_name_is_not(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="is not supported, expected a local path; download it first"):
        local_path(path, "video")
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).touch()
    assert local_path(path, "video").is_absolute()


def test_a_path_with_nul_is_refused() -> None:
    with pytest.raises(InputError, match="with a NUL in it"):
        local_path("a\0b", "video")


@given(st.lists(st.floats(0.01, 1.0), min_size=2, max_size=60), st.floats(0.05, 2.0))
def test_frames_nearest_to_an_interval_ascend_and_none_would_be_nearer(steps: list[float], interval_s: float) -> None:
    times_s = np.cumsum([0.0, *steps])
    chosen = select_frames(times_s, FramesConfig(every="auto", target_interval_s=interval_s))
    assert chosen[0] == 0
    assert (np.diff(chosen) > 0).all()
    for before, after in itertools.pairwise(chosen):
        error = np.abs(times_s[before + 1 :] - times_s[before] - interval_s)
        assert abs(times_s[after] - times_s[before] - interval_s) <= error.min() + 1e-12  # sums are rounded


def test_of_frames_of_one_time_the_first_is_chosen_and_no_time_at_all_is_refused() -> None:
    assert select_frames(np.array([0, 0, 1, 1, 1, 2.0]), FramesConfig(every=1)).tolist() == [0, 2, 5]
    with pytest.raises(InputError, match=r"found no frame from 3 s on: the source lasts 2\.000 s"):
        select_frames(np.arange(3.0), FramesConfig(every=1, start_s=3.0))
    with pytest.raises(ValidationError, match=r"stop_s = 1 \(--stop-s\) must be later than start_s = 1"):
        FramesConfig(every=1, start_s=1.0, stop_s=1.0)
    with pytest.raises(InputError, match="the source has no frames"):
        select_frames(np.zeros(0), FramesConfig())


def test_times_may_be_offset_from_the_containers_but_not_stretched() -> None:
    container_s = np.arange(50) / 25
    check_against_container(container_s + 7.3, container_s, Path("t.csv"))
    check_against_container(container_s[:1] * 9, container_s[:1], Path("t.csv"))
    with pytest.raises(InputError, match=r"t\.csv: found frame 49 2\.058 s after the first, expected 1\.960 s"):
        check_against_container(container_s * 1.05, container_s, Path("t.csv"))


@given(st.floats(0, math.pi / 2), st.floats(5, 60))
def test_the_box_of_a_rotated_car_gives_back_its_length_and_angle(angle: float, length: float) -> None:
    c, s = math.cos(angle), math.sin(angle)
    box = length * (c + CAR_ASPECT * s), length * (s + CAR_ASPECT * c)
    assert tilt_of_upright_box(*box) == pytest.approx(angle, abs=1e-6)
    shape = car_in_upright_box(*box)
    assert shape.length_px == pytest.approx(length, rel=1e-5)
    assert shape.width_px == pytest.approx(CAR_ASPECT * length, rel=1e-5)
    assert math.isnan(shape.orientation_rad) != math.isnan(shape.abs_box_angle_rad)


@given(st.floats(0, math.pi - 0.01), st.floats(10, 50), st.floats(3, 9))
def test_corners_give_back_the_rectangle(angle: float, length: float, width: float) -> None:
    along = np.array([math.cos(angle), math.sin(angle)])
    across = np.array([-along[1], along[0]])
    ends = [(1, 1), (1, -1), (-1, -1), (-1, 1)]
    corners = [(30.0, 40.0) + length / 2 * a * along + width / 2 * b * across for a, b in ends]
    x, y, shape = car_shape([(float(cx), float(cy)) for cx, cy in corners])
    assert (x, y) == pytest.approx((30, 40), abs=1e-3)
    assert (shape.length_px, shape.width_px) == pytest.approx((length, width), rel=1e-3)
    assert abs(math.sin(shape.orientation_rad - angle)) < 1e-3


def test_a_point_and_a_line_have_no_shape() -> None:
    assert car_shape([(3, 4)])[:2] == (3, 4)
    assert all(math.isnan(value) for value in car_shape([(3, 4)])[2])
    assert all(math.isnan(value) for value in car_shape([(0, 0), (5, 0), (9, 0)])[2])


def test_cars_are_known_by_their_names_and_lorries_are_none() -> None:
    names = ["truck", "Passenger Car", "large-vehicle", "van", "", "caravan", "motorcycle", "small-vehicle"]
    assert choose_cars([0, 1, 2, 3, 5, 6, 7], dict(enumerate(names)), "classes.txt")[0] == {1, 3, 7}
    with pytest.raises(InputError, match="found the classes bus, tram, expected one of cars"):
        choose_cars([0, 1], {0: "bus", 1: "tram"}, "classes.txt")


def test_black_frames_are_those_of_numpy_s_percentile_and_deviation() -> None:
    rng, answers = np.random.default_rng(5), []
    for _ in range(300):
        grey = rng.normal(rng.uniform(0, 25), rng.uniform(0.3, 6), rng.integers(1, 60, 2)).clip(0, 255).astype(np.uint8)
        sample = grey[::4, ::4]
        expected = bool(np.percentile(sample, 99) < BLACK_LEVEL or sample.std() < FLAT_SD)
        assert is_black(grey) == expected
        answers.append(expected)
    assert 60 < sum(answers) < 240  # both answers are met


@pytest.mark.parametrize(("row", "column"), [(0, 0), (63, 5), (64, 7), (129, 9)])
def test_one_pixel_of_any_row_tells_two_frames_apart(row: int, column: int) -> None:
    grey = np.full((130, 10), 90, np.uint8)
    other = grey.copy()
    other[row, column] += 1
    assert is_duplicate(grey, other)
    other[row, column] += 1
    assert not is_duplicate(grey, other)
    assert not is_duplicate(grey, grey[:-1])


def test_blur_is_relative_to_the_neighbours_and_needs_three_frames() -> None:
    assert not flag_blurred(np.array([10.0, 1.0])).any()
    sharpness = np.linspace(40, 10, 60)  # it fades, none of them is blurred beside its neighbours
    assert not flag_blurred(sharpness).any()
    sharpness[[20, 45]] *= 0.4
    sharpness[30] = np.nan
    assert np.flatnonzero(flag_blurred(sharpness)).tolist() == [20, 45]


def test_a_cut_to_another_scene_is_no_outlier() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 16, 16)).astype(np.float32)
    assert flag_outlier_frames(np.stack([first, first, second, first, first])).tolist() == [
        False,
        False,
        True,
        False,
        False,
    ]
    assert not flag_outlier_frames(np.stack([first, first, second, second])).any()
    assert not flag_outlier_frames(np.stack([first, second])).any()


def test_places_that_share_only_their_layout_are_two_places() -> None:
    """A lens's vignetting and a town in the middle of the picture make thumbnails of any two places alike."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 16)])
    here, there = (4.0 * np.exp(-(x**2) - y**2) + rng.normal(size=(2, 16, 16))).astype(np.float32)
    assert np.corrcoef(here.ravel(), there.ravel())[0, 1] > 0.5
    assert find_cuts(np.stack([here] * 6 + [there] * 6)) == [6]
    assert np.flatnonzero(flag_outlier_frames(np.stack([here] * 4 + [there] + [here] * 4))).tolist() == [4]


def test_a_header_that_is_damaged_or_declares_too_much_is_refused_before_any_pixel(tmp_path: Path) -> None:
    (tmp_path / "a.bmp").write_bytes(b"BM" + bytes(8))
    with pytest.raises(InputError, match="the image's header is damaged"):
        image_size(tmp_path / "a.bmp", max_pixels=1000)
    Image.new("L", (40, 30)).save(tmp_path / "b.png")
    with pytest.raises(InputError, match="found 40x30 = 1200 px, expected at most 1000"):
        image_size(tmp_path / "b.png", max_pixels=1000)
    with pytest.raises(InputError, match="could not be read"):
        image_size(tmp_path, max_pixels=1000)
