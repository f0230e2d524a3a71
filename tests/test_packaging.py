"""Promises of pyproject: the extras that pages and messages name, and a lock that holds them all."""

import json
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import distribution, packages_distributions
from pathlib import Path
from typing import Any

import pytest
import yaml
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder
from packaging.requirements import Requirement

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


def test_each_dependency_has_bounds_and_a_reason() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    lines = text.split("\ndependencies = [\n", 1)[1].split("\n]", 1)[0].splitlines()
    assert len(lines) == len(PROJECT["dependencies"])
    assert [line for line in lines if not re.search(r'>=[\d.]+,<[\d.]+", +# \S', line)] == []


def test_the_lock_is_within_the_bounds() -> None:
    pins = re.findall(r"^([\w.-]+)==([\w.]+)", LOCK, re.M)  # some twice, by the version of Python
    asked = {one.name.lower(): one for one in map(Requirement, PROJECT["dependencies"])}
    assert [pin for pin in pins if pin[0] in asked and not asked[pin[0]].specifier.contains(pin[1])] == []
    assert set(asked) <= {name for name, _ in pins}


def test_one_opencv_is_installed() -> None:
    """Two lie over each other, and only the headless one can be imported where there is no libGL."""
    assert set(packages_distributions()["cv2"]) == {"opencv-python-headless"}


def test_the_licences_of_what_ships_are_listed() -> None:
    """The page's packages with their versions, and the data that the detectors were trained on, are listed."""
    listed = (ROOT / "THIRD-PARTY-LICENSES.md").read_text()
    assert "THIRD-PARTY-LICENSES.md" in PROJECT["license-files"]
    packages = json.loads((ROOT / "page/package.json").read_text())["dependencies"]
    assert [name for name, version in packages.items() if f"{name} {version}" not in listed] == []
    record = json.loads((ROOT / "velfield/detection/shipped_detector.json").read_bytes())
    data = [re.split(r" \(|,| simulated", text)[0] for text in record["attribution"]]
    assert [name for name in data if name.lower() not in listed.lower()] == []
    weights = [str(path.relative_to(ROOT)) for path in (ROOT / "velfield").rglob("*.json")]
    assert weights
    assert [path for path in weights if f"`{path}`" not in listed] == []


def test_the_citation_and_the_changelog_are_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == PROJECT["version"]
    assert f"## {citation['version']} - {citation['date-released']}" in (ROOT / "CHANGELOG.md").read_text()
    assert [paper["url"] for paper in citation["references"]] == [PROJECT["urls"]["Paper"]]


