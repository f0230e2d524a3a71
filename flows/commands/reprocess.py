"""``velfield reprocess``: a new base image under a finished run."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

DONE, INCOMPLETE = 0, 3


def reprocess(
    run_folder: Path,
    /,
    *,
    base: Path,
    out: str | None = None,
    full: Annotated[bool, Parameter(negative=())] = False,
    max_error_px: float = 1.0,
    workers: int | None = None,
    scheduler: str | None = None,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative=())] = False,
) -> int:
    """A new base image: recompute only what depends on it. The previous result is kept beside the new one.

    Where the new image registers well to the old base image, all results are mapped onto it in seconds, and the error
    that this adds is printed; else the frames are registered again.

    Parameters
    ----------
    run_folder
        The run folder.
    base
        The new image, as for `velfield run`.
    out
        Name of the new result, a folder under RUN/results. Default: the image's name.
    full
        Register the frames again in any case.
    max_error_px
        Map only where the new image registers to the old one with a smaller error, new base pixels.
    workers
        Processes of a local cluster. Default: threads of this process.
    scheduler
        Address of a Dask scheduler.
    quiet
        Warnings only.
    """
    from flows.launch import prepare_process
    from flows.stopping import stop_on_signals
    from flows.temporary_server import start_server

    stop_on_signals()
    prepare_process(verbose=False)
    server = start_server()
    from flows.console import Console
    from flows.reprocess import run_reprocess
    from flows.runners import RunnerConfig

    console = Console("quiet" if quiet else "normal")
    where = RunnerConfig(workers=workers, scheduler=scheduler)
    with server.in_use():
        root, summary = run_reprocess(
            run_folder, base, name=out, full=full, max_added_error_px=max_error_px, runner=where, console=console
        )
    console.result(f"result  {root}")
    console.result(f"names   {root.parents[1] / 'results.json'}")
    return DONE if summary is None or summary.complete else INCOMPLETE
