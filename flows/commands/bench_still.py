"""``velfield bench still``: how still the things that stand lie on a run's map."""

from pathlib import Path


def still(run_folder: Path, /, *, frames: int = 200) -> int:
    """Follow corners that registration does not use through the frames of a run, and tell how they seem to move.

    Parameters
    ----------
    run_folder
        The run folder.
    frames
        At most so many frames, spread over the run.
    """
    from velfield.bench.still import still_things
    from velfield.run import open_run

    print(still_things(open_run(run_folder), max_frames=frames).text())
    return 0
