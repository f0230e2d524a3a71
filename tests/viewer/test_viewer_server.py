"""`velfield view` and `velfield annotate`: what they serve, what they refuse, what they write."""

import http.client
import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from schemas.annotation import MarkedCar, Marks
from schemas.flight import FramesConfig
from tests.browser import NEEDS_PAGE, browser
from velfield.errors import InputError
from velfield.report.figures import png_bytes
from velfield.run.run import open_run
from velfield.sources.labels.labels import read_labels
from velfield.sources.source import probe
from velfield.viewer.annotations import Frames, frames_to_annotate, read_marks, write_marks
from velfield.viewer.annotator import annotate_app
from velfield.viewer.server import page_policy, runs_app, serve_in_thread, view_app

ROOT = Path(__file__).resolve().parents[2]


class Client:
    """Raw HTTP: paths go out as they are written."""

    def __init__(self, port: int) -> None:
        self.port = port

    def ask(
        self, path: str, method: str = "GET", headers: dict[str, str] | None = None, body: str | None = None
    ) -> tuple[int, str, dict[str, str]]:
        """Status, text and headers (lower case) of an answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        connection.request(method, path, body=body, headers=headers or {})
        answer = connection.getresponse()
        text = answer.read().decode(errors="replace")
        connection.close()
        return answer.status, text, {name.lower(): value for name, value in answer.getheaders()}

    def status(self, path: str, method: str = "GET", headers: dict[str, str] | None = None, body: str = "") -> int:
        return self.ask(path, method, headers, body or None)[0]


@contextmanager
def served(app: Any) -> Iterator[Client]:
    with serve_in_thread(app, 0) as address:
        yield Client(int(address.rpartition(":")[2]))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder in the form of a run folder, with a link out of it."""
    root = tmp_path / "run"
    (root / "view").mkdir(parents=True)
    (root / "index.html").write_text("<html><style>p {}</style><script>let a = 1;</script></html>")
    (root / "view" / "run.json").write_text("{}")
    (root / ".lock").write_text("pid")
    (tmp_path / "secret").write_text("secret")
    (root / "leak").symlink_to(tmp_path / "secret")
    (root / "out").symlink_to(tmp_path)
    return root


def test_a_folder_of_runs_has_a_list_of_them(tmp_path: Path) -> None:
    pages = ("a & b", "results", "street", "street/results/spring", "street/results/.summer.unfinished", ".hidden")
    for name in pages:
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "index.html").write_text("<html></html>")
    (tmp_path / "unfinished").mkdir()
    with served(runs_app(tmp_path)) as client:
        status, text, headers = client.ask("/")
        assert (status, headers["content-type"]) == (200, "text/html; charset=utf-8")
        assert headers["content-security-policy"].startswith("default-src 'none'")
        links = dict(re.findall(r'<a href="(.*?)">(.*?)</a>', text))
        assert links == {
            "a%20%26%20b/": "a &amp; b",
            "results/": "results",
            "street/": "street",
            "street/results/spring/": "street on spring",
        }
        for link in links:
            assert client.status(f"/{link}") == 200, link
        assert client.status("/", "POST") == 405
        assert client.status("/", headers={"Host": "elsewhere.example"}) == 400
        assert client.status("/unfinished/") == 404


def test_files_of_the_folder_and_no_others(folder: Path) -> None:
    with served(view_app(folder)) as client:
        assert client.status("/") == 200
        assert client.ask("/view/run.json")[:2] == (200, "{}")
        for path in ("/view/", "/view", "/leak", "/out/secret", "/.lock", "/../secret", "/%2e%2e/secret", "/nothing"):
            assert client.status(path) == 404, path
        assert client.ask("/view/run.json", headers={"Range": "bytes=0-0"})[:2] == (206, "{")


def test_it_only_reads_and_only_for_this_machine(folder: Path) -> None:
    with served(view_app(folder)) as client:
        for method in ("POST", "PUT", "DELETE", "PATCH"):
            assert client.status("/view/run.json", method) == 405, method
        assert client.status("/", headers={"Host": "elsewhere.example"}) == 400


