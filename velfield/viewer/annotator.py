"""The annotation page's server: serves frames and receives marks, on this machine alone.

It writes one file, the labels, and only for requests with the token of the page it served, which another page in the
same browser does not have.
"""

import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Any

from schemas.annotation import Marks
from velfield.errors import InputError
from velfield.report.figures import png_bytes
from velfield.report.viewer_page import page_is_built, render_annotator
from velfield.viewer.annotations import Frames, read_marks, write_marks
from velfield.viewer.server import headers_for, trusted_host_middleware

if TYPE_CHECKING:
    from starlette.applications import Starlette

_MAX_BYTES = 16 * 2**20


def annotate_app(frames: Frames, labels: Path) -> "Starlette":
    """The server that shows ``frames`` and writes ``labels``.

    Raises
    ------
    InputError
        The labels file is of another kind, or the page is not built.
    """
    from pydantic import ValidationError
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException
    from starlette.requests import Request
    from starlette.responses import HTMLResponse, JSONResponse, Response
    from starlette.routing import Route

    if not page_is_built():
        raise InputError("the annotation page is not built in this checkout: `make page`, then try again")
    read_marks(labels)
    token = secrets.token_urlsafe(24)

    def page(_: Request) -> HTMLResponse:
        html = render_annotator(f"Cars of {_describe(frames)}", _page_content(frames, labels, token))
        return HTMLResponse(html, headers=headers_for(html))

    def image(request: Request) -> Response:
        number = request.path_params["number"]
        if number >= len(frames.names):
            raise HTTPException(404)
        return Response(png_bytes(frames.read(number)), media_type="image/png", headers=headers_for(None))

    async def save(request: Request) -> JSONResponse:
        if not secrets.compare_digest(request.headers.get("x-token", ""), token):
            raise HTTPException(403, "the token is another server's: load the page again")
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > _MAX_BYTES:
                raise HTTPException(413)
        try:
            after = write_marks(labels, Marks.model_validate_json(body), frames)
        except (ValidationError, InputError) as error:
            raise HTTPException(422, str(error)) from error
        return JSONResponse({"cars": len(after.cars), "frames": len(after.frames)}, headers=headers_for(None))

    routes = [
        Route("/", page),
        Route("/frame/{number:int}.png", image),
        Route("/labels", save, methods=["POST"]),
    ]
    return Starlette(routes=routes, middleware=[trusted_host_middleware()])


def _describe(frames: Frames) -> str:
    return frames.names[0] if len(frames.names) == 1 else f"{len(frames.names)} frames"


def _page_content(frames: Frames, labels: Path, token: str) -> dict[str, Any]:
    before = read_marks(labels)
    shown = set(frames.names)
    return {
        "token": token,
        "labels": labels.name,
        "names": frames.names,
        "width": frames.width,
        "height": frames.height,
        "marks": {
            "frames": [name for name in before.frames if name in shown],
            "cars": [car.model_dump(mode="json") for car in before.cars if car.frame in shown],
        },
    }
