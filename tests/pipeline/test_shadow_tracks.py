"""Stage `tracks` where a track is of a shadow: it is moved onto the vehicle or left out; and what it sees of frames."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from schemas.job import Inputs, Job
from velfield import parallel
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import Plan, make_plan, write_flight_record
from velfield.pipeline.stage import stages_before
from velfield.pipeline.stages import tracks as stage
from velfield.pipeline.stages.rectified_frames import FrameLook
from velfield.pipeline.stages.tracklets import read_chosen, read_unit
from velfield.run.stores import open_frames
from velfield.tracking.casters import Caster

DETECTOR = Path(__file__).resolve().parents[2] / "velfield" / "detection" / "shipped_detector.json"
GSD_M = 0.23


@pytest.fixture(scope="module")
def plan(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Plan:
    """A run of three units up to its tracks."""
    inputs = Inputs(source=str(flight / "frames"), timestamps=str(flight / "timestamps.csv"), detector=str(DETECTOR))
    config = resolve_config(overrides={"gsd_m": GSD_M}, settings=["lens.refine=never", "work.unit_frames=6"])
    made = make_plan(Job(root=str(tmp_path_factory.mktemp("shadows") / "run"), inputs=inputs, config=config))
    write_flight_record(made)
    compute_stages(made, stages_before("tracks"))
    return made


def tables(plan: Plan) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Tracklets, positions and dimensions of the stage."""
    compute_stages(plan, ["tracks"])
    read = [sorted(folder.glob("unit-*.parquet")) for folder in (plan.layout.tracks, plan.layout.track_positions)]
    assert len(read[0]) == len(plan.units) > 1
    tracklets, positions = (pd.concat([pd.read_parquet(path) for path in paths], ignore_index=True) for paths in read)
    return tracklets, positions, pd.read_parquet(plan.layout.dimensions)


def finder(casters: dict[int, Caster]) -> Callable[..., dict[int, Caster]]:
    return lambda *_: casters


def test_the_track_of_a_shadow_is_moved_or_left_out(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    before = tables(plan)
    moved, bent, double = (int(track) for track in before[0]["track_id"].value_counts().index[:3])
    offset_m = np.array([-4.6, 2.3])
    shadows = {one: Caster(offset_m, 12.0, 2.5, tracked=one == double) for one in (moved, bent, double)}
    monkeypatch.setattr(stage, "find_shadows", finder(shadows))
    monkeypatch.setattr(stage, "keeps_direction", lambda track, _: track["track_id"].iloc[0] != bent)
    after = tables(plan)
    columns = ([f"{axis}_{k}_px" for axis in "xy" for k in range(3)], ["x_px", "y_px"])
    for old, new, names in zip(before, after, columns, strict=False):
        expected = old[~old["track_id"].isin([bent, double])].reset_index(drop=True)
        rows = expected["track_id"] == moved
        assert rows.sum() > 3
        for name in names:
            expected[name] += rows * offset_m["xy".index(name[0])] / GSD_M
        pd.testing.assert_frame_equal(new, expected, check_exact=False, rtol=0, atol=1e-9)
    assert set(before[2]["track_id"]) - set(after[2]["track_id"]) == {moved, bent, double}, (
        "a shadow's dimensions are none"
    )


def test_tracks_are_the_same_however_many_units_are_read_and_written_at_once(
    plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    for processors in (1, 2, 3):
        monkeypatch.setattr(parallel, "usable_processors", lambda number=processors: number)
        monkeypatch.setattr(stage, "usable_processors", lambda number=processors: number)
        compute_stages(plan, ["tracks"])
        paths = sorted(path for path in plan.layout.tracks.rglob("*.parquet"))
        found.append([(path.name, path.read_bytes()) for path in paths])
    assert found[0] == found[1] == found[2]


def test_chosen_detections_are_those_of_all(plan: Plan) -> None:
    whole = read_unit(plan, 1)
    rows = np.arange(0, len(whole.column["detection_id"]), 3)
    ids = np.append(whole.column["detection_id"][rows], 2**60)
    chosen = read_chosen(plan, 1, ids)
    for name, values in chosen.column.items():
        np.testing.assert_array_equal(values, whole.column[name][rows])
    for name in ("chips", "xy_work"):
        np.testing.assert_array_equal(chosen.patches[name], whole.patches[name][rows])
    assert len(rows) > 10
    assert len(read_chosen(plan, 1, np.empty(0, np.int64)).column["frame"]) == 0


def test_without_images_of_tracks_there_are_no_shadows(plan: Plan) -> None:
    images = stage.TrackImages(np.empty(0, np.int64), np.empty((0, 32, 10)), np.empty(0, int), np.empty((0, 3)), 1.0)
    assert stage.find_shadows(plan, images, tables(plan)[1], GSD_M) == {}


def test_a_frame_is_seen_about_positions_in_the_base_image(plan: Plan) -> None:
    look = FrameLook.open(plan, 1.0, GSD_M, 22.0)
    frame, middle, half = 7, np.array([[300.0, 200.0], [331.4, 250.8]]), look.half
    seen = look(frame, middle)
    transform = look.maps.transform(frame)
    assert transform is not None
    assert seen.shape == (2, 2 * half + 1, 2 * half + 1)
    raw = cv2.blur(open_frames(plan.layout.frames).read(frame).astype(np.float32), (2, 2))
    for image, xy in zip(seen, middle, strict=True):
        step = np.array([[dx, dy] for dy in range(-8, 9) for dx in range(-8, 9)])
        x, y = transform.to_raw(xy + step / look.scale).astype(np.float32).T
        expected = cv2.remap(raw, (x + 0.5)[None], (y + 0.5)[None], cv2.INTER_LINEAR)[0]
        got = image[half - 8 : half + 9, half - 8 : half + 9].ravel()
        assert np.corrcoef(got, expected)[0, 1] > 0.97
    assert np.isnan(look(frame, np.array([[-5000.0, 0.0]]))).all()
