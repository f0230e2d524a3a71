"""Linux, macOS and Windows: what only one of them has is asked for by its name, and text is UTF-8 on all."""

import ast
import os
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import pytest

from velfield.errors import InputError
from velfield.run.file_lock import try_lock
from velfield.run.layout import RunLayout
from velfield.run.lock import locked

ROOT = Path(__file__).resolve().parents[1]
MODULES = sorted(path for top in ("velfield", "schemas", "flows") for path in (ROOT / top).rglob("*.py"))
POSIX = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "posix", "syslog", "crypt", "readline"}
WINDOWS = {"msvcrt", "winreg", "winsound", "_winapi"}
POSIX_OF_OS = {
    "fork",
    "forkpty",
    "getuid",
    "geteuid",
    "getpgid",
    "setsid",
    "killpg",
    "mkfifo",
    "statvfs",
    "uname",
    "kill",
}
POSIX_OF_SIGNAL = {"SIGKILL", "SIGHUP", "SIGALRM", "SIGUSR1", "SIGCHLD", "alarm", "pause"}


def unguarded(tree: ast.Module) -> Iterator[ast.AST]:
    """Nodes outside branches on `sys.platform`, where what one system has may be used."""
    todo: list[ast.AST] = [tree]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If | ast.IfExp) and "sys.platform" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.FunctionDef) and any(
            isinstance(one, ast.If) and "sys.platform" in ast.unparse(one.test) for one in node.body
        ):
            continue  # `if sys.platform == ...: return`, then the rest
        yield node
        todo += ast.iter_child_nodes(node)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_module_uses_what_every_system_has(path: Path) -> None:
    found = []
    for node in unguarded(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name in POSIX | WINDOWS]
        elif isinstance(node, ast.ImportFrom) and node.module in POSIX | WINDOWS:
            found.append(str(node.module))
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            names = {"os": POSIX_OF_OS, "signal": POSIX_OF_SIGNAL}.get(node.value.id, set())
            found += [f"{node.value.id}.{node.attr}"] if node.attr in names else []
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            text = node.func.attr in ("read_text", "write_text")
            positional = node.func.attr == "read_text" and node.args
            if text and not positional and not any(keyword.arg == "encoding" for keyword in node.keywords):
                found.append(f"line {node.lineno}: {node.func.attr} without encoding")
    assert found == []


class Msvcrt(types.ModuleType):
    """Windows' locks of bytes: a byte of a file that is locked cannot be locked again, by its own process too."""

    LK_NBLCK = 2

    def __init__(self) -> None:
        super().__init__("msvcrt")
        self.held: set[tuple[int, int]] = set()

    def locking(self, descriptor: int, mode: int, count: int) -> None:
        assert (mode, count) == (self.LK_NBLCK, 1)
        byte = os.fstat(descriptor).st_ino, os.lseek(descriptor, 0, os.SEEK_CUR)
        if byte in self.held:
            raise PermissionError(13, "Permission denied")
        self.held.add(byte)


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> Msvcrt:
    fake = Msvcrt()
    monkeypatch.setitem(sys.modules, "msvcrt", fake)
    monkeypatch.setitem(sys.modules, "fcntl", None)  # importing it fails
    monkeypatch.setattr(sys, "platform", "win32")
    return fake


def test_a_run_folder_is_locked_on_windows(windows: Msvcrt, tmp_path: Path) -> None:
    with locked(RunLayout(tmp_path)):
        assert len(windows.held) == 1
        assert f'"pid": {os.getpid()}' in (tmp_path / ".lock").read_text(encoding="utf-8")
        with pytest.raises(InputError, match=f"is locked by pid {os.getpid()}"), locked(RunLayout(tmp_path)):
            pass


def test_the_byte_that_windows_locks_lies_behind_what_others_read(windows: Msvcrt, tmp_path: Path) -> None:
    with (tmp_path / "x").open("a+") as file:
        file.write("who holds it")
        file.flush()
        assert try_lock(file)
        assert file.tell() == len("who holds it")
        assert not try_lock(file)
    assert all(position > 2**20 for _, position in windows.held)
