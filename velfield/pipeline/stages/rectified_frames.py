"""Frames on the working grid: the base image's, scaled so that a car is about 8 x 16 px whatever the footage."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import Float32Array, FloatArray
from schemas.records import GridRecord
from velfield.detection.motion.difference import MotionBackground
from velfield.pipeline.plan import Plan
from velfield.registration.transforms import FrameMap
from velfield.registration.warp import Rectification, footprint, warp_to_base
from velfield.run.commits import write_atomically
from velfield.run.frame_transforms import FrameTransforms, read_grid
from velfield.run.layout import RunLayout
from velfield.run.stores import FrameStore, open_frames

Window = tuple[int, int, int, int]
"""x, y, width, height in base px."""


@dataclass(frozen=True)
class WorkingFrame:
    """A window of one frame on the working grid.

    Attributes
    ----------
    image, valid
        (h, w) uint8 grey and bool: where the frame covers the window; elsewhere its edge goes on.
    window
        The window, base px.
    scale
        Working px a base px.
    """

    image: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    window: Window
    scale: float

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
        return cls(open_frames(plan.layout.frames), maps, read_grid(plan.layout), scale)

    @property
    def whole(self) -> Window:
        """The whole base image."""
        return 0, 0, self.grid.width_px, self.grid.height_px

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


@dataclass(frozen=True)
class FrameLook:
    """Frames of a run about positions, at half the working grid's resolution.

    ``scale``, px a base px; ``half``, px from the middle of an image to its border.
    """

    frames: FrameStore
    maps: FrameTransforms
    scale: float
    half: int

    @classmethod
    def open(cls, plan: Plan, working_scale: float, metres: float, half_m: float) -> "FrameLook":
        """The frames of a plan's run folder; ``metres`` a base px, ``half_m`` from the middle to the border."""
        scale = working_scale / 2
        half = int(np.ceil(half_m / metres * scale))
        return cls(open_frames(plan.layout.frames), FrameTransforms.open(plan.layout, plan.config), scale, half)

    def __call__(self, frame: int, xy_px: FloatArray) -> Float32Array:
        """A frame about positions (k, 2), base px: (k, n, n) grey levels, NaN outside the frame."""
        size = 2 * self.half + 1
        images = np.full((len(xy_px), size, size), np.nan, np.float32)
        transform = self.maps.transform(frame)
        if transform is None:
            return images
        raw, reach = self.frames.read(frame), int(np.ceil((self.half + 2) / self.scale))
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        for k, (x, y) in enumerate(xy_px):
            window = (int(x) - reach, int(y) - reach, 2 * reach + 1, 2 * reach + 1)
            image, valid = warp_to_base(raw, transform, window=window, scale=self.scale)
            part = image.astype(np.float32)
            part[~valid] = np.nan
            # The window begins at a whole base px: what is left is shifted, so that the position is in the middle.
            left, top = WorkingFrame(image, valid, window, self.scale).to_work(xy_px[k : k + 1])[0] - self.half
            images[k] = cv2.warpAffine(part, np.array([[1.0, 0.0, left], [0.0, 1.0, top]]), (size, size), flags=flags)
        return images


def write_background(layout: RunLayout, background: MotionBackground) -> None:
    """Write ``base/background.npz``."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        allow_pickle=False,
        median=background.median,
        low=background.low,
        high=background.high,
        valid=background.valid,
    )
    write_atomically(layout.background, buffer.getvalue())


def read_background(layout: RunLayout) -> MotionBackground:
    """Read ``base/background.npz``."""
    with np.load(io.BytesIO(layout.background.read_bytes()), allow_pickle=False) as file:
        return MotionBackground(file["median"], file["low"], file["high"], file["valid"])
