"""Frames a second of the flow animation in a window of 2560x1920, what a frame costs, and the most that is possible.

python -m tests.benchmarks.animation RUN

The most that is possible: an empty page with one canvas of 2560x1920 on which one square changes, in the same browser.
Processor time is of Chromium's processes, from the system: that of the page (script and canvas) and the compositor.
"""

import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.browser import Browser, Page, browser, served

_SIZE = (2560, 1920)
_SETTLE_S, _MEASURE_S = 12.0, 6.0  # the page chooses its canvas by the first seconds
_COUNT = """(() => {
  window.frames_ = 0;
  const count = () => { frames_++; requestAnimationFrame(count); };
  requestAnimationFrame(count);
})()"""
_EMPTY = """(() => {
  document.body.style.margin = 0;
  const canvas = document.createElement('canvas');
  [canvas.width, canvas.height] = [2560, 1920];
  document.body.replaceChildren(canvas);
  const context = canvas.getContext('2d', {alpha: false});
  const paint = (now) => {
    context.fillStyle = `hsl(${now % 360} 80% 50%)`;
    context.fillRect((now / 3) % 2400, (now / 5) % 1800, 60, 60);
    requestAnimationFrame(paint);
  };
  requestAnimationFrame(paint);
})()"""
_CANVAS = "(({width, height}) => `${width}x${height}`)(document.querySelector('canvas.animation'))"


def main(root: Path) -> None:
    """Serve the run folder, measure, print."""
    with served(root) as address, tempfile.TemporaryDirectory() as profile, browser(Path(profile)) as running:
        with running.page(width=_SIZE[0], height=_SIZE[1]) as page:
            page.open("about:blank")
            page.value(_EMPTY)
            time.sleep(1)
            print(f"empty page, one canvas: {_measure(page, running)}")
        with running.page(width=_SIZE[0], height=_SIZE[1]) as page:
            page.open(f"{address}#tab=map&flow=1")
            page.wait("Number(document.querySelector('canvas.animation')?.dataset.framesPerSecond) > 0")
            time.sleep(_SETTLE_S)
            print(f"flow animation: {_measure(page, running)}; canvas {page.value(_CANVAS)}")


def _measure(page: Page, running: Browser) -> str:
    page.value(_COUNT)
    before, frames, start = _cpu_s(running), page.value("frames_"), time.perf_counter()
    time.sleep(_MEASURE_S)
    n, taken, spent = page.value("frames_") - frames, time.perf_counter() - start, _cpu_s(running)
    cost = ", ".join(f"{kind} {1000 * (spent[kind] - before[kind]) / n:.1f} ms" for kind in ("renderer", "gpu-process"))
    return f"{n / taken:.1f} frames a second; a frame: {cost} of processor; load {os.getloadavg()[0]:.0f}"


def _cpu_s(running: Browser) -> Counter[str]:
    """Processor time of the browser's processes by their type."""
    found: Counter[str] = Counter()
    for process in running.process.children(recursive=True):
        kind = next((a.removeprefix("--type=") for a in process.cmdline() if a.startswith("--type=")), "other")
        times = process.cpu_times()
        found[kind] += times.user + times.system
    return found


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m tests.benchmarks.animation RUN")
    main(Path(sys.argv[1]))
