"""A run folder over HTTP, for its page: read-only, on this machine alone.

Files of the folder and no others: no listing but that of runs in a folder of them, no link out of it, no hidden file,
no method but GET and HEAD. Requests to another host name than this machine's own are refused, against DNS rebinding.
"""

import re
import socket
import threading
import time
import webbrowser
from base64 import b64encode
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from html import escape
from os import environ
from pathlib import Path
from sys import platform
from typing import Any
from urllib.parse import quote

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from velfield.errors import InputError
from velfield.run.flight_record import suggest_run
from velfield.run.layout import RunLayout

HOST = "127.0.0.1"
_STOP_S = 5.0
TRUSTED_HOSTS = Middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"], www_redirect=False)
"""Refuses host names other than this machine's."""
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}
_NOTHING = "default-src 'none'; frame-ancestors 'none'"


def page_policy(html: str, image_origin: str = "") -> str:
    """Content security policy of a page with inline scripts and styles: these, by their hashes, and no others.

    No other host is reached, whatever the page's own policy allows, but for images of ``image_origin``.
    """
    scripts = " ".join(_hashes("script", html)) or "'none'"
    styles = " ".join(_hashes("style", html)) or "'none'"
    return (
        f"default-src 'none'; script-src {scripts} 'wasm-unsafe-eval'; style-src {styles}; "
        f"img-src 'self' data: blob:{image_origin and ' ' + image_origin}; connect-src 'self' data:; base-uri 'none'; "
        "form-action 'none'; frame-ancestors 'none'"
    ).replace("'none' 'wasm-unsafe-eval'", "'none'")


def _hashes(tag: str, html: str) -> list[str]:
    texts = re.findall(rf"<{tag}>(.*?)</{tag}>", html, re.DOTALL)
    return [f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'" for text in texts]


def headers_for(html: str | None, image_origin: str = "") -> dict[str, str]:
    """Headers of a response: of a page, which may show images of ``image_origin``, or of anything else (None)."""
    return {**_HEADERS, "Content-Security-Policy": _NOTHING if html is None else page_policy(html, image_origin)}


def view_app(root: Path) -> Starlette:
    """The server of a run folder.

    Raises
    ------
    InputError
        There is no page in the folder.
    """
    if not (root / "index.html").is_file():
        if RunLayout(root).flight.is_file():
            from velfield.run.run import open_run

            open_run(root).require_frames()
        raise InputError(f"{root} holds no index.html: {suggest_run(root)}")
    return Starlette(routes=[_files(root)], middleware=[TRUSTED_HOSTS])


def runs_app(root: Path) -> Starlette:
    """The server of a folder of run folders: a list of them, and their files."""

    def index(_request: Request) -> HTMLResponse:
        html = _list_runs(root)
        return HTMLResponse(html, headers=headers_for(html))

    return Starlette(routes=[Route("/", index), _files(root)], middleware=[TRUSTED_HOSTS])


_LIST_STYLE = "body{font:1rem sans-serif;margin:2rem}td{padding:.2rem 2rem .2rem 0}"
_RESULT_PAGES = "results/[!.]*/index.html"


def _list_runs(root: Path) -> str:
    """HTML with a link to the page of each run and of each of its results, the newest run first."""
    pages = sorted(root.glob("[!.]*/index.html"), key=lambda page: (-page.stat().st_mtime, page))
    rows = [_list_page(root, page) for run in pages for page in (run, *sorted(run.parent.glob(_RESULT_PAGES)))]
    table = f"<table>{''.join(rows)}</table>" if rows else "<p>No run is finished.</p>"
    name = escape(str(root))
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Runs in {name}</title>'
        f"<style>{_LIST_STYLE}</style><h1>Runs</h1><p>{name}</p>{table}</html>"
    )


def _list_page(root: Path, page: Path) -> str:
    path = page.parent.relative_to(root).as_posix()
    run, _, result = path.partition("/results/")
    title = f"{run} on {result}" if result else run
    when = time.strftime("%Y-%m-%d %H:%M", time.localtime(page.stat().st_mtime))
    return f'<tr><td><a href="{quote(path)}/">{escape(title)}</a></td><td>{when}</td></tr>'


class _RunFiles(StaticFiles):
    """The files of a folder, without hidden ones."""

    async def get_response(self, path: str, scope: Any) -> Any:
        if any(part.startswith(".") and part != "." for part in Path(path).parts):
            raise HTTPException(404)
        return await super().get_response(path, scope)

    def file_response(self, full_path: Any, *arguments: Any, **named: Any) -> Any:
        response = super().file_response(full_path, *arguments, **named)
        file = Path(full_path)
        response.headers.update(headers_for(file.read_text("utf-8") if file.suffix == ".html" else None))
        return response


def _files(root: Path) -> Mount:
    return Mount("/", _RunFiles(directory=root, html=True))


@contextmanager
def serve_in_thread(app: Starlette, port: int) -> Iterator[str]:
    """Serve in a thread while the context lasts, on this port, or on any if it is in use; yields the address."""
    try:
        listener = _listen(port)
    except InputError:
        listener = _listen(None)
    with listener:
        server = _server(app)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, name="pages", daemon=True)
        thread.start()
        try:
            yield f"http://{HOST}:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join(_STOP_S)


def serve(
    app: Starlette, *, port: int | None, open_browser: bool, announce: Callable[[str], None], start: str = ""
) -> None:
    """Serve until interrupted.

    Parameters
    ----------
    port
        None: any free one.
    open_browser
        Open the page in the user's browser, where there is a screen.
    announce
        Called with the address once the server listens.
    start
        What follows in the address: the part of the page to begin with.

    Raises
    ------
    InputError
        The port is in use.
    """
    with _listen(port) as listener:
        address = f"http://{HOST}:{listener.getsockname()[1]}/{start}"
        announce(address)
        if open_browser and _has_screen():
            # The socket listens already: the browser waits for the response.
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
        _server(app).run(sockets=[listener])


def _server(app: Starlette) -> uvicorn.Server:
    return uvicorn.Server(uvicorn.Config(app, log_level="warning", lifespan="off", ws="none", server_header=False))


def _listen(port: int | None) -> socket.socket:
    try:
        return socket.create_server((HOST, port or 0))
    except (OSError, OverflowError) as error:
        raise InputError(f"--port {port}: {error}; omit it to use a free port") from error


def _has_screen() -> bool:
    return platform == "darwin" or "DISPLAY" in environ or "WAYLAND_DISPLAY" in environ