def test_its_policy_admits_what_stands_in_the_page_alone(folder: Path) -> None:
    with served(view_app(folder)) as client:
        policy = client.ask("/")[2]["content-security-policy"]
        other = client.ask("/view/run.json")[2]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe-eval'" not in policy.replace("'wasm-unsafe-eval'", "")
    assert "unsafe-inline" not in policy
    assert "http" not in policy
    assert page_policy("<p>nothing</p>").count("'sha256") == 0
    assert other["content-security-policy"].startswith("default-src 'none'")
    assert other["x-content-type-options"] == "nosniff"


def test_a_folder_without_a_page_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no index\.html"):
        view_app(tmp_path)


@contextmanager
def command(*arguments: str) -> Iterator[str]:
    """A server command of ours, until the end of the block: its address."""
    line = [sys.executable, "-m", "flows.cli", *arguments, "--no-open"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        try:
            found = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())
            yield found.group()
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0


@NEEDS_PAGE
def test_view_serves_the_page(whole: Path, tmp_path: Path) -> None:
    with command("view", str(whole)) as address, browser(tmp_path / "profile") as chromium, chromium.page() as page:
        page.open(address)
        page.wait("document.querySelector('.overlay .leaflet-tile-loaded') !== null")
        assert page.complaints == []
        assert [r for r in page.requests if not r.startswith((address, "data:", "blob:"))] == []


# ---------------------------------------------------------------------------------------------------------- annotating


@pytest.fixture
def image(tmp_path: Path) -> Path:
    grey = np.random.default_rng(1).integers(60, 180, (480, 640), dtype=np.uint8)
    path = tmp_path / "frames" / "a.png"
    path.parent.mkdir()
    path.write_bytes(png_bytes(grey))
    return path


