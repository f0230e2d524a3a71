"""``velfield view``: a run's page in the browser."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter


def view(
    run_folder: Path,
    /,
    *,
    port: int | None = None,
    open_browser: Annotated[bool, Parameter(name="--open")] = True,
) -> int:
    """Show a run's page in the browser, served from this machine to itself, until Ctrl-C.

    Parameters
    ----------
    run_folder
        The run folder.
    port
        Port to listen on. Default: any that is free.
    open_browser
        Open the browser, where there is a screen.
    """
    from velfield.viewer.server import serve, view_app

    def announce(address: str) -> None:
        print(f"{run_folder}: {address}  (Ctrl-C ends)", flush=True)

    try:
        serve(view_app(run_folder), port=port, open_browser=open_browser, announce=announce)
    except KeyboardInterrupt:
        print()
    return 0
