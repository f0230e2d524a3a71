"""The pages with scripts, a run's viewer and those that write: each one HTML file with its script and style inside.

The scripts are built from ``page/`` in the repository (`make page`) into ``velfield/report/page/``, which the wheel
includes.
"""

import json
from base64 import b64encode
from collections.abc import Mapping, Sequence
from hashlib import sha256
from html import escape
from importlib.resources import files
from typing import Literal

import numpy as np

from schemas.report import Report, ReportFigure
from velfield.report.colours import direction_colours, ramp_colours
from velfield.report.report import render_sections, report_style

_COLOURS = 512
NOT_BUILT = "the viewer page is not built in this checkout, index.html is the report alone: `make page`, then run again"


def page_is_built() -> bool:
    """Whether the pages' scripts are built."""
    return files("velfield.report").joinpath("page/viewer.js").is_file()


def licences() -> str:
    """Licences of the packages in the scripts."""
    return _read_built("LICENSES.txt")


def render_viewer(report: Report, figures: Sequence[ReportFigure]) -> str:
    """A run's page: the map, which reads the run folder's tiles, and the report as its summary.

    The content security policy blocks all external content; ``wasm-unsafe-eval`` and ``connect-src data:`` are for the
    decoder of the tiles.
    """
    return _page(
        "viewer",
        {"title": escape(report.title), "source": escape(report.source), "report": render_sections(report, figures)},
    )


def render_editor(
    name: Literal["annotate", "georeference"], title: str, content: Mapping[str, object], *, image_origin: str = ""
) -> str:
    """The page for labelling cars, or for marking control points.

    ``content`` is its server's data, ``image_origin`` the one other server that it may load images from.
    """
    return _page(name, {"title": escape(title), "data": _json(content)}, image_origin)


def _page(name: str, parts: Mapping[str, str], image_origin: str = "") -> str:
    style, script = report_style() + _read_built(f"{name}.css"), _read_built(f"{name}.js")
    policy = (
        f"default-src 'none'; script-src '{_hash(script)}' 'wasm-unsafe-eval'; style-src '{_hash(style)}'; "
        f"img-src 'self' data: blob:{image_origin and ' ' + image_origin}; connect-src 'self' data:; base-uri 'none'; "
        "form-action 'none'"
    )
    filled = {"policy": policy, "style": style, "colours": _json(_colours()), "script": script, **parts}
    pieces = _read_built(f"{name}.html").split("{{")
    html = [pieces[0]]
    for piece in pieces[1:]:  # each part once; parts are not expanded in turn
        part, _, rest = piece.partition("}}")
        html += [filled[part], rest]
    return "".join(html)


def _read_built(name: str) -> str:
    return files("velfield.report").joinpath(f"page/{name}").read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return "sha256-" + b64encode(sha256(text.encode()).digest()).decode()


def _json(value: object) -> str:
    """JSON that is safe in a script element: it cannot contain an end tag or a comment."""
    return json.dumps(value).replace("<", "\\u003c")


def _colours() -> dict[str, str]:
    wheel = direction_colours(np.arange(_COLOURS) * (2 * np.pi / _COLOURS))
    return {"wheel": wheel.tobytes().hex(), "ramp": ramp_colours(np.linspace(0, 1, _COLOURS)).tobytes().hex()}
