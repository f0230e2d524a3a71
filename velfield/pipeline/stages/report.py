"""The page of a run, ``index.html``: the viewer, and as its summary the report: results, quality, maps.

No stage of the table: it is made of the summary of all stages, by every run, and nothing depends on it.
"""

import datetime
from collections.abc import Sequence

import numpy as np

from schemas.report import Report, ReportStage, ResidualSeries
from schemas.summary import RunSummary, StageSummary
from velfield.analysis.coverage import low_coverage_note, percent
from velfield.analysis.vehicles import SURE_SCORE
from velfield.detection.registry import load_detector
from velfield.pipeline.plan import Plan
from velfield.pipeline.stage import STAGES
from velfield.report.report import render_report
from velfield.report.run_figures import report_figures
from velfield.report.viewer_page import NOT_BUILT, licences, page_is_built, render_viewer
from velfield.run.commits import code_version, record_page, write_atomically, write_record
from velfield.run.flight_record import source_name
from velfield.run.frame_transforms import north_direction_rad, read_grid, read_working
from velfield.run.layout import RunLayout
from velfield.run.stores import FrameStore, RegistrationStore
from velfield.viewer.record import write_view_record

_TRAINING_SOURCES = {
    "labels": "labelled cars",
    "file": "none: a detector file",
    "shipped": "none: the shipped detector",
    "detections": "none: external detections",
    "tracks": "none: tracks were given",
}
_CURVES = {
    "labels": "Precision and recall of the detector that this run trained on labelled frames of the flight. This run "
    "measured them on",
    "file": "Precision and recall of the detector file that was given. They were not measured on this flight, but when "
    "the file was made, on the images that it was trained with:",
    "shipped": "Precision and recall of the detector that ships with velfield. They were not measured on this flight, "
    "but by the authors of velfield, on the labelled images that it was made with:",
}
"""Whose curve the report has, and where it is from, by the source of the training data."""


def write_report(plan: Plan, summary: RunSummary, *, preview_of: str | None = None) -> list[str]:
    """Write ``index.html``, the viewer with the report as its summary, and the records of both.

    Parameters
    ----------
    preview_of
        The frames that the field is of, while the run goes on.

    Returns
    -------
    Warnings, one line each: the viewer is not built, and the page holds the report only.
    """
    report = make_report(plan, summary)
    if preview_of is not None:
        note = f"Preview of {preview_of}, while the run goes on: load the page again for more."
        report = report.model_copy(update={"title": f"{report.title}: {preview_of}", "notes": (note, *report.notes)})
    warnings = _write_page(plan.layout, report)
    record_page(plan.layout)
    return warnings


def _write_page(layout: RunLayout, report: Report) -> list[str]:
    write_record(layout.report_record, report, indent=None)
    write_view_record(layout)
    figures = report_figures(layout.maps)
    if not page_is_built():
        write_atomically(layout.report, render_report(report, list(figures.values())).encode())
        return [NOT_BUILT]
    named = [figure.model_copy(update={"data": b"", "file": f"view/{name}.jpg"}) for name, figure in figures.items()]
    for name, figure in figures.items():
        write_atomically(layout.view / f"{name}.jpg", figure.data)
    write_atomically(layout.view / "LICENSES.txt", licences().encode())
    write_atomically(layout.report, render_viewer(report, named).encode())
    return []


def make_report(plan: Plan, summary: RunSummary) -> Report:
    """The content of the report."""
    counts: dict[str, dict[str, float]] = {stage.name: {} for stage in STAGES} | {
        stage.name: stage.counts for stage in summary.stages
    }
    return Report(
        title=f"Velocity field of {source_name(plan.job.inputs.source, plan.info.kind)}",
        source=plan.job.inputs.source,
        created=datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        version=code_version(),
        facts=tuple(_facts(plan, counts)),
        low_coverage_note=low_coverage_note(
            int(counts["field"].get("pixels", 0)), int(counts["field"].get("pixels_5", 0))
        ),
        inputs=tuple(_inputs(plan)),
        stages=tuple(
            ReportStage(name=s.name, text=s.text, seconds=s.seconds + s.seconds_before, lost=len(s.lost))
            for s in summary.stages
        ),
        residual=_residual(plan),
        detection=load_detector(plan.layout.detector).curve if plan.layout.detector.exists() else None,
        detection_source=_CURVES.get(read_working(plan.layout).training_source, ""),
        gates=_gates(summary.stages),
        notes=(*_parked_notes(plan, counts["maps"]), *(note for stage in summary.stages for note in stage.notes)),
        warnings=(
            *plan.info.warnings,
            *(line for stage in summary.stages for line in (*stage.failures, *stage.warnings)),
        ),
        frames_lost=summary.frames_lost,
        footage_lost=summary.footage_lost,
        files=tuple(_files(plan)),
    )


