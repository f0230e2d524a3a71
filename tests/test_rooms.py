"""The rules of the house, read off the imports themselves."""

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FLOORS = {"schemas": 0, "velfield": 1, "flows": 2, "tools": 3}
SCIENCE = ("sources", "camera", "registration", "detection", "paper", "tracking", "field", "analysis")
"""Arrays in, arrays out: no run folder, no graph."""
ONLY_IN_TOOLS = ("torch",)
"""Libraries of developers' tools that are in no environment of ours: torch's wheel brings gigabytes of CUDA."""


@cache
def modules() -> list[Path]:
    return sorted(path for room in FLOORS for path in (ROOT / room).rglob("*.py"))


@cache
def nodes(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_text())))


def imports(path: Path) -> Iterator[str]:
    for node in nodes(path):
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


def names_of(module: str) -> set[str]:
    """Names that a module defines; for a tool whose library is not installed, the names in its source."""
    try:
        return set(dir(importlib.import_module(module)))
    except ModuleNotFoundError as error:
        if error.name not in ONLY_IN_TOOLS or not module.startswith("tools."):
            raise
    tree = ast.parse((ROOT / Path(*module.split("."))).with_suffix(".py").read_text())
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}


def test_only_tools_import_what_velfield_does_not_install() -> None:
    tools = {path.relative_to(ROOT).as_posix() for path in modules() if path.is_relative_to(ROOT / "tools")}
    assert violations(dict.fromkeys(ONLY_IN_TOOLS, tools)) == []


def test_every_import_within_the_house_is_there() -> None:
    """Imports inside functions are checked too, which nothing imports before a command runs."""
    missing = []
    for path in modules():
        for node in nodes(path):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in FLOORS:
                names = names_of(node.module)
                missing += [
                    f"{path.relative_to(ROOT)}:{node.lineno}: {node.module}.{alias.name}"
                    for alias in node.names
                    if alias.name not in names and find_spec(f"{node.module}.{alias.name}") is None
                ]
    assert missing == []


def test_few_files_import_prefect() -> None:
    shown = ("artifacts", "deployed", "prefect_flows", "prefect_server", "serve", "stale")
    assert violations({"prefect": {f"flows/{name}.py" for name in shown}}) == []


def test_only_the_stores_import_zarr() -> None:
    assert violations({"zarr": {"velfield/run/stores.py"}}) == []


def test_only_graphs_and_runners_import_dask() -> None:
    may = {"velfield/pipeline/graphs.py", "flows/runners.py"}
    assert violations({"dask": may, "distributed": may}) == []


@pytest.mark.parametrize("room", SCIENCE)
def test_science_knows_neither_run_folder_nor_pipeline(room: str) -> None:
    found = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in modules()
        if path.is_relative_to(ROOT / "velfield" / room)
        for name in imports(path)
        if name.startswith(
            ("velfield.run", "velfield.pipeline", "velfield.exports", "velfield.report", "velfield.viewer")
        )
    ]
    assert found == []


def find_circle(after: dict[str, set[str]]) -> list[str]:
    """Names of which each imports the one before, the first again at the end; none where there is no circle."""
    try:
        TopologicalSorter(after).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_no_file_imports_itself_through_others() -> None:
    """A package's ``__init__`` is a file like any other, so that packages form no circle through them either."""
    names = {path.relative_to(ROOT).with_suffix("").as_posix().replace("/", "."): path for path in modules()}
    names = {name.removesuffix(".__init__"): path for name, path in names.items()}
    after: dict[str, set[str]] = {name: set() for name in names}
    for name, path in names.items():
        for node in nodes(path):
            if isinstance(node, ast.ImportFrom) and node.module in names:
                below = {f"{node.module}.{alias.name}" for alias in node.names} & names.keys()
                after[name] |= (below or {node.module}) - {name}
    assert find_circle(after) == []


def room_of(module: str) -> str | None:
    """The room of ``velfield`` that a dotted module name lies in: a package or a loose module."""
    parts = module.split(".")
    return parts[1] if parts[0] == "velfield" and len(parts) > 1 else None


def test_no_package_cycles() -> None:
    after: dict[str, set[str]] = {}
    for path in modules():
        room = room_of(path.relative_to(ROOT).with_suffix("").as_posix().replace("/", "."))
        others = {room_of(name) for name in imports(path)} if room else set()
        after.setdefault(room or "", set()).update(other for other in others if other and other != room)
    assert find_circle(after) == []


def test_no_print_no_exit_in_the_library() -> None:
    calls = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in modules()
        if not path.is_relative_to(ROOT / "flows") and not path.is_relative_to(ROOT / "tools")
        for node in nodes(path)
        if isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) in ("print", "exit")
    ]
    assert calls == []


def test_the_command_imports_nothing_heavy() -> None:
    heavy = ("prefect", "dask", "zarr", "pandas", "numba", "cv2", "numpy", "psutil")
    code = f"import sys, flows.cli; print(*sys.modules.keys() & {heavy})"
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout == "\n"
