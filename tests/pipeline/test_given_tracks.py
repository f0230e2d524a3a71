"""`velfield run --tracks`: tracks of a simulated flight in each format give the same field and answers as the truth."""

import re
import xml.etree.ElementTree as ET
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from flows.commands.run import run as run_command
from flows.commands.verify import DAMAGED, WHOLE, verify
from schemas.analysis import AnalysisRecord
from schemas.export import ExportOptions
from schemas.flight import FlightConfig
from schemas.job import Inputs, Job
from schemas.simulation import SimulationConfig
from tests.analysis.test_traffic_analysis import crossroads, gather
from tests.small_flight import digests
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.errors import InputError
from velfield.exports.export import export_run
from velfield.pipeline.analysis.analyse import analyse_tracks
from velfield.pipeline.compare import compare_runs
from velfield.pipeline.given_tracks.load import load_tracks
from velfield.pipeline.given_tracks.plan import plan_tracks
from velfield.pipeline.given_tracks.write import at_frames
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import write_flight_record
from velfield.pipeline.verify import verify_run
from velfield.run.commits import read_commits
from velfield.run.layout import RunLayout
from velfield.run.run import Run, open_run
from velfield.synthetic.flight import Flight
from velfield.synthetic.observed import NO_ERRORS, observed_detections

GSD_M = 0.23


@cache
def truth() -> pd.DataFrame:
    """True positions of simulated traffic in a minute, a row a vehicle and frame, in metres."""
    flight = Flight(SimulationConfig(seed=971, frames=300, width=480, height=360, gsd_m=GSD_M))
    city, rng = flight.city, np.random.default_rng(0)
    table = observed_detections(
        city.traffic, flight.times_s, city.to_px, shape=flight.base_shape, rng=rng, errors=NO_ERRORS
    )
    length_m = city.traffic.dimensions.length_m[table["vehicle_id"].to_numpy(np.int64)]
    xy = table[["x_px", "y_px"]] * GSD_M
    table = table.assign(x_m=xy["x_px"], y_m=xy["y_px"], length_m=length_m)
    return table.sort_values(["vehicle_id", "frame"], kind="stable", ignore_index=True)


def write(form: str, path: Path) -> tuple[Path, dict[str, float | str]]:
    """The truth as a file, and what the format needs to be said beside it."""
    t = truth()
    plain = t[["vehicle_id", "frame", "time_s"]]
    match form:
        case "metres":
            table = plain.assign(x_m=t["x_m"], y_m=t["y_m"], length_m=t["length_m"]).rename(
                columns={"vehicle_id": "id"}
            )
        case "pixels":
            table, said = plain.assign(x_px=t["x_px"], y_px=t["y_px"]), {"gsd_m": GSD_M}
            table.to_csv(path.with_suffix(".csv"), index=False)
            return path.with_suffix(".csv"), said
        case _:
            steps = "".join(
                f'<timestep time="{time:.4f}">'
                + "".join(
                    f'<vehicle id="car.{v}" x="{x:.6f}" y="{-y:.6f}"/>'
                    for v, x, y in zip(part["vehicle_id"], part["x_m"], part["y_m"], strict=True)
                )
                + "</timestep>"
                for time, part in t.groupby("time_s")
            )
            path.with_suffix(".xml").write_text(f"<fcd-export>{steps}</fcd-export>")
            return path.with_suffix(".xml"), {}
    table.to_csv(path.with_suffix(".csv"), index=False)
    return path.with_suffix(".csv"), {}


def process(path: Path, out: Path, **settings: float | str) -> Run:
    """The stages of the run, one after the other, without Prefect."""
    config = FlightConfig.model_validate(settings)
    plan = plan_tracks(Job(root=str(out), inputs=Inputs(source=str(path)), config=config))
    write_flight_record(plan)
    compute_stages(plan)
    return open_run(out)


def answers(analysis: TrafficAnalysis) -> list[float]:
    scene = analysis.scene
    flows = [flow.flow_veh_per_h.value for flow in analysis.flows if flow.flow_veh_per_h]
    counts = sorted(r.vehicles for r in scene.relations) if scene else []
    return [len(analysis.lanes), *sorted(lane.length_m for lane in analysis.lanes), *sorted(flows), *counts]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    root = tmp_path_factory.mktemp("tracks")
    path, said = write("metres", root / "t")
    return process(path, root / "run", gsd_m=GSD_M, **said)


