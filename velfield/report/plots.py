"""Small plots as inline SVG: no script, no library, coloured by the page's style.

By hand, as plotting libraries write fixed colours and fonts. Each plot is drawn twice, for wide and for narrow screens,
and the style sheet shows one of them: a plot scaled down to a narrow screen has illegible letters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from schemas.report import PrecisionRecall, ResidualSeries
from velfield.report.figures import round_up
from velfield.report.panel import bar_ticks

_RIGHT, _TOP, _BOTTOM = 16, 32, 44
_LETTER_PX = 7.0  # width of a letter of a label, at most


@dataclass(frozen=True)
class _Size:
    name: str
    width: int
    height: int
    columns: int
    """Most points of a line."""


_SIZES = (_Size("wide", 720, 280, 600), _Size("narrow", 330, 230, 300))


def _on_each_screen(draw: Callable[[_Size], "_Plot"]) -> str:
    return "".join(draw(size).svg() for size in _SIZES)


def residual_plot(series: ResidualSeries) -> str:
    """Registration residual against time: a line, gaps and red ticks where a frame is not registered."""
    times = np.array(series.times_s, np.float64)
    residual = np.array([np.nan if r is None else r for r in series.residual_px], np.float64)
    lost = times[np.isnan(residual)]
    maximum = float(np.nanmax(residual)) if np.isfinite(residual).any() else 1.0

    def draw(size: _Size) -> _Plot:
        plot = _Plot(
            size,
            x_range=(float(times.min(initial=0.0)), float(times.max(initial=1.0))),
            y_top=round_up(maximum * 1.1),
            x_label="time, s",
            y_label="residual, px",
            description=f"Registration residual against time; {len(lost)} frames are not registered.",
        )
        if series.limit_px is not None and series.limit_px <= plot.y_top:
            plot.rule(series.limit_px, f"limit {series.limit_px:g} px")
        plot.line(*_decimate(times, residual, size.columns))
        for time in lost[:: max(1, len(lost) // size.columns)]:
            plot.tick(float(time))
        return plot

    return _on_each_screen(draw)


def precision_recall_plot(curve: PrecisionRecall) -> str:
    """Precision against recall, the chosen threshold marked."""

    def draw(size: _Size) -> _Plot:
        plot = _Plot(
            size,
            x_range=(0.0, 1.0),
            y_top=1.0,
            x_label="recall",
            y_label="precision",
            description="Precision of the car detector against its recall.",
        )
        plot.line(np.array(curve.recall, np.float64), np.array(curve.precision, np.float64))
        if curve.operating_point is not None:
            x, y = curve.recall[curve.operating_point], curve.precision[curve.operating_point]
            plot.mark(x, y, f"chosen: precision {y:.2f}, recall {x:.2f}")
        return plot

    return _on_each_screen(draw)


def _decimate(times: np.ndarray, values: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Decimate to at most ``most`` points, the maximum of each run of frames, so that no peak is lost."""
    if len(times) <= most:
        return times, values
    step = -(-len(times) // most)
    starts = np.arange(0, len(times), step)
    highest = np.maximum.reduceat(np.where(np.isnan(values), -np.inf, values), starts)
    return times[starts], np.where(np.isneginf(highest), np.nan, highest)


class _Plot:
    """Axes from 0 upwards, and the marks in them."""

    def __init__(
        self, size: _Size, *, x_range: tuple[float, float], y_top: float, x_label: str, y_label: str, description: str
    ) -> None:
        self.size, self.right = size, size.width - _RIGHT
        self.foot = size.height - _BOTTOM
        names = [f"{value:g}" for value in bar_ticks(y_top)]
        self.left = round(14 + _LETTER_PX * max(map(len, names)))
        self.x_low, self.x_high = x_range[0], max(x_range[1], x_range[0] + 1e-6)
        self.y_top = y_top
        self.description = description
        self.parts: list[str] = []
        for value, name in zip(bar_ticks(y_top), names, strict=True):
            self.parts.append(f'<line class="grid" x1="{self.left}" x2="{self.right}" {self._at_y(value)}/>')
            self._text(self.left - 8, self._y(value) + 4, name, "end")
        for value in self._x_ticks():
            self._text(self._x(value), self.foot + 18, f"{value:g}", "middle")
        self._text((self.left + self.right) / 2, size.height - 6, x_label, "middle")
        self._text(4, 14, y_label, "start")

    def line(self, x: np.ndarray, y: np.ndarray) -> None:
        """A line, broken where y is not finite; a single point is a dot."""
        good = np.isfinite(y)
        for run in np.split(np.arange(len(x)), np.flatnonzero(np.diff(good.astype(np.int8))) + 1):
            if not len(run) or not good[run[0]]:
                continue
            points = " ".join(f"{self._x(x[i]):.1f},{self._y(y[i]):.1f}" for i in run)
            if len(run) == 1:
                self.parts.append(
                    f'<circle class="dot" cx="{self._x(x[run[0]]):.1f}" cy="{self._y(y[run[0]]):.1f}" r="2"/>'
                )
            else:
                self.parts.append(f'<polyline class="line" points="{points}"/>')

    def rule(self, y: float, label: str) -> None:
        """A level across the plot."""
        self.parts.append(f'<line class="rule" x1="{self.left}" x2="{self.right}" {self._at_y(y)}/>')
        self._text(self.right - 4, self._y(y) - 5, label, "end")

    def tick(self, x: float) -> None:
        """A mark on the x axis."""
        at = f"{self._x(x):.1f}"
        self.parts.append(f'<line class="lost" x1="{at}" x2="{at}" y1="{self.foot - 8}" y2="{self.foot}"/>')

    def mark(self, x: float, y: float, label: str) -> None:
        """A labelled point, its label on the side with more room."""
        self.parts.append(f'<circle class="dot" cx="{self._x(x):.1f}" cy="{self._y(y):.1f}" r="5"/>')
        if x > (self.x_low + self.x_high) / 2:
            end = max(self._x(x) - 10, self.left + _LETTER_PX * len(label))
            self._text(end, self._y(y) + 18, label, "end")
        else:
            start = min(self._x(x) + 10, self.right - _LETTER_PX * len(label))
            self._text(start, self._y(y) + 18, label, "start")

    def svg(self) -> str:
        body = "".join(self.parts)
        return (
            f'<svg class="plot {self.size.name}" viewBox="0 0 {self.size.width} {self.size.height}" role="img" '
            f'aria-label="{escape(self.description)}">{body}</svg>'
        )

    def _x_ticks(self) -> Sequence[float]:
        span = self.x_high - self.x_low
        most = (self.right - self.left) / 54  # labels that fit side by side
        power = 10.0 ** np.floor(np.log10(span / most))
        step = next(s * power for s in (1, 2, 5, 10) if span / (s * power) <= most)
        first = np.ceil(self.x_low / step - 1e-9) * step
        return [float(v) + 0.0 for v in np.arange(first, self.x_high + 1e-9, step).round(9)]  # + 0.0: no minus zero

    def _x(self, value: float) -> float:
        return float(self.left + (value - self.x_low) / (self.x_high - self.x_low) * (self.right - self.left))

    def _y(self, value: float) -> float:
        return float(self.foot - value / self.y_top * (self.foot - _TOP))

    def _at_y(self, value: float) -> str:
        return f'y1="{self._y(value):.1f}" y2="{self._y(value):.1f}"'

    def _text(self, x: float, y: float, text: str, anchor: str) -> None:
        self.parts.append(f'<text class="label" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>')
