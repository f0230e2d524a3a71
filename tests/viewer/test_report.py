"""Figures and the report: what is drawn where, and that the page holds all it shows."""

import math
import re
from base64 import b64decode, b64encode
from hashlib import sha256
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from schemas.detector import PrecisionRecallCurve
from schemas.report import Report, ReportFigure, ReportStage, ResidualSeries
from velfield.errors import InputError
from velfield.report.colours import direction_colours, ramp_colours
from velfield.report.figures import MapScale, direction_figure, jpeg_bytes, png_bytes, speed_figure
from velfield.report.panel import bar_ticks
from velfield.report.plots import highest_of_runs, precision_recall_plot
from velfield.report.report import rejection_table, render_report, totals_table
from velfield.tracking.gates import GateLog

GREY = np.full((480, 640), 100, np.uint8)


def lanes() -> tuple[np.ndarray, np.ndarray]:
    """Two opposed lanes, an area of stationary vehicles, and nothing elsewhere: direction and speed."""
    direction, speed = np.full(GREY.shape, np.nan), np.full(GREY.shape, np.nan)
    direction[200:210], speed[200:210] = 0.0, 60.0
    direction[220:230], speed[220:230] = math.pi, 30.0
    speed[300:310, 300:310] = 0.1
    return direction, speed


def test_nothing_is_drawn_where_nothing_is_known_and_no_direction_where_vehicles_stand() -> None:
    direction, speed = lanes()
    by_direction, by_speed = (
        direction_figure(GREY, direction, MapScale(0.25)),
        speed_figure(GREY, speed, MapScale(0.25)),
    )
    for figure in (by_direction, by_speed):
        assert figure.dtype == np.uint8
        assert figure.shape[0] == 480
        np.testing.assert_array_equal(figure[10, 10], [50, 50, 50])
        assert np.ptp(figure[205, 100].astype(int)) > 60
    np.testing.assert_array_equal(by_direction[305, 305], [50, 50, 50])
    assert np.ptp(by_speed[305, 305].astype(int)) > 60


def test_opposite_directions_have_opposite_colours_all_round() -> None:
    angles = np.radians(np.arange(0, 360, 5.0))
    a, b = direction_colours(angles).astype(float), direction_colours(angles + np.pi).astype(float)
    assert np.linalg.norm(a - b, axis=1).min() > 140


def test_wheel_has_no_seam() -> None:
    around = direction_colours(np.linspace(-np.pi, np.pi, 2049)).astype(int)
    assert np.abs(np.diff(around, axis=0)).max() <= 12
    np.testing.assert_array_equal(direction_colours(np.array([-np.pi])), direction_colours(np.array([np.pi])))


def test_ramp_rises_in_lightness_and_clips() -> None:
    luminance = ramp_colours(np.linspace(0, 1, 50)) @ np.array([0.2126, 0.7152, 0.0722])
    assert (np.diff(luminance) > 0).all()
    np.testing.assert_array_equal(ramp_colours(np.array([-1.0, 9.0])), ramp_colours(np.array([0.0, 1.0])))


@pytest.mark.parametrize("shape", [(120, 160), (480, 640), (1920, 2560), (2000, 300)])
def test_any_size_gets_a_legend(shape: tuple[int, int]) -> None:
    grey, nothing = np.full(shape, 90, np.uint8), np.full(shape, np.nan)
    for figure in (direction_figure(grey, nothing, MapScale()), speed_figure(grey, nothing, MapScale(0.2, "mph", 0.3))):
        assert figure.shape[0] == shape[0]
        assert figure.shape[1] > shape[1]
        assert figure[:, shape[1] :].max() > 200


def test_speeds_are_shown_in_the_unit_that_can_be_known() -> None:
    speed = np.array([[40.0]])
    assert MapScale(0.25).shown_speed(speed) == pytest.approx(36.0)
    assert MapScale(0.25, "mph").shown_speed(speed) == pytest.approx(22.369, abs=1e-3)
    assert MapScale(None, "mph").shown_unit == "px/s"
    assert MapScale(None, "mph").shown_speed(speed) == pytest.approx(40.0)


