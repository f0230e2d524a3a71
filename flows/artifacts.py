"""Artifacts in the Prefect UI: a summary with the two maps, a table of stages, a link to the report, the progress of
long stages."""

import base64
import hashlib
import os
import re
import shlex
import time
from pathlib import Path
from uuid import UUID

from prefect.artifacts import (
    create_link_artifact,
    create_markdown_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)
from prefect.runtime import flow_run

from flows.launch import PAGES, PAGES_OF
from schemas.summary import RunSummary
from velfield.errors import count_text
from velfield.pipeline.plan import Plan
from velfield.run.layout import RunLayout, is_remote
from velfield.run.results import final_root

_MAX_IMAGE_BYTES = 600_000
"""A markdown artifact of about this size is displayed; larger images are left to the report."""


_LONG_S, _EVERY_S = 20.0, 5.0
"""A stage that takes longer than the first has its progress shown, updated as often as the second."""


def publish_summary(plan: Plan, summary: RunSummary) -> None:
    """Create the artifacts of a finished run."""
    report = RunLayout(final_root(plan.layout.root)).report
    shown = f"velfield view {shlex.quote(str(report.parent))}"
    lines = [f"# {plan.job.inputs.source}", "", f"The page of the run, in a browser: `{shown}`", ""]
    lines += [f"- **{stage.name}**: {stage.text} ({stage.seconds:.1f} s)" for stage in summary.stages]
    lost = [*summary.footage_lost, *(line for stage in summary.stages for line in stage.failures)]
    lines += ["", *(f"- warning: {line}" for stage in summary.stages for line in stage.warnings)]
    lines += ["", f"{count_text(len(summary.frames_lost), 'frame')} lost.", "", *(f"- {line}" for line in lost), ""]
    for name in ("direction", "speed"):
        image = plan.layout.maps / f"{name}_preview.png"
        if image.exists() and image.stat().st_size <= _MAX_IMAGE_BYTES:
            data = base64.b64encode(image.read_bytes()).decode()
            lines += [f"## {name.capitalize()}", f"![modal {name}](data:image/png;base64,{data})", ""]
    create_markdown_artifact(key=_key("summary"), markdown="\n".join(lines), description=_of("summary and maps"))
    if (link := page_address(report)) is not None:
        about = _of("page with map and report")
        create_link_artifact(key=_key("report"), link=link, link_text="report", description=about)
    create_table_artifact(
        key=_key("stages"),
        table=[
            {
                "stage": s.name,
                "units": s.units,
                "done before": s.done_before,
                "lost": len(s.lost),
                "seconds": round(s.seconds, 1),
            }
            for s in summary.stages
        ],
        description=_of("stages"),
    )


def _key(what: str) -> str:
    """Key of an artifact of this run: under one key Prefect keeps versions of one thing, and lists the last.

    Keys are of lower-case letters, digits and dashes; a run's name of other letters alone is in the description only.
    The run folder's digest tells runs apart whose folders have one name.
    """
    folder = hashlib.sha256(str(flow_run.parameters["run_folder"]).encode()).hexdigest()[:6]
    return re.sub(r"[^a-z0-9]+", "-", f"{flow_run.name} {folder} {what}".lower()).strip("-")


def _of(what: str) -> str:
    return f"{flow_run.name}: {what}"


def page_address(report: Path) -> str | None:
    """Address of the page under `velfield serve`; None elsewhere: a browser opens no link to a file or an object."""
    served = os.environ.get(PAGES_OF)
    if served is not None and not is_remote(report) and report.resolve().is_relative_to(Path(served).resolve()):
        return f"{os.environ[PAGES]}/{report.resolve().relative_to(Path(served).resolve()).as_posix()}"
    return None


class LongStage:
    """The progress of a stage, shown in the UI once it takes long; short ones would only fill the page."""

    def __init__(self, stage: str, steps: int) -> None:
        self._stage, self._steps = stage, max(steps, 1)
        self._updated_s = time.monotonic() + _LONG_S - _EVERY_S
        self._artifact: UUID | None = None

    def update(self, done: int) -> None:
        """Show that so many steps are done."""
        now_s = time.monotonic()
        if now_s - self._updated_s < _EVERY_S and (self._artifact is None or done < self._steps):
            return
        self._updated_s = now_s
        percent = 100.0 * min(done / self._steps, 1.0)
        if self._artifact is None:
            key, about = _key(f"progress {self._stage}"), _of(f"{self._stage}, per cent")
            self._artifact = UUID(str(create_progress_artifact(percent, key=key, description=about)))
        else:
            update_progress_artifact(self._artifact, percent)
