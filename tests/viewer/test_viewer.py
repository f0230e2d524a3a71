"""The page of a run in a real browser, from a plain static server: it shows the values that Python gives."""

import json
import re
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.browser import MIDDLE_OF_MAP, NEEDS_PAGE, Browser, Page, served
from velfield.analysis import coverage
from velfield.report.figures import colour_scale_max, round_up
from velfield.run.layout import RunLayout
from velfield.run.run import Run
from velfield.run.stores import FieldStore

pytestmark = NEEDS_PAGE


@pytest.fixture
def page(chromium: Browser, address: str) -> Iterator[Page]:
    """A page that complains of nothing and asks no other host for anything."""
    with chromium.page() as opened:
        yield opened
        assert opened.complaints == []
        assert [r for r in opened.requests if not r.startswith((address, "data:", "blob:"))] == []


def shown_value(page: Page, name: str) -> Any:
    """The number behind a cell of the answer."""
    return json.loads(page.value(f"document.querySelector('#answer [data-name={name}]').dataset.value"))


def busiest(run: Run) -> tuple[int, int]:
    count = run.field.count()
    y, x = np.unravel_index(int(count.argmax()), count.shape)
    return int(x), int(y)


def across_the_busiest(run: Run) -> tuple[float, float, float, float]:
    """A line of 60 px across the way of the vehicles there: x and y of its start and its end."""
    x, y = busiest(run)
    vx, vy = run.field.at(x, y).modal_velocity_px_per_s * 30 / np.hypot(*run.field.at(x, y).modal_velocity_px_per_s)
    return x - vy, y + vx, x + vy, y - vx


def click_pixel(page: Page, x: float, y: float) -> None:
    """Click a base pixel, the map standing at zoom 3 around it."""
    page.click(*page.value(MIDDLE_OF_MAP))
    page.wait(f"document.querySelector('#answer h2')?.textContent === 'Pixel ({x}, {y})'")


ANSWERED = "document.querySelector('#answer [data-name=n]') !== null"


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, None], ids=lambda share: str(share or "the busiest"))
def test_a_click_shows_the_values_of_python(page: Page, address: str, run: Run, share: float | None) -> None:
    """At places all over the map: so many of those that vehicles passed lie above."""
    passed = np.argwhere(run.field.count() > 0)
    y, x = busiest(run)[::-1] if share is None else passed[int(share * len(passed))].tolist()
    page.open(f"{address}#view={x},{y},3")
    page.wait("document.querySelector('.overlay .leaflet-tile-loaded') !== null")
    click_pixel(page, x, y)
    here = run.field.at(x, y)
    assert shown_value(page, "n") == here.n
    vx, vy = here.modal_velocity_px_per_s
    assert shown_value(page, "direction") == pytest.approx(np.arctan2(vy, vx), abs=1e-5)
    assert shown_value(page, "modal_speed") == pytest.approx(np.hypot(vx, vy), rel=1e-5)
    assert shown_value(page, "stationary_fraction") == pytest.approx(here.stationary_fraction, abs=1e-6)
    median = here.percentiles_px_per_s[50]
    assert shown_value(page, "speed_p50") == pytest.approx(median, rel=1e-5)
    shown = page.value("document.querySelector('#answer [data-name=speed_p50]').textContent")
    assert shown == f"{median * 0.23 * 3.6:.1f} km/h"
    assert page.value("document.querySelector('#answer canvas').getContext('2d') !== null")
    assert page.value("document.querySelectorAll('#answer [data-name^=mode_]').length") == len(here.modes)
    for k, mode in enumerate(here.modes):
        np.testing.assert_allclose(shown_value(page, f"mode_{k}"), mode, rtol=1e-4, atol=0.02)


NAMES = "[...document.querySelectorAll('#answer [data-name]')].map((each) => each.dataset.name)"


