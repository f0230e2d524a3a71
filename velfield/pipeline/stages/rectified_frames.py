"""Frames on the working grid: the base image's, scaled so that a car is about 8 x 16 px whatever the footage."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.records import GridRecord
from velfield.pipeline.plan import Plan
from velfield.registration.transforms import FrameMap
from velfield.registration.warp import Rectification, footprint, warp_to_base
from velfield.run.frame_transforms import FrameTransforms, read_grid
from velfield.run.stores import FrameStore

Window = tuple[int, int, int, int]
"""x, y, width, height in base px."""


@dataclass(frozen=True)
class WorkingFrame:
    """A window of one frame on the working grid."""

    image: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    """(h, w) uint8 grey and bool: where the frame covers the window; elsewhere its edge goes on."""
    window: Window
    """The window, base px."""
    scale: float
    """Working px a base px."""

    def to_base(self, xy_work: NDArray[np.float64]) -> NDArray[np.float64]:
        """Working pixels (n, 2) -> base pixels (n, 2)."""
        return (xy_work + 0.5) / self.scale - 0.5 + self.window[:2]

    def to_work(self, xy_base: NDArray[np.float64]) -> NDArray[np.float64]:
        """Base pixels (n, 2) -> working pixels (n, 2)."""
        return (xy_base - self.window[:2] + 0.5) * self.scale - 0.5


@dataclass(frozen=True)
class WorkingGrid:
    """Gives any registered frame of a run on the working grid."""

    frames: FrameStore
    maps: FrameTransforms
    grid: GridRecord
    scale: float

    @classmethod
    def open(cls, plan: Plan, scale: float) -> "WorkingGrid":
        """The working grid of a plan's run folder at a scale."""
        maps = FrameTransforms.open(plan.layout, plan.config)
        return cls(FrameStore(plan.layout.frames), maps, read_grid(plan.layout), scale)

    def frame(self, frame: int, window: Window | None = None) -> WorkingFrame | None:
        """One frame; none where it is not registered or does not meet the base image. ``window`` none: its
        footprint."""
        transform = self.maps.transform(frame)
        if transform is None:
            return None
        box = window or self._footprint(transform)
        if box is None:
            return None
        image, valid = warp_to_base(
            self.frames.read(frame),
            transform,
            window=box,
            scale=self.scale,
            interpolation=cv2.INTER_CUBIC,
            replicate_border=True,
        )
        return WorkingFrame(image, valid, box, self.scale)

    def rectification(self, frame: int, window: Window) -> Rectification | None:
        """One frame on a window, resampled where it is asked for; none where it is not registered."""
        transform = self.maps.transform(frame)
        if transform is None:
            return None
        return Rectification(self.frames.read(frame), transform, window=window, scale=self.scale)

    def common_window(self, frames: Sequence[int]) -> Window | None:
        """The window of all of some frames; none where none of them is registered and meets the base image."""
        transforms = [self.maps.transform(frame) for frame in frames]
        boxes = [box for one in transforms if one is not None and (box := self._footprint(one)) is not None]
        if not boxes:
            return None
        left, top = (min(box[k] for box in boxes) for k in (0, 1))
        right, bottom = (max(box[k] + box[2 + k] for box in boxes) for k in (0, 1))
        return left, top, right - left, bottom - top

    def _footprint(self, transform: FrameMap) -> Window | None:
        x0, y0, x1, y1 = footprint(transform, self.frames.shape)
        if not np.isfinite(x0):
            return None
        left, top = max(0, int(np.floor(x0))), max(0, int(np.floor(y0)))
        right, bottom = min(self.grid.width_px, int(np.ceil(x1)) + 1), min(self.grid.height_px, int(np.ceil(y1)) + 1)
        return (left, top, right - left, bottom - top) if right > left and bottom > top else None
