"""Frames that are blurred, black, doubled, truncated, damaged or of another place are flagged, in no tracklet, and
reported."""

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.flight import FramesConfig
from schemas.summary import RunSummary
from tests.media import flip_bytes, write_video
from tests.small_flight import FRAMES, job, process
from velfield import open_run
from velfield.errors import InputError
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import Plan, make_plan, write_flight_record
from velfield.pipeline.stage import stages_before
from velfield.registration.mesh import reach
from velfield.run.commits import read_commit
from velfield.run.layout import RunLayout
from velfield.run.stores import FrameStore
from velfield.sources.quality import UNUSABLE, FrameFlag
from velfield.sources.source import iter_frames, probe

FAULTS = {
    2: FrameFlag.UNREADABLE,
    5: FrameFlag.BLURRED,
    8: FrameFlag.OUTLIER,  # the first frame of a unit of eight
    12: FrameFlag.BLACK,
    15: FrameFlag.DUPLICATE,
    16: FrameFlag.UNREADABLE,  # a unit of its own: all of it is lost, and the rest goes on
}
TRUNCATED, BLURRED, FOREIGN, BLACK, DUPLICATE, LAST = FAULTS
MISSING = 17
"""The file of times lists it, and the folder has it not."""
COUNT = FRAMES - 1
EXPECTED = [int(FAULTS.get(k, 0)) for k in range(COUNT)]


