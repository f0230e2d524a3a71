"""Prefect's temporary server, started beside the imports of the process that needs it.

Where no server is set, Prefect starts a temporary one when the first flow asks for it, waits until it answers, and
imports the server's code into the asking process first: 10 s in a row, of which one process is idle half the time.
Here it starts with the process, by the same command, and the asking process only talks to it.

Run as a module, with a port: is the server.
"""

import atexit
import os
import socket
import ssl
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPException
from subprocess import DEVNULL, Popen, TimeoutExpired

from velfield.errors import InputError

_HOST = "127.0.0.1"
_NOT_ASKED_FOR = 4
"""Exit status where Prefect's settings name a server, or forbid a temporary one."""
_END_S = 5.0
_ANSWER_S = 5.0


def start_server() -> "TemporaryServer":
    """Start a temporary server while this process imports and works; it ends with this process.

    Should it fail to start, nothing is lost: Prefect starts its own, and reports errors. Call before prefect is
    imported: what Prefect does at the end of the process, such as sending the last of its log, then comes before the
    end of the server.

    Raises
    ------
    InputError
        Nothing answers at the address in PREFECT_API_URL.
    """
    check_address()
    with socket.socket() as free:
        free.bind((_HOST, 0))
        port = int(free.getsockname()[1])
    return TemporaryServer(port, Popen([sys.executable, "-m", __spec__.name, str(port)], stderr=DEVNULL))


def check_address() -> None:
    """Refuse an address in PREFECT_API_URL at which nothing answers, before Prefect is imported, which takes seconds.

    What answers is left to `check_server`, which knows all of Prefect's settings.

    Raises
    ------
    InputError
        One line, within seconds.
    """
    url = os.environ.get("PREFECT_API_URL")
    if not url:
        return
    try:
        with urllib.request.urlopen(f"{url}/health", timeout=_ANSWER_S):
            return
    except urllib.error.HTTPError:
        return
    except urllib.error.URLError as error:
        if isinstance(error.reason, ssl.SSLError):
            return  # Prefect has certificates of its own
        raise _no_answer(url, error.reason) from None
    except (OSError, ValueError, HTTPException) as error:  # no time left; no address; no HTTP
        raise _no_answer(url, error) from None


def _no_answer(url: str, error: object) -> InputError:
    return InputError(
        f"PREFECT_API_URL {url}: found no Prefect server that answers "
        f"({' '.join(str(error).split()) or type(error).__name__}); start it, correct the address, or unset it "
        "(`prefect config unset PREFECT_API_URL`): then a temporary one is used"
    )


def check_server() -> None:
    """Refuse settings of Prefect that name a server which does not answer: each of its requests would be repeated.

    Raises
    ------
    InputError
        One line: the address, and what became of the request.
    """
    from prefect.client.orchestration import get_client
    from prefect.settings import get_current_settings

    url = get_current_settings().api.url
    if url is None:
        return
    try:
        with get_client(httpx_settings={"timeout": _ANSWER_S}, sync_client=True) as client:
            error = client.api_healthcheck()
    except Exception as refused:  # of the address, of a proxy
        error = refused
    if error is not None:
        raise _no_answer(url, error)


class TemporaryServer:
    """A server on a port of this machine, in a process of its own."""

    def __init__(self, port: int, process: "Popen[bytes]") -> None:
        self._url = f"http://{_HOST}:{port}/api"
        self._process = process
        atexit.register(self.stop)

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Prefect's settings with this server, once it answers; unchanged where another is set or this one ended.

        Raises
        ------
        InputError
            Another is set, and does not answer.
        """
        if self._wait():
            from prefect.settings import PREFECT_API_URL, PREFECT_UI_URL, temporary_settings

            with temporary_settings({PREFECT_API_URL: self._url, PREFECT_UI_URL: ""}):  # it has no UI to link to
                yield
        else:
            check_server()
            yield

    def stop(self) -> None:
        """End it."""
        self._process.terminate()
        try:
            self._process.wait(_END_S)
        except TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _wait(self) -> bool:
        """Until it answers, or ended, or Prefect's own limit."""
        from prefect.settings import get_current_settings

        end = time.monotonic() + get_current_settings().server.ephemeral.startup_timeout_seconds
        while self._process.poll() is None and time.monotonic() < end:
            try:
                with urllib.request.urlopen(f"{self._url}/health", timeout=5) as answer:
                    return bool(answer.status == 200)
            except (urllib.error.URLError, TimeoutError, ConnectionError):
                time.sleep(0.05)
        return False


def _serve(port: int) -> int:
    # As Prefect starts its own: without the UI, and without services that a server of minutes does not need.
    os.environ |= {"PREFECT_UI_ENABLED": "0", "PREFECT__SERVER_EPHEMERAL": "1", "PREFECT__SERVER_FINAL": "1"}
    from prefect.settings import get_current_settings

    settings = get_current_settings()
    if settings.api.url is not None or not settings.server.ephemeral.enabled:
        return _NOT_ASKED_FOR
    import uvicorn

    application = "prefect.server.api.server:create_app"
    uvicorn.run(application, factory=True, host=_HOST, port=port, log_level="error", lifespan="on")
    return 0


if __name__ == "__main__":
    sys.exit(_serve(int(sys.argv[1])))
