"""The rules of the house, read off the imports themselves."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FLOORS = {"schemas": 0, "velfield": 1, "flows": 2}
NO_STORE_NO_GRAPH = (
    "sources",
    "camera",
    "registration",
    "detection",
    "tracking",
    "field",
    "insight",
    "render",
    "exports",
)


def modules() -> list[Path]:
    return sorted(path for room in FLOORS for path in (ROOT / room).rglob("*.py"))


def imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert not node.level, f"{path}: relative import"
            yield node.module


def violations(allowed: dict[str, set[str]]) -> list[str]:
    """Imports of a package, by modules that may not: package -> modules (paths from the root) that may."""
    return [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in modules()
        for name in imports(path)
        for package, may in allowed.items()
        if name.split(".")[0] == package and path.relative_to(ROOT).as_posix() not in may
    ]


def test_rooms_are_found() -> None:
    assert len(modules()) > 30


def test_imports_go_down_the_floors() -> None:
    upward = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in modules()
        for name in imports(path)
        if FLOORS.get(name.split(".")[0], -1) > FLOORS[path.relative_to(ROOT).parts[0]]
    ]
    assert upward == []


def test_only_flows_imports_prefect() -> None:
    flows = {path.relative_to(ROOT).as_posix() for path in modules() if path.is_relative_to(ROOT / "flows")}
    assert violations({"prefect": flows}) == []


def test_only_the_stores_import_zarr() -> None:
    assert violations({"zarr": {"velfield/stores.py"}}) == []


def test_only_graphs_and_runners_import_dask() -> None:
    may = {"velfield/graphs.py", "flows/runners.py"}
    assert violations({"dask": may, "distributed": may}) == []


@pytest.mark.parametrize("room", NO_STORE_NO_GRAPH)
def test_stages_know_neither_stores_nor_graphs(room: str) -> None:
    stage = [path for path in modules() if path.is_relative_to(ROOT / "velfield" / room)]
    forbidden = ("velfield.stores", "velfield.graphs", "velfield.steps", "velfield.plan", "velfield.run")
    found = [f"{path.name} imports {name}" for path in stage for name in imports(path) if name.startswith(forbidden)]
    assert found == []


def test_no_print_no_exit_in_the_library() -> None:
    calls = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in modules()
        if not path.is_relative_to(ROOT / "flows")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) in ("print", "exit")
    ]
    assert calls == []


@pytest.mark.parametrize("heavy", ["prefect", "dask", "zarr", "pandas", "numba", "cv2"])
def test_the_command_imports_nothing_heavy(heavy: str) -> None:
    code = f"import sys, flows.cli; sys.exit({heavy!r} in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
