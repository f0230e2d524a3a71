"""A small simulated flight and its run: what the tests of flows share, made once a session (see conftest)."""

from collections.abc import Mapping
from pathlib import Path

from flows.console import Console
from flows.runners import RunnerConfig
from schemas.job import Inputs, Job
from schemas.summary import RunSummary
from velfield.pipeline.configuration import resolve_config
from velfield.run.commits import digest_bytes
from velfield.run.layout import RunLayout

SMALL = (
    "detection.fine_tune_steps=6",
    "lens.calibrate=never",
    "registration.max_keypoints=1200",
    "work.unit_frames=8",
    "work.retries=1",
)
FRAMES = 18


def job(flight: Path, root: Path, *settings: str, **inputs: str) -> Job:
    given = {
        "source": str(flight / "frames"),
        "timestamps": str(flight / "timestamps.csv"),
        "base": str(flight / "base.png"),
        "labels": str(flight / "labels.csv"),
    }
    config = resolve_config(settings=[*SMALL, *settings], overrides={"gsd_m": 0.23})
    return Job(root=str(root), inputs=Inputs.model_validate(given | inputs), config=config)


def process(work: Job, runner: RunnerConfig | None = None) -> RunSummary:
    from flows.process_flight import run_flight

    return run_flight(work, runner or RunnerConfig(), Console("quiet"))


def digests(root: Path) -> dict[str, str]:
    """Digests of all files of a run, apart from those with the time of its creation."""
    return digests_of(root, {path: path.read_bytes() for path in root.rglob("*") if path.is_file()})


def digests_of(root: Path, files: Mapping[Path, bytes]) -> dict[str, str]:
    """Digests of a run's files, wherever they were read from, apart from those with the time of its creation."""
    layout = RunLayout(root)
    when = {layout.flight, layout.report, layout.report_record, layout.lock}
    return {
        path.relative_to(root).as_posix(): digest_bytes(data)
        for path, data in sorted(files.items())
        if path not in when and not path.is_relative_to(layout.commits)
    }


def redone(summary: RunSummary) -> list[str]:
    return [stage.name for stage in summary.stages if stage.done_before < stage.units]
