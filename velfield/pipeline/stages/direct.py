"""Direct registration of sampled frames to the image given as ``--base``, and the lens that follows from it.

If all succeed, frames need no intermediate image. If not (another season, other light), they are registered to the
flight's own base image, and that once to the given one.

Their control points, hundreds a frame, show the lens better than straight lines do: it is fitted to them again, and the
frames registered through it, which reaches farther into the corners.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from velfield.camera.lens import Lens, PolynomialLens
from velfield.camera.map_fit import MapFit, fit_lens_to_map, mean_lens
from velfield.parallel import parallel_map
from velfield.pipeline.plan import Plan
from velfield.pipeline.stages.base_fit import BaseFit, check_scale, covered_fraction
from velfield.registration.frame_fit import BaseReference, FrameRegistration
from velfield.registration.intrasensor import prepare_base, register_frame
from velfield.registration.keypoints import Keypoints
from velfield.run.commits import write_record
from velfield.run.stores import FrameStore
from velfield.sources.geo import BaseRaster

_N_TRIALS = 8
_MAX_ERROR_PX, _MIN_COVERAGE = 0.5, 0.8
"""Held-out residual and coverage that all sampled frames must reach to be registered directly to the given image."""
_LENS_ROUNDS = 3
_MIN_LENS_CHANGE_PX = 0.3
"""RMS change of the lens over the frame that is worth registering the frames again."""

Register = Callable[[int, Lens], FrameRegistration]
"""Registers a frame through a lens."""


@dataclass(frozen=True)
class DirectRegistration:
    """Direct registration of the sampled frames (None if one fails), the lens from their matches, notes on it, and
    the features of the given image."""

    fit: BaseFit | None
    lens: Lens
    notes: list[str]
    reference: BaseReference


def trial_frames(spread: list[int]) -> list[int]:
    """Select the spread frames that are registered directly to a given image first."""
    count = min(_N_TRIALS, len(spread))
    return [spread[k] for k in np.unique(np.linspace(0, len(spread) - 1, count).round().astype(int))]


def register_directly(plan: Plan, given: BaseRaster, keypoints: dict[int, Keypoints], lens: Lens) -> DirectRegistration:
    """Register sampled frames directly to the given image.

    Where their control points decide for another lens, it is written to ``base/lens.json``.
    """
    config, store = plan.config.registration, FrameStore(plan.layout.frames)
    shape = plan.frame_shape
    reference = prepare_base(given.grey, config, mask=given.valid, frame_shape=shape)
    frames = trial_frames(sorted(keypoints))

    def register(frame: int, lens: Lens) -> FrameRegistration:
        return register_frame(store.read(frame), keypoints[frame], reference, lens, config)

    refines = plan.config.lens.calibrate != "never"
    first, notes = register(frames[0], lens), list[str]()
    if refines:
        lens, first, notes = _refine_by_one(plan, register, frames[0], lens, first)
    results = _register_others(register, frames, lens, first)
    if results is None:
        return DirectRegistration(None, lens, notes, reference)
    if refines:
        for _ in range(_LENS_ROUNDS):
            fit = _fit_lens(results, lens, shape)
            if fit is None:
                break
            again = _register_others(register, frames, fit.lens, register(frames[0], fit.lens))
            if again is None or _error_px(again) >= _error_px(results):
                break
            notes = accept_lens(plan, fit.lens, _evidence(again))
            lens, results = fit.lens, again
    return DirectRegistration(_summarise(plan, given, results), lens, notes, reference)


def _refine_by_one(
    plan: Plan, register: Register, frame: int, lens: Lens, result: FrameRegistration
) -> tuple[Lens, FrameRegistration, list[str]]:
    """The lens, or a better one where a frame registers not well through it, each reaching farther out; the frame's
    registration through it, and notes.

    Through a lens that is far off in the corners the patches that verify a given image agree in its middle alone, and
    it would be refused as one of another area.
    """
    notes: list[str] = []
    for _ in range(_LENS_ROUNDS):
        if not result.ok or _is_accurate(result):
            break
        fit = _fit_lens([result], lens, plan.frame_shape)
        if fit is None:
            break
        again = register(frame, fit.lens)
        if not again.ok or again.heldout_px >= result.heldout_px:
            break
        lens, result, notes = fit.lens, again, accept_lens(plan, fit.lens, _evidence([again]))
    return lens, result, notes


def accept_lens(plan: Plan, lens: PolynomialLens, evidence: str) -> list[str]:
    """Write a lens that matches with the given image decide for to ``base/lens.json``; a note on it."""
    write_record(plan.layout.map_lens, lens.to_record())
    first, second = lens.coefficients
    return [f"lens by the base image: k = {first:.3f}, {second:.3f} from {evidence}"]


def _evidence(results: Sequence[FrameRegistration]) -> str:
    return f"{sum(result.n_inliers for result in results)} control points"


def _register_others(
    register: Register, frames: list[int], lens: Lens, first: FrameRegistration
) -> list[FrameRegistration] | None:
    """The frames' registrations, after that of the first; None if one of them is not accurate."""
    if not _is_accurate(first):
        return None
    results = [first, *parallel_map(lambda frame: register(frame, lens), frames[1:])]
    return results if all(_is_accurate(result) for result in results) else None


def _is_accurate(result: FrameRegistration) -> bool:
    return result.ok and result.heldout_px <= _MAX_ERROR_PX and result.coverage >= _MIN_COVERAGE


def _error_px(results: Sequence[FrameRegistration]) -> float:
    return float(np.mean([result.heldout_px for result in results]))


def _fit_lens(results: Sequence[FrameRegistration], lens: Lens, shape: tuple[int, ...]) -> MapFit | None:
    """The mean of the lenses that each frame's control points give; None where most decide for none.

    Row motion is removed first. Of several frames it leaves a mean lens that no one frame's rolling shutter bends.
    """
    fits = []
    for result in results:
        assert result.transform is not None, "accurate frames have a transform"
        assert result.control_points is not None, "accurate frames have control points"
        xy_raw = lens.distort_points(result.transform.remove_row_motion(result.control_points.xy_raw))
        valid = np.isfinite(xy_raw).all(axis=1)
        fit = fit_lens_to_map(xy_raw[valid], result.control_points.xy_base[valid], lens, (shape[0], shape[1]))
        if fit is not None:
            fits.append(fit)
    if 2 * sum(fit.is_better and fit.change_px >= _MIN_LENS_CHANGE_PX for fit in fits) <= len(results):
        return None
    return replace(fits[0], lens=mean_lens([fit.lens for fit in fits]))


def _summarise(plan: Plan, given: BaseRaster, results: Sequence[FrameRegistration]) -> BaseFit:
    fits = []
    for result in results:
        assert result.transform is not None, "accurate frames have a transform"
        scale, rotation = result.transform.scale_and_rotation()
        check_scale(scale, given, plan.job.inputs.base or "")
        covered = covered_fraction(result.transform, None, given)
        fits.append(BaseFit(True, result.heldout_px, result.n_inliers, scale, rotation, covered))
    return replace(
        fits[len(fits) // 2],
        error_px=float(np.mean([fit.error_px for fit in fits])),
        points=int(np.mean([fit.points for fit in fits])),
        covered=float(np.mean([fit.covered for fit in fits])),
    )
