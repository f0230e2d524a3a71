"""Animations of the page: the replay's files and the draws of the flow, read back; both in a real browser."""

import base64
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from schemas.analysis import (
    AnalysisColumn,
    AnalysisRecord,
    AnalysisRow,
    AnalysisTable,
    EstimateRecord,
    GeometryRecord,
    NameRecord,
)
from schemas.arrays import IntArray
from schemas.view import ViewRecord
from tests.browser import MIDDLE_OF_MAP, NEEDS_PAGE, Browser, Page, served
from velfield.analysis.vehicle_classes import CLASS_NAMES
from velfield.analysis.vehicles import STATES
from velfield.field.segments import SEGMENT_DTYPE, stationary_speed_px_per_s
from velfield.report.colours import direction_colours, ramp_colours
from velfield.run.layout import RunLayout
from velfield.run.run import Run
from velfield.run.stores import FieldStore
from velfield.viewer.flow import DRAWS, _draw_tile
from velfield.viewer.replay import CHUNK_S, chunk_count, position_step, replay_chunks, vehicle_paths

PAINTED = """(() => {
  const canvas = document.querySelector('canvas.animation');
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext('2d', {willReadFrequently: true});
  copy.drawImage(canvas, 0, 0);
  const data = copy.getImageData(0, 0, canvas.width, canvas.height).data;
  const found = [];
  for (let k = 0; k < data.length; k += 4) if (data[k] > 200 && data[k + 3] > 200) found.push(k / 4);
  return {width: canvas.width, found};
})()"""
# The page makes the canvas a moment after it is loaded.
PAINTED_PX = f"document.querySelector('canvas.animation') !== null && ({PAINTED}).found.length"


@pytest.fixture(scope="module")
def record(whole: Path) -> ViewRecord:
    return ViewRecord.model_validate_json(RunLayout(whole).view_record.read_bytes())


def decode(data: bytes, step_px: float) -> dict[int, dict[str, np.ndarray]]:
    """Vehicle -> its times, positions and gaps, by the format's description alone."""
    n, m = np.frombuffer(data, "<u4", 2)
    vehicle, first = np.frombuffer(data, "<u4", 2 * n, 8).reshape(2, n)
    at = 8 + 8 * n
    time_s = np.frombuffer(data, "<f4", m, at)
    x, y = np.frombuffer(data, "<u2", 2 * m, at + 4 * m).reshape(2, m) * step_px - 0.5
    state, axis = np.frombuffer(data, np.uint8, 2 * n, at + 8 * m).reshape(2, n)
    gap = np.frombuffer(data, np.uint8, m, at + 8 * m + 2 * n)
    kind, percent, length = np.frombuffer(data, np.uint8, 3 * n, at + 9 * m + 2 * n).reshape(3, n)
    assert len(data) == at + 9 * m + 5 * n
    parts = np.split(np.arange(m), first[1:])[:n]
    return {
        int(name): {"t": time_s[rows], "x": x[rows], "y": y[rows], "gap": gap[rows], "state": state[k], "axis": axis[k]}
        | {"class": kind[k], "percent": percent[k], "length": length[k]}
        for k, (name, rows) in enumerate(zip(vehicle, parts, strict=True))
    }


def made_segments(rows: list[tuple[int, float, float, float, float]]) -> np.ndarray:
    """Segments of half a second along x: (track, start, x0, x1, y)."""
    made = np.zeros(len(rows), SEGMENT_DTYPE)
    for k, (track, start, x0, x1, y) in enumerate(rows):
        made[k] = (track, start, 0.5, x0, y, x1, y, 2 * (x1 - x0), 0, 0, 0, 0)
    return made