def drag(page: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    page.mouse("mouseMoved", *start)
    page.mouse("mousePressed", *start, 1)
    page.mouse("mouseMoved", *end, 1)
    page.mouse("mouseReleased", *end, 0)


@NEEDS_PAGE
def test_a_drag_along_a_car_is_a_label(image: Path, tmp_path: Path) -> None:
    labels = tmp_path / "labels.csv"
    arguments = ("annotate", str(image), "--labels", str(labels))
    with command(*arguments) as address, browser(tmp_path / "profile") as chromium, chromium.page() as page:
        page.open(address)
        page.wait("document.querySelector('img.frame')?.naturalWidth === 640")
        left, top, width = page.value(
            "(({left, top, width}) => [left, top, width])(document.querySelector('img.frame').getBoundingClientRect())"
        )
        scale = width / 640
        at = [
            (left + (x + 0.5) * scale, top + (y + 0.5) * scale)
            for x, y in ((100, 200), (130, 240), (400, 100), (440, 100))
        ]
        drag(page, at[0], at[1])
        drag(page, at[2], at[3])
        page.wait("document.getElementById('saved').textContent.startsWith('saved: 2')")
        page.key("Delete", 46)
        page.wait("document.getElementById('saved').textContent.startsWith('saved: 1')")
        assert page.complaints == []
    table = pd.read_csv(labels)
    assert table.columns.tolist() == ["frame", "x_px", "y_px", "orientation_rad", "length_px", "width_px"]
    (row,) = table.to_dict("records")
    assert row["frame"] == "a.png"
    expected = (115, 220, np.arctan2(40, 30), 50)
    found = [row[name] for name in ("x_px", "y_px", "orientation_rad", "length_px")]
    np.testing.assert_allclose(found, expected, atol=1.5 / scale, rtol=0.03)
    info = probe(image.parent, frames=FramesConfig(fps=5.0))
    assert len(read_labels(labels, info).cars) == 1


def frames() -> Frames:
    return Frames(("a.png", "b.png"), 640, 480, lambda _: np.zeros((480, 640), np.uint8))


def car(frame: str, **more: float) -> MarkedCar:
    return MarkedCar(frame=frame, x_px=100, y_px=50, **more)


def test_labels_of_other_frames_stay(tmp_path: Path) -> None:
    path = tmp_path / "labels.csv"
    path.write_text("frame,x_px,y_px\na.png,10,20\nother.png,30,40\n")
    marks = Marks(frames=("a.png", "b.png"), cars=(car("a.png", orientation_rad=4.0, length_px=20, width_px=9),))
    write_marks(path, marks, frames())
    lines = path.read_text().splitlines()
    assert lines[1:] == ["other.png,30.00,40.00,,,", "a.png,100.00,50.00,0.8584,20.00,9.00", "b.png,,,,,"]
    assert read_marks(path).frames == ("other.png", "a.png", "b.png")
    write_marks(path, Marks(frames=(), cleared=("a.png", "b.png"), cars=()), frames())
    assert path.read_text().splitlines()[1:] == ["other.png,30.00,40.00,,,"]


@pytest.mark.parametrize("wrong", [car("c.png"), MarkedCar(frame="a.png", x_px=700, y_px=5), car("b.png")])
def test_marks_that_cannot_be_are_refused(tmp_path: Path, wrong: MarkedCar) -> None:
    with pytest.raises(InputError, match="expected"):
        write_marks(tmp_path / "labels.csv", Marks(frames=("a.png",), cars=(wrong,)), frames())
    assert not (tmp_path / "labels.csv").exists()


@NEEDS_PAGE
def test_only_the_page_it_served_may_write(tmp_path: Path) -> None:
    path = tmp_path / "labels.csv"
    body = Marks(frames=("a.png",), cars=(car("a.png"),)).model_dump_json()
    with served(annotate_app(frames(), path)) as client:
        assert client.status("/labels", "POST", {}, body) == 403
        assert client.status("/labels", "POST", {"X-Token": "guess"}, body) == 403
        assert not path.exists()
        found = re.search(r'id="server-data">(.*?)</script>', client.ask("/")[1])
        token = {"X-Token": json.loads(found.group(1))["token"]}
        assert client.status("/labels", "POST", {**token, "Host": "elsewhere.example"}, body) == 400
        assert client.status("/labels", "POST", token, "{}") == 422
        assert client.status("/labels") == 405
        assert client.status("/frame/9.png") == 404
        assert client.ask("/frame/1.png")[2]["content-type"] == "image/png"
        assert json.loads(client.ask("/labels", "POST", token, body)[1]) == {"cars": 1, "frames": 1}
    assert path.exists()


def test_a_run_offers_frames_spread_over_the_flight(whole: Path, flight: Path) -> None:
    offered = frames_to_annotate(whole, max_frames=4)
    names = sorted(path.name for path in (flight / "frames").iterdir())
    assert len(offered.names) == 4
    assert (offered.names[0], offered.names[-1]) == (names[0], names[-1])
    assert offered.read(1).shape == (offered.height, offered.width) == (480, 640)


def test_a_frame_begins_with_the_vehicles_that_the_run_tracks(whole: Path) -> None:
    run, offered = open_run(whole), frames_to_annotate(whole, max_frames=4)
    seen = run.track_positions()
    seen = seen[(seen["frame"] == 0) & (seen["source"] != "interpolated")]
    seen = seen.merge(run.vehicles()[["track_id", "length_px"]], on="track_id")
    cars = [car for car in offered.found if car.frame == offered.names[0]]
    assert 0.9 * len(seen) <= len(cars) <= len(seen)
    places = run.to_base(0, np.array([[car.x_px, car.y_px] for car in cars]))
    away = np.hypot(*(places[:, None] - seen[["x_px", "y_px"]].to_numpy()[None]).transpose(2, 0, 1))
    assert away.min(axis=1).max() < 0.5
    longer = [car.length_px / seen["length_px"].iloc[k] for car, k in zip(cars, away.argmin(axis=1), strict=True)]
    assert 0.8 < np.nanmedian(longer) < 1.25  # of the frame's pixels, not of the map's


@NEEDS_PAGE
def test_what_the_run_found_is_no_label_before_it_is_confirmed(whole: Path, tmp_path: Path) -> None:
    labels = tmp_path / "labels.csv"
    arguments = ("annotate", str(whole), "--labels", str(labels), "--frames", "2")
    with command(*arguments) as address, browser(tmp_path / "profile") as chromium, chromium.page() as page:
        page.open(address)
        page.wait("document.getElementById('saved').textContent.includes('found by the run and not saved')")
        count = int(page.value("document.getElementById('saved').textContent").split()[0])
        assert not labels.exists()
        page.value("document.getElementById('confirm').click()")
        page.wait(f"document.getElementById('saved').textContent.startsWith('saved: {count}')")
        assert page.value("document.getElementById('confirm').hidden")
        assert page.complaints == []
    assert pd.read_csv(labels)["frame"].value_counts().tolist() == [count]  # of the other frame nothing


def test_neither_a_run_nor_an_image_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no run folder and no image"):
        frames_to_annotate(tmp_path, max_frames=3)