def test_p15_and_p85_of_few_vehicles_are_withheld_and_the_page_says_so(page: Page, address: str, run: Run) -> None:
    x, y = busiest(run)
    n = run.field.at(x, y).n
    assert 1 < n < 19, "the test needs a place that few vehicles passed"
    page.open(f"{address}#pixel={x},{y}")
    page.wait(ANSWERED)
    names = page.value(NAMES)
    assert "speed_p50" in names
    assert not {"speed_p15", "speed_p85"} & set(names)
    caution = page.value("document.querySelector('#answer [data-name=caution]').textContent")
    assert f"The 15th and 85th percentiles need 19 vehicles; {n} passed here." in caution
    assert ("The median of fewer than 5 is uncertain." in caution) == (n < 5)
    page.open("about:blank")
    page.open(f"{address}#line={','.join(map(str, across_the_busiest(run)))}")
    page.wait("document.querySelector('#answer [data-name=forward_count]') !== null")
    names, crossed = page.value(NAMES), 0
    for way in ("forward", "back"):
        if n := shown_value(page, f"{way}_count"):
            crossed += 1
            assert f"{way}_p50" in names
            assert not {f"{way}_p15", f"{way}_p85"} & set(names)
            caution = page.value(f"document.querySelector('#answer [data-name={way}_caution]').textContent")
            assert f"need 19 vehicles; {n} crossed this way." in caution
    assert crossed


@pytest.fixture
def of_few(linked: Path) -> Iterator[str]:
    """The same run, were one vehicle enough for a percentile."""
    path = linked / "view" / "run.json"
    record = json.loads(path.read_bytes())
    assert record["vehicles_for_percentile"] == {"15": 19, "50": 5, "85": 19}
    path.unlink()
    path.write_text(json.dumps({**record, "vehicles_for_percentile": {"15": 1, "50": 1, "85": 1}}))
    with served(linked) as there:
        yield there


def test_percentiles_of_enough_vehicles_are_those_of_python(chromium: Browser, of_few: str, run: Run) -> None:
    x, y = busiest(run)
    ends = across_the_busiest(run)
    with chromium.page() as page:
        page.open(f"{of_few}#pixel={x},{y}")
        page.wait(ANSWERED)
        for percent, speed in run.field.at(x, y).percentiles_px_per_s.items():
            assert shown_value(page, f"speed_p{percent}") == pytest.approx(speed, rel=1e-5)
            shown = page.value(f"document.querySelector('#answer [data-name=speed_p{percent}]').textContent")
            assert shown == f"{speed * 0.23 * 3.6:.1f} km/h"
        assert "need" not in page.value("document.querySelector('#answer [data-name=caution]').textContent")
        page.open("about:blank")
        page.open(f"{of_few}#line={','.join(map(str, ends))}")
        page.wait("document.querySelector('#answer [data-name=forward_count]') !== null")
        crossings, ways = run.crossings(ends[:2], ends[2:]), 0
        for name, direction in (("forward", 1), ("back", -1)):
            part = crossings[crossings["direction"] == direction]
            if len(part):
                ways += 1
                found = [shown_value(page, f"{name}_p{percent}") for percent in (15, 50, 85)]
                np.testing.assert_allclose(found, np.percentile(part["speed_px_per_s"], (15, 50, 85)), rtol=1e-4)
                assert f"{name}_caution" not in page.value(NAMES)
        assert ways
        assert page.complaints == []


@pytest.fixture
def north_up(linked: Path) -> Iterator[str]:
    """The same run, had its base image north at its upper edge."""
    path = linked / "view" / "run.json"
    record = json.loads(path.read_bytes())
    path.unlink()
    path.write_text(json.dumps({**record, "north_rad": -np.pi / 2}))
    with served(linked) as there:
        yield there


def beside(run: Run, away: int) -> tuple[int, int]:
    """A pixel that no vehicle passed, so far above one that was passed, none nearer."""
    count = run.field.count()
    height, width = count.shape
    for y, x in np.argwhere(count > 0).tolist():
        if away <= y < height - away and away <= x < width - away:
            around = count[y - 2 * away : y, x - away : x + away + 1]
            if around.size and not around.any():
                return x, y - away
    raise AssertionError("no such place")


def test_a_tap_beside_a_lane_means_the_lane_where_a_screen_pixel_is_many(page: Page, address: str, run: Run) -> None:
    x, y = beside(run, 3)
    page.open(f"{address}#view={x},{y},1")
    page.wait("document.querySelector('.overlay .leaflet-tile-loaded') !== null")
    page.click(*page.value(MIDDLE_OF_MAP))
    page.wait(ANSWERED)
    away = shown_value(page, "away")
    pixel = [int(part) for part in page.value("new URLSearchParams(location.hash.slice(1)).get('pixel')").split(",")]
    assert page.value("document.querySelector('#answer h2').textContent") == f"Pixel ({pixel[0]}, {pixel[1]})"
    assert away == pytest.approx(np.hypot(pixel[0] - x, pixel[1] - y), abs=1.0)
    assert 2 < away <= 4
    assert shown_value(page, "n") == run.field.at(*pixel).n > 0
    assert "m away" in page.value("document.querySelector('#answer').textContent")


