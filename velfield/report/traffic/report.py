"""The report of an analysis as one HTML file and as a PDF of a few pages."""

import textwrap
from base64 import b64encode
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

from schemas.analysis import AnalysisRecord, AnalysisTable, Cell, EstimateRecord
from schemas.flight import PAPER_GSD_M
from velfield.errors import count_text
from velfield.report.drawing import figure_bytes, new_figure, pages_bytes
from velfield.report.traffic.diagrams import WIDTH_IN, Diagram
from velfield.report.traffic.first_page import FirstPage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_ROWS = 400
"""Rows of a table that are shown; the workbook and the JSON have all."""
_PAGE_IN = (8.27, 11.69)
DPI = 130
_TOP_IN, _FOOT_IN = 11.0, 0.4
_WRAP, _LINE_IN = 112, 0.155
"""Characters and height of a line of the answers."""
BRACKETS = (
    "Numbers in brackets: the range in which the true value lies with 90 % probability, and n, the number of vehicles, "
    "cycles or events that it rests on. Level of service: from A, the best, to F."
)
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 1.5em auto; max-width: 58em; padding: 0 1em; color: #1b1f24 }
h1 { line-height: 1.2; margin-bottom: 0.2em } h2 { margin: 1.6em 0 0.3em }
.seen { font-size: 1.1em; color: #4b545d; margin: 0 0 1em }
dt { font-weight: 650; margin-top: 0.8em } dd { margin: 0 0 0 1em }
.withheld { border-left: 4px solid #8a929b; padding: 0.1em 1em; background: #f3f4f6 }
figure { margin: 0 0 1em } figure img { max-width: 100% } figcaption, p.note { color: #4b545d; font-size: 0.92em }
details { border-top: 1px solid #d5d9de; padding: 0.5em 0 } summary { cursor: pointer; font-weight: 600 }
.scroll { overflow-x: auto }
table { border-collapse: collapse; margin: 0.6em 0 1em; font-size: 13px; font-variant-numeric: tabular-nums }
th, td { border-bottom: 1px solid #d5d9de; padding: 0.25em 0.7em; text-align: right; vertical-align: top }
th { text-align: left; border-bottom: 2px solid #8a929b }
td.text { text-align: left } .ci { color: #667079; white-space: nowrap } .none { color: #6b747d }
@media print { details { display: none } }
"""


def report_html(
    record: AnalysisRecord, page: FirstPage, diagrams: Sequence[Diagram], clips: Mapping[int, bytes] | None = None
) -> str:
    """One HTML file: the first page, the diagrams, the tables folded.

    Parameters
    ----------
    clips
        JPEG strips of unusual tracks, by their row.
    """
    answers = "".join(
        f"<dt>{escape(question)}</dt>" + "".join(f"<dd>{escape(line)}</dd>" for line in lines)
        for question, lines in page.answers
    )
    withheld = "".join(f"<li>{escape(line)}</li>" for line in page.withheld)
    missing = f'<div class="withheld"><h2>What is not known</h2><ul>{withheld}</ul></div>' if withheld else ""
    pictures = [_picture(diagram) for diagram in diagrams]
    tables = "".join(_table(table) + _clips(table, clips or {}) for table in record.tables)
    return page_html(
        "Traffic analysis",
        escape(_seen(record, page)),
        f"{''.join(pictures[:1])}<h2>Answers</h2><dl>{answers}</dl><p class='note'>{BRACKETS}</p>{missing}"
        f"{''.join(pictures[1:])}<h2>Tables</h2><p class='note'>All rows are in analysis.xlsx and analysis.json.</p>"
        f"{tables}",
    )


def page_html(title: str, seen: str, body: str) -> str:
    """A page that holds all it shows: its title, what was seen, and the rest."""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{_STYLE}</style></head><body>'
        f'<h1>{title}</h1><p class="seen">{seen}</p>{body}</body></html>'
    )


def _seen(record: AnalysisRecord, page: FirstPage) -> str:
    known = (
        ""
        if record.gsd_known
        else f" The size of a pixel is not known: lengths and speeds are those of {PAPER_GSD_M} m, the paper's; give "
        "it by --gsd-m."
    )
    return f"{record.about}. {page.seen}.{known} velfield {record.code_version}."


def _picture(diagram: Diagram) -> str:
    figure = new_figure(WIDTH_IN, diagram.height_in, dpi=DPI)
    diagram.draw(figure.add_subplot())
    figure.tight_layout()
    url = f"data:image/png;base64,{b64encode(figure_bytes(figure, 'png')).decode()}"
    return (
        f'<figure id="{diagram.name}"><h2>{escape(diagram.title)}</h2><img src="{url}" alt="{escape(diagram.title)}">'
        f"<figcaption>{escape(diagram.caption)}</figcaption></figure>"
    )


def report_pdf(record: AnalysisRecord, page: FirstPage, diagrams: Sequence[Diagram]) -> bytes:
    """The first page and the diagrams as A4 pages, the same bytes for the same analysis."""
    pages, y = _front(record, page, diagrams[0]) if diagrams else ([], 0.0)
    for diagram in diagrams[1:]:
        if y - diagram.height_in - 0.9 < _FOOT_IN:
            pages.append(new_figure(*_PAGE_IN))
            y = _TOP_IN
        y = _place(pages[-1], diagram, y) - 0.35
    return pages_bytes(pages)


def _front(record: AnalysisRecord, page: FirstPage, place: Diagram) -> tuple[list["Figure"], float]:
    """The place and the answers, on as many pages as they need, and the height that is left on the last."""
    figure = new_figure(*_PAGE_IN)
    pages = [figure]
    figure.text(0.08, 0.945, "Traffic analysis", fontsize=20, fontweight="bold")
    y = 0.925 * _PAGE_IN[1]
    for line in textwrap.wrap(_seen(record, page), 100):
        figure.text(0.08, y / _PAGE_IN[1], line, fontsize=10, parse_math=False)
        y -= 0.19
    y = _place(figure, place, y - 0.05) - 0.1
    for question, lines in (("Answers", (BRACKETS,)), *page.sections):
        for line, follows in ((question, lines[0]), *((line, "") for line in lines)):
            if y - _LINE_IN * (len(_wrapped(line)) + len(_wrapped(follows))) < _FOOT_IN:
                pages.append(new_figure(*_PAGE_IN))
                y = _TOP_IN
            y = _write(pages[-1], line, y, bold=line == question)
        y -= 0.07
    return pages, y - 0.2


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, _WRAP)


def _write(figure: "Figure", text: str, y_in: float, *, bold: bool) -> float:
    for line in _wrapped(text):
        weight, x = ("bold", 0.08) if bold else ("normal", 0.1)
        figure.text(x, y_in / _PAGE_IN[1], line, fontsize=8.5, fontweight=weight, parse_math=False)
        y_in -= _LINE_IN
    return y_in


def _place(figure: "Figure", diagram: Diagram, top_in: float) -> float:
    """A diagram with its title and caption, from a height of the page downwards; returns where it ends."""
    high = _PAGE_IN[1]
    figure.text(0.08, (top_in - 0.05) / high, diagram.title, fontsize=12, fontweight="bold")
    bottom, below = top_in - 0.45 - diagram.height_in, 0.1 if diagram.bare else 0.55
    if diagram.bare:
        bottom += 0.65
    diagram.draw(figure.add_axes((0.13, (bottom + below) / high, 0.8, (diagram.height_in - 0.65) / high)))
    y = bottom - 0.02
    for line in textwrap.wrap(diagram.caption, 118):
        figure.text(0.08, y / high, line, fontsize=8, color="#4b545d")
        y -= 0.15
    return y


def _table(table: AnalysisTable) -> str:
    known, columns = [row for row in table.rows if not row.unknown], [c for c in table.columns if not c.unknown]
    heads = "".join(f"<th>{escape(c.title)}{f', {escape(c.unit)}' if c.unit else ''}</th>" for c in columns)
    rows = "".join(f"<tr>{''.join(_cell(row.cells.get(c.name)) for c in columns)}</tr>" for row in known[:MAX_ROWS])
    more = f"<p>{len(known) - MAX_ROWS} more rows in analysis.json.</p>" if len(known) > MAX_ROWS else ""
    left_out = [count_text(n, "row")] if (n := len(table.rows) - len(known)) else []
    left_out += [f"“{escape(c.title)}”" for c in table.columns if c.unknown]
    if left_out:
        more += f"<p>Not known, and left out here (analysis.xlsx has all): {', '.join(left_out)}.</p>"
    body = (f'<div class="scroll"><table><tr>{heads}</tr>{rows}</table></div>' if known else "") + more
    return (
        f'<details id="{table.name}"><summary>{escape(table.title)} ({len(table.rows)})</summary>'
        f'<p class="note">{escape(table.note)}</p>{body}</details>'
    )


def _clips(table: AnalysisTable, clips: Mapping[int, bytes]) -> str:
    """The strips below the table of unusual tracks: 2 s before to 2 s after, the vehicle in a ring."""
    if table.name != "unusual":
        return ""
    out = []
    for number, data in sorted(clips.items()):
        cells = table.rows[number].cells
        text = escape(f"{cells['kind']}, track {cells['track']}, frame {cells['frame']}, {cells['time']} s; 1 s apart")
        url = f"data:image/jpeg;base64,{b64encode(data).decode()}"
        out.append(f'<figure><img src="{url}" alt="{text}"><figcaption>{text}</figcaption></figure>')
    return "".join(out)


def _cell(cell: Cell) -> str:
    if isinstance(cell, EstimateRecord):
        if cell.value is None:
            return '<td class="none">too little data</td>'
        return f'<td>{cell.value:g} <span class="ci">{cell.low:g} to {cell.high:g} ({cell.n})</span></td>'
    if cell is None:
        return '<td class="none"></td>'
    if isinstance(cell, str):
        return f'<td class="text">{escape(cell)}</td>'
    return f"<td>{cell}</td>" if isinstance(cell, int) else f"<td>{cell:g}</td>"
