"""How soon a run's page stands, and answers: first view of five visits with nothing cached, and forty clicks.

python -m tests.benchmarks.viewer RUN
"""

import functools
import sys
import tempfile
import threading
import time
from http.server import ThreadingHTTPServer
from pathlib import Path
from statistics import median

import numpy as np

from tests.browser import Browser, browser
from tests.test_viewer import Quiet, click_pixel
from velfield import open_run

_VISITS, _CLICKS = 5, 40
_STANDS = (
    "document.querySelector('#map img')?.complete && document.querySelector('canvas.leaflet-tile-loaded') !== null"
)


def main(root: Path) -> None:
    """Serve the run folder from Python's plain static server, look, print."""
    with (
        ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(root))) as server,
        tempfile.TemporaryDirectory() as profile,
        browser(Path(profile)) as running,
    ):
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/"
        views = [_first_view(running, address) for _ in range(_VISITS)]
        print(f"first view: {', '.join(f'{view:.2f}' for view in views)} s; median {median(views):.2f} s")
        clicks = _clicks(running, address, root)
        print(f"click: median {median(clicks):.0f} ms, p90 {np.quantile(clicks, 0.9):.0f} ms, of {len(clicks)}")
        server.shutdown()


def _first_view(running: Browser, address: str) -> float:
    with running.page() as page:
        page.call("Network.setCacheDisabled", cacheDisabled=True)
        start = time.perf_counter()
        page.call("Page.navigate", url=f"{address}#tab=map")
        page.wait(_STANDS)
        return time.perf_counter() - start


def _clicks(running: Browser, address: str, root: Path) -> list[float]:
    """Milliseconds from the click to the numbers, each at a place not asked before."""
    known = np.argwhere(open_run(root).field.count() > 0)
    places = np.random.default_rng(0).choice(known, _CLICKS, replace=False)
    taken = []
    with running.page() as page:
        for y, x in places.tolist():
            page.open("about:blank")
            page.open(f"{address}#view={x},{y},2")
            page.wait(_STANDS)
            click_pixel(page, x, y)
            page.wait("document.getElementById('answer').dataset.milliseconds !== undefined")
            taken.append(float(page.value("document.getElementById('answer').dataset.milliseconds")))
    return taken


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m tests.benchmarks.viewer RUN")
    main(Path(sys.argv[1]))
