"""Lineage: the tracks behind a pixel are exactly those that the field counts there."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from flows.commands.lineage import lineage
from velfield import open_run
from velfield.errors import InputError
from velfield.pipeline.stage import STAGE
from velfield.run.commits import digest_file
from velfield.run.lineage import pixel_lineage, stage_lineage


@pytest.fixture
def pixel(whole: Path) -> tuple[int, int]:
    """The busiest pixel, (x, y)."""
    count = open_run(whole).field.count()
    y, x = np.unravel_index(count.argmax(), count.shape)
    return int(x), int(y)


def test_as_many_vehicles_as_the_field_counts(whole: Path) -> None:
    run = open_run(whole)
    count = run.field.count()
    rng = np.random.default_rng(0)
    ys, xs = np.nonzero(count)
    known = rng.integers(0, len(ys), 12)
    places = [
        *zip(xs[known], ys[known], strict=True),
        *zip(rng.integers(0, 640, 6), rng.integers(0, 480, 6), strict=True),
    ]
    found = [len(pixel_lineage(run, int(x), int(y)).tracks) for x, y in places]
    assert found == [int(count[y, x]) for x, y in places]


def test_the_frames_are_those_of_the_tracklets_with_their_true_times(whole: Path, pixel: tuple[int, int]) -> None:
    run = open_run(whole)
    found = pixel_lineage(run, *pixel)
    tracklets = run.tracklets().set_index("tracklet_id")
    ids = [tracklet for track in found.tracks for tracklet in track.tracklets]
    frames = np.unique(tracklets.loc[ids, ["frame_0", "frame_1", "frame_2"]].to_numpy())
    assert [frame.frame for frame in found.frames] == frames.tolist()
    assert [frame.time_s for frame in found.frames] == run.times_s[frames].tolist()
    assert all(0 < frame.heldout_px < 2 for frame in found.frames)


def test_the_chain_of_stages(whole: Path) -> None:
    run = open_run(whole)
    stages = stage_lineage(run)
    assert [stage.name for stage in stages] == list(STAGE)
    assert {stage.name: stage.key for stage in stages} == run.record.keys


def test_the_command_prints_it(whole: Path, pixel: tuple[int, int], capsys: pytest.CaptureFixture[str]) -> None:
    x, y = pixel
    assert lineage(whole) == lineage(whole, str(x), y) == lineage(whole, f"{x},{y}") == 0
    printed = capsys.readouterr().out
    assert digest_file(whole / "detector.json") in printed
    assert digest_file(whole / "base/base_image.png") in printed
    assert "labelled cars" in printed
    lineage(whole, pixel=f"{x},{y}", as_json=True)
    assert json.loads(capsys.readouterr().out)["x"] == x


@pytest.mark.parametrize("wrong", ["7", "7,a", "-1,5", "9999,5"])
def test_a_pixel_that_is_none_is_refused(whole: Path, wrong: str) -> None:
    with pytest.raises(InputError, match=r"pixel"):
        lineage(whole, pixel=wrong)


def test_a_run_converts_to_metres_where_its_scale_is_known(whole: Path) -> None:
    run = open_run(whole)
    assert run.gsd_m == run.grid.gsd_m
    np.testing.assert_allclose(run.to_metres([[0, 0], [412, 300]]), [[0, 0], [412 * run.gsd_m, 300 * run.gsd_m]])
    assert run.to_metres([2, 0]).shape == run.to_base(0, [100, 100]).shape == (1, 2)
    for ask in (run.to_metres, partial(run.to_base, 0), partial(run.to_raw, 0), partial(run.position_sd_px, 0)):
        with pytest.raises(ValueError, match=r"^found points of shape \(3,\), expected \(n, 2\): x and y of each$"):
            ask([1, 2, 3])
    vars(run)["grid"] = run.grid.model_copy(update={"gsd_m": None})
    for ask in (lambda: run.gsd_m, lambda: run.to_metres([[1, 2]])):
        with pytest.raises(InputError, match=r"no scale.*--gsd-m"):
            ask()
