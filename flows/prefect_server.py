"""Whether a Prefect server is set and answers: asked before Prefect, which waits for it with every request."""

import os
import ssl
import sys
import urllib.error
import urllib.request
from contextlib import suppress
from http import HTTPStatus
from http.client import HTTPException
from pathlib import Path

from flows.launch import spare_proxies
from flows.orchestration import Orchestration, Threads
from velfield.errors import InputError, one_line

_ANSWER_S = 5.0
_NAMING_A_SERVER = ("PREFECT_API_URL", "PREFECT_PROFILE", "PREFECT_PROFILES_PATH")
"""Environment variables that may name a server."""


def choose_orchestration() -> Orchestration:
    """Prefect where its settings name a server, else threads.

    Raises
    ------
    InputError
        The server does not answer.
    """
    if not may_have_settings():
        return Threads()
    spare_proxies()
    check_address()
    from prefect.settings import get_current_settings

    if not get_current_settings().api.url:
        return Threads()
    check_server()
    from flows.prefect_flows import PrefectFlows

    return PrefectFlows()


def may_have_settings() -> bool:
    """Whether the user may have settings of Prefect, in any of the places where it reads them."""
    if "prefect" in sys.modules or any(name in os.environ for name in _NAMING_A_SERVER):
        return True
    profiles = Path(os.environ.get("PREFECT_HOME") or os.path.expanduser("~/.prefect")) / "profiles.toml"
    here = {"prefect.toml": "", "pyproject.toml": "tool.prefect", ".env": "PREFECT_"}
    return profiles.exists() or any(_holds(Path(name), text) for name, text in here.items())


def _holds(file: Path, text: str) -> bool:
    with suppress(OSError, UnicodeDecodeError):
        return text in file.read_text(encoding="utf-8")
    return False


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
        with urllib.request.urlopen(f"{url}/health", timeout=_ANSWER_S) as answer:
            is_page = answer.headers.get_content_type() == "text/html"
    except urllib.error.HTTPError as error:
        is_page = error.code == HTTPStatus.NOT_FOUND and error.headers.get_content_type() == "text/html"
    except urllib.error.URLError as error:
        if isinstance(error.reason, ssl.SSLError):
            return  # Prefect has certificates of its own
        raise _no_answer(url, error.reason) from None
    except (OSError, ValueError, HTTPException) as error:  # no time left; no address; no HTTP
        raise _no_answer(url, error) from None
    if is_page:
        raise InputError(
            f"PREFECT_API_URL {url}: found a server, and not Prefect's interface there, whose address ends with /api; "
            "correct it"
        )


def _no_answer(url: str, error: object) -> InputError:
    in_settings = "`prefect config unset PREFECT_API_URL`, or from prefect.toml or .env"
    remove = "`unset PREFECT_API_URL`" if os.environ.get("PREFECT_API_URL") else in_settings
    return InputError(
        f"PREFECT_API_URL {url}: found no Prefect server that answers "
        f"({one_line(error)}); start it, correct the address, or remove it "
        f"({remove}): a run needs none"
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