def _facts(plan: Plan, counts: dict[str, dict[str, float]]) -> list[tuple[str, str]]:
    times_s = plan.info.times_s[plan.indices]
    grid, field = read_grid(plan.layout), counts["field"]
    pixels = field.get("pixels", 0)
    maps = counts["maps"]
    tracks = [("tracks", f"{counts['tracks'].get('tracks', 0):.0f}")]
    if maps:
        tracks = [
            ("vehicles that move or wait in a lane", f"{maps['moving'] + maps['stopped']:.0f}"),
            ("more that stand throughout: see the notes", f"{maps['parked']:.0f}"),
        ]
    covered = [
        *tracks,
        ("of the map, passed by vehicles", percent(pixels, grid.width_px * grid.height_px)),
        ("of these pixels, by 5 vehicles or more", percent(field.get("pixels_5", 0), pixels)),
    ]
    if not counts["registration"]:
        return [("tracks given", f"{times_s[-1] - times_s[0]:.1f} s, {plan.frame_count} times"), *covered]
    frames, registered = counts["registration"].get("frames", 0), counts["registration"].get("registered", 0)
    return [
        ("flight", f"{times_s[-1] - times_s[0]:.1f} s, {plan.frame_count} frames"),
        ("registered", f"{registered:.0f} of {frames:.0f} frames"),
        ("hold-out registration error", f"{counts['registration'].get('heldout_px', float('nan')):.2f} px"),
        ("detections", f"{counts['detections'].get('cars', 0):.0f}"),
        *covered,
    ]


def _parked_notes(plan: Plan, states: dict[str, float]) -> list[str]:
    """How sure it is that what stands throughout are vehicles."""
    if not states.get("parked"):
        return []
    note = (
        f"Tracks of what stands throughout: {states['parked']:.0f}. Only looks tell that these are vehicles; things on "
        "roofs, sheds and trees are among them."
    )
    if read_working(plan.layout).training_source == "shipped":
        note += (
            f" With a mean score of {SURE_SCORE:g} or more: {states['parked_sure']:.0f}. In the two flights where it "
            "was checked, a town and a simulated city, 0.83 and 1.0 of such were vehicles, and 0.41 and 0.29 of the "
            "others; of this flight it is not known."
        )
    return [note]


def _inputs(plan: Plan) -> list[tuple[str, str]]:
    grid, working = read_grid(plan.layout), read_working(plan.layout)
    gsd = f"{grid.gsd_m:.4g} m a pixel" if grid.gsd_m else "not known: speeds in px/s"
    return [
        (
            "base image",
            plan.job.inputs.base
            or ("built from the flight" if not plan.inputs.source.of_tracks else "the tracks, drawn"),
        ),
        ("ground sample distance", gsd),
        ("training data", _TRAINING_SOURCES[working.training_source]),
        ("preset", plan.config.preset),
        ("frame size", f"{plan.info.width} x {plan.info.height} px"),
    ]


def _residual(plan: Plan) -> ResidualSeries:
    times_s = FrameStore(plan.layout.frames).column("time_s")
    heldout = RegistrationStore(plan.layout.registration).column("heldout_px")
    return ResidualSeries(
        times_s=tuple(float(time) for time in times_s),
        residual_px=tuple(float(value) if np.isfinite(value) else None for value in heldout),
        limit_px=plan.config.registration.max_residual_px,
    )


def _gates(stages: Sequence[StageSummary]) -> dict[str, int]:
    counts = next((stage.counts for stage in stages if stage.name == "tracklets"), {})
    return {name.removeprefix("gate_"): int(count) for name, count in counts.items() if name.startswith("gate_")}


def _files(plan: Plan) -> list[tuple[str, str]]:
    layout, files = plan.layout, []
    north = (
        "the top of the image: north is not known" if north_direction_rad(read_grid(plan.layout)) is None else "north"
    )
    for path, what in (
        (layout.maps / "direction.png", "modal direction"),
        (layout.maps / "speed.png", "modal speed"),
        (layout.maps / "direction.tif", f"modal direction for GIS, degrees clockwise from {north}"),
        (layout.maps / "speed.tif", "modal speed for GIS"),
    ):
        if path.exists():
            files.append((path.relative_to(layout.root).as_posix(), what))
    return files
