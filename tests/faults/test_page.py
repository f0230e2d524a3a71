"""The page of faults names tests that are there, and each fault has one."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "faults.md").read_text()


def rows() -> list[list[str]]:
    """Cells of the rows of the tables of faults: fault, what happens, test, seen."""
    tables = [block.splitlines() for block in re.findall(r"^\| fault \|.*?(?=\n\n|\Z)", PAGE, re.DOTALL | re.MULTILINE)]
    return [[cell.strip() for cell in line.strip("| ").split(" | ")] for table in tables for line in table[2:]]


def test_every_test_that_is_named_is_there() -> None:
    missing = []
    for file, name in re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", PAGE):
        path = ROOT / file
        defined = {node.name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)}
        missing += [] if not name or name in defined else [f"{file}::{name}"]
    assert missing == []


def test_every_fault_has_a_test() -> None:
    assert len(rows()) > 20
    assert [row[0] for row in rows() if "`tests/" not in row[2]] == []
