"""What the Prefect UI shows of a run besides its graph: a summary, a table of stages, the two maps as pictures."""

import base64

from prefect.artifacts import create_markdown_artifact, create_table_artifact

from schemas.summary import RunSummary
from velfield.plan import Plan

_PICTURE_BYTES = 600_000
"""A markdown artifact of about this size was seen to show; a larger picture is left to the report."""


def publish_summary(plan: Plan, summary: RunSummary) -> None:
    """Create the artifacts of a finished run."""
    lines = [f"# {plan.job.inputs.source}", "", f"Report: `{plan.layout.report}`", ""]
    lines += [f"- **{stage.name}**: {stage.text} ({stage.seconds:.1f} s)" for stage in summary.stages]
    lines += ["", f"{len(summary.frames_lost)} frames lost.", ""]
    for name in ("direction", "speed"):
        picture = plan.layout.maps / f"{name}_preview.png"
        if picture.exists() and picture.stat().st_size <= _PICTURE_BYTES:
            data = base64.b64encode(picture.read_bytes()).decode()
            lines += [f"## {name.capitalize()}", f"![modal {name}](data:image/png;base64,{data})", ""]
    create_markdown_artifact(key="summary", markdown="\n".join(lines), description="What was done, and the maps")
    create_table_artifact(
        key="stages",
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
        description="The stages of the run",
    )
