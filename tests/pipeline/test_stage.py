"""The table of stages: whole, the only one, and keys change exactly where a stage reads what changed."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import pytest

from schemas.flight import FlightConfig
from schemas.model import Model
from schemas.records import CommitRecord, InputsRecord, SourceRecord
from tests.small_flight import digests, job
from velfield.bench.workers import compute_bare
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.pipeline.stage import STAGE, STAGES, stage_keys
from velfield.pipeline.summary import summarise_stage
from velfield.run.layout import RunLayout
from velfield.run.results import link_shared_outputs

ROOT = Path(__file__).resolve().parents[2]
SOURCE = SourceRecord(path="v", kind="video", digest="d", width=64, height=48, frame_count=9)
INPUTS = InputsRecord(source=SOURCE, base="b", labels="l", detector="d", detections="e", timestamps="t")


def test_the_nouns_of_a_stages_line_follow_its_counts() -> None:
    counts = {"tracks": 1.0, "doubtful": 2.0, "lone": 1.0}
    record = CommitRecord(stage="tracks", unit="all", key="k", code_version="1", counts=counts)
    text = summarise_stage("tracks", [record], units=1, before=(), seconds=0.0).text
    assert text == "1 track; set aside as no vehicles: 2 doubtful tracks, 1 detection in no track"


def test_a_stage_reads_stages_before_it_and_known_inputs_and_settings() -> None:
    before: set[str] = set()
    for stage in STAGES:
        assert set(stage.after) <= before
        assert set(stage.inputs) <= set(InputsRecord.model_fields)
        read = FlightConfig()
        assert stage.settings(read) or not stage.config
        whole = [name for name in stage.config if isinstance(getattr(read, name.split(".")[0]), Model)]
        assert {name.split(".")[0] for name in stage.unread} <= set(whole)
        before.add(stage.name)
    assert len(before) == len(STAGES)


def test_the_last_stage_depends_on_every_other() -> None:
    assert following(STAGES[0].name) == set(STAGE)
    assert {name for name in STAGE if STAGES[-1].name in following(name)} == set(STAGE)


def following(*names: str) -> set[str]:
    """These stages and all that read them, directly or not."""
    found = set(names)
    for stage in STAGES:
        if found & set(stage.after):
            found.add(stage.name)
    return found


def leaves() -> Iterator[tuple[str, object]]:
    """Every setting by its dotted name."""
    for name, value in FlightConfig():
        if isinstance(value, Model):
            yield from ((f"{name}.{key}", one) for key, one in value)
        else:
            yield name, value


def changed_stages(setting: str) -> set[str]:
    """Stages whose content key another value of a setting changes."""
    section, _, key = setting.rpartition(".")
    config = FlightConfig()
    part = getattr(config, section).model_copy(update={key: "other"}) if section else "other"
    one, two = stage_keys(config, INPUTS), stage_keys(config.model_copy(update={section or key: part}), INPUTS)
    return {name for name in one if one[name] != two[name]}


READERS: dict[str, tuple[str, ...]] = {
    "preset": (),
    "gsd_m": ("georeference",),
    "position_unit": (),  # part of the digest of given tracks
    "position_y_axis": (),
    "frames": ("frames",),
    "lens": ("lens",),
    "base": ("base",),
    "registration": ("base",),  # the flight's own base image is made by registration
    "detection": ("detector",),
    "detection.full_frame_every": ("detections",),
    "tracking": ("tracklets",),
    "tracking.max_interval_s": ("detector",),
    "tracking.max_gap_s": ("tracks",),
    "tracking.max_stationary_gap_s": ("tracks",),
    "tracking.max_hidden_gap_s": ("tracks",),
    "tracking.doubt": ("tracks",),
    "field": ("field",),
    "work": (),
    "work.unit_frames": ("frames",),
}
"""Section or key of the configuration -> the first stages that read it."""


@pytest.mark.filterwarnings("ignore:Pydantic serializer warnings")
@pytest.mark.parametrize("setting", [name for name, _ in leaves()])
def test_a_changed_setting_changes_the_keys_of_its_readers_and_of_what_follows(setting: str) -> None:
    readers = READERS.get(setting, READERS[setting.split(".")[0]])
    assert changed_stages(setting) == following(*readers)


@pytest.mark.parametrize(
    ("given", "readers"),
    [
        ("source", ("frames",)),
        ("timestamps", ("frames",)),
        ("base", ("base",)),
        ("labels", ("detector",)),
        ("detector", ("detector",)),
        ("detections", ("base",)),  # key points are detected beside the given boxes
    ],
)
def test_another_input_changes_the_keys_of_its_readers_and_of_what_follows(
    given: str, readers: tuple[str, ...]
) -> None:
    other = SOURCE.model_copy(update={"digest": "other"}) if given == "source" else "other"
    one = stage_keys(FlightConfig(), INPUTS)
    two = stage_keys(FlightConfig(), INPUTS.model_copy(update={given: other}))
    assert {name for name in one if one[name] != two[name]} == following(*readers)


def test_another_path_of_the_same_source_changes_nothing() -> None:
    moved = INPUTS.model_copy(update={"source": SOURCE.model_copy(update={"path": "elsewhere"})})
    assert stage_keys(FlightConfig(), INPUTS) == stage_keys(FlightConfig(), moved)


def listed(node: ast.AST) -> list[object]:
    """The constants of a literal: elements, or keys."""
    if isinstance(node, ast.List | ast.Tuple | ast.Set):
        return [one.value if isinstance(one, ast.Constant) else None for one in node.elts]
    if isinstance(node, ast.Dict):
        return [key.value if isinstance(key, ast.Constant) else None for key in node.keys]
    return []


def test_no_other_file_lists_the_stages() -> None:
    """A literal of stage names alone, two in a row or three as keys (two may be counts), is a second list of stages."""
    found = []
    for path in [path for room in ("schemas", "velfield", "flows", "tools") for path in (ROOT / room).rglob("*.py")]:
        if path == ROOT / "velfield/pipeline/stage.py":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            names = listed(node)
            if len(names) > isinstance(node, ast.Dict) + 1 and set(names) <= set(STAGE):
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}: {names}")
    assert found == []


class OneByOne(Executor):
    """Computes what is submitted at once, on this thread."""

    def submit(self, function: Any, /, *arguments: Any, **options: Any) -> "Future[Any]":
        done: Future[Any] = Future()
        done.set_result(function(*arguments, **options))
        return done


def test_the_graphs_compute_what_the_bare_functions_do(whole: Path, flight: Path, tmp_path: Path) -> None:
    plan = make_plan(job(flight, tmp_path / "bare"))
    write_flight_record(plan)
    alone = ("lens", "base", "detector")  # one unit each
    link_shared_outputs(RunLayout(whole), plan.layout, alone)
    compute_bare(plan, OneByOne(), [name for name in STAGE if name not in alone])
    by_graphs = digests(whole)
    bare = digests(tmp_path / "bare")
    assert {name for name in bare if by_graphs.get(name) != bare[name]} == set()
    assert {name.split("/")[0] for name in by_graphs.keys() - bare.keys()} <= {"view"}  # what the report adds


def test_kernels_are_loaded_before_they_are_called() -> None:
    module = "import numpy as np; from velfield.registration import kernels as module; "
    call = "module.mesh_displacement(np.ones((3, 2)), np.ones((2, 2, 2)), 8)"
    signatures = "module.mesh_displacement.signatures"
    assert run_python(module + call) == ""  # compiled, and so cached
    loaded = f"from velfield.pipeline.stage import load_kernels; assert not {signatures}; assert load_kernels() > 0; "
    assert run_python(f"{module}{loaded}assert {signatures}") == ""


def run_python(code: str) -> str:
    """Error output of a separate process, empty if it succeeds."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    return (done.stderr or "failed") if done.returncode else ""
