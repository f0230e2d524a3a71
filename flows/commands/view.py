"""``velfield view``: a run's page in the browser."""

from pathlib import Path
from typing import TYPE_CHECKING

from flows.options import OpenBrowser, Port, RunFolder
from velfield.errors import InputError

if TYPE_CHECKING:
    from starlette.applications import Starlette


def view(
    run_folder: RunFolder,
    /,
    *,
    port: Port = None,
    open_browser: OpenBrowser = True,
) -> int:
    """Show a run's page in the browser until Ctrl-C, the answers first if it is analysed; for this machine alone."""
    from velfield.run.layout import RunLayout
    from velfield.viewer.server import view_app

    if run_folder.parts[:1] == ("s3:",):
        from schemas.job import absolute

        raise InputError(
            f"{absolute(str(run_folder))}: a run on S3 cannot be shown; copy it to this machine first, such as with "
            "`aws s3 sync`"
        )

    analysed = (RunLayout(run_folder).analysis / "analysis.json").is_file()
    serve_until_interrupted(
        view_app(run_folder),
        port=port,
        open_browser=open_browser,
        place=run_folder,
        start="#tab=analysis" if analysed else "",
    )
    return 0


def serve_until_interrupted(
    app: "Starlette", *, port: int | None, open_browser: bool, place: Path, purpose: str = "", start: str = ""
) -> None:
    """Serve a page until Ctrl-C; prints the address, what is served and what for."""
    from velfield.viewer.server import serve

    def announce(address: str) -> None:
        print("  ".join(part for part in (f"{place}: {address}", purpose, "(Ctrl-C ends)") if part), flush=True)

    try:
        serve(app, port=port, open_browser=open_browser, announce=announce, start=start)
    except KeyboardInterrupt:
        print()
