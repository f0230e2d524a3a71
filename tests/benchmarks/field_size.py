"""Room and memory that the field of a flight of 1126 frames at 2560x1920 takes: its traffic simulated, no pictures.

python -m tests.benchmarks.field_size [SEED]
"""

import multiprocessing
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

FRAMES, WIDTH, HEIGHT, GSD_M = 1126, 2560, 1920, 0.23


def main(seed: int) -> None:
    """Print the traffic, the field's size on disk, and what a worker that builds all of it needs at most."""
    import numpy as np

    from schemas.simulation import SimulationConfig
    from velfield.synthetic.flight import Flight
    from velfield.synthetic.observed import observed_tracklets

    config = SimulationConfig(seed=seed, frames=FRAMES, width=WIDTH, height=HEIGHT, gsd_m=GSD_M)
    flight = Flight(config)
    rng = np.random.default_rng(seed)
    tracklets = observed_tracklets(
        flight.city.traffic, flight.times_s, flight.city.to_px, shape=flight.base_shape, rng=rng
    )
    with tempfile.TemporaryDirectory() as folder:
        plan = _plan(Path(folder) / "run", flight.base_shape, tracklets)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            seconds, pixels, idle_mb, peak_mb = pool.submit(_build, plan).result()
        size = sum(path.stat().st_size for path in plan.layout.field.rglob("*") if path.is_file())
    print(f"{len(tracklets)} tracklets of {tracklets['track_id'].nunique()} vehicles, base image {flight.base_shape}")
    print(f"field.zarr {size / 1e6:.1f} MB, {pixels} pixels known, built in {seconds:.1f} s")
    print(f"a worker: {idle_mb:.0f} MB before, {peak_mb:.0f} MB at most")


def _plan(root: Path, shape: tuple[int, int], tracklets: Any) -> Any:
    """A run folder whose tracklets are these."""
    from schemas.records import GridRecord
    from tests.pipeline.test_estimate import planned
    from velfield.run.commits import write_atomically
    from velfield.run.tables import write_tracks

    plan = planned(FRAMES, root, WIDTH, HEIGHT)
    grid = GridRecord(width_px=shape[1], height_px=shape[0], gsd_m=GSD_M, base_source="given", reference_frame=0)
    write_atomically(plan.layout.grid, grid.model_dump_json().encode())
    write_tracks(plan.layout.unit_file(plan.layout.tracks, 0), tracklets)
    return plan


def _build(plan: Any) -> tuple[float, int, float, float]:
    """Seconds, pixels known, and MB of memory before and at most, in a process of its own."""
    from velfield.pipeline.stages.field import accumulate_block, create_field_stores, field_blocks

    idle_mb = _most_mb()
    started = time.monotonic()
    create_field_stores(plan)
    pixels = sum(int(accumulate_block(plan, group).counts["pixels"]) for group in field_blocks(plan))
    return time.monotonic() - started, pixels, idle_mb, _most_mb()


def _most_mb() -> float:
    # Not getrusage: its maximum is inherited from the process that started this one.
    status = Path("/proc/self/status").read_text()
    return float(status.split("VmHWM:")[1].split()[0]) / 1024


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1)