def test_where_a_map_pixel_is_wider_than_a_finger_the_click_means_itself(page: Page, address: str, run: Run) -> None:
    x, y = beside(run, 1)
    page.open(f"{address}#view={x},{y},3")
    page.wait("document.querySelector('.overlay .leaflet-tile-loaded') !== null")
    click_pixel(page, x, y)
    assert shown_value(page, "n") == 0


def test_degrees_name_their_reference_direction(chromium: Browser, address: str, north_up: str, run: Run) -> None:
    goes = np.where(np.isfinite(run.field.modal_direction_rad()), run.field.count(), 0)
    y, x = (int(k) for k in np.unravel_index(int(goes.argmax()), goes.shape))
    vx, vy = run.field.at(x, y).modal_velocity_px_per_s
    degrees = f"{round(np.degrees(np.arctan2(vx, -vy))) % 360}°"
    with chromium.page() as page:
        for there, counted_from in ((address, " from up"), (north_up, " [NESW]{1,2}")):
            page.open(f"{there}#pixel={x},{y}&view={x},{y},3")
            page.wait(ANSWERED)
            direction = page.value("document.querySelector('#answer [data-name=direction]').closest('td').textContent")
            assert re.search(rf"{degrees} .*{counted_from.strip()}$", direction)
            page.mouse("mouseMoved", *page.value(MIDDLE_OF_MAP))
            page.wait("document.getElementById('readout').textContent.includes('vehicle')")
            readout = page.value("document.getElementById('readout').textContent")
            assert readout.startswith(f"({x}, {y})")
            assert re.search(rf"{degrees}{counted_from} ", readout)
            assert f"{np.hypot(vx, vy) * 0.23 * 3.6:.1f} km/h" in readout
            titles = page.value("[...document.querySelectorAll('#answer thead th')].map((cell) => cell.textContent)")
            assert ("From up" in titles) == (there == address)
            page.open("about:blank")
        page.open(f"{address}#line=10,200,600,200")
        page.wait("document.querySelector('#answer h3') !== null")
        assert page.value("document.querySelector('#answer h3').textContent").endswith("towards 180° from up")


def test_the_labels_of_a_histogram_do_not_touch(page: Page, address: str, run: Run) -> None:
    height, width = run.field.shape
    page.open(f"{address}#line=0,0,{width},{height}")
    page.wait("document.querySelector('#answer svg text') !== null")
    boxes = page.value(
        "[...document.querySelector('#answer svg').querySelectorAll('text')].map((text) => "
        "(({left, right, top, bottom}) => [left, right, top, bottom])(text.getBoundingClientRect()))"
    )
    texts = page.value("[...document.querySelector('#answer svg').querySelectorAll('text')].map((t) => t.textContent)")
    assert len(texts) >= 4
    assert [text for text in texts if not text.isdecimal()] == ["km/h"]
    for k, (left, right, top, bottom) in enumerate(boxes):
        for other in boxes[k + 1 :]:
            assert right < other[0] or other[1] < left or bottom < other[2] + 2 or other[3] < top + 2


def test_the_page_colours_speeds_as_the_figure_does_and_notes_what_is_cut_off(
    page: Page, address: str, whole: Path
) -> None:
    store = FieldStore(RunLayout(whole).field)
    modal = np.hypot(store.layer("modal_vx"), store.layer("modal_vy")).astype(np.float64) * 0.23 * 3.6
    reach = colour_scale_max(modal)
    assert reach is not None
    page.open(address)
    page.wait("document.querySelector('#layer option') !== null")
    cut_off = []
    for layer, values in (("speed", modal), ("speed_p50_ci90_upper", store.layer("speed_p50_ci90_upper") * 0.23 * 3.6)):
        page.value(f"layer.value = '{layer}'; layer.dispatchEvent(new Event('change'))")
        top = float(page.value("[...document.querySelectorAll('#legend .ticks span')].at(-1).textContent"))
        assert top == round_up(reach)
        legend = page.value("document.getElementById('legend').textContent")
        note = f"Values above {top:g} have the last colour; the maximum is {np.nanmax(values):.3g} km/h"
        cut_off.append(note in legend)
        assert cut_off[-1] == bool(np.nanmax(values) > top)
    assert cut_off[-1], "the test needs a layer that is cut off"


