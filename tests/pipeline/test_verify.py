"""Damage: every flipped bit and every missing chunk is named, and only the units it is in are done again."""

from pathlib import Path

import numpy as np
import pytest

from flows.commands.verify import verify
from flows.console import Console
from flows.process_flight import record_start
from tests.faults.flipped_bits import flip_bits
from tests.small_flight import digests, job
from velfield import open_run
from velfield.errors import InputError, StoreError
from velfield.pipeline.analysis.analyse import analyse_run
from velfield.pipeline.plan import make_plan
from velfield.pipeline.stage import STAGE
from velfield.pipeline.verify import invalidate, verify_run
from velfield.run.commits import commit_path, read_commit, read_commits
from velfield.run.layout import RunLayout

FLIPS, SEED = 200, 25


def flip_a_bit(path: Path, rng: np.random.Generator) -> None:
    data = bytearray(path.read_bytes())
    data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    path.write_bytes(bytes(data))


def committed_files(root: Path) -> list[str]:
    layout = RunLayout(root)
    return sorted({name for stage in STAGE for record in read_commits(layout, stage) for name in record.outputs})


def found(root: Path) -> dict[str, str]:
    run = open_run(root)
    return {
        damage.path or f"{damage.stage} {damage.unit}": damage.what for damage in verify_run(run.layout, run.record)
    }


