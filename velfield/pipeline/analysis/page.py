"""The report: one HTML file, with the map of lanes and every table."""

from base64 import b64encode
from collections.abc import Mapping
from html import escape

from schemas.analysis import AnalysisRecord, AnalysisTable, Cell, EstimateRecord, LanesRecord
from velfield.analysis.answers import duration_text

MAX_ROWS = 400
"""Rows of a table that are shown; the workbook and the JSON have all."""
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 75em; padding: 0 1em; color: #1b1f24 }
table { border-collapse: collapse; margin: .6em 0 2em; font-size: 13px; font-variant-numeric: tabular-nums }
th, td { border-bottom: 1px solid #d5d9de; padding: .25em .7em; text-align: right; vertical-align: top }
th { text-align: left; border-bottom: 2px solid #8a929b; white-space: normal }
td.text { text-align: left } .ci { color: #667079; white-space: nowrap } .none { color: #98a1aa }
svg { width: 100%; height: auto; background: #f3f4f6; border: 1px solid #d5d9de }
p.note { color: #4b545d; max-width: 60em }
nav a { margin-right: 1.2em }
figure { margin: 0 0 1em } figure img { max-width: 100% }
"""
_COLOURS = ("#2563eb", "#d97706", "#059669", "#dc2626", "#7c3aed", "#0891b2", "#be185d", "#4d7c0f")


def report_html(
    record: AnalysisRecord,
    lanes: LanesRecord,
    shape: tuple[int, int],
    background: str | None,
    clips: Mapping[int, bytes] | None = None,
) -> str:
    """The report.

    Parameters
    ----------
    record, lanes
        The answers.
    shape
        (height, width) of the base image.
    background
        The base image as a data URL, or None.
    clips
        JPEG strips of unusual tracks, by their row.
    """
    links = "".join(f'<a href="#{table.name}">{escape(table.title)}</a>' for table in record.tables)
    head = (
        f"{record.tracks} tracks of moving vehicles in {duration_text(record.duration_s)}. Grey: the 90 % interval "
        "and, in brackets, the number of vehicles (cycles, events) that it rests on."
    )
    scale = (
        "" if record.gsd_known else " The ground sample distance is not known: lengths and speeds are by the paper's."
    )
    sections = "".join(_section(table) + _clips(table, clips or {}) for table in record.tables)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Traffic analysis</title><style>{_STYLE}</style>'
        f"<h1>Traffic analysis</h1><p>{escape(head + scale)}</p><nav>{links}</nav>"
        f"{_map(lanes, shape, background)}{sections}</html>"
    )


def _map(lanes: LanesRecord, shape: tuple[int, int], background: str | None) -> str:
    height, width = shape
    unit = max(width, height) / 900
    parts = [f'<image href="{background}" width="{width}" height="{height}" opacity="0.55"/>'] if background else []
    for lane in lanes.lanes:
        points = " ".join(f"{x},{y}" for x, y in lane.xy_px)
        colour = _COLOURS[lane.lane % len(_COLOURS)]
        parts.append(
            f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{1.6 * unit:.2f}" '
            f'marker-end="url(#a)"><title>lane {lane.lane}: {lane.tracks} tracks</title></polyline>'
        )
        x, y = lane.xy_px[len(lane.xy_px) // 2]
        parts.append(f'<text x="{x}" y="{y}" font-size="{9 * unit:.1f}" fill="{colour}">{lane.lane}</text>')
    for junction in lanes.junctions:
        points = " ".join(f"{x},{y}" for x, y in junction.hull_px)
        parts.append(
            f'<polygon points="{points}" fill="#0003" stroke="#000" stroke-width="{0.6 * unit:.2f}"/>'
            f'<text x="{junction.x_px}" y="{junction.y_px}" font-size="{14 * unit:.1f}" text-anchor="middle">'
            f"J{junction.junction}</text>"
        )
    arrow = (
        '<defs><marker id="a" viewBox="0 0 6 6" refX="5" refY="3" markerWidth="5" markerHeight="5" orient="auto">'
        '<path d="M0 0L6 3L0 6z"/></marker></defs>'
    )
    return f'<svg viewBox="0 0 {width} {height}">{arrow}{"".join(parts)}</svg>'


def _section(table: AnalysisTable) -> str:
    heads = "".join(f"<th>{escape(c.title)}{f', {escape(c.unit)}' if c.unit else ''}</th>" for c in table.columns)
    rows = "".join(
        f"<tr>{''.join(_cell(row.cells.get(c.name)) for c in table.columns)}</tr>" for row in table.rows[:MAX_ROWS]
    )
    more = f"<p>{len(table.rows) - MAX_ROWS} more rows in analysis.json.</p>" if len(table.rows) > MAX_ROWS else ""
    body = f"<table><tr>{heads}</tr>{rows}</table>{more}" if table.rows else ""
    picture = diagram_svg(table) if table.name == "fundamental_diagram" and table.rows else ""
    return f'<h2 id="{table.name}">{escape(table.title)}</h2><p class="note">{escape(table.note)}</p>{picture}{body}'


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


def diagram_svg(table: AnalysisTable) -> str:
    """Flow against density, a point a slice; the colours are those of the lanes on the map."""
    names = ("lane", "density", "flow", "begin")
    known = [(int(lane), x, y, t) for lane, x, y, t in ([_number(row.cells[n]) for n in names] for row in table.rows)]
    far, high = max(x for _, x, _, _ in known), max(y for _, _, y, _ in known)
    width, height, left = 640, 360, 60
    at = [
        (lane, left + x / far * (width - left - 20), height - 40 - y / high * (height - 60), t)
        for lane, x, y, t in known
    ]
    dots = "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{_COLOURS[lane % len(_COLOURS)]}">'
        f"<title>lane {lane}, from {t:g} s</title></circle>"
        for lane, x, y, t in at
    )
    axes = f'<path d="M{left} 20V{height - 40}H{width - 20}" fill="none" stroke="#8a929b"/>'
    labels = "".join(
        f'<text x="{x}" y="{y}" font-size="12" text-anchor="{anchor}">{text}</text>'
        for x, y, anchor, text in (
            (left - 6, 26, "end", f"{high:.0f}"),
            (left - 6, height - 38, "end", "0"),
            (width - 20, height - 22, "end", f"{far:.0f}"),
            (width / 2, height - 8, "middle", "density, veh/km"),
            (left + 6, 16, "start", "flow, veh/h"),
        )
    )
    return f'<svg viewBox="0 0 {width} {height}" style="max-width: 45em">{axes}{labels}{dots}</svg>'


def _number(cell: Cell) -> float:
    return float(cell) if isinstance(cell, int | float) else 0.0


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
