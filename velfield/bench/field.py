"""Kernel and bins of the field by the held-out log-likelihood."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from schemas.flight import FieldConfig
from schemas.simulation import SimulationConfig
from velfield.errors import InputError
from velfield.field.heldout import heldout_log_likelihood
from velfield.field.segments import Segments, segment_table
from velfield.run.run import open_run
from velfield.synthetic.flight import Flight
from velfield.synthetic.observed import observed_tracklets

_SIZE_PX = (640, 480)


def sweep(
    run_folder: Path | None, *, seed: int, frames: int, sigmas: Sequence[float], widths: Sequence[float]
) -> Iterator[str]:
    """A line a combination: nats a held-out track by the field, by one distribution, by a Gaussian a pixel.

    Raises
    ------
    InputError
        The run knows no metres.
    """
    segments, gsd_m, shape = _simulate_segments(seed, frames) if run_folder is None else _of_run(run_folder)
    yield "log density per (m/s)^2 of a held-out track, nats"
    yield f"{'bin m/s':>8} {'kernel':>7} {'field':>8} {'map':>8} {'gaussian':>9} {'tracks':>9}"
    for width in widths:
        for sigma in sigmas:
            config = FieldConfig(bin_width_m_per_s=width, kernel_sigma_m_per_s=sigma)
            r = heldout_log_likelihood(segments, config, gsd_m=gsd_m, shape=shape)
            yield f"{width:8.2f} {sigma:7.2f} {r.field:8.3f} {r.whole_map:8.3f} {r.gaussian:9.3f} {r.tracks:9d}"


def _simulate_segments(seed: int, frames: int) -> tuple[Segments, float, tuple[int, int]]:
    flight = Flight(SimulationConfig(seed=seed, frames=frames, width=_SIZE_PX[0], height=_SIZE_PX[1]))
    tracklets = observed_tracklets(
        flight.city.traffic,
        flight.times_s,
        flight.city.to_px,
        shape=flight.base_shape,
        rng=np.random.default_rng(seed),
    )
    return segment_table(tracklets, FieldConfig()), flight.config.gsd_m, flight.base_shape


def _of_run(root: Path) -> tuple[Segments, float, tuple[int, int]]:
    run = open_run(root)
    if run.grid.gsd_m is None:
        raise InputError(f"{root}: metres a pixel are not known; run the flight with --gsd-m")
    segments = segment_table(run.tracklets(), run.record.config.field)
    return segments, run.grid.gsd_m, (run.grid.height_px, run.grid.width_px)
