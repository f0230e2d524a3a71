"""How soon a run's page stands, and answers: five first views with nothing cached, twelve clicks of each visit, and
each table of the analysis, where the run has one.

python -m tests.benchmarks.viewer RUN
"""

import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np

from tests.browser import MIDDLE_OF_MAP, Browser, browser, served
from velfield import open_run

_VISITS, _CLICKS = 5, 12
_REST_S = 0.3
"""A person's pointer comes to a place so long before the click."""
_REACH_X, _REACH_Y = 300, 250
_TILES = [f"document.querySelector('.{layer} .leaflet-tile-loaded') !== null" for layer in ("base", "overlay")]
_STANDS = " && ".join(_TILES)


def main(root: Path) -> None:
    """Serve the run folder from Python's plain static server, look, print."""
    with (
        served(root) as address,
        tempfile.TemporaryDirectory() as profile,
        browser(Path(profile)) as running,
    ):
        views = [_first_view(running, address) for _ in range(_VISITS)]
        print(f"first view: {', '.join(f'{view:.2f}' for view in views)} s; median {median(views):.2f} s")
        for rest_s in (0.0, _REST_S):
            first, later = _clicks(running, address, root, rest_s)
            print(f"click {rest_s:g} s after the pointer came: median {median([*first, *later]):.0f} ms of ", end="")
            late = np.quantile(later, 0.9)
            print(
                f"{len(first) + len(later)}; first of a visit {median(first):.0f} ms; p90 of later ones {late:.0f} ms"
            )
        if (root / "analysis" / "analysis.json").is_file():
            opened, tables = _tables(running, address)
            print(f"analysis: opened {median(opened):.0f} ms, worst {max(opened):.0f} ms")
            print(f"  a table {median(tables.values()):.0f} ms; worst {max(tables.values()):.0f} ms of {len(tables)}")


def _first_view(running: Browser, address: str) -> float:
    with running.page() as page:
        page.call("Network.setCacheDisabled", cacheDisabled=True)
        start = time.perf_counter()
        page.call("Page.navigate", url=f"{address}#tab=map")
        page.wait(_STANDS)
        return time.perf_counter() - start


def _clicks(running: Browser, address: str, root: Path, rest_s: float) -> tuple[list[float], list[float]]:
    """Milliseconds from the click to the numbers: of the first click of a visit, and of those after it."""
    known = np.argwhere(open_run(root).field.count() > 0)
    rng = np.random.default_rng(0)
    first, later = [], []
    with running.page() as page:
        for y, x in rng.choice(known, _VISITS, replace=False).tolist():
            page.open("about:blank")
            page.open(f"{address}#view={x},{y},0")  # a screen pixel is a base pixel
            page.wait(_STANDS)
            near = known[(np.abs(known - [y, x]) <= [_REACH_Y, _REACH_X]).all(axis=1)]
            left, top = page.value(MIDDLE_OF_MAP)
            taken = []
            for there_y, there_x in rng.choice(near, _CLICKS).tolist():
                page.value("delete document.getElementById('answer').dataset.milliseconds")
                page.mouse("mouseMoved", left + there_x - x, top + there_y - y)
                time.sleep(rest_s)
                page.click(left + there_x - x, top + there_y - y)
                page.wait("document.getElementById('answer').dataset.milliseconds !== undefined")
                taken.append(float(page.value("document.getElementById('answer').dataset.milliseconds")))
            first.append(taken[0])
            later += taken[1:]
    return first, later


def _tables(running: Browser, address: str) -> tuple[list[float], dict[str, float]]:
    """Milliseconds from the click on its tab until the analysis is shown, of each visit; and of each of its tables, by
    title, the slowest."""
    opened: list[float] = []
    tables: dict[str, float] = {}
    taken = "document.getElementById('analysis-content').dataset.milliseconds"
    with running.page() as page:
        for _ in range(_VISITS):
            page.open("about:blank")
            page.open(f"{address}#tab=map")
            page.wait(_STANDS)
            page.value("document.getElementById('tab-analysis').click()")
            page.wait(f"{taken} !== undefined")
            opened.append(float(page.value(taken)))
            titles = page.value("[...document.querySelectorAll('#table option')].map((each) => each.textContent)")
            for k, title in enumerate(titles):
                page.value(
                    f"delete {taken}; choice = document.getElementById('table'); "
                    f"choice.value = '{k}'; choice.dispatchEvent(new Event('change'))"
                )
                page.wait(f"{taken} !== undefined")
                tables[title] = max(tables.get(title, 0.0), float(page.value(taken)))
    return opened, tables


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m tests.benchmarks.viewer RUN")
    main(Path(sys.argv[1]))
