"""The report as one HTML file that holds all it shows, to send by mail."""

from pathlib import Path

from schemas.export import ExportOptions
from schemas.report import Report
from velfield.errors import InputError
from velfield.report.report import render_report
from velfield.report.run_figures import report_figures
from velfield.run.layout import RunLayout
from velfield.run.run import Run

FILE_NAME = "report.html"


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    run.require_frames()
    report = _read_report(run.layout)
    alone = report.model_copy(update={"files": ()})  # a mail does not carry them
    figures = [figure.model_copy(update={"full_size": None}) for figure in report_figures(run.layout.maps).values()]
    return render_report(alone, figures).encode()


def _read_report(layout: RunLayout) -> Report:
    path = layout.report_record
    if not path.exists():
        raise InputError(f"{path} does not exist: the run is unfinished; run it again")
    return Report.model_validate_json(path.read_bytes())
