"""Scores of a run of a simulated flight against its ground truth, as `velfield demo` prints them."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from velfield.errors import InputError
from velfield.run.run import open_run
from velfield.synthetic.score import (
    DetectionScore,
    FieldScore,
    RegistrationScore,
    TrackletScore,
    fit_homography,
    score_detections,
    score_field,
    score_registration,
    score_tracklets,
)
from velfield.synthetic.track_score import TrackScore, score_run_tracks
from velfield.synthetic.truth import load_truth

_ANOTHER_BASE_PX = 30.0  # no registered frame is that far off its own base image


@dataclass(frozen=True)
class RunScore:
    """All scores of a run.

    ``traffic`` scores the tracks that are not parked against the vehicles that move at some time.
    """

    registration: RegistrationScore
    detection: DetectionScore
    tracking: TrackletScore
    tracks: TrackScore
    traffic: TrackScore
    field: FieldScore

    def text(self) -> str:
        """The scores in five lines, for a reader who does not know the terms."""
        r, d, t, f = self.registration, self.detection, self.tracking, self.field
        return "\n".join(
            (
                "compared with the ground truth of the simulation:",
                f"  vehicles   {d.recall:.1%} of all vehicles found, {d.recall_moving:.1%} of those that drive; "
                f"{d.precision:.1%} of the detections are vehicles",
                f"  positions  {r.mean_px:.2f} px mean error on the map, {r.p95_px:.2f} px at the 95th percentile",
                f"  speeds     {t.speed_error_mean_km_per_h:.2f} km/h mean error over three frames",
                f"  identity   {self.traffic.tracks_per_vehicle:.2f} tracks per vehicle that drives (1 is ideal), "
                f"{self.traffic.switches} swapped between two vehicles",
                f"  direction  within 10 degrees at {f.fraction_within:.1%} of {f.pixels} pixels of the map "
                f"that vehicles passed; undefined at {f.undirected} where most vehicles are stationary",
            )
        )


def score_run(root: str | Path, flight: str | Path, *, min_count: int = 5) -> RunScore:
    """Score a run folder against its simulated flight.

    If the run made its own base image, its base pixels are first transformed to the truth's by a fitted homography.

    Raises
    ------
    InputError
        The flight has no truth, the run is incomplete, or its base image is another one than the flight's.
    """
    run, truth = open_run(root), load_truth(Path(flight))
    source_index = run.frames.column("source_index")
    frame_of = {frame: int(index) for frame, index in enumerate(source_index)}
    registered = [frame for frame, status in enumerate(run.registration_status) if status == "ok"]
    flight_frames = {frame_of[frame]: frame for frame in registered}

    def to_base(flight_frame: int, xy_raw: np.ndarray) -> np.ndarray:
        return run.to_base(flight_frames[flight_frame], xy_raw)

    frames = sorted(flight_frames)
    velocity = run.field.modal_velocity().astype(np.float64)
    velocity[np.isnan(run.field.modal_direction_rad())] = np.nan  # stationary: no direction
    some = frames[:: max(1, len(frames) // 20)]
    to_truth = None if run.grid.base_source == "given" else fit_homography(truth, to_base, some)
    registration = score_registration(
        truth, to_base, frames, asked=[int(index) for index in source_index], to_truth=to_truth
    )
    if to_truth is None and registration.mean_px > _ANOTHER_BASE_PX:
        raise InputError(
            f"{run.layout.root}: positions differ from those of {flight} by {registration.mean_px:.0f} px (mean): its "
            f"base image is another one; score a run with --base {Path(flight) / 'base.png'}, or with none"
        )
    score_identity = partial(
        score_run_tracks, truth, frame_of={frame: frame_of[frame] for frame in registered}, to_truth=to_truth
    )
    tracklets, vehicles, positions = run.tracklets(), run.vehicles(), run.track_positions()
    in_traffic = vehicles.loc[vehicles["state"] != "parked", "track_id"]
    return RunScore(
        registration=registration,
        detection=score_detections(truth, run.detections(), frame_of=frame_of, to_truth=to_truth),
        tracking=score_tracklets(truth, tracklets, frame_of=frame_of, to_truth=to_truth),
        tracks=score_identity(tracks=positions),
        traffic=score_identity(tracks=positions[positions["track_id"].isin(in_traffic)], moving_only=True),
        field=score_field(
            truth,
            velocity,
            run.field.count(),
            to_truth=to_truth,
            min_count=min_count,
        ),
    )