def test_a_long_flight_is_cut_by_time_and_each_part_holds_all_of_its_time() -> None:
    rows = [(7, 100 + 0.5 * k, 4.0 * k, 4.0 * (k + 1), 20.0) for k in range(60)]  # 30 s, from 100 s on
    rows += [(9, 102.0, 50.0, 52.0, 5.0), (9, 118.0, 80.0, 83.0, 5.0)]  # unseen for 15.5 s
    segments = made_segments(rows)
    vehicles = pd.DataFrame({"state": ["moving", "moving"], "orientation_rad": [0.0, np.nan]}).assign(
        vehicle_class=["lorry or bus", None], class_probability=[0.934, np.nan], length_m=[11.26, np.nan]
    )
    paths = vehicle_paths(segments, np.zeros(2, bool))
    chunks = list(replay_chunks(paths, vehicles, first_time_s=100.0, duration_s=30.0, step_px=0.01))
    assert len(chunks) == chunk_count(30.0) == 4
    for k, chunk in enumerate(chunks[:3]):
        there = decode(chunk, 0.01)
        assert (there[0]["t"][0], there[0]["t"][-1]) == pytest.approx((10 * k, 10 * k + 10), abs=0.51)
        np.testing.assert_allclose(there[0]["x"], 8 * there[0]["t"], atol=0.01)
        assert CLASS_NAMES[there[0]["class"] - 1] == "lorry or bus"
        assert (there[0]["percent"], there[0]["length"]) == (93, 113)
        assert there.get(1, {"class": 0})["class"] == 0
        if k < 2:
            middle = there[1]
            assert (middle["t"][0] <= CHUNK_S * k) or k == 0
            assert middle["gap"].tolist().count(1) == 1
            assert np.interp(10.25, middle["t"], middle["x"]) == pytest.approx(66, abs=0.1)
    assert max(map(len, chunks)) < 300  # of 60 positions a vehicle, 21 in each


def test_what_is_parked_stands_still() -> None:
    jitter = np.random.default_rng(4).normal(0, 0.4, 41)
    rows = [(3, 0.5 * k, 100 + jitter[k], 100 + jitter[k + 1], 30.0) for k in range(40)]
    paths = vehicle_paths(made_segments(rows), np.ones(1, bool))
    assert paths.time_s.tolist() == [0.0, 20.0]
    assert np.ptp(paths.x_px) == 0
    assert paths.x_px[0] == pytest.approx(100, abs=0.3)


def test_no_vehicles_make_files_too() -> None:
    paths = vehicle_paths(np.zeros(0, SEGMENT_DTYPE), np.zeros(0, bool))
    numbers = ("orientation_rad", "class_probability", "length_m")
    vehicles = pd.DataFrame({"state": [], "vehicle_class": []} | {name: np.zeros(0) for name in numbers})
    (chunk,) = replay_chunks(paths, vehicles, first_time_s=0.0, duration_s=3.0, step_px=1.0)
    assert decode(chunk, 1.0) == {}


def test_each_vehicle_of_the_replay_is_drawn_by_its_own_row(run: Run, record: ViewRecord) -> None:
    """Where there are doubtful tracks, which have rows of `vehicles` and no segments."""
    assert run.vehicles(doubtful=True)["doubtful"].any()
    tracks = np.unique(run.segments()["track"])
    vehicles = run.vehicles().set_index("track_id")
    shown = set()
    for path in sorted((run.layout.view / "replay").glob("*.bin")):
        for number, drawn in decode(path.read_bytes(), position_step(record.width_px, record.height_px)).items():
            row = vehicles.loc[tracks[number]]
            assert STATES[drawn["state"]] == row["state"]
            assert drawn["length"] == round(10 * row["length_m"])
            shown.add(number)
    assert len(shown) == len(vehicles)


def draw_bins(weights: IntArray) -> IntArray:
    """(n, DRAWS) systematic sample of bins with these weights (n, bins), each row with some: in plain numpy."""
    cumulative = np.cumsum(weights, axis=1)
    at = (np.arange(DRAWS) + 0.5) / DRAWS * cumulative[:, -1:]
    return np.stack([np.searchsorted(row, where, side="right") for row, where in zip(cumulative, at, strict=True)])


