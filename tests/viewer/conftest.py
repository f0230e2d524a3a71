"""What the tests of the page share: a browser, a run and its address, a copy of the run that may be changed."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.browser import Browser, browser, served
from velfield import open_run
from velfield.run.run import Run


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("chromium")) as running:
        yield running


@pytest.fixture(scope="module")
def run(whole: Path) -> Run:
    return open_run(whole)


@pytest.fixture(scope="module")
def address(whole: Path) -> Iterator[str]:
    """The run folder behind Python's plain static server."""
    with served(whole) as there:
        yield there


@pytest.fixture
def linked(whole: Path, tmp_path: Path) -> Path:
    """The run folder as links, in which a test may put files in the place of others."""
    (tmp_path / "view").mkdir()
    for path in (*whole.iterdir(), *(whole / "view").iterdir()):
        if path.name != "view":
            (tmp_path / path.relative_to(whole)).symlink_to(path)
    return tmp_path
