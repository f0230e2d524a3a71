"""The lens of a flight: frames spread over it, the plumb line, what control points add, ``camera.json``."""

import numpy as np
from numpy.typing import NDArray

from schemas.camera import CameraRecord
from velfield.camera.fusion import refine_lens
from velfield.camera.lens import lens_from_record, pinhole
from velfield.camera.plumbline import calibrate
from velfield.pipeline.plan import Plan
from velfield.pipeline.progress import advance
from velfield.pipeline.result import StageResult
from velfield.registration.pairing import match_frame_pairs
from velfield.run.commits import write_atomically
from velfield.run.stores import open_frames
from velfield.sources.flags import UNUSABLE


def spread_usable(plan: Plan, count: int) -> list[int]:
    """At most ``count`` frames spread evenly over those that nothing is wrong with."""
    flags = open_frames(plan.layout.frames).column("flags")
    usable = np.flatnonzero((flags & int(UNUSABLE)) == 0)
    chosen: NDArray[np.int64] = np.unique(
        np.linspace(0, max(len(usable) - 1, 0), min(count, len(usable))).round()
    ).astype(int)
    return [int(frame) for frame in usable[chosen]]


def calibrate_flight(plan: Plan) -> StageResult:
    """Calibrate, or keep the pin-hole where that is asked for."""
    store = open_frames(plan.layout.frames)
    height, width = store.shape
    config = plan.config.lens
    if config.calibrate == "never":
        record = CameraRecord(
            lens=pinhole((height, width)).to_record(),
            frame_width_px=width,
            frame_height_px=height,
            accepted=False,
            reason="lens.calibrate is never: taken for a pin-hole",
        )
    else:
        frames = spread_usable(plan, config.frames)
        pictures = [store.read(frame) for frame in frames]
        record = calibrate(pictures, config).to_record()
        if config.refine == "auto":
            record = refine_lens(record, match_frame_pairs(pictures, lens_from_record(record.lens)))
    write_atomically(plan.layout.camera, record.model_dump_json(indent=1).encode())
    advance("lens")
    counts = {"corner_px": _corner_shift(record, width, height)}
    if record.residual_px is not None:
        counts["residual_px"] = record.residual_px
    return StageResult([plan.layout.camera], counts, _notes(record))


def _notes(record: CameraRecord) -> list[str]:
    if not record.accepted:
        return [f"the lens: {record.reason}"]
    if record.overlap is not None and record.overlap.used:
        return [f"the lens, refined by control points: {record.overlap.reason}"]
    return []


def _corner_shift(record: CameraRecord, width: int, height: int) -> float:
    """How far the lens moves a corner of the frame, px: what a person can picture of a distortion."""
    corners = np.array([[0.0, 0.0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]])
    moved = lens_from_record(record.lens).undistort_points(corners) - corners
    return float(np.hypot(*moved.T).max())
