"""``velfield reprocess``: a new base image under a finished run."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from flows.options import DONE, INCOMPLETE, Cluster, Quiet, RunFolder, Scheduler, Workers


def reprocess(
    run_folder: RunFolder,
    /,
    *,
    base: Path,
    out: str | None = None,
    full: Annotated[bool, Parameter(negative=())] = False,
    max_error_px: float = 1.0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    cluster: Cluster = None,
    quiet: Quiet = False,
) -> int:
    """Put a new base image under a finished run, and recompute only what depends on it. The old result is kept.

    If the new image registers well to the old base image, all results are mapped onto it in seconds, and the added
    error is printed; otherwise the frames are registered again.

    Parameters
    ----------
    base
        The new base image, as for `velfield run`.
    out
        Name of the new result, a folder under RUN/results. Default: the image's name.
    full
        Always register the frames again.
    max_error_px
        Largest error of the registration to the old base image, in new base pixels, for mapping the results.
    """
    from flows.launch import prepare_process
    from flows.stopping import stop_on_signals

    stop_on_signals()
    prepare_process(verbose=False)
    from flows.console import Console
    from flows.reprocess import run_reprocess
    from flows.runners import choose_runner

    console = Console("quiet" if quiet else "normal")
    where = choose_runner(workers, scheduler, cluster)
    root, summary = run_reprocess(
        run_folder, base, name=out, full=full, max_added_error_px=max_error_px, runner=where, console=console
    )
    console.result(f"result  {root}")
    console.result(f"names   {root.parents[1] / 'results.json'}")
    return DONE if summary is None or summary.complete else INCOMPLETE
