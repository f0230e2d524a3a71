"""Plots of a run's quality: registration residual against time, precision against recall of the detector."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from schemas.detector import PrecisionRecallCurve
from schemas.report import ResidualSeries
from velfield.report.drawing import figure_bytes, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_POINTS = 600
_LINE, _ALARM = "#5b3fd6", "#b3261e"


def residual_plot(series: ResidualSeries) -> bytes:
    """SVG of the registration residual against time: a line, and red ticks where a frame is not registered."""
    times = np.array(series.times_s, np.float64)
    residual = np.array([np.nan if r is None else r for r in series.residual_px], np.float64)

    def draw(axes: "Axes") -> None:
        axes.plot(*highest_of_runs(times, residual), color=_LINE, marker="o" if len(times) < 100 else "", markersize=2)
        lost = times[np.isnan(residual)]
        axes.plot(lost[:: max(1, len(lost) // _MOST_POINTS)], np.zeros(len(lost[:: max(1, len(lost) // _MOST_POINTS)])),
                  "|", color=_ALARM, markersize=14)  # fmt: skip
        if series.limit_px is not None and np.nanmax(residual, initial=0.0) > series.limit_px / 3:
            axes.axhline(series.limit_px, color=_ALARM, linestyle="--")
            axes.annotate(f"limit {series.limit_px:g} px", (1, series.limit_px), xycoords=("axes fraction", "data"),
                          ha="right", va="bottom", color=_ALARM)  # fmt: skip
        axes.set(xlabel="time, s", ylabel="residual, px", ylim=(0, None))

    return _plot(draw)


def precision_recall_plot(curve: PrecisionRecallCurve) -> bytes:
    """SVG of precision against recall, the chosen threshold marked."""

    def draw(axes: "Axes") -> None:
        axes.plot(curve.recall, curve.precision, color=_LINE)
        axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1.02), ylim=(0, 1.02))
        if curve.operating_point is not None:
            x, y = curve.recall[curve.operating_point], curve.precision[curve.operating_point]
            axes.plot([x], [y], "o", color=_LINE, markersize=8)
            label = f"chosen: precision {y:.2f}, recall {x:.2f}"
            axes.annotate(label, (x, y), (0, -18), textcoords="offset points", ha="right" if x > 0.5 else "left")

    return _plot(draw)


def _plot(draw: Callable[["Axes"], None]) -> bytes:
    figure = new_figure(3.8, 2.4)  # about the width of a phone's page: its letters can be read there
    axes = figure.add_subplot()
    axes.grid(axis="y", alpha=0.4)
    draw(axes)
    figure.tight_layout(pad=0.6)  # numbers are as wide as they are: 0.00125 px, or 1
    return figure_bytes(figure, "svg")


def highest_of_runs(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most `_MOST_POINTS`, the highest of each run of frames, so that no peak is lost; NaN where none is known."""
    if len(times) <= _MOST_POINTS:
        return times, values
    starts = np.arange(0, len(times), -(-len(times) // _MOST_POINTS))
    highest = np.maximum.reduceat(np.where(np.isnan(values), -np.inf, values), starts)
    return times[starts], np.where(np.isneginf(highest), np.nan, highest)
