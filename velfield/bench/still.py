"""How still things that stand lie on the map of a run: the jitter of registration, measured without any truth.

Corners of the base image that registration itself does not use (those at least a patch's half away from its own) are
found in every registered frame below the pixel, and carried to the map by the frame's transform. What is left of their
motion is what a standing car would seem to do: registration's residual, and the alignment's own noise.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from velfield.errors import InputError
from velfield.registration.alignment import FEW, MANY, Templates, align, blurred, make_templates
from velfield.registration.transforms import FrameTransform
from velfield.run import Run
from velfield.sources.pictures import read_picture_grey

FloatArray = NDArray[np.float64]

_MAX_SHIFT_PX = 3.0
_MIN_SHARE = 0.5
_MAD_TO_SD = 1.4826


@dataclass(frozen=True)
class StillScore:
    """What stands, on the map.

    Attributes
    ----------
    points, frames : corners followed in at least half of the registered frames; the frames.
    sd_median_px, sd_p90_px : robust standard deviation of a corner's place an axis, its median and 90th percentile over
        the corners, base px.
    drift_px : how far the corners' mean place moved from the first to the last tenth of the frames, base px.
    """

    points: int
    frames: int
    sd_median_px: float
    sd_p90_px: float
    drift_px: float

    def text(self) -> str:
        """One line."""
        return (
            f"{self.points} still corners in {self.frames} frames: standard deviation {self.sd_median_px:.3f} px "
            f"an axis (median; 90 % below {self.sd_p90_px:.3f}), drift from first to last tenth {self.drift_px:.3f} px"
        )


def still_things(run: Run, *, max_frames: int = 200) -> StillScore:
    """Follow still corners through at most ``max_frames`` frames, spread over the run.

    Raises
    ------
    InputError
        Fewer than three registered frames, or nothing to follow in them.
    """
    maps = replace(run.maps, onward=())
    registered = [frame for frame, status in enumerate(run.registration_status) if status == "ok"]
    chosen = np.unique(np.linspace(0, len(registered) - 1, min(max_frames, len(registered))).astype(int))
    if len(chosen) < 3:
        raise InputError(f"{run.layout.root}: {len(registered)} registered frames, 3 or more needed to see jitter")
    templates = _unused_corners(run)
    places = np.full((len(chosen), len(templates), 2), np.nan)
    for row, k in enumerate(chosen):
        transform = maps.transform(registered[k])
        assert isinstance(transform, FrameTransform), "a registered frame has a map"
        places[row] = _places(run.frames.read(registered[k]), transform, templates)
    return _score(places, run)


def _unused_corners(run: Run) -> Templates:
    """Corners of the picture that frames were registered to, away from those that registration aligns."""
    layout, limit = run.layout, run.record.config.frames.max_pixels
    own = run.grid.frames_to == "own"
    grey = read_picture_grey(layout.own_base_image, limit) if own else run.base_image
    known = read_picture_grey(layout.own_base_mask, limit) > 0 if own else np.ones(grey.shape, np.bool_)
    used = [make_templates(grey, known, count=count).xy for count in (FEW, MANY)]
    return make_templates(grey, known, apart_from=np.concatenate(used))


def _places(grey: NDArray[np.uint8], transform: FrameTransform, templates: Templates) -> FloatArray:
    """Where a frame puts the corners on the map, (n, 2) base px; NaN where it does not show them."""
    found, _ = align(blurred(grey)[0], transform, templates, coarse=False, max_shift_px=_MAX_SHIFT_PX)
    number = {(float(x), float(y)): k for k, (x, y) in enumerate(templates.xy)}
    rows = [number[(float(x), float(y))] for x, y in found.xy_base]
    places = np.full((len(templates), 2), np.nan)
    places[rows] = transform.to_base(found.xy_raw)
    return places


def _score(places: FloatArray, run: Run) -> StillScore:
    """Of places (frames, corners, 2)."""
    seen = np.isfinite(places[..., 0])
    followed = seen.mean(axis=0) >= _MIN_SHARE
    if not followed.any():
        raise InputError(f"{run.layout.root}: no corner of the base image is seen in half of the frames")
    kept = places[:, followed]
    rest = kept - np.nanmedian(kept, axis=0)
    sd = _MAD_TO_SD * np.sqrt(np.mean(np.nanmedian(np.abs(rest), axis=0) ** 2, axis=1))
    tenth = max(1, len(kept) // 10)
    drift = np.nanmedian(rest[-tenth:], axis=(0, 1)) - np.nanmedian(rest[:tenth], axis=(0, 1))
    return StillScore(
        points=int(followed.sum()),
        frames=len(places),
        sd_median_px=float(np.median(sd)),
        sd_p90_px=float(np.percentile(sd, 90)),
        drift_px=float(np.hypot(*drift)),
    )
