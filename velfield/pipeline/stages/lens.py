"""Stage ``lens``: calibration by the plumb line on frames sampled over the flight, refined by frame pairs."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from schemas.arrays import GreyImage, IntArray
from schemas.camera import CameraRecord, TiltEvidence
from velfield.camera.fusion import refine_lens
from velfield.camera.lens import lens_from_record
from velfield.camera.plumbline import calibrate, pinhole_record
from velfield.camera.tilt import tilt_of_frames
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.registration.pairing import match_frame_pairs
from velfield.run.commits import write_record
from velfield.run.stores import FrameStore
from velfield.sources.quality import UNUSABLE

_TILT_FRAMES = 3
"""One shows it; the others look from other sides."""


def select_usable_frames(plan: Plan, count: int) -> list[int]:
    """At most ``count`` frames, evenly sampled from those without a fault."""
    flags = FrameStore(plan.layout.frames).column("flags")
    usable = np.flatnonzero((flags & int(UNUSABLE)) == 0)
    indices: IntArray = np.unique(np.linspace(0, max(len(usable) - 1, 0), min(count, len(usable))).round()).astype(int)
    return [int(frame) for frame in usable[indices]]


def calibrate_flight(plan: Plan) -> StageResult:
    """Calibrate the lens and write ``camera.json``; the pinhole model if ``lens.calibrate`` is ``never``."""
    store = FrameStore(plan.layout.frames)
    height, width = store.shape
    config = plan.config.lens
    if config.calibrate == "never":
        record = pinhole_record((height, width), "lens.calibrate is never: pinhole model used")
    else:
        frames = select_usable_frames(plan, config.frames)
        images = [store.read(frame) for frame in frames]
        with ThreadPoolExecutor(1) as beside:  # the fits keep one processor busy
            pairs = beside.submit(match_frame_pairs, images) if config.refine == "auto" else None
            record = calibrate(images, config)
        if pairs is not None:
            record = refine_lens(record, pairs.result())
        record = record.model_copy(update={"tilt": _tilt(images[:_TILT_FRAMES], record)})
    write_record(plan.layout.camera, record)
    advance("lens")
    counts = {"corner_px": _corner_shift(record, width, height)}
    if record.residual_px is not None:
        counts["residual_px"] = record.residual_px
    return StageResult([plan.layout.camera], counts, _notes(record), _warnings(plan, record))


def _tilt(images: list[GreyImage], record: CameraRecord) -> TiltEvidence | None:
    found = tilt_of_frames(images, lens_from_record(record.lens)) if images else None
    if found is None:
        return None
    x, y = found.convergence
    return TiltEvidence(
        convergence_x=x, convergence_y=y, gain_nats=found.gain_nats, tilt_deg=found.degrees, oblique=found.is_oblique
    )


def _warnings(plan: Plan, record: CameraRecord) -> list[str]:
    if record.tilt is None or not record.tilt.oblique:
        return []
    remedy = (
        "its parts that are too far from the base image's scale are lost"
        if plan.job.inputs.base
        else "without --base the map keeps that perspective: scale, speeds and directions differ over it; give an "
        "orthophoto with --base, or fly looking straight down"
    )
    return [
        f"the camera looks at the ground obliquely, {record.tilt.tilt_deg:.0f} degrees from the vertical by the "
        f"directions of {record.frames or 'its'} frames' lines, 0 to 20 expected: {remedy}"
    ]


def _notes(record: CameraRecord) -> list[str]:
    """What was decided, for people; the figures that decided it are in ``camera.json``."""
    if not record.accepted and not record.frames:
        return [record.reason]  # not asked for
    if not record.accepted:
        return ["no lens distortion is certain enough to correct: the frames are used as recorded"]
    if record.overlap is not None and record.overlap.used:
        return ["the lens distortion was refined by frames that show the same ground at different places"]
    return []


def _corner_shift(record: CameraRecord, width: int, height: int) -> float:
    """Largest displacement of a frame corner by the lens, px: an intuitive measure of the distortion."""
    corners = np.array([[0.0, 0.0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]])
    displacement = lens_from_record(record.lens).undistort_points(corners) - corners
    return float(np.hypot(*displacement.T).max())
