"""The pages by axe-core's rules (WCAG 2 A and AA, and its best practices), in light and dark, wide and narrow."""

from pathlib import Path

import pytest

from tests.browser import NEEDS_PAGE, Browser, served
from velfield import open_run

AXE = Path(__file__).resolve().parents[2] / "page" / "node_modules" / "axe-core" / "axe.min.js"
FINDINGS = """axe.run(document).then(({violations, passes}) => ({passes: passes.length, violations: violations.map(
  ({id, nodes}) => [id, ...nodes.map(({target, failureSummary}) => [target.join(' '), failureSummary])])}))"""

pytestmark = [
    NEEDS_PAGE,
    pytest.mark.skipif(not AXE.exists(), reason="axe-core is not installed: `npm ci` in page/, as `make page` does"),
]


@pytest.mark.parametrize(("width", "height", "scheme"), [(1400, 900, "light"), (390, 800, "dark")])
def test_axe_has_no_findings(chromium: Browser, whole: Path, width: int, height: int, scheme: str) -> None:
    count = open_run(whole).field.count()
    y, x = divmod(int(count.argmax()), count.shape[1])
    with served(whole) as address, chromium.page(width=width, height=height) as page:
        page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        for state, ready in (
            (f"pixel={x},{y}&replay=1", "document.querySelector('#answer details.tracks') !== null"),
            ("line=10,200,600,200", "document.querySelector('#answer h3') !== null"),
            ("tab=summary", "document.querySelector('#summary-panel').hidden === false"),
        ):
            page.open("about:blank")
            page.open(f"{address}#{state}")
            page.wait(ready)
            page.value(f"{AXE.read_text()};0")
            found = page.value(FINDINGS)
            assert found["passes"] > 10
            assert found["violations"] == [], state