@pytest.fixture(scope="module")
def damaged(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small flight with a frame of each fault."""
    folder = tmp_path_factory.mktemp("damaged") / "flight"
    shutil.copytree(flight, folder)
    names = [str(path) for path in sorted((folder / "frames").iterdir())]
    images = [cv2.imread(name, cv2.IMREAD_GRAYSCALE) for name in names]
    cv2.imwrite(names[BLURRED], cv2.GaussianBlur(images[BLURRED], (0, 0), 4))
    cv2.imwrite(names[FOREIGN], 255 - cv2.rotate(images[FOREIGN], cv2.ROTATE_180))
    cv2.imwrite(names[BLACK], np.zeros_like(images[BLACK]))
    shutil.copy(names[DUPLICATE - 1], names[DUPLICATE])
    truncated = Path(names[TRUNCATED])
    truncated.write_bytes(truncated.read_bytes()[: truncated.stat().st_size // 2])
    Path(names[LAST]).write_bytes(b"not a picture")
    Path(names[MISSING]).unlink()
    return folder


@pytest.fixture(scope="module")
def run(damaged: Path, server: None, tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    return process(job(damaged, tmp_path_factory.mktemp("quality") / "run"))


def test_they_are_flagged_and_no_other_frame_is(run: RunSummary) -> None:
    assert open_run(run.root).frames.column("flags").tolist() == EXPECTED


def test_they_are_in_no_tracklet(run: RunSummary) -> None:
    tracklets = open_run(run.root).tracklets()
    used = set(np.unique(tracklets[["frame_0", "frame_1", "frame_2"]].to_numpy()).tolist())
    assert used == set(range(COUNT)) - set(FAULTS)
    velocities = tracklets[[f"v{axis}_{link}_px_per_s" for axis in "xy" for link in ("01", "12")]].to_numpy()
    assert len(velocities) > 100
    assert np.isfinite(velocities).all()


def test_they_are_reported(run: RunSummary) -> None:
    assert not run.complete  # `velfield run` ends with status 3
    assert [line.split(": ", 1)[1] for line in run.frames_lost] == [
        f"skipped:{name}" for name in ("unreadable", "blurred", "outlier", "black", "duplicate", "unreadable")
    ]
    (stage,) = [stage for stage in run.stages if stage.name == "quality"]
    assert stage.text.startswith(f"{COUNT - len(FAULTS)} frames usable, {len(FAULTS)} flagged: ")
    warnings = [warning for stage in run.stages for warning in stage.warnings]
    assert {int(re.findall(r"^frame (\d+)", warning)[0]) for warning in warnings} == set(FAULTS)
    told = [warning for warning in warnings if warning.startswith(f"frame {DUPLICATE} (")]
    assert re.fullmatch(
        rf"frame {DUPLICATE} \(\d\.\d{{3}} s, source frame \S*{DUPLICATE}\.png\): the same image as the frame before",
        told[0],
    )
    report = Path(run.root, "index.html").read_text()
    assert all(warning in report for warning in warnings)


def test_flags_are_the_same_however_the_flight_is_cut(damaged: Path, tmp_path: Path) -> None:
    compute_stages(make_plan(job(damaged, tmp_path / "run", "work.unit_frames=3")), stages_before("lens"))
    assert FrameStore(RunLayout(tmp_path / "run").frames).column("flags").tolist() == EXPECTED


def test_no_frame_of_a_good_flight_is_flagged(whole: Path) -> None:
    run = open_run(whole)
    assert not run.frames.column("flags").any()
    record = read_commit(run.layout, "quality", "all")
    assert (record.counts["usable"], record.counts["flagged"]) == (FRAMES, 0)


@dataclass(frozen=True)
class Clip:
    """A run up to the field, of a video that is damaged on the way, on a base image that is blank from a column on."""

    plan: Plan
    whole: Path
    blank_from_px: int


@pytest.fixture(scope="module")
def clip(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Clip:
    folder = tmp_path_factory.mktemp("clip")
    names = sorted((flight / "frames").iterdir())
    images = [np.asarray(cv2.imread(str(name), cv2.IMREAD_GRAYSCALE), np.uint8) for name in names]
    whole = write_video(folder / "whole.mp4", images, key_interval=6, times=range(0, 90, 5))
    damaged = flip_bytes(whole, folder / "damaged.mp4", start=0.78, stop=0.84, count=30, seed=25)
    labels = folder / "labels.csv"  # of a video's frames by number
    labels.write_text(re.sub(r"^0*(\d+)\.png", r"\1", (flight / "labels.csv").read_text(), flags=re.MULTILINE))
    base = np.asarray(cv2.imread(str(flight / "base.png"), cv2.IMREAD_GRAYSCALE), np.uint8)
    blank_from_px = int(0.55 * base.shape[1])
    base[:, blank_from_px:] = 0
    cv2.imwrite(str(folder / "base.png"), base)
    work = job(flight, folder / "run", "frames.every=1")
    given = {"source": damaged, "timestamps": None, "labels": labels, "base": folder / "base.png"}
    inputs = work.inputs.model_copy(update={name: path and str(path) for name, path in given.items()})
    plan = make_plan(work.model_copy(update={"inputs": inputs}))
    write_flight_record(plan)
    compute_stages(plan, stages_before("maps"))
    return Clip(plan, whole, blank_from_px)


def test_frames_of_a_damaged_bitstream_are_in_no_tracklet(clip: Clip) -> None:
    """From the first error to the next key frame; the frames before have theirs."""
    read = FrameStore(clip.plan.layout.frames)
    flags = read.column("flags")
    suspect = set(np.flatnonzero(flags & int(UNUSABLE)).tolist())
    assert 1 <= len(suspect) <= 12
    info = probe(clip.whole, frames=FramesConfig(every=1))
    sound = [frame.grey for frame in iter_frames(clip.whole, info, range(len(flags)))]
    wrong = {k for k in range(len(flags)) if not np.array_equal(read.read(k), sound[k])}
    assert wrong
    assert wrong <= suspect
    used = set(
        np.unique(open_run(clip.plan.layout.root).tracklets()[["frame_0", "frame_1", "frame_2"]].to_numpy()).tolist()
    )
    assert used
    assert not used & suspect


def test_where_no_control_points_support_the_map_nothing_is_detected_tracked_or_counted(
    clip: Clip, whole: Path
) -> None:
    """Vehicles drive in the blank part of the base image too: the flight shows them, and the map does not bear them."""
    run = open_run(clip.plan.layout.root)
    tracklets = run.tracklets()
    last_px = {
        "detection": float(run.detections()["x_px"].max()),
        "tracklet": float(tracklets[["x_0_px", "x_1_px", "x_2_px"]].to_numpy().max()),
        "field": float(np.flatnonzero(run.field.count().any(axis=0)).max()),
    }
    beyond = clip.blank_from_px + reach(640, 480)
    whole_run = open_run(whole)
    assert (whole_run.detections()["x_px"] > beyond + 20).sum() > 100
    assert np.flatnonzero(whole_run.field.count().any(axis=0)).max() > beyond + 50
    assert {name: x for name, x in last_px.items() if x > beyond + 3} == {}
    assert min(last_px.values()) > clip.blank_from_px - 60


def test_a_flight_without_a_sound_frame_is_refused_with_the_faults(flight: Path, tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    shutil.copytree(flight, folder)
    for k, path in enumerate(sorted((folder / "frames").iterdir())):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(path), np.zeros_like(image) if k < 16 else image)
    plan = make_plan(job(folder, tmp_path / "run"))
    with pytest.raises(
        InputError, match=r"found 2 frames without a fault of 18 \(15 duplicate, 16 black\), expected 3 or more; "
    ):
        compute_stages(plan, stages_before("lens"))
