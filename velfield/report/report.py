"""The report: one self-contained HTML file that opens offline and runs no script.

The page's content security policy blocks all external content: images are ``data:``, the one style sheet is allowed by
its hash, and all external text (names, messages) is escaped.
"""

from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from hashlib import sha256
from html import escape
from importlib.resources import files
from urllib.parse import quote

from schemas.report import Report, ReportFigure, ReportStage
from velfield.errors import count_text
from velfield.report.plots import precision_recall_plot, residual_plot

_TOTALS = {
    "windows": "Windows of three frames",
    "links_tried": "Links tried, from a car to one in the next frame",
    "pairs_tried": "Pairs of links tried, over three frames",
    "tracklets": "Pairs accepted: tracklets",
    "moving_candidates": "Tracklets of candidates that the detector was not sure of, by their motion",
    "links_refined": "Links of tracklets refined in the images",
    "links_not_refined": "Links of tracklets not refined",
}
_REJECTIONS = {
    "frames_not_registered": ("frames", "not registered to the map", None),
    "gaps_too_long": ("frames", "the next one comes too late", None),
    "speed": ("links", "faster than a vehicle", "links_tried"),
    "axis": ("links", "not along the car's axis", "links_tried"),
    "appearance": ("links", "another car has the more similar appearance", "links_tried"),
    "turn": ("pairs", "change direction too fast", "pairs_tried"),
    "acceleration": ("pairs", "change speed too fast", "pairs_tried"),
    "not_best": ("pairs", "another pair with the same car is more likely", "pairs_tried"),
    "confidence": ("pairs", "most likely, but ambiguous", "pairs_tried"),
}
"""Gate -> what it rejects, why, and the total it is a fraction of."""


def render_report(report: Report, figures: Sequence[ReportFigure]) -> str:
    """The report as one HTML document.

    Parameters
    ----------
    report
        Facts, tables and curves.
    figures
        Images, the maps first.
    """
    style = report_style()
    digest = b64encode(sha256(style.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'; "
        "base-uri 'none'; form-action 'none'"
    )  # fmt: skip
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="referrer" content="no-referrer">\n<link rel="icon" href="data:,">\n'
        f"<title>{escape(report.title)}</title>\n<style>{style}</style>\n</head>\n<body>\n"
        f"<header><h1>{escape(report.title)}</h1><p>{escape(report.source)}</p></header>\n"
        f"<main>\n{render_sections(report, figures)}\n</main>\n</body>\n</html>\n"
    )


def report_style() -> str:
    """The style sheet of `render_sections`."""
    return files("velfield.report").joinpath("report.css").read_text(encoding="utf-8")


def render_sections(report: Report, figures: Sequence[ReportFigure]) -> str:
    """The report's sections and footer: a page's body below its title."""
    sections = [
        _warnings(report),
        _section("Few vehicles at each pixel", f"<p>{escape(report.low_coverage_note)}</p>", "coverage-note")
        if report.low_coverage_note
        else "",
        _facts(report.facts),
        _section("Notes", _items(report.notes), "notes") if report.notes else "",
        *map(_figure, figures),
        _stages(report.stages),
        _registration(report),
        _detection(report),
        _gates(report.gates),
        _frames_lost(report.frames_lost),
        _pairs("Inputs", report.inputs),
        _files(report.files),
    ]
    return (
        '<div class="sections">\n'
        + "\n".join(section for section in sections if section)
        + f"\n</div>\n<footer>velfield {escape(report.version)}, {escape(report.created)}</footer>"
    )


def _section(title: str, body: str, kind: str = "") -> str:
    attribute = f' class="{kind}"' if kind else ""
    return f"<section{attribute}><h2>{escape(title)}</h2>{body}</section>"


def _scrolled(name: str, table: str, kind: str = " narrow") -> str:
    """A table that scrolls sideways where the screen is narrow, by keyboard too."""
    return f'<div class="scroll{kind}" tabindex="0" role="group" aria-label="{escape(name)}">{table}</div>'


def _items(texts: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(text)}</li>" for text in texts) + "</ul>"


def _warnings(report: Report) -> str:
    lost = sum(stage.lost for stage in report.stages)
    lines = list(report.warnings)
    if report.frames_lost or lost:
        frames = count_text(len(report.frames_lost), "frame")
        lines.insert(0, f"Not complete: {frames} and {count_text(lost, 'unit')} lost, as listed below.")
    elif report.footage_lost:
        lines.insert(0, "Not complete: a part of the recording is not there, as listed below.")
    return _section("Warnings", _items(lines), "warnings") if lines else ""


def _facts(facts: Sequence[tuple[str, str]]) -> str:
    if not facts:
        return ""
    cells = "".join(f"<div><dt>{escape(label)}</dt><dd>{escape(value)}</dd></div>" for label, value in facts)
    return f'<section class="facts" aria-label="In short"><dl>{cells}</dl></section>'


def _figure(figure: ReportFigure) -> str:
    if figure.file is None:
        source = f'src="data:{figure.mime};base64,{b64encode(figure.data).decode()}"'
    else:
        source = f'loading="lazy" src="{_path(figure.file)}"'
    image = f'<img alt="{escape(figure.alt_text)}" {source}>'
    link = ""
    if figure.full_size:
        link = f' <a href="{_path(figure.full_size)}">Full size</a>'
    body = f"<figure>{image}<figcaption>{escape(figure.caption)}{link}</figcaption></figure>"
    return _section(figure.title, body)


