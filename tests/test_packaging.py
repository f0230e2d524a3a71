"""What pyproject promises: the extras that pages and messages name, and a lock that holds them all."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LOCK = (ROOT / "requirements.lock").read_text()


def extras_named() -> set[str]:
    """Extras of velfield that pages, messages and comments tell people to install."""
    files = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]
    files += [path for room in ("velfield", "flows", "schemas", "tools") for path in (ROOT / room).rglob("*.py")]
    return {extra for path in files for extra in re.findall(r"velfield\[(\w+)\]", path.read_text(encoding="utf-8"))}


def test_each_extra_that_is_named_exists() -> None:
    named = extras_named()
    assert {"s3", "gis"} <= named
    assert named <= set(PROJECT["optional-dependencies"])


# onnxruntime-gpu takes the place of onnxruntime: one environment cannot hold both.
@pytest.mark.parametrize("extra", sorted(set(PROJECT["optional-dependencies"]) - {"cuda"}))
def test_the_lock_holds_each_extra(extra: str) -> None:
    names = [re.split(r"[\[<>=!~ ;]", line, maxsplit=1)[0] for line in PROJECT["optional-dependencies"][extra]]
    assert [name for name in names if not re.search(rf"^{re.escape(name)}(\[.*\])?==", LOCK, re.M)] == []


def test_the_lock_names_no_registry() -> None:
    assert re.findall(r"^.*(?:--index-url|--find-links|--extra-index-url|://).*$", LOCK, re.M) == []
