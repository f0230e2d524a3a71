"""A finished run is put on Earth by control points, or by a drone's telemetry, without its frames."""

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import rasterio

from flows.cli import app
from schemas.georeference import ControlPoint
from schemas.job import Inputs
from schemas.simulation import SimulationConfig
from schemas.tables import TRACK_COLUMNS
from velfield import open_run
from velfield.errors import InputError
from velfield.exports.export import export_run
from velfield.exports.georeference import Georeference
from velfield.pipeline.georeference import georeference
from velfield.pipeline.plan import Plan
from velfield.pipeline.stages.georeference import compass_text, georeference_run
from velfield.pipeline.stages.scale import scale_run
from velfield.pipeline.verify import verify_run
from velfield.run.frame_transforms import (
    heading_deg,
    north_direction_rad,
    read_first_georeference,
    read_georeference,
    read_tracking_gsd,
)
from velfield.run.lineage import pixel_lineage
from velfield.run.run import Run
from velfield.run.tables import write_tracks
from velfield.synthetic.clip import simulate_telemetry, srt_text
from velfield.synthetic.flight import Flight

LON, LAT = 13.4, 52.5


@pytest.fixture(scope="module")
def copied(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("georeference") / "run"
    shutil.copytree(whole, root)
    return root


def points(run: Run, gsd_m: float, count: int = 4) -> list[ControlPoint]:
    """Control points of a map whose top is north."""
    w, h = run.grid.width_px, run.grid.height_px
    pixels = np.array([[20, 20], [w - 20, 30], [w - 30, h - 20], [30, h - 30], [w / 2, h / 2], [w / 3, h / 4]])[:count]
    east, north = 111_320 * np.cos(np.radians(LAT)), 111_262.0
    return [ControlPoint(x_px=x, y_px=y, x=LON + x * gsd_m / east, y=LAT - y * gsd_m / north) for x, y in pixels]


def test_control_points_move_maps_exports_and_lineage(copied: Path, tmp_path: Path) -> None:
    run = open_run(copied)
    frames = {path: path.stat().st_mtime_ns for path in run.layout.registration.rglob("*") if path.is_file()}
    count, speed = run.field.count(), run.field.modal_speed_px_per_s()
    y, x = np.unravel_index(count.argmax(), count.shape)
    tracks = [track.track_id for track in pixel_lineage(run, int(x), int(y)).tracks]
    assert run.grid.crs_wkt is None

    rows = ["x_px,y_px,longitude,latitude", *(f"{p.x_px},{p.y_px},{p.x},{p.y}" for p in points(run, 0.25))]
    (tmp_path / "points.csv").write_text("\n".join(rows))
    assert (
        app(["georeference", str(copied), "--points", str(tmp_path / "points.csv")], result_action="return_value") == 0
    )

    run = open_run(copied)
    assert run.grid.gsd_m == pytest.approx(0.25, rel=2e-3)
    lonlat = Georeference.from_grid(run.grid).to_lonlat(np.array([[20.0, 20.0]]))[0]
    assert lonlat == pytest.approx(
        [points(run, 0.25)[0].x, points(run, 0.25)[0].y], abs=3e-6
    )  # the points are made on a sphere
    with rasterio.open(run.layout.maps / "speed.tif") as dataset:
        assert tuple(dataset.transform)[:6] == run.grid.affine
    with rasterio.open(run.layout.base_image_tif) as dataset:
        assert dataset.crs.to_epsg() == 32633
    with rasterio.open(export_run(run, "cog", tmp_path / "field.tif")) as dataset:
        assert dataset.crs.to_epsg() == 32633
        np.testing.assert_array_equal(dataset.read(dataset.descriptions.index("count") + 1), run.field.count())
    after = run.field.modal_speed_px_per_s()
    known = np.isfinite(after) & (speed > 5)
    assert np.median(after[known] / speed[known]) == pytest.approx(1.0, abs=0.1)  # vehicles go as fast, in pixels
    assert set(tracks) & {track.track_id for track in pixel_lineage(run, int(x), int(y)).tracks}
    assert {path: path.stat().st_mtime_ns for path in frames} == frames
    assert verify_run(run.layout, run.record) == []
    record = read_georeference(run.layout)
    assert [estimate.source for estimate in record.scale.others] == ["given", "vehicles"]
    assert any("--gsd-m" in line for line in record.scale.disagreements)  # 0.23 was given


def test_points_that_cannot_be_used_change_nothing(copied: Path) -> None:
    before = {path: path.read_bytes() for path in copied.rglob("*.json")}
    with pytest.raises(InputError, match="found 2 control points"):
        georeference(copied, points(open_run(copied), 0.25, 2))
    assert {path: path.read_bytes() for path in copied.rglob("*.json")} == before


def test_a_drones_telemetry_gives_scale_north_and_place(copy: Path, flight: Path, tmp_path: Path) -> None:
    """The base image of this run is the simulation's own, of 0.23 m a pixel, its top at a known heading."""
    config = SimulationConfig.model_validate_json((flight / "simulation.json").read_text())
    simulated = Flight(config)
    subtitles = simulate_telemetry(config, simulated.camera, simulated.base_shape)
    text = srt_text((f"2026-05-04 12:00:00 {one}" for one in subtitles), simulated.times_s)
    (tmp_path / "x.SRT").write_text(text)
    run = open_run(copy)
    plan = made_plan(run, Inputs(source=str(flight / "frames"), telemetry=str(tmp_path / "x.SRT")))
    done = georeference_run(plan)
    grid, record = open_run(copy).grid, read_georeference(run.layout)
    assert record.scale.used.source == "metadata"
    assert open_run(copy).start == record.start
    assert f"{record.start.time:%Y-%m-%d}" == "2026-05-04"
    assert grid.gsd_m == pytest.approx(0.23, rel=0.03)
    up = float(heading_deg(np.array([-np.pi / 2]), record.north_rad)[0])
    assert any(line.startswith(f"north: the map's top is {compass_text(up)}, standard") for line in done.notes)
    off = np.angle(np.exp(1j * ((north_direction_rad(grid) or 0.0) - np.radians(-90 - config.telemetry.north_deg))))
    assert abs(np.degrees(off)) < 2.0
    assert run.layout.base_image_tif in done.outputs

    done = georeference_run(with_config(plan, gsd_m=0.23 * 1.2))
    assert any("by the metadata" in line for line in done.warnings)
    chosen = read_georeference(run.layout)
    assert chosen.scale.used.source == "given"


def test_the_lengths_of_vehicles_give_the_scale_and_contradict_a_wrong_one(copy: Path, flight: Path) -> None:
    """The flight's base image has 0.23 m a pixel."""
    run = open_run(copy)
    alone = made_plan(run, Inputs(source=str(flight / "frames")))
    warnings = {}
    for gsd_m in (None, 0.23, 0.23 * 1.2, 0.23 / 1.2):
        plan = with_config(alone, gsd_m=gsd_m)
        georeference_run(plan)
        assert read_georeference(run.layout) == read_first_georeference(run.layout)
        warnings[gsd_m] = scale_run(plan).warnings
        record = read_georeference(run.layout)
        assert record.scale.used.source == ("vehicles" if gsd_m is None else "given")
        if gsd_m is None:
            assert record.scale.used.gsd_m == pytest.approx(0.23, rel=0.06)
            assert record.scale.used.low_m < 0.23 < record.scale.used.high_m
            assert open_run(copy).grid.gsd_m == record.scale.used.gsd_m
            assert read_tracking_gsd(run.layout) is None  # its detector was trained with --gsd-m
    assert not warnings[None]
    assert not warnings[0.23]
    assert all("by the lengths of vehicles" in warnings[wrong][0] for wrong in (0.23 * 1.2, 0.23 / 1.2))


@pytest.mark.parametrize("factor", [1.0, 1.35, 5.0, 0.2])
def test_metadata_that_the_cars_contradict_are_not_used(
    factor: float, copy: Path, flight: Path, tmp_path: Path
) -> None:
    """Heights are wrong by a factor, as by a unit or a zoom; what looks like a car does not depend on them."""
    config = SimulationConfig.model_validate_json((flight / "simulation.json").read_text())
    simulated = Flight(config)
    text = srt_text(simulate_telemetry(config, simulated.camera, simulated.base_shape), simulated.times_s)
    wrong = re.sub(r"rel_alt: ([\d.]+)", lambda match: f"rel_alt: {float(match[1]) * factor:.3f}", text)
    (tmp_path / "x.SRT").write_text(wrong)
    run = open_run(copy)
    plan = made_plan(run, Inputs(source=str(flight / "frames"), telemetry=str(tmp_path / "x.SRT")))
    first = georeference_run(plan)
    record = read_first_georeference(run.layout)
    is_impossible = factor in (5.0, 0.2)  # at a third more the detector finds the same cars
    assert record.scale.used.source == ("vehicles" if is_impossible else "metadata")
    assert (sum("by the metadata: speeds" in line for line in first.warnings) == 1) == is_impossible
    if is_impossible:
        assert record.scale.used.gsd_m == pytest.approx(0.23, rel=0.2)
    done = scale_run(plan)
    record = read_georeference(run.layout)
    assert record.scale.used.source == ("metadata" if factor == 1 else "vehicles")
    assert record.scale.used.gsd_m == pytest.approx(0.23, rel=0.06)
    assert sum("by the metadata: speeds" in line for line in done.warnings) == (factor != 1)


def stopping_street(gsd_m: float, fps: float) -> pd.DataFrame:
    """Tracklets of 12 vehicles that set off, one after another, with 1.7 m/s2 up to 12 m/s (`TRACK_COLUMNS`)."""
    rows = []
    for track in range(12):
        times_s = np.arange(40) / 5.0
        since = np.clip(times_s - 0.1 * track, 0, None)
        x_px = np.where(since < 12 / 1.7, 0.85 * since**2, 12 * since - 72 / 1.7) / gsd_m
        for k in range(38):
            row: dict[str, float] = dict.fromkeys(TRACK_COLUMNS, 0) | {"track_id": track}
            for j in range(3):
                row |= {f"frame_{j}": k + j, f"detection_id_{j}": 1000 * track + k + j}
                row |= {f"time_{j}_s": (k + j) / fps, f"x_{j}_px": x_px[k + j], f"y_{j}_px": 20.0 * track}
            for j in range(2):
                row[f"vx_{j}{j + 1}_px_per_s"] = (x_px[k + j + 1] - x_px[k + j]) * fps
            rows.append(row)
    return pd.DataFrame(rows)


def test_a_frame_rate_that_vehicles_contradict_is_reported(copy: Path, flight: Path) -> None:
    """Vehicles that set off in the images do so with four times the usual acceleration at twice the rate."""
    run = open_run(copy)
    made = made_plan(run, Inputs(source=str(flight / "frames")))
    for path in run.layout.tracks.glob("unit-*.parquet"):
        path.unlink()
    results = {}
    for fps in (5.0, 10.0, 2.5):
        plan = with_config(made, frames=made.config.frames.model_copy(update={"fps": fps}), gsd_m=0.23)
        georeference_run(plan)
        write_tracks(run.layout.unit_file(run.layout.tracks, 0), stopping_street(0.23, fps))
        results[fps] = scale_run(plan)
    assert not any("--fps" in line for line in [*results[5.0].warnings, *results[5.0].notes])
    (fast,) = [line for line in results[10.0].warnings if "--fps 10" in line]
    assert "about 2" in fast
    assert "give --fps 5 " in fast
    (slow,) = [line for line in results[2.5].warnings if "--fps 2.5" in line]
    assert "about 0.5" in slow
    write_tracks(run.layout.unit_file(run.layout.tracks, 0), stopping_street(0.23, 5.0).query("track_id < 4"))
    assert any("found 4 of the 10 vehicles that must set off or stop" in line for line in scale_run(plan).notes)


def made_plan(run: Run, inputs: Inputs) -> Plan:
    from velfield.pipeline.georeference import plan_of_finished

    plan = plan_of_finished(run)
    job = plan.job.model_copy(update={"inputs": inputs, "config": plan.config.model_copy(update={"gsd_m": None})})
    return Plan(job, plan.info, plan.indices, plan.inputs, plan.keys)


def with_config(plan: Plan, **changes: object) -> Plan:
    """The same plan with other values in its configuration."""
    job = plan.job.model_copy(update={"config": plan.config.model_copy(update=changes)})
    return Plan(job, plan.info, plan.indices, plan.inputs, plan.keys)