def test_a_whole_run_is_whole(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert verify(copy) == 0
    assert capsys.readouterr().out.strip() == f"{copy}: whole"


def test_every_file_of_the_stores_and_tables_is_in_a_record(copy: Path) -> None:
    on_disk = {
        path.relative_to(copy).as_posix()
        for folder in ("frames.zarr", "registration.zarr", "field.zarr", "base", "detections", "tracklets", "tracks")
        for path in (copy / folder).rglob("*")
        if path.is_file()
    }
    assert on_disk - set(committed_files(copy)) == set()


def test_every_one_of_200_flipped_bits_is_found(copy: Path) -> None:
    """In any file of the run but the lock: stores, tables, images, records, the page, the analysis."""
    list(analyse_run(copy))
    flips = flip_bits(copy, FLIPS, SEED)
    assert [flip.text() for flip in flips if not flip.is_found] == [], f"seed {SEED}"
    assert sum(flip.path.startswith("commits/") for flip in flips) > 5
    assert sum(flip.path.startswith("field.zarr/") for flip in flips) > 5


def test_a_damaged_commit_record_counts_for_nothing(copy: Path) -> None:
    """One digit of a count: the unit is computed again rather than taken."""
    path = commit_path(RunLayout(copy), "detections", "000008-000015")
    path.write_text(path.read_text().replace('"cars": ', '"cars": 1'))
    assert found(copy) == {"commits/detections/000008-000015.json": "damaged"}
    assert read_commit(RunLayout(copy), "detections", "000008-000015") is None


def test_a_damaged_flight_record_is_refused_with_what_to_do(copy: Path) -> None:
    path = copy / "flight.json"
    path.write_text(path.read_text().replace('"max_keypoints": 1200', '"max_keypoints": 1201'))
    with pytest.raises(InputError, match=r"flight\.json is damaged .*same `velfield run` command writes it again"):
        open_run(copy)


def test_a_damaged_page_is_found(copy: Path) -> None:
    flip_a_bit(copy / "view/run.json", np.random.default_rng(SEED))
    assert found(copy) == {"view/run.json": "damaged"}


def test_an_analysis_of_other_results_does_not_outlive_them(
    copy: Path, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    list(analyse_run(copy))
    console = Console("normal")
    record_start(make_plan(job(flight, copy)), "the same again", console)
    assert (copy / "analysis/analysis.json").exists()
    record_start(make_plan(job(flight, copy, "tracking.max_turn_rad=0.4")), "with another limit", console)
    assert not (copy / "analysis").exists()
    assert f"`velfield analyse {copy}` makes it again" in " ".join(capsys.readouterr().err.split())
    assert not [name for name in found(copy) if "analysis" in name]
    list(analyse_run(copy))  # of the tracks that are there, which are older than the settings now
    record_start(make_plan(job(flight, copy, "tracking.max_turn_rad=0.4")), "to its end", console)
    assert not (copy / "analysis").exists()


def test_a_damaged_analysis_is_found_and_made_again_as_it_was(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    list(analyse_run(copy, slice_s=2.0))
    before, rng = digests(copy), np.random.default_rng(SEED)
    flip_a_bit(copy / "analysis/lanes.json", rng)
    flip_a_bit(copy / "analysis/report.html", rng)
    (copy / "analysis/lanes.geojson").unlink()
    assert found(copy) == {
        "analysis/lanes.geojson": "gone",
        "analysis/lanes.json": "damaged",
        "analysis/report.html": "damaged",
    }
    assert verify(copy, repair=True) == 0
    assert capsys.readouterr().out.strip().endswith(f"{copy}: whole")
    after = digests(copy)
    different = {name for name in before if before[name] != after[name]}
    assert different <= {"analysis/analysis.xlsx"}  # it has its time in it
    assert after.keys() == before.keys()


def test_reading_a_damaged_table_raises_and_names_it(copy: Path) -> None:
    path = next((copy / "detections").glob("*.parquet"))
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 4
    path.write_bytes(data)
    with pytest.raises(StoreError, match=f"{path.name} is damaged"):
        open_run(copy).detections()


def test_missing_files_and_unfinished_units_are_listed(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (copy / "frames.zarr/raw/c/5/0/0").unlink()
    commit_path(RunLayout(copy), "tracklets", "000008-000015").unlink()
    assert found(copy) == {"frames.zarr/raw/c/5/0/0": "gone", "tracklets 000008-000015": "not finished"}
    assert verify(copy) == 3
    assert f"{copy}: 2 faults in 2 units" in capsys.readouterr().out


def test_an_unfinished_run_is_not_called_damaged(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for record in (copy / "commits" / "maps").glob("*.json"):
        record.unlink()
    assert verify(copy) == 3
    output = capsys.readouterr().out
    assert "what is there is whole; 1 unit never finished" in output
    assert "--repair" not in output
    assert f"velfield run ... --out {copy}" in output


def test_reading_a_damaged_chunk_raises_and_names_it(copy: Path) -> None:
    path = copy / "frames.zarr/raw/c/5/0/0"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(StoreError, match="frame 5 is damaged"):
        open_run(copy).frames.read(5)
    status = copy / "registration.zarr/status/c/1/0"
    status.write_bytes(status.read_bytes()[:-2])
    with pytest.raises(StoreError, match="status"):
        open_run(copy).registration.statuses()


def test_only_the_damaged_units_are_recomputed_with_equal_results(
    copy: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in (copy / "commits").rglob("*.json")}
    rng = np.random.default_rng(1)
    for name in ("frames.zarr/raw/c/3/0/0", "registration.zarr/vector/c/1/0", "tracks/unit-00000.parquet"):
        flip_a_bit(copy / name, rng)
    (copy / "frames.zarr/raw/c/17/0/0").unlink()
    assert verify(copy) == 3
    assert verify(copy, repair=True) == 0
    assert capsys.readouterr().out.strip().endswith(f"{copy}: whole")
    assert digests(copy) == digests(whole)
    again = {
        path.relative_to(copy / "commits").as_posix() for path in before if path.stat().st_mtime_ns != before[path]
    }
    units = ("frames/000000-000007", "frames/000016-000017", "registration/000008-000015", "tracks/all")
    assert again == {f"{unit}.json" for unit in (*units, "page/all")}  # every run writes the page again


def test_what_no_unit_writes_and_what_an_earlier_stage_reads_are_repaired(copy: Path, whole: Path) -> None:
    """Coordinates, which are written with their store; the scale of the last run, which registration reads."""
    rng = np.random.default_rng(2)
    for name in ("field.zarr/y/c/0", "field.zarr/vx_m_per_s/c/0", "commits/registration/000000-000007.json"):
        flip_a_bit(copy / name, rng)
    (copy / "base/scale.json").write_text("{")
    assert verify(copy, repair=True) == 0
    assert digests(copy) == digests(whole)


def test_a_store_whose_metadata_is_damaged_is_recreated(copy: Path) -> None:
    (copy / "registration.zarr/zarr.json").write_text("{")
    run = open_run(copy)
    taken_back = invalidate(run.layout, verify_run(run.layout, run.record))
    assert taken_back == [f"registration {unit}" for unit in ("000000-000007", "000008-000015", "000016-000017")]
    assert not (copy / "registration.zarr").exists()
