"""Times that other libraries take for the same work on the same flight: the peers of `velfield bench speed`.

Each does less than the stage beside it: the text says what.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from schemas.arrays import FloatArray
from schemas.simulation import SimulationConfig
from schemas.tables import DETECTION_COLUMNS
from velfield.bench.detection import fastest_s
from velfield.bench.registration import register_by_stabilo
from velfield.errors import InputError
from velfield.field.accumulate import accumulate_tile
from velfield.field.segments import Segments, VelocityBins, band_radius_px, segments_by_tile
from velfield.pipeline.plan import Plan
from velfield.run.frame_transforms import read_grid
from velfield.run.run import open_run
from velfield.run.tables import read_tables
from velfield.synthetic.truth import load_truth

_REACH_PX = 30.0
"""Search range of the linking peer: the paper's greatest motion between two frames."""


def time_stabilo(flight: Path, config: SimulationConfig, registration_s: float) -> str:
    """A line on registration: stabilo estimates one homography a frame, on frames undistorted by the true lens.

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
    # Rows of parked cars are in reach of so many others that trackpy gives up, unless it may reach less far there.
    trackpy.link(
        detections,
        _REACH_PX,
        pos_columns=["x_px", "y_px"],
        t_column="frame",
        link_strategy="hybrid",
        adaptive_stop=_REACH_PX / 8,
        adaptive_step=0.8,
    )
    seconds = time.process_time() - start
    return _compare("tracklets", tracklets_s, "trackpy, nearest neighbours alone", seconds)


def time_accumulation(plan: Plan) -> list[str]:
    """Lines on the field: the busiest tiles, beside histograms of the same pixels and velocities.

    Ours also shares a track's unit among its segments and spreads each over the velocity bins; theirs are given the
    pixels, and count.

    Raises
    ------
    InputError
        A peer is not installed.
    """
    grid, config = read_grid(plan.layout), plan.config.field
    bins, radius = VelocityBins.from_config(config, grid.gsd_m), band_radius_px(config, grid.gsd_m)
    segments = open_run(plan.layout.root).segments()
    by_tile = segments_by_tile(
        segments, shape=(grid.height_px, grid.width_px), tile_size=config.tile_size_px, radius_px=radius
    )
    busiest = sorted(by_tile, key=lambda tile: -len(by_tile[tile]))[:16]
    side, ours, work = config.tile_size_px, 0.0, []
    for row, column in busiest:
        mine, origin = segments[by_tile[row, column]], (column * side, row * side)
        accumulate = partial(accumulate_tile, mine, origin_xy=origin, shape=(side, side), bins=bins, radius_px=radius)
        ours += fastest_s(accumulate, 1)
        work.append(_samples(mine, origin, side, bins, radius or 0.75))
    axes = [np.arange(n + 1, dtype=np.float64) - 0.5 for n in (side, side, bins.n, bins.n)]
    lines = []
    for name, count in (("boost-histogram", _boost_histogram), ("xhistogram", _xhistogram)):
        fill = count(axes)
        theirs = sum(fastest_s(partial(fill, samples), 1) for samples in work)
        lines.append(_compare(f"accumulation, {len(busiest)} tiles", ours, f"{name}, counts alone", theirs))
    return lines


Samples = FloatArray
"""(4, n): y, x, vy, vx of each pixel of each segment: pixels of a tile, and bins."""


def _samples(segments: Segments, origin: tuple[int, int], side: int, bins: VelocityBins, radius: float) -> Samples:
    """Samples of a tile: each segment's velocity at the pixels within a radius of its path."""
    y, x = (axis.ravel().astype(np.float64) for axis in np.mgrid[0:side, 0:side])
    parts = []
    for one in segments:
        start = np.array([one["x0_px"] - origin[0], one["y0_px"] - origin[1]])
        along = np.array([one["x1_px"], one["y1_px"]]) - origin - start
        place = ((x - start[0]) * along[0] + (y - start[1]) * along[1]) / max(float(along @ along), 1e-9)
        place = place.clip(0, 1)
        near = np.hypot(x - start[0] - place * along[0], y - start[1] - place * along[1]) < radius
        velocity = bins.to_bins(np.array([one["vy_px_per_s"], one["vx_px_per_s"]])).clip(0, bins.n - 1)
        parts.append(np.stack([y[near], x[near], *np.broadcast_to(velocity[:, None], (2, int(near.sum())))]))
    return np.concatenate(parts, axis=1)


def _boost_histogram(axes: Sequence[FloatArray]) -> Callable[[Samples], object]:
    try:
        import boost_histogram
    except ImportError:
        raise InputError("found no boost-histogram, a peer of accumulation; pip install boost-histogram") from None

    def fill(samples: Samples) -> object:
        regular = [boost_histogram.axis.Regular(len(axis) - 1, axis[0], axis[-1]) for axis in axes]
        return boost_histogram.Histogram(*regular, storage=boost_histogram.storage.Int64()).fill(*samples)

    return fill


def _xhistogram(axes: Sequence[FloatArray]) -> Callable[[Samples], object]:
    try:
        from xhistogram.core import histogram
    except ImportError:
        raise InputError("found no xhistogram, a peer of accumulation; pip install xhistogram") from None
    return lambda samples: histogram(*samples, bins=list(axes))


def _compare(what: str, seconds: float, peer: str, peer_seconds: float) -> str:
    return f"{what}: {seconds:.3g} s of processor; {peer}: {peer_seconds:.3g} s; {peer_seconds / seconds:.3g} times"