@pytest.mark.parametrize("side", [1, 4])
def test_the_draws_of_a_tile_are_those_from_the_sums_of_its_cells(side: int) -> None:
    rng = np.random.default_rng(side)
    count = rng.integers(0, 3, (8, 12)).astype(np.int32)
    count[:4, 4:8] = 0  # a cell that no vehicle passed
    histogram = rng.integers(0, 2**27, (8, 12, 9, 9)) * (rng.random((8, 12, 9, 9)) < 0.1) * (count > 0)[..., None, None]
    histogram[..., 4, 4] += count > 0
    across = 12 // side
    cells, vehicles, bins = _draw_tile(histogram.astype(np.int32), count, side, across)
    for cell, most, drawn in zip(cells, vehicles, bins, strict=True):
        window = np.s_[cell // across * side :, cell % across * side :]
        here = np.s_[:side, :side]
        assert most == count[window][here].max()
        weights = histogram[window][here].sum(axis=(0, 1)).reshape(1, -1)
        np.testing.assert_array_equal(drawn, draw_bins(weights)[0])
    assert len(cells) == count.reshape(8 // side, side, across, side).any(axis=(1, 3)).sum()


def test_the_flow_holds_the_distribution_of_the_field(run: Run, record: ViewRecord) -> None:
    data = (run.layout.view / "flow.bin").read_bytes()
    n = len(data) // (5 + 2 * DRAWS)
    cells = np.frombuffer(data, "<u4", n)
    bins = np.frombuffer(data, "<u2", n * DRAWS, 5 * n).reshape(n, DRAWS)
    side, width = record.flow.cell_px, run.field.shape[1]
    moving = run.field.modal_speed_px_per_s() > stationary_speed_px_per_s(run.record.config.field, run.grid.gsd_m)
    y, x = np.nonzero(moving)
    assert set(((y // side) * -(-width // side) + x // side).tolist()) <= set(cells.tolist())
    differences, store = [], FieldStore(run.layout.field)
    for k in range(0, n, max(1, n // 40)):
        row, column = divmod(int(cells[k]), -(-width // side))
        y0, x0 = row * side, column * side
        tile = store.read_tile(y0 // store.tile, x0 // store.tile)
        y0, x0 = y0 % store.tile, x0 % store.tile
        total = tile[y0 : y0 + side, x0 : x0 + side].sum(axis=(0, 1), dtype=float).ravel()
        drawn = np.bincount(bins[k], minlength=len(total)) / DRAWS
        differences.append(np.abs(drawn - total / total.sum()).max())
    assert np.median(differences) <= 1 / DRAWS + 1e-9


def vehicle_at(run: Run, time_s: float) -> tuple[float, float, float]:
    """Position and speed over a second of the vehicle that is fastest at a time, px and px/s."""
    segments = run.segments()
    best = (0.0, 0.0, 0.0)
    for track in np.unique(segments["track"]):
        mine = segments[segments["track"] == track]
        t = np.append(mine["start_s"], mine["start_s"][-1] + mine["duration_s"][-1])
        if not t[0] + 0.5 < time_s < t[-1] - 0.5:
            continue
        xy = np.column_stack([np.append(mine[f"{c}0_px"], mine[f"{c}1_px"][-1]) for c in "xy"])
        place = [np.array([np.interp(time_s + s, t, xy[:, k]) for k in (0, 1)]) for s in (-0.5, 0.0, 0.5)]
        speed = float(np.hypot(*(place[2] - place[0])))
        if speed > best[2]:
            best = (float(place[1][0]), float(place[1][1]), speed)
    assert best[2] > 0, "the test needs a vehicle that is seen for a second"
    return best


@NEEDS_PAGE
def test_a_click_on_a_vehicle_of_the_replay_tells_its_speed(chromium: Browser, address: str, run: Run) -> None:
    middle = float(np.nanmedian(run.times_s))
    x, y, speed = vehicle_at(run, middle)
    since = round(middle - float(run.times_s[0]), 1)
    x, y, speed = vehicle_at(run, since + float(run.times_s[0]))
    with chromium.page() as page:
        page.open(f"{address}#replay={since}&view={x},{y},2")
        page.wait(f"{PAINTED_PX} > 0")
        page.click(*page.value(MIDDLE_OF_MAP))
        page.wait("document.querySelector('#answer [data-name=vehicle_speed]') !== null")
        shown = json.loads(page.value("document.querySelector('#answer [data-name=vehicle_speed]').dataset.value"))
        assert shown == pytest.approx(speed, rel=0.02)
        answer = page.value("document.getElementById('answer').innerText")
        vehicle = run.vehicles().iloc[int(re.search(r"Vehicle (\d+)", answer)[1])]
        assert vehicle["vehicle_class"] in CLASS_NAMES, "the test needs a vehicle that was measured"
        percent = f"{100 * vehicle['class_probability']:.0f}".replace("100", "> 99")
        assert re.search(rf"Class\s+{vehicle['vehicle_class']} \({percent} %\)", answer)
        assert re.search(rf"Length\s+{vehicle['length_m']:.1f} m", answer)
        page.value("document.getElementById('play').click()")
        page.wait(f"Number(document.getElementById('time').value) > {since}")
        page.value("document.getElementById('play').click()")
        page.wait(f"Number(new URLSearchParams(location.hash.slice(1)).get('replay')) > {since}")
        page.value("time.value = time.max; time.dispatchEvent(new Event('input'))")
        page.value("document.getElementById('map').focus()")
        page.key("p", 80)
        page.wait("document.getElementById('play').getAttribute('aria-label') === 'Pause'")  # from the start again
        assert page.value("Number(document.getElementById('time').value) < Number(time.max)")
        page.key("r", 82)
        page.wait("document.getElementById('player').hidden")
        assert page.complaints == []


@NEEDS_PAGE
def test_the_analysis_tab_shows_no_replay(chromium: Browser, address: str, run: Run) -> None:
    since = round(float(np.nanmedian(run.times_s) - run.times_s[0]), 1)
    with chromium.page() as page:
        page.open(f"{address}#replay={since}")
        page.wait(f"{PAINTED_PX} > 0")
        page.value("document.getElementById('play').click()")
        page.value("document.getElementById('tab-analysis').click()")
        page.wait("document.querySelector('canvas.animation').hidden && document.getElementById('player').hidden")
        assert page.value("getComputedStyle(document.querySelector('canvas.animation')).display") == "none"
        page.value("document.getElementById('tab-map').click()")
        page.wait("!document.getElementById('player').hidden")
        page.wait(f"{PAINTED_PX} > 0")
        assert page.value("document.getElementById('play').getAttribute('aria-label')") == "Play"
        assert all("analysis.json" in line for line in page.complaints)  # this run has none


@NEEDS_PAGE
def test_a_slow_machine_paints_on_a_coarser_canvas(chromium: Browser, address: str) -> None:
    with chromium.page(width=2560, height=1920) as page:
        page.open(f"{address}#flow=1")
        page.wait("document.querySelector('canvas.animation') !== null")
        width = page.value("document.querySelector('canvas.animation').width")
        # Frames of 40 ms, whatever this machine can do.
        page.value(
            "(() => { const ask = requestAnimationFrame; let last = 0;"
            " window.requestAnimationFrame = (paint) => setTimeout(() => paint((last += 40)), 1); })()"
        )
        page.wait(f"document.querySelector('canvas.animation').width < {0.7 * width}")
        shown = page.value("document.querySelector('canvas.animation').getBoundingClientRect().width")
        smallest = page.value("(({width, height}) => width * height)(document.querySelector('canvas.animation'))")
        assert shown == pytest.approx(width, abs=1)
        assert smallest > 1.0e6
        assert page.complaints == []


@NEEDS_PAGE
def test_particles_move_on_the_roads(chromium: Browser, address: str, run: Run) -> None:
    height, width = run.field.shape
    near = cv2.dilate((run.field.count() > 0).astype(np.uint8), np.ones((41, 41), np.uint8))
    with chromium.page() as page:
        page.open(f"{address}#flow=1&view={width / 2},{height / 2},0")
        page.wait(f"{PAINTED_PX} > 200")
        first = page.value(PAINTED)
        page.wait("Number(document.querySelector('canvas.animation').dataset.framesPerSecond) > 0")
        second = page.value(PAINTED)
        w, h = page.value("(({width, height}) => [width, height])(map.getBoundingClientRect())")
        assert page.complaints == []
    assert set(first["found"]) != set(second["found"])
    y, x = np.divmod(np.array(second["found"]), second["width"])
    x, y = (np.array([x, y]) + 0.5) * w / second["width"]  # a slow machine's canvas is coarser than the screen
    x, y = (x - w / 2 + width / 2).astype(int), (y - h / 2 + height / 2).astype(int)
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    assert near[y[inside], x[inside]].mean() > 0.98


def screen(page: Page) -> np.ndarray:
    """The page as it is seen, without the particles."""
    page.value("document.querySelector('canvas.animation').style.opacity = 0")
    png = base64.b64decode(page.call("Page.captureScreenshot", format="png")["data"])
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR).astype(int)


@NEEDS_PAGE
@pytest.mark.parametrize("zoom", [0, -0.75])
def test_while_particles_move_one_image_stands_for_the_tiles_and_shows_the_same(
    chromium: Browser, address: str, zoom: float
) -> None:
    backdrop, pane = "document.querySelector('canvas.backdrop')", "document.querySelector('.leaflet-tile-pane')"
    with chromium.page() as page:
        page.open(f"{address}#flow=1&opacity=60&view=300,200,{zoom}")
        page.wait(f"{backdrop} !== null && !{backdrop}.hidden")
        assert page.value(f"getComputedStyle({pane}).visibility") == "hidden"
        left, top = page.value(MIDDLE_OF_MAP)
        x, y = slice(int(left) - 300, int(left) + 300), slice(int(top) - 200, int(top) + 200)
        flattened = screen(page)[y, x]
        page.value("document.getElementById('map').focus()")
        page.key("f", 70)
        page.wait(f"{backdrop}.hidden")
        tiles = screen(page)[y, x]
        assert np.ptp(tiles) > 100
        assert np.abs(flattened - tiles).mean() < 0.5
        assert np.quantile(np.abs(flattened - tiles), 0.99) <= (2 if zoom == 0 else 12)
        assert page.complaints == []


@NEEDS_PAGE
def test_tiles_are_shown_while_the_map_is_moved_and_then_the_image_of_the_new_view(
    chromium: Browser, address: str
) -> None:
    backdrop = "document.querySelector('canvas.backdrop')"
    with chromium.page() as page:
        page.open(f"{address}#flow=1")
        page.wait(f"{backdrop} !== null && !{backdrop}.hidden")
        before = screen(page)
        left, top = page.value(MIDDLE_OF_MAP)
        page.mouse("mouseMoved", left, top)
        page.mouse("mousePressed", left, top, 1)
        for step in range(1, 9):
            page.mouse("mouseMoved", left + 8 * step, top, 1)
        assert page.value(f"{backdrop}.hidden")
        page.mouse("mouseReleased", left + 64, top)
        page.wait(f"!{backdrop}.hidden")
        assert np.abs(screen(page) - before).mean() > 1


@NEEDS_PAGE
def test_where_less_motion_is_asked_for_nothing_flows(chromium: Browser, address: str) -> None:
    with chromium.page() as page:
        page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
        page.open(f"{address}#flow=1")
        page.wait("document.getElementById('hint').textContent.includes('reduced motion')")
        assert page.value("document.getElementById('flow').getAttribute('aria-pressed')") == "false"
        assert page.value(PAINTED)["found"] == []


@NEEDS_PAGE
@pytest.mark.parametrize(("ratio", "zoom"), [(1, -0.25), (1.25, 0), (1.5, 0.25)])
def test_no_seam_shows_between_tiles(chromium: Browser, whole: Path, linked: Path, ratio: float, zoom: float) -> None:
    (linked / "view" / "base").unlink()
    for path in (whole / "view" / "base").rglob("*.jpg"):
        even = linked / path.relative_to(whole)
        even.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(even), np.full_like(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), 220))
    with served(linked) as there, chromium.page(width=700, height=500) as page:
        page.call("Emulation.setDeviceMetricsOverride", width=700, height=500, deviceScaleFactor=ratio, mobile=False)
        page.open(f"{there}#opacity=0&view=500.3,300.7,{zoom}")
        page.wait(
            "[...document.querySelectorAll('.base .leaflet-tile')].every((t) => t.matches('.leaflet-tile-loaded'))"
        )
        page.wait("document.querySelectorAll('.base .leaflet-tile-loaded').length >= 2")
        page.wait("getComputedStyle([...document.querySelectorAll('.base .leaflet-tile')].at(-1)).opacity === '1'")
        box = page.value("(({left, top, width, height}) => [left, top, width, height])(map.getBoundingClientRect())")
        png = base64.b64decode(page.call("Page.captureScreenshot", format="png")["data"])
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    x, y = (box[0] + box[2] / 2) * ratio, (box[1] + box[3] / 2) * ratio
    reach = int(60 * ratio)
    around = image[int(y) - reach : int(y) + reach, int(x) - reach : int(x) + reach]
    assert np.ptp(around) <= 1


def made_analysis() -> AnalysisRecord:
    """Two lanes with a speed each, one of them known."""
    speed = EstimateRecord(value=10.0, low=9.0, high=11.5, n=14)
    rows = (
        AnalysisRow(
            cells={"lane": 0, "speed": speed}, geometry=GeometryRecord(type="LineString", xy_px=((9, 9), (90, 9)))
        ),
        AnalysisRow(cells={"lane": 1, "speed": EstimateRecord(n=1)}),
        AnalysisRow(cells={"lane": 2, "speed": EstimateRecord()}, unknown=True),
    )
    columns = (
        AnalysisColumn(name="lane", title="Lane"),
        AnalysisColumn(name="speed", title="Median speed", unit="m/s"),
        AnalysisColumn(name="headway", title="Headway", unit="s", unknown=True),
    )
    table = AnalysisTable(name="speeds", section="Speed", title="Speeds", note="A note.", columns=columns, rows=rows)
    return AnalysisRecord(code_version="0", gsd_m=0.23, gsd_known=True, duration_s=8, tracks=15, tables=(table,))


@NEEDS_PAGE
def test_the_tab_of_the_analysis_shows_tables_with_n_and_intervals(chromium: Browser, linked: Path) -> None:
    (linked / "analysis").mkdir()
    names = {"directions": "N is north", "names": (NameRecord(name="J0", x_px=150, y_px=80),)}
    (linked / "analysis" / "analysis.json").write_text(made_analysis().model_copy(update=names).model_dump_json())
    with served(linked) as there, chromium.page() as page:
        page.open(f"{there}#tab=analysis")
        page.wait("document.querySelector('#analysis tbody') !== null")
        assert "(N is north)" in page.value("document.getElementById('analysis').textContent")
        cells = page.value("[...document.querySelectorAll('#analysis tbody td')].map((cell) => cell.textContent)")
        assert cells == ["●", "0", "36 32.4 to 41.4, n = 14", "", "1", "–"]
        titles = page.value("[...document.querySelectorAll('#analysis thead th')].map((cell) => cell.textContent)")
        assert titles == ["Map", "Lane", "Median speed, km/h"]
        left_out = "Not known, and left out here (analysis/analysis.xlsx has all): 1 row, “Headway”."
        assert left_out in page.value("document.getElementById('analysis').textContent")
        labels = page.value("[...document.querySelectorAll('#map .place-label')].map((each) => each.textContent)")
        assert labels == ["J0", "➤0"]  # the second row has no place
        page.value("document.querySelector('#analysis .place').click()")
        assert page.value("document.getElementById('side').hidden")
        assert page.complaints == []


LABELS = """[...document.querySelectorAll('#map .place-label')].filter((each) => each.checkVisibility()).map((each) =>
  (({left, right, top, bottom}) => [each.textContent, left, right, top, bottom])(each.getBoundingClientRect()))"""


@NEEDS_PAGE
def test_no_label_of_the_analysis_covers_another(chromium: Browser, linked: Path, run: Run) -> None:
    height, width = run.field.shape
    x, y = width / 2, height / 2
    lines = (
        ((x - 150, y), (x + 150, y)),
        ((x, y - 150), (x, y + 150)),  # crosses it in its middle: its label moves
        ((x - 2, y), (x + 2, y)),  # has no other place: its label is left out
    )
    geometries = [GeometryRecord(type="LineString", xy_px=line) for line in lines]
    rows = tuple(AnalysisRow(cells={"lane": k}, geometry=geometry) for k, geometry in enumerate(geometries))
    table = made_analysis().tables[0].model_copy(update={"rows": rows})
    (linked / "analysis").mkdir()
    path = linked / "analysis" / "analysis.json"
    path.write_text(made_analysis().model_copy(update={"tables": (table,)}).model_dump_json())
    with served(linked) as there, chromium.page() as page:
        page.open(f"{there}#tab=analysis&view={x},{y},0")
        page.wait("document.querySelector('#analysis tbody') !== null")
        shown = page.value(LABELS)
        assert [text for text, *_ in shown] == ["➤0", "➤1"]
        (_, left, right, top, bottom), (_, a, b, c, d) = shown
        assert right < a or b < left or bottom < c or d < top
        page.value("document.querySelectorAll('#analysis .place')[2].click()")  # the chosen one comes first
        assert "➤2" in [text for text, *_ in page.value(LABELS)]
        page.value("document.querySelector('.leaflet-control-zoom-out').click()")
        page.wait("new URLSearchParams(location.hash.slice(1)).get('view').split(',')[2] < 0")
        assert page.complaints == []


@NEEDS_PAGE
@pytest.mark.parametrize("width", [800, 1400])
def test_the_map_shows_the_same_place_where_the_panel_is_wider(
    chromium: Browser, linked: Path, run: Run, width: int
) -> None:
    (linked / "analysis").mkdir()
    (linked / "analysis" / "analysis.json").write_text(made_analysis().model_dump_json())
    view = "new URLSearchParams(location.hash.slice(1)).get('view')"
    with served(linked) as there, chromium.page(width=width, height=900) as page:
        page.open(there)
        page.wait("document.querySelector('#layer option') !== null")
        page.value("document.getElementById('whole').click()")
        before = page.value(view)
        page.value("document.getElementById('tab-analysis').click()")
        page.wait("document.querySelector('#analysis tbody') !== null")
        x, _, zoom = map(float, page.value(view).split(","))
        half = page.value("map.clientWidth") / 2 / 2**zoom
        assert x - half <= 0
        assert x + half >= run.field.shape[1] - 1
        for tab in ("summary", "analysis", "map"):
            page.value(f"document.getElementById('tab-{tab}').click()")
        assert page.value(view) == before
        assert page.complaints == []


BARE_EDGES = """[...document.querySelectorAll('.overlay canvas')].reduce(([painted, bare], canvas) => {
  const { width, height } = canvas;
  const { data } = canvas.getContext('2d').getImageData(0, 0, width, height);
  const alpha = (x, y) => data[4 * (y * width + x) + 3];
  for (let y = 1; y < height - 1; y++)
    for (let x = 1; x < width - 1; x++) {
      if (alpha(x, y) !== 255) continue;
      painted++;
      bare += [[x - 1, y], [x + 1, y], [x, y - 1], [x, y + 1]].filter(([i, j]) => alpha(i, j) === 0).length;
    }
  return [painted, bare];
}, [0, 0])"""


@NEEDS_PAGE
@pytest.mark.parametrize("layer", ["direction", "speed"])
def test_the_colours_of_a_layer_stand_in_a_dark_edge(chromium: Browser, address: str, layer: str) -> None:
    """So that they are read on light images as well as on dark ones."""
    with chromium.page() as page:
        page.open(f"{address}#layer={layer}")
        page.wait(f"{BARE_EDGES}[0] > 200")
        assert page.value(BARE_EDGES)[1] == 0


def luminance(rgb: np.ndarray) -> np.ndarray:
    """Relative luminance as the Web Content Accessibility Guidelines define it."""
    share = np.asarray(rgb, float) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(linear @ np.array([0.2126, 0.7152, 0.0722]))


def test_every_colour_has_the_contrast_of_graphics_to_its_dark_edge() -> None:
    scales = direction_colours(np.linspace(0, 2 * np.pi, 720)), ramp_colours(np.linspace(0, 1, 720))
    for scale in scales:
        assert ((luminance(scale) + 0.05) / 0.05).min() >= 3.0  # of graphics, by success criterion 1.4.11
