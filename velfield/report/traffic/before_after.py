"""Before and after as one page: what changed by more than chance, the turns side by side, all that was compared."""

from base64 import b64encode
from collections.abc import Sequence
from html import escape

from velfield.analysis.answers import seen_text
from velfield.analysis.changes import FDR_LEVEL, Change, common_junctions
from velfield.analysis.intervals import Estimate
from velfield.analysis.movements.movements import JunctionMovements
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.report.drawing import figure_bytes, new_figure
from velfield.report.traffic.report import DPI, page_html
from velfield.report.traffic.turning import draw_turning

_UNITS = {"m/s": (3.6, "km/h"), "": (100.0, "%")}
"""Displayed unit and factor, by unit; shares in per cent."""
NOTHING_COMPARED = (
    "no share, flow, delay, cycle or free-flow speed could be compared: none is known at the same place in both, as of "
    "clips that are too short"
)
_WIDTH_IN, _HEIGHT_IN = 11.0, 4.4


def before_after_html(
    before: TrafficAnalysis,
    after: TrafficAnalysis,
    changes: Sequence[Change],
    *,
    pixels: Sequence[str] = (),
    maps: Sequence[tuple[str, str]] = (),
) -> str:
    """The page.

    Parameters
    ----------
    changes
        What `velfield.analysis.changes.find_changes` gives of both.
    pixels
        Lines on direction, speed and volume at the pixels of the map.
    maps
        Title and address of each map of what changed.
    """
    real = [change for change in changes if change.significant]
    found = "".join(f"<li>{escape(change_text(change))}</li>" for change in real)
    verdict = f"<p>{len(real)} of {len(changes)} comparisons of junctions and roads.</p>"
    if not changes:
        verdict = f"<p>{NOTHING_COMPARED}.</p>"
    elif real:
        verdict += f"<ul>{found}</ul>"
    else:
        verdict += "<p>Nothing that was compared differs by more than chance: film longer to see smaller changes.</p>"
    pictures = "".join(
        _turns(old, new) for old, new in common_junctions(before, after) if old.movements and new.movements
    )
    at_pixels = "".join(f"<li>{escape(line)}</li>" for line in pixels)
    figures = f"<h2>On the map</h2><ul class='pixels'>{at_pixels}</ul>" if pixels else ""
    figures += "".join(
        f'<figure><h2>{escape(title)}</h2><img src="{escape(url)}" alt="{escape(title)}"></figure>'
        for title, url in maps
    )
    rows = "".join(
        f'<tr><td class="text">{escape(c.what)}</td>{_cell(c.before, c.unit)}{_cell(c.after, c.unit)}'
        f'<td>{c.p_value:.2g}</td><td class="text">{"yes" if c.significant else ""}</td></tr>'
        for c in changes
    )
    heads = "".join(f"<th>{head}</th>" for head in ("Quantity", "Before", "After", "p", "More than chance"))
    table = f"<div class='scroll'><table><tr>{heads}</tr>{rows}</table></div>"
    compared = f"<h2>All that was compared</h2>{table}" if changes else ""
    seen = [seen_text(analysis.trajectories) for analysis in (before, after)]
    return page_html(
        "Before and after",
        f"Before: {seen[0]}. After: {seen[1]}.",
        f"<h2>What changed</h2>{verdict}"
        "<p class='note'>In brackets: the 90 % interval, and n. Of the changes that are listed some "
        f"{FDR_LEVEL:.0%} are chance (false discovery rate).</p>{pictures}{figures}{compared}",
    )


def change_text(change: Change) -> str:
    """A change in words.

    Examples
    --------
    >>> import numpy as np
    >>> a, b = Estimate(10.0, 9.0, 11.0, 40), Estimate(12.0, 11.5, 12.5, 50)
    >>> change_text(Change("free-flow speed at 3, 4 m", "m/s", np.zeros(2), a, b, 0.001, True))
    'free-flow speed at 3, 4 m: from 36 (32.4 to 39.6, n 40) to 43.2 (41.4 to 45, n 50) km/h'
    """
    factor, unit = _UNITS.get(change.unit, (1.0, change.unit))
    was, now = (_text(estimate, factor) for estimate in (change.before, change.after))
    return f"{change.what}: from {was} to {now} {unit}"


def _text(estimate: Estimate, factor: float) -> str:
    e = estimate.in_units(factor)
    return f"{e.value:.3g} ({e.low:.3g} to {e.high:.3g}, n {e.n})"


def _cell(estimate: Estimate, of: str) -> str:
    factor, unit = _UNITS.get(of, (1.0, of))
    return f"<td>{escape(_text(estimate, factor))} {escape(unit)}</td>"


def _turns(old: JunctionMovements, new: JunctionMovements) -> str:
    """The turning-movement diagrams of a junction side by side."""
    figure = new_figure(_WIDTH_IN, _HEIGHT_IN, dpi=DPI)
    for k, (title, found) in enumerate((("Before", old), ("After", new))):
        axes = figure.add_subplot(1, 2, k + 1)
        draw_turning(axes, found=found)
        axes.set_title(f"{title}: junction {found.junction.number}")
    figure.tight_layout()
    url = f"data:image/png;base64,{b64encode(figure_bytes(figure, 'png')).decode()}"
    x, y = old.junction.centre_m
    title = f"Junction at {x:.0f}, {y:.0f} m: where vehicles go"
    caption = "Vehicles counted, and their share of those that enter by the same arm; arrows as wide as the flow."
    return (
        f'<figure><h2>{title}</h2><img src="{url}" alt="{title}, before and after">'
        f"<figcaption>{caption}</figcaption></figure>"
    )
