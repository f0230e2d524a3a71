"""matplotlib's figures as arrays and files: by Agg, without pyplot's state, the same bytes for the same content.

matplotlib is imported when a figure is made: most commands draw none.
"""

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from schemas.arrays import RGBImage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POINTS_PER_INCH = 72
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "velfield",
    "pdf.fonttype": 42,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
_METADATA: dict[str, dict[str, str | None]] = {
    "pdf": {"CreationDate": None, "Creator": "velfield", "Producer": "velfield"},
    "svg": {"Date": None, "Creator": "velfield"},
    "png": {"Software": "velfield"},
}


def new_figure(width_in: float, height_in: float, *, dpi: float = 100) -> "Figure":
    """An empty figure on Agg's canvas."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width_in, height_in), dpi=dpi)
    FigureCanvasAgg(figure)
    return figure


def figure_pixels(figure: "Figure") -> RGBImage:
    """(h, w, 3) uint8 RGB at the figure's dpi."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]


def figure_bytes(figure: "Figure", kind: Literal["pdf", "svg", "png"]) -> bytes:
    """The figure as a file, without a date in it."""
    if kind == "pdf":
        return pages_bytes([figure])
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context(_STYLE):
        figure.savefig(buffer, format=kind, metadata=_METADATA[kind])
    return buffer.getvalue()


def pages_bytes(figures: Sequence["Figure"]) -> bytes:
    """The figures as the pages of one PDF."""
    import matplotlib
    from matplotlib.backends.backend_pdf import PdfPages

    buffer = io.BytesIO()
    with matplotlib.rc_context(_STYLE), PdfPages(buffer, metadata=_METADATA["pdf"]) as pages:
        for figure in figures:
            pages.savefig(figure)
    return buffer.getvalue()