def test_the_field_has_the_true_speeds(run: Run) -> None:
    t = truth()
    same = t["vehicle_id"].diff(-1) == 0
    v = -t[["x_m", "y_m"]].diff(-1)[same].to_numpy() / -t["time_s"].diff(-1)[same].to_numpy()[:, None]
    at = t[["x_m", "y_m"]][same].to_numpy()
    corner = np.array([run.grid.origin_x_px, run.grid.origin_y_px]) * GSD_M
    modal = run.field.modal_velocity() * GSD_M
    xy = np.round((at - corner) / GSD_M).astype(int)
    found = modal[xy[:, 1], xy[:, 0]]
    moving = np.hypot(*v.T) > 3.0
    assert np.isfinite(found[moving]).all()
    turn = np.angle(np.exp(1j * (np.arctan2(found[:, 1], found[:, 0]) - np.arctan2(v[:, 1], v[:, 0]))))[moving]
    assert np.quantile(np.abs(np.degrees(turn)), 0.9) < 20
    assert np.median(np.hypot(*found[moving].T) / np.hypot(*v[moving].T)) == pytest.approx(1.0, abs=0.05)


def test_the_run_is_whole(run: Run) -> None:
    assert verify_run(run.layout, run.record) == []


def test_a_video_of_it_is_refused_with_what_shows_it(run: Run, tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match="was made from tracks and has no images for a video; replay it by `velfield v"
    ):
        export_run(run, "video", tmp_path / "clip.mp4", ExportOptions())
    assert list(tmp_path.iterdir()) == []


def test_the_run_has_its_vehicles_and_times(run: Run) -> None:
    t = truth()
    assert run.times_s[-1] == pytest.approx(t["time_s"].max() - t["time_s"].min(), abs=0.21)
    vehicles = run.vehicles()
    seen = t.groupby("vehicle_id")["frame"].size()
    assert len(vehicles) == (seen >= 3).sum()
    names = pd.read_csv(run.layout.tracks / "source_ids.csv").set_index("track_id")["source_id"]
    lengths = t.drop_duplicates("vehicle_id").set_index("vehicle_id")["length_m"]
    assert vehicles["length_m"].to_numpy() == pytest.approx(
        lengths.reindex(names.reindex(vehicles["track_id"])).to_numpy(), abs=1e-3
    )


def street(ids: list[str | int]) -> pd.DataFrame:
    """A vehicle every 8 s drives along a street; the last one, in the middle of the time, against the others."""
    rows, t = [], np.arange(0.0, 15.0, 0.2)
    for k, one in enumerate(ids[:-1]):
        rows.append(pd.DataFrame({"id": one, "time_s": 8 * k + t, "x_m": 10 * t, "y_m": 0.0}))
    rows.append(pd.DataFrame({"id": ids[-1], "time_s": 52 + t, "x_m": 150 - 10 * t, "y_m": 0.0}))
    return pd.concat(rows[::-1])


def test_runs_of_one_place_in_metres_are_compared_where_both_reach(tmp_path: Path) -> None:
    """The second file is of the same street, on which vehicles drive at 6 m/s in place of 10, and reaches farther."""
    first, more = street([*range(20)]), street([*range(20)])
    more["time_s"] /= 0.6
    more.loc[more["id"] == 19, "x_m"] *= 1.5
    runs = []
    for k, table in enumerate((first.assign(x_m=first["x_m"] + 7.0), more.assign(x_m=more["x_m"] + 7.0))):
        table.to_csv(tmp_path / f"{k}.csv", index=False)
        runs.append(process(tmp_path / f"{k}.csv", tmp_path / f"run{k}", position_y_axis="down"))
    assert runs[0].grid.width_px < runs[1].grid.width_px
    for before, after in (runs, runs[::-1]):
        roots = before.layout.root, after.layout.root
        lines = compare_runs(*roots, tmp_path / "out")
        speed = next(line for line in lines if line.startswith("speed"))
        by = float(re.search(r"by ([+-][\d.]+) km/h", speed)[1])
        assert by == pytest.approx(-14.4 if after is runs[1] else 14.4, abs=0.5)
        table = pd.read_csv(tmp_path / "out" / "traffic_change.csv")
        assert table["what"].str.startswith("free-flow speed at").any()


