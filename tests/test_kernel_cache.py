"""Compiled code is never older than the sources, in any process, and needs no folder of the user's."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1]
INNER = "from numba import njit\n\n\n@njit(cache=True)\ndef inner(x):\n    return x * {factor}\n"
OUTER = """from numba import njit

from velfield.probe_inner import inner


@njit(cache=True)
def outer(x):
    return inner(x) + 1
"""
ASK = "from velfield.probe_outer import outer; print(outer(10), sum(outer.stats.cache_hits.values()))"


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the package, with a kernel that calls one of another file."""
    for name in ("velfield/__init__.py", "velfield/kernel_cache.py", "velfield/errors.py", "schemas/__init__.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(PACKAGE / name, tmp_path / name)
    (tmp_path / "velfield/probe_outer.py").write_text(OUTER)
    write_inner(tmp_path, 2)
    return tmp_path


def write_inner(folder: Path, factor: int) -> None:
    path = folder / "velfield/probe_inner.py"
    path.write_text(INNER.format(factor=factor))
    os.utime(path, (1e9, 1e9 + factor))  # older than any process


def ask(folder: Path, code: str = ASK, **variables: str) -> tuple[str, str]:
    """Output and errors of a process that runs the copy."""
    ours = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA", "XDG", "PYTHON"))}
    command = [sys.executable, "-P", "-c", f"import sys; sys.path.insert(0, {str(folder)!r}); {code}"]
    done = subprocess.run(command, env=ours | variables, capture_output=True, text=True, cwd=folder, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip(), done.stderr


def age(folder: Path) -> None:
    """Let the sources be older than any process."""
    for path in folder.glob("velfield/*.py"):
        os.utime(path, (1e9, min(path.stat().st_mtime, 1e9 + 9)))


@pytest.mark.parametrize("first", ["", "import numba; "], ids=["numba after", "numba before"])
def test_a_changed_callee_is_compiled_anew_and_an_unchanged_one_is_not(copy: Path, first: str) -> None:
    age(copy)
    assert [ask(copy, first + ASK)[0] for _ in range(2)] == ["21 0", "21 1"]
    write_inner(copy, 3)
    assert ask(copy, first + ASK)[0] == "31 0"
    write_inner(copy, 2)
    assert ask(copy, first + ASK)[0] == "21 1"


def test_code_of_a_source_that_changed_under_a_process_is_its_own(copy: Path) -> None:
    age(copy)
    inner = copy / "velfield/probe_inner.py"
    edit = f"from pathlib import Path; Path({str(inner)!r}).write_text({INNER.format(factor=5)!r})"
    assert ask(copy, f"import velfield.probe_inner; {edit}; {ASK}")[0] == "21 0"  # with what it had imported
    age(copy)
    assert ask(copy)[0] == "51 0"


def test_code_compiled_at_installation_serves_where_nothing_can_be_written(copy: Path, tmp_path: Path) -> None:
    age(copy)
    ask(copy)
    kernels = copy / "velfield/__pycache__/kernels"
    nowhere = {"HOME": "/dev/null/home", "TMPDIR": str(tmp_path / "tmp")}
    (tmp_path / "tmp").mkdir()
    # Also where root asks, who may write everywhere.
    cannot = (
        "import velfield.kernel_cache as k; real = k.is_writable; "
        "k.is_writable = lambda folder: folder != k._beside_sources() and real(folder); "
    )
    before = sorted(kernels.rglob("*"))
    said, errors = ask(copy, cannot + ASK, **nowhere)
    assert said == "21 1"
    assert errors.count("CacheWarning") == 1
    assert "NUMBA_CACHE_DIR" in errors
    assert sorted(kernels.rglob("*")) == before
    again, errors = ask(copy, cannot + ASK, NUMBA_CACHE_DIR=str(tmp_path / "given"), **nowhere)
    assert (again, errors) == ("21 1", "")


def test_code_that_nothing_used_for_a_month_is_removed_when_newer_is_compiled(copy: Path) -> None:
    age(copy)
    ask(copy)
    kernels = copy / "velfield/__pycache__/kernels"
    (old,) = kernels.glob("velfield.probe_outer-*")
    os.utime(old, (1e9, 1e9))
    write_inner(copy, 3)
    ask(copy)
    (new,) = kernels.glob("velfield.probe_outer-*")
    assert new != old