def test_one_false_fast_track_does_not_set_the_colours() -> None:
    _, speed = lanes()
    false_track = speed.copy()
    false_track[400, :5] = 400.0
    plain, cut_off = speed_figure(GREY, speed, MapScale(0.25)), speed_figure(GREY, false_track, MapScale(0.25))
    np.testing.assert_array_equal(plain[:390, :640], cut_off[:390, :640])
    assert (plain[:, 640:] != cut_off[:, 640:]).any(), "the legend notes the end of the colour scale"


def test_a_field_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match="must agree"):
        direction_figure(GREY, np.zeros((10, 10)), MapScale())


def test_images_come_back_from_their_bytes() -> None:
    figure = direction_figure(GREY, lanes()[0], MapScale(0.25))
    read = cv2.imdecode(np.frombuffer(png_bytes(figure), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(cv2.cvtColor(read, cv2.COLOR_BGR2RGB), figure)
    small = cv2.imdecode(np.frombuffer(jpeg_bytes(figure, max_side=320), np.uint8), cv2.IMREAD_COLOR)
    assert max(small.shape) == 320


@pytest.mark.parametrize("top", [0.7, 1.0, 10.0, 60.0, 120.0, 150.0, 800.0])
def test_bars_have_a_few_round_ticks_and_one_at_the_end(top: float) -> None:
    assert 4 <= len(bar_ticks(top)) <= 11
    assert bar_ticks(top)[-1] == pytest.approx(top)


class Reader(HTMLParser):
    """Collects tags and checks that they close in order."""

    VOID = frozenset({"meta", "link", "img", "line", "circle", "polyline"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def made_report() -> tuple[Report, list[ReportFigure]]:
    report = Report(
        title="Field of <script>alert(1)</script>",
        source='flight "a" & b.mp4',
        created="2026-11-21",
        version="0.1.0",
        facts=(("Vehicles", "1,240"),),
        inputs=(("Base image", "built from the flight"),),
        stages=(ReportStage(name="registration", text="8 of 9 frames", seconds=1.5, lost=1),),
        residual=ResidualSeries(times_s=(0.0, 0.2, 0.4, 0.6), residual_px=(0.3, None, 0.4, 0.5), limit_px=0.45),
        detection=PrecisionRecallCurve(
            recall=(0.2, 0.9), precision=(1.0, 0.8), threshold=(1.0, 0.5), operating_point=1, description="12 cars"
        ),
        detection_source="Precision and recall of a <detector>, measured on",
        gates={"links_tried": 1200, "speed": 30, "of_another_time": 7},
        low_coverage_note="Directions hold; speeds are of single vehicles.",
        notes=("lens taken for a pin-hole",),
        warnings=("few <b>labels</b>",),
        frames_lost=("frame 1 (0.200 s): failed:12 control points, 40 needed",),
        files=(("maps/direction.tif", "GeoTIFF"), ("javascript:alert(1)", "not a link")),
    )
    data = png_bytes(np.zeros((4, 4, 3), np.uint8))
    return report, [ReportFigure(title="Map", caption="c", alt_text="a map", mime="image/png", data=data)]


def test_page_is_whole_offline_and_scriptless() -> None:
    report, figures = made_report()
    page = render_report(report, figures)
    reader = Reader()
    reader.feed(page)
    assert not reader.open
    assert "Precision and recall of a &lt;detector&gt;, measured on 12 cars." in page
    assert not [tag for tag, _ in reader.found if tag in {"script", "iframe", "object", "form"}]
    for _, attributes in reader.found:
        assert not [name for name in attributes if name == "style" or name.startswith("on")]
        for link in (attributes.get("src"), attributes.get("href")):
            assert link is None or link.startswith(("data:", "./"))
    assert "http://" not in page
    assert "https://" not in page
    images = [attributes for tag, attributes in reader.found if tag == "img"]
    assert b64decode(str(images[0]["src"]).split(",")[1]) == figures[0].data
    assert images[0]["alt"] == "a map"


def test_policy_admits_the_style_and_nothing_else() -> None:
    page = render_report(*made_report())
    style = re.search(r"<style>(.*?)</style>", page, re.DOTALL)
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)
    digest = b64encode(sha256(style.group(1).encode()).digest()).decode()
    assert f"'sha256-{digest}'" in policy.group(1)
    assert policy.group(1).startswith("default-src 'none'")
    assert "unsafe" not in policy.group(1)


def test_page_tells_what_the_run_was() -> None:
    page = render_report(*made_report())
    for text in (
        "1,240",
        "8 of 9 frames",
        "faster than a vehicle",
        "1,200",
        "12 control points",
        "Not complete",
    ):
        assert text in page


def section(page: str, kind: str) -> str:
    found = re.search(rf'<section class="{kind}">(.*?)</section>', page)
    return found.group(1)


def test_only_what_is_to_be_minded_is_red() -> None:
    page = render_report(*made_report())
    assert "pin-hole" in section(page, "notes")
    assert "Directions hold" in section(page, "coverage-note")
    assert "labels" in section(page, "warnings")
    assert not re.search("pin-hole|Directions hold", section(page, "warnings"))
    assert page.index("Directions hold") < page.index("pin-hole") < page.index("<figure>")
    report, figures = made_report()
    calm = report.model_copy(update={"warnings": (), "frames_lost": (), "stages": ()})
    assert 'class="warnings"' not in render_report(calm, figures)


def test_what_tracking_left_out_stands_apart_from_what_it_tried() -> None:
    gates = made_report()[0].gates
    assert totals_table(gates) == [
        ("Links tried, from a car to one in the next frame", "1,200"),
        ("of another time", "7"),
    ]
    assert rejection_table(gates) == [("links", "faster than a vehicle", "30", "2 %")]


def test_every_gate_that_tracking_counts_has_words() -> None:
    names = set(re.findall(r"``(\w+)``", GateLog.__doc__ or ""))
    assert {"links_tried", "not_best", "windows"} <= names
    counts = dict.fromkeys(sorted(names), 3)
    assert len(totals_table(counts)) + len(rejection_table(counts)) == len(names)
    assert not {name.replace("_", " ") for name in names} & {words for words, _ in totals_table(counts)}


def test_an_empty_report_is_a_page_too() -> None:
    page = render_report(Report(title="t", source="s", created="c", version="v"), [])
    assert "<h1>t</h1>" in page


def test_a_long_flight_keeps_its_peaks() -> None:
    residual = [0.3] * 20_000
    residual[12_345] = 4.0
    series = ResidualSeries(times_s=tuple(i * 0.2 for i in range(20_000)), residual_px=tuple(residual))
    page = render_report(Report(title="t", source="s", created="c", version="v", residual=series), [])
    assert len(page) < 60_000
    _, shown = highest_of_runs(np.array(series.times_s), np.array(residual))
    assert shown.max() == 4.0
    assert len(shown) <= 600


def test_plots_are_the_same_bytes_whenever_they_are_drawn() -> None:
    curve = made_report()[0].detection
    assert precision_recall_plot(curve) == precision_recall_plot(curve)
    assert b"chosen: precision 0.80, recall 0.90" in precision_recall_plot(curve)


DICHROMATS = {  # Machado, Oliveira and Fernandes 2009, severity 1, linear RGB
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
    "none": np.eye(3).tolist(),
}


@pytest.mark.parametrize("sight", list(DICHROMATS))
def test_directions_are_told_apart_with_any_sight(sight: str) -> None:
    from skimage.color import deltaE_ciede2000, rgb2lab

    n = 72
    encoded = direction_colours(np.arange(n) * 2 * np.pi / n) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    seen = (linear @ np.array(DICHROMATS[sight]).T).clip(0, 1)
    lab = rgb2lab(np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055))
    apart = min(deltaE_ciede2000(lab, np.roll(lab, k, axis=0)).min() for k in range(n // 8, n // 2 + 1))
    opposite = deltaE_ciede2000(lab, np.roll(lab, n // 2, axis=0)).min()
    assert apart > 12  # a difference of 5 is plain side by side
    assert opposite > 35
