"""Servers of the pages that write: one page, the images it shows, and its requests, on this machine alone.

They write only for requests with the token of the page they served, which another page in the same browser does not
have, and one request at a time.
"""

import secrets
import threading
from collections.abc import Callable, Mapping
from typing import Any

from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Route

from schemas.arrays import GreyImage, RGBImage
from velfield.errors import InputError
from velfield.report.figures import png_bytes
from velfield.report.viewer_page import page_is_built
from velfield.viewer.server import TRUSTED_HOSTS, headers_for

_MAX_BYTES = 16 * 2**20


def editing_app(
    page: Callable[[str], str],
    images: Callable[[int], GreyImage | None],
    requests: Mapping[str, Callable[[bytes], dict[str, Any]]],
    *,
    tiles: Callable[[int, int, int], RGBImage | None] | None = None,
    image_origin: str = "",
) -> Starlette:
    """The server of a page that writes.

    Parameters
    ----------
    page
        Returns the page's HTML, with this token in it.
    images
        Returns the k-th image that the page shows, (h, w) uint8; None where there is none.
    requests
        Path -> what answers a POST to it, by a JSON object. `InputError` and pydantic's errors become status 422.
    tiles
        Returns the tile of zoom, column and row of a map, as an image; None where there is no such tile.
    image_origin
        The one other server that the page may load images from.

    Raises
    ------
    InputError
        The page is not built.
    """
    if not page_is_built():
        raise InputError("the page is not built in this checkout; run `make page` first")
    token = secrets.token_urlsafe(24)
    alone = threading.Lock()

    def show(_: Request) -> HTMLResponse:
        html = page(token)
        return HTMLResponse(html, headers=headers_for(html, image_origin))

    def image(request: Request) -> Response:
        grey = images(request.path_params["number"])
        if grey is None:
            raise HTTPException(404)
        return Response(png_bytes(grey), media_type="image/png", headers=headers_for(None))

    routes = [Route("/", show), Route("/frame/{number:int}.png", image)]
    if tiles is not None:
        routes.append(_tile_route(tiles))
    routes += [_post_route(path, token, alone, answer) for path, answer in requests.items()]
    return Starlette(routes=routes, middleware=[TRUSTED_HOSTS])


def _tile_route(tiles: Callable[[int, int, int], RGBImage | None]) -> Route:
    """GET of a map's tiles; Starlette answers them in threads."""

    def tile(request: Request) -> Response:
        zoom, column, row = (request.path_params[name] for name in ("zoom", "column", "row"))
        try:
            image = tiles(zoom, column, row)
        except InputError as error:
            raise HTTPException(422, str(error)) from error
        if image is None:
            raise HTTPException(404)
        return Response(png_bytes(image), media_type="image/png", headers=headers_for(None))

    return Route("/map/{zoom:int}/{column:int}/{row:int}.png", tile)


def _post_route(path: str, token: str, alone: threading.Lock, answer: Callable[[bytes], dict[str, Any]]) -> Route:
    """POST to ``path``, for who has the token; answered in a thread, as it may take long."""

    def answer_alone(body: bytes) -> dict[str, Any]:
        with alone:
            return answer(body)

    async def post(request: Request) -> JSONResponse:
        if not secrets.compare_digest(request.headers.get("x-token", "").encode(), token.encode()):
            raise HTTPException(403, "the token is another server's: load the page again")
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > _MAX_BYTES:
                raise HTTPException(413)
        try:
            content = await run_in_threadpool(answer_alone, body)
        except (ValidationError, InputError) as error:
            raise HTTPException(422, str(InputError(str(error)))) from error
        return JSONResponse(content, headers=headers_for(None))

    return Route(path, post, methods=["POST"])