def test_the_line_counts_as_python_does(page: Page, address: str, run: Run) -> None:
    crossed = 0
    height, width = run.field.shape
    for ends in (
        (10, height / 2, width - 10, height / 2),
        (width / 2, 10, width / 2, height - 10),
        (0, 0, width, height),
    ):
        page.open("about:blank")
        page.open(f"{address}#line={','.join(map(str, ends))}")
        page.wait("document.querySelector('#answer [data-name=forward_count]') !== null")
        crossings = run.crossings(ends[:2], ends[2:])
        crossed += len(crossings)
        for name, direction in (("forward", 1), ("back", -1)):
            part = crossings[crossings["direction"] == direction]
            assert shown_value(page, f"{name}_count") == len(part)
            if len(part):
                speed = float(np.percentile(part["speed_px_per_s"], 50))
                assert shown_value(page, f"{name}_p50") == pytest.approx(speed, rel=1e-4)
    assert crossed > 3


def test_a_line_is_drawn_by_two_clicks_and_by_the_keyboard(page: Page, address: str) -> None:
    page.open(address)
    page.wait("document.getElementById('draw-line') !== null && document.querySelector('#layer option') !== null")
    page.value("document.getElementById('draw-line').click()")
    left, top = page.value("(({left, top}) => [left, top])(map.getBoundingClientRect())")
    page.click(left + 200, top + 300)
    page.click(left + 600, top + 300)
    page.wait("document.querySelector('#answer [data-name=forward_count]') !== null")
    assert "line=" in page.value("location.hash")
    page.value("document.getElementById('map').focus()")
    page.key("Enter", 13)
    page.wait("document.querySelector('#answer h2').textContent.startsWith('Pixel')")
    assert "line=" not in page.value("location.hash")


def test_a_link_holds_the_view(page: Page, address: str, run: Run) -> None:
    x, y = busiest(run)
    page.open(f"{address}#layer=speed_p85&unit=mph&opacity=40&min_vehicles=2&view={x},{y},1&pixel={x},{y}")
    page.wait(ANSWERED)
    shown = {
        name: page.value(f"document.getElementById('{name}').value")
        for name in ("layer", "unit", "opacity", "min-vehicles")
    }
    assert shown == {"layer": "speed_p85", "unit": "mph", "opacity": "40", "min-vehicles": "2"}
    speed = run.field.at(x, y).percentiles_px_per_s[50] * 0.23 * 2.2369362920544
    assert page.value("document.querySelector('#answer [data-name=speed_p50]').textContent") == f"{speed:.1f} mph"
    page.value("document.getElementById('layer').value = 'count'; layer.dispatchEvent(new Event('change'))")
    assert "layer=count" in page.value("location.hash")
    assert f"pixel={x},{y}" in page.value("location.hash")


def test_every_layer_is_explained_and_painted(page: Page, address: str) -> None:
    page.open(address)
    page.wait("document.querySelector('#layer option') !== null")
    options = page.value("[...document.querySelectorAll('#layer option')].map(({value, title}) => [value, title])")
    assert len(options) == 17
    painted = """(() => [...document.querySelectorAll('.overlay .leaflet-tile-loaded canvas')].some((canvas) => {
      const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext('2d', {willReadFrequently: true});
      copy.drawImage(canvas, 0, 0);
      return copy.getImageData(0, 0, canvas.width, canvas.height).data.some((value) => value > 0);
    }))()"""
    for name, explanation in options:
        assert explanation.endswith(".")
        page.value(f"layer.value = '{name}'; layer.dispatchEvent(new Event('change'))")
        assert page.value("layer.title") == explanation
        assert page.value("document.querySelector('#legend .note').textContent").startswith(explanation)
        page.wait(painted)


def test_tracks_under_the_cursor(page: Page, address: str, run: Run) -> None:
    x, y = busiest(run)
    page.open(f"{address}#view={x},{y},3&tracks=1&pixel={x},{y}")
    page.wait("document.querySelector('#answer details.tracks') !== null")
    near = int(page.value("document.querySelector('#answer details.tracks').dataset.count"))
    assert 0 < near <= run.field.at(x, y).n + 2  # tracks within a pixel and a half; the field's band is wider or not


