"""Every command and snippet of the documentation, run on a small flight or, where that would take long, parsed.

The words VIDEO, RUN, ... of the pages are replaced by what the test has.
"""

import json
import re
import shlex
import shutil
from dataclasses import fields, is_dataclass
from functools import cached_property
from inspect import Parameter, getdoc, signature
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from flows.cli import app
from flows.commands.serve import serve
from schemas.detector import METHODS
from schemas.flight import FlightConfig
from tests.media import drifting, write_video
from velfield.field.pixel import PixelDistribution
from velfield.field.view import VelocityField
from velfield.pipeline.configuration import resolve_config
from velfield.run.analysis import RunAnalysis
from velfield.run.run import Run

ROOT = Path(__file__).resolve().parents[1]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [ROOT / "README.md", *DOCS]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
BARE_DECIMAL = re.compile(r"(?<![\w.)\]*/])\.\d")
QUICK = {"analyse", "schema", "config", "export", "init", "lineage", "verify"}
"""Commands that are run; the others take minutes, or wait for a person: their lines must parse."""


def blocks(language: str) -> list[tuple[str, str]]:
    """(page, text) of all blocks of a language."""
    return [
        (page.relative_to(ROOT).as_posix(), text)
        for page in PAGES
        for kind, text in BLOCK.findall(page.read_text())
        if kind == language
    ]


def commands() -> list[tuple[str, str]]:
    lines = [
        (page, line.split("  #")[0].split("   ")[0].strip())
        for page, text in blocks("sh")
        for line in text.splitlines()
    ]
    return sorted({(page, line) for page, line in lines if line.startswith("velfield ")})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_section_stands_twice_on_a_page(page: Path) -> None:
    titles = re.findall(r"^## .+", BLOCK.sub("", page.read_text()), re.MULTILINE)
    assert [title for title in titles if titles.count(title) > 1] == []


