"""The files that were given beside the frames: whether they can be read, and whether a base image shows the area."""

from collections.abc import Callable
from pathlib import Path

from schemas.arrays import GreyImage
from velfield.camera.lens import pinhole
from velfield.detection.interface import Detector
from velfield.detection.registry import load_detector
from velfield.detection.runtime import use_device
from velfield.errors import Failure, InputError
from velfield.pipeline.plan import Plan
from velfield.pipeline.stages.labels import rescale
from velfield.registration.intersensor.register import MIRRORED, IntersensorResult, register_intersensor
from velfield.sources.geo import read_base_raster
from velfield.sources.labels.labels import read_detections, read_labels
from velfield.sources.quality import UNUSABLE
from velfield.sources.source import iter_frames
from velfield.sources.telemetry.read import read_telemetry_file

_CHECKED_SIDE_PX = 960
_TRIED_FRAMES = 5

READ_GIVEN: dict[str, Callable[[Path, Plan], object]] = {
    "base": lambda path, plan: read_base_raster(path, plan.config.frames),
    "labels": lambda path, plan: read_labels(path, plan.info),
    "detector": lambda path, plan: _read_detector(path, plan),
    "detections": lambda path, plan: read_detections(path, plan.info),
    "telemetry": lambda path, plan: read_telemetry_file(path, plan.info),
}
"""By option: reads its file, or raises an `InputError` that does not name the option."""


def _read_detector(path: Path, plan: Plan) -> Detector:
    """A model of another maker opens a session: on the device of the stages, which report what limits it."""
    use_device(plan.config.work.device)
    return load_detector(path)


def check_base_area(plan: Plan) -> None:
    """Refuse a base image of another area by one frame of the flight's middle, before the others are decoded.

    The lens is not known yet. So the middle of the frame, where a lens distorts little, is tried where all of it fails,
    both reduced, and only an image to which neither registers is refused; the base stage decides on the others.

    Raises
    ------
    InputError
        Neither registers.
    """
    grey = _middle_frame(plan)
    if grey is None:
        return
    base = read_base_raster(Path(plan.job.inputs.base or ""), plan.config.frames).grey
    height, width = grey.shape
    middle = grey[height // 4 : height - height // 4, width // 4 : width - width // 4]
    reasons = []
    for image in (grey, middle):
        found = _register_reduced(plan, image, base)
        if not isinstance(found, Failure):
            return
        reasons.append(found.reason)
    reason = next((reason for reason in reasons if MIRRORED in reason), reasons[-1])
    raise InputError(f"--base {plan.job.inputs.base}: {reason}")


def _register_reduced(plan: Plan, image: GreyImage, base: GreyImage) -> IntersensorResult | Failure:
    """Register an image that no lens is known of, reduced as far as it shows the area."""
    factor = min(1.0, _CHECKED_SIDE_PX / max(image.shape))
    small = rescale(image, factor)
    return register_intersensor(small, rescale(base, factor), plan.config.base, lens=pinhole(small.shape))


def _middle_frame(plan: Plan) -> GreyImage | None:
    """A usable frame near the middle of the flight; None where the first few there are not."""
    middle = plan.indices[plan.frame_count // 2 :][:_TRIED_FRAMES]
    for frame in iter_frames(Path(plan.job.inputs.source), plan.info, middle):
        if not frame.flags & UNUSABLE:
            return frame.grey
    return None
