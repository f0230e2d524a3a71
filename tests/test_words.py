"""Words of the field: private words stay out of identifiers, docstrings, messages and help texts.

A reader searches for the term of the textbooks: a detector is trained, not learnt; a field predicts, it does not
foretell. `docs/glossary.md` has the terms.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MODULES = sorted(path for top in ("velfield", "schemas", "flows", "tools") for path in (ROOT / top).rglob("*.py"))

IN_IDENTIFIERS = re.compile(
    r"told|tells?|said|says?|liked|likes|heard|anew|mend(s|ed)?|foretell(s|ing)?|foretold|borne|learnt|finds"
)
"""Parts of an identifier, between underscores and humps."""
IN_TEXT = re.compile(
    r"\b(told|tells?|said|liked|likes|heard|anew|mend(s|ed)?|foretells?|foretold|borne out|learnt)\b", re.IGNORECASE
)
"""Words of a text. ``say`` and ``find`` are verbs of plain English there."""
OLD_NAMES = ROOT / "schemas" / "renames.py"
"""Lists the names of format 1, which are read for this release."""

MAX_NAMES_IN_OF = 4
"""Functions called ``x_of``: ``from_x``, ``to_x`` or a verb gives the direction."""
MAX_PARTICIPLES = 18
"""Functions called by a participle alone (``scaled``): a verb says that something is computed."""
_IRREGULAR = (
    "bound|broken|built|chosen|drawn|found|given|held|kept|known|laid|learnt|left|lost|made|seen|shown|taken|told"
)
_PARTICIPLE = re.compile(rf"_*([a-z]*[^e_]ed|{_IRREGULAR})_*")


_BARE_DECIMAL = re.compile(r"""(?<![\w.:\])}%"'\\/])\.\d+(?![\w%])""")
"""A number below one without its zero, as .94; format specifications, file suffixes and attributes are none."""


def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def identifiers(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and name of whatever a module defines: functions, classes, parameters, variables, attributes."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield node.lineno, name
            case ast.arg(arg=name) | ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield node.lineno, name
            case ast.alias(asname=str(name)):
                yield node.lineno, name


def texts(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and text of every string: docstrings, messages, help texts, names of columns."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            for offset, line in enumerate(node.value.splitlines()):
                yield node.lineno + offset, line


def functions() -> Iterator[tuple[str, str]]:
    """Place and name of every function that is no property."""
    for path in MODULES:
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.FunctionDef) and not any("property" in ast.unparse(d) for d in node.decorator_list):
                yield f"{path.relative_to(ROOT)}:{node.lineno}", node.name


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_module_has_no_private_words(path: Path) -> None:
    tree, found = parse(path), []
    for line, name in [(1, path.stem), *identifiers(tree)]:
        parts = re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name)
        found += [
            f"{path.relative_to(ROOT)}:{line}: {name}" for part in parts if IN_IDENTIFIERS.fullmatch(part.lower())
        ]
    if path != OLD_NAMES:
        for line, text in texts(tree):
            found += [
                f"{path.relative_to(ROOT)}:{line}: {match[0]!r} in {text.strip()!r}" for match in IN_TEXT.finditer(text)
            ]
    assert not found, "private words; use the field's (docs/glossary.md):\n" + "\n".join(found)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_numbers_below_one_have_their_zero(path: Path) -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text.strip()!r}"
        for line, text in texts(parse(path))
        if _BARE_DECIMAL.search(text)
    ]
    assert not found, "write 0.94 rather than .94:\n" + "\n".join(found)


def test_few_functions_are_called_x_of() -> None:
    found = [f"{place}: {name}" for place, name in functions() if name.endswith("_of")]
    assert len(found) <= MAX_NAMES_IN_OF, "name them by a verb, or from_x and to_x:\n" + "\n".join(found)


def test_few_functions_are_called_by_a_participle_alone() -> None:
    found = [f"{place}: {name}" for place, name in functions() if _PARTICIPLE.fullmatch(name)]
    assert len(found) <= MAX_PARTICIPLES, "name them by a verb:\n" + "\n".join(found)


def test_the_rules_find_what_they_forbid() -> None:
    tree = ast.parse('def learnt(told):\n    """What the network said."""\n    self.heard = told\n')
    assert [name for _, name in identifiers(tree)] == ["learnt", "told", "heard"]
    assert [IN_TEXT.search(text)[0] for _, text in texts(tree)] == ["said"]  # type: ignore[index]
    assert not IN_TEXT.search("a message says which keypoints SIFT finds; it looks like a car, likelihood")
    assert _PARTICIPLE.fullmatch("_scaled")
    assert not _PARTICIPLE.fullmatch("seed")
    assert not _PARTICIPLE.fullmatch("_is_scaled")
    assert _BARE_DECIMAL.search("a precision of .94")
    assert not _BARE_DECIMAL.search("0.94, {x:.2f}, frame.png, v1.2")
