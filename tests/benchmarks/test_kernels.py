"""Speed of the kernels beside a plain peer in the same run: read the ratio, not the time. `make bench` runs them."""

import numpy as np
from pytest_benchmark.fixture import BenchmarkFixture

from schemas.flight import FieldConfig
from velfield.field.accumulate import accumulate_tile
from velfield.field.segments import SEGMENT_DTYPE, VelocityBins


def test_tile_of_the_field(benchmark: BenchmarkFixture) -> None:
    benchmark.group = "tile of 64 x 64 from 2,000 segments"
    rng = np.random.default_rng(2)
    segments = np.zeros(2000, SEGMENT_DTYPE)
    segments["track"] = np.arange(2000)
    segments["duration_s"] = 0.2
    for name in ("x0_px", "y0_px", "x1_px", "y1_px"):
        segments[name] = rng.uniform(0, 64, 2000)
    segments["vx_px_per_s"] = (segments["x1_px"] - segments["x0_px"]) / 0.2
    segments["vy_px_per_s"] = (segments["y1_px"] - segments["y0_px"]) / 0.2
    bins = VelocityBins.from_config(FieldConfig(), 0.23)
    tile = benchmark(lambda: accumulate_tile(segments, origin_xy=(0, 0), shape=(64, 64), bins=bins, radius_px=3.8))
    assert tile.count.sum() > 0
