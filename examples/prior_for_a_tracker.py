"""Hand the field to another tracker: a plain nearest-neighbour one at 2 frames a second, with and without the prior.

The first half of a simulated flight makes the field; on the second half the tracker links detections from frame to
frame, first by distance alone, then only where the field's gate accepts the velocity. Compared at the same recall or a
higher one.

python examples/prior_for_a_tracker.py [SEED]
"""

import sys
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
from scipy.spatial.distance import cdist

from schemas.flight import FieldConfig
from schemas.simulation import SimulationConfig
from velfield.field.segments import VelocityBins, band_radius_px, segment_table, stationary_speed_px_per_s
from velfield.field.view import VelocityField
from velfield.synthetic.flight import Flight
from velfield.synthetic.observed import observed_detections, observed_tracklets

GSD_M = 0.23
INTERVAL_S = 0.5
FASTEST_PX = 34.5 / GSD_M * INTERVAL_S


@dataclass(frozen=True)
class Score:
    """Links made, those of them that join two vehicles, and the fraction of the possible ones that were made."""

    links: int
    wrong: int
    recall: float


def build_field(flight: Flight, until_s: float, rng: np.random.Generator) -> VelocityField:
    """The field of the vehicles that passed until then."""
    times_s = flight.times_s[flight.times_s < until_s]
    scene = flight.city.traffic, times_s, flight.city.to_px
    tracklets = observed_tracklets(*scene, shape=flight.base_shape, rng=rng)
    config = FieldConfig()
    return VelocityField.from_segments(
        segment_table(tracklets, config),
        shape=flight.base_shape,
        tile_size=16,  # positions all over the map are queried, and small tiles are built quickly
        bins=VelocityBins.from_config(config, GSD_M),
        radius_px=band_radius_px(config, GSD_M),
        stationary_speed_px_per_s=stationary_speed_px_per_s(config, GSD_M),
    )


def link(before: np.ndarray, after: np.ndarray, field: VelocityField | None) -> np.ndarray:
    """Pairs (k, 2) of mutual nearest neighbours within reach, and within the field's gate where one is given."""
    distance = cdist(before, after)
    distance[distance > FASTEST_PX] = np.inf
    if field is not None:
        for i, position in enumerate(before):
            near = np.flatnonzero(np.isfinite(distance[i]))
            if near.size:
                likely = field.gate(position).accepts((after[near] - position) / INTERVAL_S)
                distance[i, near[~likely]] = np.inf
    if not distance.size:
        return np.empty((0, 2), int)
    forth, back = distance.argmin(axis=1), distance.argmin(axis=0)
    rows = np.arange(len(before))
    good = (back[forth] == rows) & np.isfinite(distance[rows, forth])
    return np.column_stack([rows, forth])[good]


def track(detections: pd.DataFrame, field: VelocityField | None) -> Score:
    """Link all consecutive frames and count against the truth."""
    links = wrong = right = possible = 0
    frames = [part for _, part in detections.groupby("frame")]
    for a, b in pairwise(frames):
        pairs = link(a[["x_px", "y_px"]].to_numpy(), b[["x_px", "y_px"]].to_numpy(), field)
        one, other = a["vehicle_id"].to_numpy(), b["vehicle_id"].to_numpy()
        same = one[pairs[:, 0]] == other[pairs[:, 1]]
        links, wrong, right = links + len(pairs), wrong + int((~same).sum()), right + int(same.sum())
        possible += len(np.intersect1d(one, other))
    return Score(links, wrong, right / max(possible, 1))


def measure(seed: int, *, frames: int = 600, size: tuple[int, int] = (400, 300)) -> tuple[Score, Score]:
    """The tracker's scores on the second half of a flight: without and with the field of the first."""
    rng = np.random.default_rng(seed)
    flight = Flight(SimulationConfig(seed=seed, frames=frames, width=size[0], height=size[1]))
    half = float(flight.times_s[-1]) / 2
    field = build_field(flight, half, rng)
    times_s = np.arange(half, float(flight.times_s[-1]), INTERVAL_S)
    scene = flight.city.traffic, times_s, flight.city.to_px
    detections = observed_detections(*scene, shape=flight.base_shape, rng=rng)
    return track(detections, None), track(detections, field)


def main(seed: int) -> None:
    """Print both scores."""
    plain, helped = measure(seed)
    for name, score in (("without the field", plain), ("with its gate", helped)):
        print(f"{name:18} {score.links} links, {score.wrong} wrong, recall {score.recall:.3f}")
    print(f"wrong links {1 - helped.wrong / max(plain.wrong, 1):.0%} fewer")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
