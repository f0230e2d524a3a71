"""Maps before a flight is through: they come, they grow, and the result is to the bit what it is without them."""

import re
import shutil
import threading
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from flows.console import Console
from flows.process_flight import run_flight
from flows.runners import RunnerConfig, open_runner
from tests.small_flight import FRAMES, digests, job
from velfield.pipeline.plan import make_plan
from velfield.pipeline.preview import make_first_preview, publish_first_preview
from velfield.run.frame_transforms import read_grid
from velfield.run.layout import RunLayout
from velfield.run.results import link_shared_outputs
from velfield.run.stores import FieldStore, FrameStore


class Recording(Console):
    """Notes the page's title and the count of vehicles when a preview is announced."""

    def __init__(self, root: Path) -> None:
        super().__init__("quiet")
        self.root = root
        self.seen: list[tuple[int, str, int]] = []
        self.warnings: list[str] = []
        self._more = threading.Condition()

    def previews_are_there(self, count: int) -> bool:
        with self._more:
            return self._more.wait_for(lambda: len(self.seen) >= count, timeout=120)

    def event(self, kind: str, text: str, **values: Any) -> None:
        if kind == "preview":
            (title,) = re.findall(r"<title>(.*?)</title>", (self.root / "index.html").read_text())
            vehicles = int(FieldStore(self.root / "field.zarr").layer("count").sum())
            assert (self.root / "maps/direction.png").stat().st_size > 1000
            with self._more:
                self.seen.append((values["frames"], title, vehicles))
                self._more.notify_all()

    def warn(self, text: str) -> None:
        self.warnings.append(text)


@pytest.fixture
def _always(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("velfield.pipeline.plan.LONG_MPX", 0.0)
    for name in ("WORTH_S", "TIMES_ITS_COST"):
        monkeypatch.setattr(f"flows.previews.{name}", 0.0)
    monkeypatch.setattr("flows.previews.SHARE", 1.0)


@pytest.mark.usefixtures("_always")
def test_previews_come_and_grow_and_leave_no_trace(
    whole: Path, flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from velfield.pipeline.stages import detections as step

    root = tmp_path / "run"
    link_shared_outputs(RunLayout(whole), RunLayout(root), ("frames", "lens", "base", "registration", "detector"))
    for name in ("frames.zarr", "registration.zarr"):
        shutil.rmtree(root / name)
        shutil.copytree(whole / name, root / name)
    console = Recording(root)
    true = step.detect_block

    def waiting(plan: Any, frames: range) -> object:
        """The second unit of this run comes after the first preview, the third one after the second."""
        if plan.frame_count == FRAMES:
            assert console.previews_are_there(frames.start // 8)
        return true(plan, frames)

    monkeypatch.setattr(step, "detect_block", waiting)
    run_flight(job(flight, root), RunnerConfig(), console)
    assert console.warnings == []
    # Of the first frames, by the detector that ships; then of the first unit, whose windows reach into the second.
    first, then = (found for found, _, _ in console.seen)
    assert first == 12
    assert then in (8, 16)  # of the first unit, or of both that were through when it began
    for found, title, vehicles in console.seen:
        assert f"{found} of {FRAMES} frames" in title or f"the first {found} of" in title
        assert vehicles > 0
    assert console.seen[-1][2] < FieldStore(root / "field.zarr").layer("count").sum()
    assert not RunLayout(root).preview.exists()
    assert digests(root) == digests(whole)


def test_a_worker_makes_the_first_preview_by_itself(flight: Path, tmp_path: Path) -> None:
    plan = make_plan(job(flight, tmp_path / "run"))
    with open_runner(RunnerConfig(workers=1)) as runner:
        assert runner.call(make_first_preview, plan) == 12
    preview = RunLayout(plan.layout.preview)
    assert preview.field.is_dir()
    assert not plan.layout.report.exists()
    publish_first_preview(plan, nullcontext())
    assert "the first 12 of" in plan.layout.report.read_text()
    assert plan.layout.field.is_dir()
    assert not preview.root.exists()


def test_the_first_preview_of_large_frames_is_made_at_half_their_size(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("velfield.pipeline.preview._LARGE_PX", 0)
    nothing = {"base": None, "labels": None}
    given = job(flight, tmp_path / "run")
    plan = make_plan(given.model_copy(update={"inputs": given.inputs.model_copy(update=nothing)}))
    assert make_first_preview(plan) == 12
    height, width = plan.frame_shape
    preview = RunLayout(plan.layout.preview)
    assert FrameStore(preview.frames).read(0).shape == (height // 2, width // 2)
    assert read_grid(preview).gsd_m == pytest.approx(2 * 0.23, rel=0.01)
    assert int(FieldStore(preview.field).layer("count").sum()) > 100


@pytest.mark.usefixtures("_always")
def test_a_preview_that_fails_fails_alone(
    whole: Path, copy: Path, flight: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_arguments: Any) -> int:
        raise OSError("no space left")

    monkeypatch.setattr("velfield.pipeline.preview.make_first_preview", broken)
    (copy / "index.html").unlink()
    console = Recording(copy)
    assert run_flight(job(flight, copy), RunnerConfig(), console).complete
    assert console.warnings == ["no preview of the field: no space left"]
    assert console.seen == []
    assert digests(copy) == digests(whole)
