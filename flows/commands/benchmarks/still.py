"""``velfield bench still``: the stability of stationary objects on a run's map."""

from pathlib import Path

from flows.options import RunFolder
from velfield.errors import InputError


def still(run_folder: RunFolder, /, *, frames: int = 200, within: Path | None = None) -> int:
    """Track corners that registration does not use through the frames of a run, and print how they seem to move.

    Parameters
    ----------
    frames
        At most so many frames, spread over the run.
    within
        A CSV `x_px,y_px`: corners of the area to measure, base pixels.
        Roofs and trees move on the map of a camera that flies by; a road does not.
    """
    from velfield.bench.still import measure_stability, read_area
    from velfield.run.run import open_run

    if frames < 3:
        raise InputError(f"--frames {frames}: expected 3 or more, to see jitter")
    area = None if within is None else read_area(within)
    print(measure_stability(open_run(run_folder), max_frames=frames, within=area).text())
    return 0