def test_the_lock_names_no_registry() -> None:
    assert re.findall(r"^.*(?:--index-url|--find-links|--extra-index-url|://).*$", LOCK, re.M) == []


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from this checkout, whose page `make page` has built: without network."""
    (built,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("wheel")), versions=["standard"])
    return Path(built)


PAGE = ("viewer.html", "viewer.js", "viewer.css", "annotate.js", "georeference.js", "LICENSES.txt")


def test_the_wheel_holds_what_runs_and_nothing_else(wheel: Path) -> None:
    assert wheel.stat().st_size < 3_000_000
    names = set(zipfile.ZipFile(wheel).namelist())
    page = {f"velfield/report/page/{name}" for name in PAGE} | {"velfield/report/report.css"}
    licences = f"velfield-{PROJECT['version']}.dist-info/licenses"
    expected = page | {"velfield/detection/shipped_detector.json", "velfield/py.typed", "schemas/py.typed"}
    assert expected | {f"{licences}/{name}" for name in PROJECT["license-files"]} <= names
    sources = {
        str(path.relative_to(ROOT)) for room in ("flows", "velfield", "schemas") for path in (ROOT / room).rglob("*.py")
    }
    assert sources <= names
    assert {name.split("/")[0] for name in names} == {
        "flows",
        "velfield",
        "schemas",
        f"velfield-{PROJECT['version']}.dist-info",
    }


def test_the_wheel_runs_from_a_folder_with_decoys(wheel: Path, tmp_path: Path) -> None:
    site, decoys = tmp_path / "site", tmp_path / "decoys"
    zipfile.ZipFile(wheel).extractall(site)
    for name in ("flows", "velfield", "schemas"):
        (decoys / name).mkdir(parents=True)
        (decoys / name / "__init__.py").write_text("raise RuntimeError('a decoy was imported')")
    for name in ("types.py", "utils.py", "stores.py", "logging.py"):
        (decoys / name).write_text("raise RuntimeError('a decoy was imported')")
    code = "import flows.cli, velfield, schemas; print(flows.cli.__file__); flows.cli.app(['--version'])"
    environment = {**os.environ, "PYTHONPATH": str(site), "PYTHONSAFEPATH": "1"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=decoys, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(site))


def test_the_source_distribution_holds_what_its_tests_read(tmp_path: Path) -> None:
    (built,) = SdistBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with tarfile.open(built) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    data = {
        str(path.relative_to(ROOT)) for path in (ROOT / "tests").rglob("*") if path.suffix in (".py", ".csv", ".zip")
    }
    read = {
        "requirements.lock",
        "Makefile",
        "conda/meta.yaml",
        "docs/index.md",
        "mkdocs.yml",
        "CITATION.cff",
        "page/build.py",
    }
    assert data | read | {"velfield/report/page/viewer.html"} <= names


# What conda-forge calls by another name, or splits.
CONDA_NAMES = {
    "dask": {"dask-core", "distributed"},
    "matplotlib": {"matplotlib-base"},
    "opencv-python-headless": {"opencv"},
}


def requirement(line: str) -> tuple[str, str]:
    """Name and bounds of a requirement, without extras and spaces."""
    name, bounds = re.fullmatch(r"([\w.-]+)(?:\[[^]]*\])?\s*(.*)", line).groups()
    return name, bounds.replace(" ", "")


def test_the_conda_recipe_has_the_requirements_of_the_wheel() -> None:
    text = (ROOT / "conda" / "meta.yaml").read_text()
    recipe = yaml.safe_load(re.sub(r"\{%.*?%\}", "", text).replace("{{", "").replace("}}", ""))
    found = dict(requirement(line) for line in recipe["requirements"]["run"])
    assert found.pop("python") == PROJECT["requires-python"]
    expected = {}
    for name, bounds in map(requirement, PROJECT["dependencies"]):
        expected |= dict.fromkeys(CONDA_NAMES.get(name, {name}), bounds)
    assert found == expected
    assert recipe["build"]["entry_points"] == [f"velfield = {PROJECT['scripts']['velfield']}"]
    assert f'version = "{PROJECT["version"]}"' in text


def compose() -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text())
    return loaded


def test_the_services_that_the_scale_page_lists_are_those_of_compose() -> None:
    page = (ROOT / "docs" / "scale.md").read_text()
    listed = set(re.findall(r"^\| `(\w+)` \|", page.partition("## Containers")[2], re.M))
    assert listed == set(compose()["services"])


def test_services_wait_for_services_that_are_there_and_have_a_check() -> None:
    services = compose()["services"]
    for name, service in services.items():
        waits = service.get("depends_on", {})
        for other, condition in waits.items() if isinstance(waits, dict) else ((one, {}) for one in waits):
            assert other in services, name
            if condition.get("condition") == "service_healthy":
                assert "healthcheck" in services[other], f"{name} waits for {other}"
        for port in service.get("ports", []):
            assert port.startswith("127.0.0.1:"), f"{name} is open to others"


def test_commands_of_the_containers_are_commands_that_the_image_has() -> None:
    scripts = {script.name for script in distribution("prefect").entry_points if script.group == "console_scripts"}
    scripts |= {script.name for script in distribution("dask").entry_points if script.group == "console_scripts"}
    docker = (ROOT / "Dockerfile").read_text()
    assert {"prefect", "dask"} <= scripts
    for service in compose()["services"].values():
        if service.get("image") == "velfield" and "entrypoint" in service:
            assert service["entrypoint"][0] in scripts
    assert 'ENTRYPOINT ["velfield"]' in docker
    copied = {word for line in docker.splitlines() if line.startswith("COPY") for word in line.split()[1:-1]}
    missing = [name for name in copied if not name.startswith(("-", "/")) and not (ROOT / name).exists()]
    assert missing == []
    for package in ("flows", "velfield", "schemas"):
        assert package in copied or f"/source/{package}" in copied