def _plot(svg: bytes, alt_text: str) -> str:
    return f'<img class="plot" alt="{alt_text}" src="data:image/svg+xml;base64,{b64encode(svg).decode()}">'


def _stages(stages: Sequence[ReportStage]) -> str:
    if not stages:
        return ""
    rows = "".join(
        f'<tr><th scope="row">{escape(stage.name)}</th><td>{escape(stage.text)}</td>'
        f'<td class="number">{stage.seconds:.1f}</td></tr>'
        for stage in stages
    )
    total = sum(stage.seconds for stage in stages)
    head = _head("Stage", "Result", number="Seconds of work")
    foot = f'<tfoot><tr><th scope="row">all</th><td></td><td class="number">{total:.1f}</td></tr></tfoot>'
    return _section("Stages", _scrolled("Stages", f"<table>{head}<tbody>{rows}</tbody>{foot}</table>", ""))


def _head(*names: str, number: str) -> str:
    cells = "".join(f'<th scope="col">{name}</th>' for name in names)
    return f'<thead><tr>{cells}<th scope="col" class="number">{number}</th></tr></thead>'


def _registration(report: Report) -> str:
    series = report.residual
    if series is None or not series.times_s:
        return ""
    good = sorted(r for r in series.residual_px if r is not None)
    text = f"{len(good)} of {count_text(len(series.times_s), 'frame')} registered."
    if good:
        middle, late = good[len(good) // 2], good[min(int(len(good) * 0.95), len(good) - 1)]
        text += f" Residual on held-out control points: median {middle:.2f} px, 95 % below {late:.2f} px."
    return _section(
        "Registration", f"<p>{escape(text)}</p>{_plot(residual_plot(series), 'Registration residual against time')}"
    )


def _detection(report: Report) -> str:
    curve = report.detection
    if curve is None or not curve.recall:
        return ""
    text = f"{report.detection_source or 'Precision and recall of the detector, measured on'} {curve.description}."
    plot = _plot(precision_recall_plot(curve), "Precision of the detector against its recall")
    return _section("Detection", f"<p>{escape(text)}</p>{plot}")


def _gates(gates: dict[str, int]) -> str:
    if not gates:
        return ""
    kept = _table(["Candidates", "Number"], totals_table(gates), numbers=1)
    lost = _table(["Rejected", "Reason", "Number", "Fraction"], rejection_table(gates), numbers=2)
    return _section("Tracking", _scrolled("Candidates", kept) + _scrolled("Rejected", lost))


def totals_table(gates: Mapping[str, int]) -> list[tuple[str, ...]]:
    """Candidates and accepted ones: description and count. A count without a description has its own name."""
    known = [(words, f"{gates[name]:,}") for name, words in _TOTALS.items() if name in gates]
    others = [name for name in gates if name not in _TOTALS and name not in _REJECTIONS]
    return [*known, *((name.replace("_", " "), f"{gates[name]:,}") for name in others)]


def rejection_table(gates: Mapping[str, int]) -> list[tuple[str, ...]]:
    """Rejected candidates by gate: kind, reason, count, and fraction of those tried."""
    return [
        (kind, why, f"{gates[name]:,}", _fraction(gates[name], gates.get(total or "", 0)))
        for name, (kind, why, total) in _REJECTIONS.items()
        if name in gates
    ]


def _fraction(count: int, tried: int) -> str:
    return f"{100 * count / tried:.0f} %" if tried else ""


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: int) -> str:
    """A table whose last columns are numbers; nothing where it has no rows."""
    if not rows:
        return ""
    kinds = [""] * (len(head) - numbers) + [' class="number"'] * numbers
    titles = "".join(f'<th scope="col"{kind}>{title}</th>' for title, kind in zip(head, kinds, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td{kind}>{escape(cell)}</td>" for cell, kind in zip(row, kinds, strict=True)) + "</tr>"
        for row in rows
    )
    return f"<table><thead><tr>{titles}</tr></thead><tbody>{body}</tbody></table>"


def _frames_lost(frames: Sequence[str]) -> str:
    if not frames:
        return ""
    body = f"<details><summary>{count_text(len(frames), 'frame')} without tracklets</summary>{_items(frames)}</details>"
    return _section("Frames lost", body)


def _pairs(title: str, pairs: Sequence[tuple[str, str]]) -> str:
    if not pairs:
        return ""
    rows = "".join(f'<tr><th scope="row">{escape(a)}</th><td>{escape(b)}</td></tr>' for a, b in pairs)
    return _section(title, _scrolled(title, f"<table><tbody>{rows}</tbody></table>"))


def _files(listed: Sequence[tuple[str, str]]) -> str:
    if not listed:
        return ""
    items = "".join(f'<li><a href="{_path(path)}">{escape(path)}</a> {escape(what)}</li>' for path, what in listed)
    return _section("Files", f"<ul>{items}</ul>")


def _path(relative: str) -> str:
    """A path inside the run folder as a link; the colon is quoted, else it would be parsed as a scheme."""
    return "./" + quote(relative)