@pytest.fixture
def folder(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with the files that the pages name."""
    shutil.copytree(whole, tmp_path / "RUN")  # the commands write into it
    write_video(tmp_path / "VIDEO.mp4", list(drifting(30)))
    rows = [f"{k},{k + t / 5},{10 * t / 5},{50}" for k in range(6) for t in range(60)]
    (tmp_path / "tracks.csv").write_text("\n".join(["track_id,time_s,x_m,y_m", *rows]))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def words(line: str) -> list[str]:
    return [{"VIDEO": "VIDEO.mp4"}.get(word, word) for word in shlex.split(line)[1:]]


def test_the_pages_have_commands_and_snippets() -> None:
    assert len(commands()) > 10
    assert len(blocks("python")) >= 2


@pytest.mark.parametrize(("page", "line"), commands())
def test_a_command_of_the_pages(page: str, line: str, request: pytest.FixtureRequest) -> None:
    arguments = words(line)
    app.parse_args(arguments, exit_on_error=False, print_error=False)
    if arguments[0] in QUICK or "--plan" in arguments:
        folder: Path = request.getfixturevalue("folder")
        if "--plan" in arguments:
            shutil.rmtree(folder / "RUN")  # of another video
        assert app(arguments, result_action="return_value", exit_on_error=False) == 0


@pytest.mark.parametrize(("page", "text"), blocks("python"))
def test_a_snippet_of_the_pages(page: str, text: str, folder: Path) -> None:
    """It defines the names that it uses: a reader pastes it as it stands."""
    names: dict[str, object] = {}
    exec(compile(text, page, "exec"), names)
    imported = set(re.findall(r"^from \S+ import (.+)$", text, re.MULTILINE))
    unused = [name for line in imported for name in line.split(", ") if len(re.findall(rf"\b{name}\b", text)) < 2]
    assert unused == []
    assert names.keys() - {"__builtins__"}, "the snippet defines nothing, not even an import"


def test_the_notebook_runs(folder: Path) -> None:
    """On a run that is there: its cell that makes one is skipped, as for a user who runs it twice."""
    notebook = json.loads((ROOT / "examples" / "video_to_map.ipynb").read_text(encoding="utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell.get("outputs") == [] for cell in notebook["cells"] if cell["cell_type"] == "code")
    names: dict[str, object] = {}
    for number, text in enumerate(cells):
        exec(compile(text, f"cell {number}", "exec"), names)
    assert (folder / "RUN" / "exports" / "field.tif").exists()


@pytest.mark.parametrize(("page", "text"), [one for one in blocks("yaml") if not one[1].startswith("# model.yaml")])
def test_a_configuration_of_the_pages(page: str, text: str, tmp_path: Path) -> None:
    file = tmp_path / "flight.yaml"
    file.write_text(text)
    assert resolve_config(file=file) != resolve_config(), "it changes nothing"


def test_links_between_the_pages_resolve() -> None:
    missing = [
        f"{page.name}: {target}"
        for page in PAGES
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text())
        if not (page.parent / target).exists()
    ]
    assert missing == []


def test_every_page_is_in_the_navigation() -> None:
    navigation = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    entries = [value for entry in navigation for value in entry.values()]
    files = [
        file
        for value in entries
        for part in ([{"": value}] if isinstance(value, str) else value)
        for file in part.values()
    ]
    assert sorted(files) == [page.name for page in DOCS]


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md"], ids=lambda page: page.name)
def test_decimals_have_a_leading_zero(page: Path) -> None:
    prose = BLOCK.sub("", page.read_text())
    assert [line for line in prose.splitlines() if BARE_DECIMAL.search(re.sub(r"`[^`]*`", "", line))] == []


def test_every_option_of_serve_is_on_its_page() -> None:
    page = (ROOT / "docs" / "scale.md").read_text().partition("## Serve")[2]
    listed = set(re.findall(r"^\| `--([\w-]+)", page, re.MULTILINE))
    keywords = [name for name, one in signature(serve).parameters.items() if one.kind is Parameter.KEYWORD_ONLY]
    assert listed == {name.replace("_", "-") for name in keywords}


REFERENCE: tuple[tuple[str, type], ...] = (
    ("run", Run),
    ("run.field", VelocityField),
    ("run.field.at(x, y)", PixelDistribution),
    ("run.analysis", RunAnalysis),
)
"""How a user gets at each public object, and its class."""


def summary_line(documented: object) -> str:
    """The first sentence of a docstring, on one line."""
    text = " ".join((getdoc(documented) or "").partition("\n\n")[0].split())
    return re.split(r"(?<=\.) ", text, maxsplit=1)[0].rstrip(".").replace("``", "`").replace("|", "\\|")


def reference_rows() -> list[str]:
    """A row for each public method, property and documented attribute of what `velfield.open_run` leads to."""
    rows: dict[str, str] = {}
    for path, owner in REFERENCE:
        if is_dataclass(owner):
            names = f"with {', '.join(f'`{one.name}`' for one in fields(owner))}"
            rows[path] = f"{rows[path]}; {names}" if path in rows else names
        for name, member in vars(owner).items():
            plain = member.__func__ if isinstance(member, classmethod) else member
            if name.startswith("_") or isinstance(member, classmethod) or not getdoc(plain):
                continue
            if callable(plain):
                rows[f"{path}.{name}({parameter_names(plain)})"] = summary_line(plain)
            elif isinstance(plain, property | cached_property):
                rows[f"{path}.{name}"] = summary_line(plain)
    return [f"| `{path}` | {text} |" for path, text in rows.items()]


def parameter_names(function: Any) -> str:
    """Parameters of a method, with a star before the keyword-only ones."""
    found = list(signature(function).parameters.values())[1:]
    by_name = [one.name for one in found if one.kind is Parameter.KEYWORD_ONLY]
    others = [one.name for one in found if one.kind is not Parameter.KEYWORD_ONLY]
    return ", ".join([*others, "*", *by_name] if by_name else others)


def test_the_reference_lists_the_interface_as_it_is() -> None:
    """Neither a public name that is missing or changed, nor one that is gone."""
    page = (ROOT / "docs" / "reference.md").read_text()
    listed = [line for line in page.splitlines() if line.startswith("| `run")]
    assert listed == reference_rows()


def configuration_keys() -> set[str]:
    sections = {name: field.default for name, field in FlightConfig.model_fields.items()}
    models = [(name, type(model)) for name, model in sections.items() if isinstance(model, BaseModel)]
    models += [("detection", method) for method in METHODS]
    return {f"{name}.{key}" for name, model in models for key in model.model_fields}


def test_the_configuration_keys_that_the_pages_name_exist() -> None:
    keys = configuration_keys()
    sections = "|".join(sorted({key.partition(".")[0] for key in keys}))
    named = {
        (page.name, key)
        for page in PAGES
        for code in re.findall(r"`([^`\n]+)`", page.read_text())
        for key in re.findall(rf"(?<![\w./])((?:{sections})\.(?!zarr)[a-z]\w+)(?![\w/(])", code)
    }
    assert len(named) > 20
    assert sorted(found for found in named if found[1] not in keys) == []