def test_runs_of_two_places_in_metres_are_not_compared(tmp_path: Path) -> None:
    roots = []
    for k in range(2):
        street([1, 2, 3]).assign(x_m=lambda t, k=k: t["x_m"] + 900.0 * k).to_csv(tmp_path / "t.csv", index=False)
        roots.append(process(tmp_path / "t.csv", tmp_path / str(k), position_y_axis="down").layout.root)
    with pytest.raises(InputError, match="have no place in common"):
        compare_runs(*roots, tmp_path / "out")


@pytest.mark.parametrize("ids", [[*range(99, 60, -3), 64], [*(f"car.{k}" for k in range(13)), "bus & tram"]])
def test_a_track_has_the_id_of_the_users_file_wherever_it_is_shown(ids: list[str | int], tmp_path: Path) -> None:
    street(ids).to_csv(tmp_path / "t.csv", index=False)
    lines = [*analyse_tracks(tmp_path / "t.csv", tmp_path / "out", gsd_m=None, fps=None, unit=None, y_axis="down")]
    assert any(re.match(rf"wrong way .* track {ids[-1]}\)", line) for line in lines)
    record = AnalysisRecord.model_validate_json((tmp_path / "out" / "analysis.json").read_text())
    unusual = next(table for table in record.tables if table.name == "unusual")
    assert [row.cells["track"] for row in unusual.rows] == [ids[-1]]

    run = process(tmp_path / "t.csv", tmp_path / "run", position_y_axis="down")
    assert [run.analysis.trajectories.id_of(one.track) for one in run.analysis.traffic.unusual] == [ids[-1]]
    assert set(pd.read_parquet(export_run(run, "trajectories"))["track_id"]) == set(ids)
    assert set(pd.read_parquet(export_run(run, "geoparquet"))["track_id"]) == set(ids)
    assert {one.get("id") for one in ET.parse(export_run(run, "sumo")).getroot().iter("vehicle")} == {*map(str, ids)}
    numbers = {*ids} if isinstance(ids[0], int) else {*range(1, 15)}
    for form, column in (("highd", "id"), ("geotrax", "Vehicle_ID")):
        assert set(pd.read_csv(export_run(run, form))[column]) == numbers


def test_an_id_that_comes_back_is_of_a_second_vehicle_with_a_name_of_its_own(tmp_path: Path) -> None:
    again = street([1, 2, 3]).assign(time_s=lambda t: t["time_s"] + 600.0)
    pd.concat([street([1, 2, 3]), again[again["id"] == 2]]).to_csv(tmp_path / "t.csv", index=False)
    loaded = load_tracks(tmp_path / "t.csv", FlightConfig(position_y_axis="down"))
    assert sorted(loaded.names) == ["1", "2", "2 (2)", "3"]


