"""What other libraries take for the same work on the same flight: the peers of `velfield bench speed`.

Each does less than the stage beside it: the text says what.
"""

import time
from pathlib import Path

from schemas.simulation import SimulationConfig
from schemas.tables import DETECTION_COLUMNS
from velfield.bench.registration import register_by_stabilo
from velfield.errors import InputError
from velfield.pipeline.plan import Plan
from velfield.run.tables import read_tables
from velfield.synthetic.truth import load_truth

_REACH_PX = 30.0
"""Search range of the linking peer: the paper's greatest motion between two frames."""


def time_stabilo(flight: Path, config: SimulationConfig, registration_s: float) -> str:
    """A line on registration: stabilo finds one homography a frame, on frames undistorted by the true lens.

    Raises
    ------
    InputError
        stabilo is not installed.
    """
    _, registered, seconds = register_by_stabilo(flight, config, load_truth(flight))
    return _compare(
        "registration", registration_s, f"stabilo, a homography a frame, {len(registered)} registered", seconds
    )


def time_trackpy(plan: Plan, tracklets_s: float) -> str:
    """A line on linking: trackpy links the nearest detections between frames, without gates or appearance.

    Raises
    ------
    InputError
        trackpy is not installed.
    """
    try:
        import trackpy
    except ImportError:
        raise InputError("found no trackpy, the peer of linking; pip install trackpy") from None
    paths = sorted(plan.layout.detections.glob("*.parquet"))
    detections = read_tables(paths, DETECTION_COLUMNS, only=["frame", "x_px", "y_px"])
    trackpy.quiet()
    start = time.process_time()
    trackpy.link(detections, _REACH_PX, pos_columns=["x_px", "y_px"], t_column="frame", link_strategy="hybrid")
    seconds = time.process_time() - start
    return _compare("tracklets", tracklets_s, "trackpy, nearest neighbours alone", seconds)


def _compare(what: str, seconds: float, peer: str, peer_seconds: float) -> str:
    return f"{what}: {seconds:.1f} s of processor; {peer}: {peer_seconds:.1f} s; {peer_seconds / seconds:.3g} times"