def test_the_summary_is_the_report(page: Page, address: str) -> None:
    page.open(f"{address}#tab=summary")
    page.wait("document.querySelector('#summary-panel').hidden === false")
    text = page.value("document.getElementById('summary-panel').innerText")
    for words in ("Direction of travel", "Registration", "Candidates", "Inputs"):
        assert words in text
    trained = "Precision and recall of the detector that this run trained on labelled frames of the flight. This run"
    assert re.search(
        trained + r" measured them on \d+ labelled cars in stripes of the images, detected after half", text
    )
    page.wait("[...document.querySelectorAll('figure img')][0].naturalWidth > 300")


def test_a_short_clip_is_marked_as_of_few_vehicles_a_pixel(page: Page, address: str, run: Run) -> None:
    count = run.field.count()
    known, well = int((count > 0).sum()), int((count >= 5).sum())
    assert well < known / 20, "the test needs a short clip"
    page.open(f"{address}#tab=summary")
    page.wait("!document.querySelector('#summary-panel').hidden && document.getElementById('coverage-note').innerText")
    for place in ("#coverage-note", "#summary-panel .coverage-note"):
        text = page.value(f"document.querySelector('{place}').textContent")
        assert (
            "Where fewer passed, directions and speeds are those of single vehicles, and of what was taken for one"
            in text
        )
    facts = dict(
        page.value(
            "[...document.querySelectorAll('.facts dl div')].map((d) => [...d.children].map((c) => c.textContent))"
        )
    )
    states = run.vehicles()["state"].value_counts()
    assert facts["vehicles that move or wait in a lane"] == str(states["moving"] + states["stopped"])
    assert facts["more that stand throughout: see the notes"] == str(states["parked"])
    assert ("Only looks tell" in page.value("document.querySelector('.notes').textContent")) == (states["parked"] > 0)
    assert facts["of the map, passed by vehicles"] == coverage.percent(known, count.size)
    assert facts["of these pixels, by 5 vehicles or more"] == coverage.percent(well, known)


PLOTS = """[...document.querySelectorAll('img.plot')].filter((plot) => plot.checkVisibility()).map((plot) =>
  [plot.src, plot.getBoundingClientRect().width / plot.naturalWidth])"""
LABELS = """[...document.querySelectorAll('text')].map((text) => text.getBoundingClientRect()).map(
  ({left, right, top, bottom}) => [left, right, top, bottom])"""


@pytest.mark.parametrize("width", [390, 1400])
def test_the_labels_of_the_plots_can_be_read_on_any_screen(
    chromium: Browser, address: str, tmp_path: Path, width: int
) -> None:
    with chromium.page(width=width, height=844) as opened:
        opened.open(f"{address}#tab=summary")
        opened.wait("document.querySelector('#summary-panel').hidden === false")
        plots = opened.value(PLOTS)
        assert plots
        for source, scale in plots:
            (tmp_path / "plot.svg").write_bytes(b64decode(source.partition(",")[2]))
            opened.open((tmp_path / "plot.svg").as_uri())
            boxes = scale * np.array(opened.value(LABELS))
            assert len(boxes) > 4
            assert min(bottom - top for _, _, top, bottom in boxes) >= 13  # a letter of 11 px or more
            for k, (left, right, top, bottom) in enumerate(boxes):
                for a, b, c, d in boxes[k + 1 :]:
                    assert right < a or b < left or bottom < c + 3 or d < top + 3


@pytest.mark.parametrize("tab", ["map", "summary"])
def test_a_small_screen_shows_it_without_scrolling_sideways(
    chromium: Browser, address: str, run: Run, tab: str
) -> None:
    x, y = busiest(run)
    with chromium.page(width=390, height=844) as small:
        small.open(f"{address}#tab={tab}&pixel={x},{y}")
        small.wait(ANSWERED)
        assert small.value("document.documentElement.scrollWidth") <= 390
        if tab == "map":
            assert small.value("map.getBoundingClientRect().height") > 300


def test_opened_from_the_disk_it_names_the_command(chromium: Browser, whole: Path) -> None:
    with chromium.page() as opened:
        opened.open((whole / "index.html").as_uri())
        opened.wait("document.querySelector('#map .alarm') !== null")
        assert "velfield view RUN" in opened.value("document.querySelector('#map .alarm').textContent")
        assert opened.value("document.getElementById('summary-panel').hidden") is False