def test_the_flow_writes_the_same_bits_and_repairs_what_was_damaged(run: Run, server: None, tmp_path: Path) -> None:
    from flows.console import Console
    from flows.process_flight import run_flight
    from flows.runners import RunnerConfig

    path, said = write("metres", tmp_path / "t")
    root, config = tmp_path / "run", FlightConfig.model_validate({"gsd_m": GSD_M} | said)
    job = Job(root=str(root), inputs=Inputs(source=str(path)), config=config)
    assert run_flight(job, RunnerConfig(), Console("quiet"), of_tracks=True).complete
    before, staged = digests(root), digests(run.layout.root)
    del staged["frames.zarr/zarr.json"]  # it has the path of the source
    assert {name: value for name, value in before.items() if name in staged} == staged
    for file in (next((root / "field.zarr").rglob("c/*/*")), next((root / "tracks").glob("unit-*.parquet"))):
        file = next(p for p in file.rglob("*") if p.is_file()) if file.is_dir() else file
        data = bytearray(file.read_bytes())
        data[len(data) // 2] ^= 1
        file.write_bytes(data)
    assert verify(root) == DAMAGED
    assert digests(root) != before
    assert verify(root, repair=True) == WHOLE
    assert digests(root) == before
    path.write_text(path.read_text() + "9999,0,0.0,1.0,1.0,4.5\n")
    (root / "tracks" / "source_ids.csv").unlink()
    with pytest.raises(InputError, match="its inputs or the code have changed"):
        verify(root, repair=True)


@pytest.mark.parametrize("form", ["pixels", "fcd"])
def test_each_format_gives_the_same_answers(form: str, run: Run, tmp_path: Path) -> None:
    path, said = write(form, tmp_path / "t")
    other = process(path, tmp_path / "run", **({"gsd_m": GSD_M} | said))
    expected = answers(run.analysis.traffic)
    assert expected[0] > 3
    assert answers(other.analysis.traffic) == pytest.approx(expected, rel=0.02, abs=1.0)  # m: an end of a lane
    known, all_known = (np.isfinite(r.field.modal_velocity()).all(axis=2).sum() for r in (other, run))
    # pixels end at their image's border, metres have a margin in which lanes are as wide as elsewhere
    assert known == pytest.approx(all_known, rel=0.06 if form == "pixels" else 0.02)


def test_positions_with_errors_are_smoothed_to_the_same_lanes(tmp_path: Path) -> None:
    """As of another program's detections: as they are, the paths of a lane cross, and five lanes become 26."""
    exact = gather(crossroads())
    position = exact.xy_m + np.random.default_rng(8).normal(0, 0.4, exact.xy_m.shape)
    table = pd.DataFrame({"id": exact.owner, "time_s": exact.time_s, "x_m": position[:, 0], "y_m": position[:, 1]})
    table.to_csv(tmp_path / "t.csv", index=False)
    found = process(tmp_path / "t.csv", tmp_path / "run").analysis.traffic
    assert len(found.lanes) == len(TrafficAnalysis(exact).lanes) == 5
    notes = [note for of in read_commits(RunLayout(tmp_path / "run"), "tracks") for note in of.notes]
    assert any(re.search(r"errors of 0\.[345]\d m.*: smoothed to 0\.[123]", note) for note in notes)
    assert 0.1 < found.trajectories.position_sd_m < 0.4  # lanes and U-turns of the run need evidence above it


def test_positions_are_interpolated_over_short_gaps_alone() -> None:
    table = pd.DataFrame({"track_id": [0, 0, 0, 0], "time_s": [0.0, 0.3, 0.6, 5.0]}).assign(y_px=0.0)
    table["x_px"] = 10 * table["time_s"]
    found = at_frames(table, np.arange(0, 5.1, 0.2))
    assert found["time_s"].tolist() == pytest.approx([0.0, 0.2, 0.4, 0.6, 5.0])
    assert found["x_px"].tolist() == pytest.approx([0.0, 2.0, 4.0, 6.0, 50.0])


@pytest.mark.parametrize(
    ("text", "settings", "message"),
    [
        ("id,time,x_px,y_px\n1,0,1,1\n1,1,9,9\n1,2,9,9\n", {}, "--gsd-m"),
        ("id,time,x_m,y_m\n1,0,1,1\n1,1,9,9\n1,2,19,9\n2,0,9e7,9\n", {}, "too large a map"),
        ("id,time,x_m,y_m\n1,0,1,1\n1,1,9,9\n", {}, "expected 3 or more"),
        ("foo,bar\n1,2\n3,4\n", {}, r"found the columns foo, bar, expected x and y; name them track_id, time_s"),
        ("foo\n1\n", {}, r"found 1 column in line 1"),
        ("id,time,x_px,y_px\n1,0,-9,1\n1,1,39,9\n1,2,99,9\n", {"gsd_m": 0.2}, "none below 0"),
    ],
)
def test_bad_tracks_are_one_line(text: str, settings: dict[str, float], message: str, tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text(text)
    job = Job(root=str(tmp_path / "run"), inputs=Inputs(source=str(path)), config=FlightConfig.model_validate(settings))
    with pytest.raises(InputError, match=message) as error:
        plan_tracks(job)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


def test_pixels_of_another_image_are_refused(tmp_path: Path) -> None:
    import cv2

    (tmp_path / "t.csv").write_text("id,time,x_px,y_px\n1,0,900,900\n1,1,930,900\n1,2,960,900\n")
    cv2.imwrite(str(tmp_path / "base.png"), np.zeros((50, 60), np.uint8))
    with pytest.raises(InputError, match="0% of the positions within --base of 60 x 50 px"):
        load_tracks(tmp_path / "t.csv", FlightConfig(gsd_m=0.2), base=tmp_path / "base.png")


def test_options_of_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no input; give a video"):
        run_command(out=tmp_path / "run")
    with pytest.raises(InputError, match="--tracks cannot be combined with VIDEO, --labels"):
        run_command(tmp_path / "a.mp4", out=tmp_path / "run", tracks=tmp_path / "t.csv", labels=tmp_path / "l.csv")
