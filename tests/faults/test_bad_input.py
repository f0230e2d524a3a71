"""Bad input is refused in one line: a sample of what `tests.faults.bad_input` tries, and structures made at random."""

import json
import time
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.faults import bad_input
from tests.faults.bad_input import Kind, kinds, problem_of_case, try_cases
from velfield.errors import StoreError

SEED, CASES = 2026, 150
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=12), inner, max_size=4),
    max_leaves=12,
)
KEYS = st.sampled_from(
    ["frames", "lens", "gsd_m", "detection", "tracking", "field", "work", "preset", "every", "method"]
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bad")


@pytest.fixture(scope="module")
def by_name(folder: Path) -> dict[str, Kind]:
    return {kind.name: kind for kind in kinds(folder)}


def test_mutated_files_of_every_kind_are_read_or_refused(tmp_path: Path) -> None:
    tried, problems = try_cases(tmp_path, CASES, SEED)
    assert problems == []
    assert len(tried) > 15


@settings(max_examples=40)
@given(content=st.dictionaries(KEYS, JSON, max_size=4))
def test_any_structure_as_configuration(content: object, by_name: dict[str, Kind], folder: Path) -> None:
    assert problem_of_case(by_name["configuration"], yaml.safe_dump(content).encode(), folder) == ""


@pytest.mark.parametrize("name", ["labels (JSON)", "detector", "flight record"])
@settings(max_examples=25)
@given(content=JSON)
def test_any_json(name: str, content: object, by_name: dict[str, Kind], folder: Path) -> None:
    assert problem_of_case(by_name[name], json.dumps(content).encode(), folder) == ""


HEADERS = {
    "time stamps": ["frame", "time_s", "timestamp", "name"],
    "labels (CSV)": ["frame", "x_px", "y_px", "length_px", "width_px", "angle_deg", "orientation_rad"],
    "tracks (CSV)": ["track_id", "id", "frame", "time_s", "x_m", "y_m", "x_px", "y_px", "length_m", "width_m"],
}
CELL = (
    st.integers(-(10**20), 10**20).map(str)
    | st.floats().map(str)
    | st.sampled_from(["", "f1.png", "0", "1", "NaN", "1e400", "-0", '"', "1,2", "\t", "\x00", "#"])
    | st.text(max_size=6)
)


@pytest.mark.parametrize("name", list(HEADERS))
@settings(max_examples=40)
@given(data=st.data())
def test_any_table(name: str, data: st.DataObject, by_name: dict[str, Kind], folder: Path) -> None:
    """Its columns, some of them twice or missing, and rows of any length with any text."""
    header = data.draw(st.lists(st.sampled_from(HEADERS[name]), min_size=1, max_size=6))
    rows = data.draw(st.lists(st.lists(CELL, max_size=len(header) + 1), max_size=5))
    text = "\n".join(",".join(row) for row in [header, *rows])
    assert problem_of_case(by_name[name], text.encode("utf-8", "surrogatepass"), folder) == ""


@pytest.mark.parametrize("name", ["configuration", "labels (JSON)", "detector", "flight record", "cluster"])
@pytest.mark.parametrize("whole", [True, False])
def test_arrays_without_end_are_refused(name: str, whole: bool, by_name: dict[str, Kind], folder: Path) -> None:
    data = b"[" * 100_000 + (b"]" * 100_000 if whole else b"")
    assert problem_of_case(by_name[name], data, folder) == ""


def test_an_onnx_model_brings_no_files_shapes_or_operators_of_its_own(by_name: dict[str, Kind], folder: Path) -> None:
    """Its weights in another file, of a huge shape, with an operator of its own: read or refused, and nothing run."""
    kind = by_name["detector"]
    assert [problem_of_case(kind, data, folder) for data in kind.good] == [""] * 4


def test_the_check_finds_what_it_is_for(folder: Path) -> None:
    """A traceback, a message of many lines, a file that was written, a hang."""

    def fail(_path: Path) -> None:
        raise ValueError("a traceback")

    def speak(_path: Path) -> None:
        raise StoreError("one line\nand another")

    def write(path: Path) -> None:
        (path.parent / "left behind").touch()

    def hang(_path: Path) -> None:
        while True:
            pass

    def wait(_path: Path) -> None:
        time.sleep(30)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bad_input, "LIMIT_S", 0.2)
        patch.setattr(bad_input, "WAIT_S", 5)
        readers = (fail, speak, write, hang, wait)
        found = [problem_of_case(Kind("x", (b"",), "x", read), b"", folder) for read in readers]
    assert [text.split()[0] for text in found] == ["ValueError:", "a", "wrote", "TooLong:", "TooLong:"]
