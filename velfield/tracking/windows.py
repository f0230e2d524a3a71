"""The input of tracking by frame, and the frames that a part of a flight needs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.arrays import ByteArray, FloatArray, IntArray
from velfield.tracking.crop_alignment import UprightCrops
from velfield.tracking.gates import DetectionStates
from velfield.tracking.limits import Limits


@dataclass(frozen=True)
class FrameTable:
    """Detections of one frame with their positions, axes, appearance and time.

    Attributes
    ----------
    frame, time_s
        Index in ``frames.zarr``, and its true time.
    registered
        Whether it is used: registered, and not flagged.
    residual_px
        Registration residual, base px; widens the gates.
    detection_id, x_px, y_px, orientation_rad, orientation_sd_rad, score
        (n,) as in the detections' table. Orientations may be NaN.
    patches
        (n, length, width) uint8 oriented patches in working px; None: appearance is not used.
    chips
        (n, 32, 32) uint8 upright crops in working px, centred on ``round(x_work), round(y_work)``; None: displacements
        are not refined.
    x_work, y_work
        (n,) positions in working px of this frame's rectified image; with ``crops`` only.
    working_scale
        Working px a base px.
    registration_sd_px
        Standard error of the frame's transform, base px; part of a displacement's standard deviation.
    """

    frame: int
    time_s: float
    registered: bool
    residual_px: float
    detection_id: IntArray
    x_px: FloatArray
    y_px: FloatArray
    orientation_rad: FloatArray
    orientation_sd_rad: FloatArray
    score: FloatArray
    patches: ByteArray | None = None
    crops: ByteArray | None = None
    x_work: FloatArray | None = None
    y_work: FloatArray | None = None
    working_scale: float = 1.0
    registration_sd_px: float = 0.0

    def states(self, limits: Limits) -> DetectionStates:
        """Positions and axes of the detections, for the gates."""
        return DetectionStates(
            x_px=np.asarray(self.x_px, np.float64),
            y_px=np.asarray(self.y_px, np.float64),
            axis_rad=np.asarray(self.orientation_rad, np.float64),
            axis_sd_rad=np.asarray(self.orientation_sd_rad, np.float64),
            sd_px=limits.position_sd_px(self.residual_px),
            time_s=self.time_s,
        )

    def upright_crops(self) -> UprightCrops | None:
        """The upright crops with their centres in base px."""
        if self.crops is None or self.x_work is None or self.y_work is None:
            return None
        return UprightCrops(
            pixels=self.crops,
            centre_x_px=self.x_px + (np.rint(self.x_work) - self.x_work) / self.working_scale,
            centre_y_px=self.y_px + (np.rint(self.y_work) - self.y_work) / self.working_scale,
            axis_rad=np.asarray(self.orientation_rad, np.float64),
            scale=self.working_scale,
        )


def window_frames(registered: Sequence[bool], times_s: Sequence[float], starts: range, max_interval_s: float) -> range:
    """Frames (positions) that the windows starting in ``starts`` read, so that parts of it can be processed alone.

    Parameters
    ----------
    registered, times_s
        Of every frame of the flight, in time order.
    starts
        Positions at which a window may start.
    max_interval_s
        Longest interval between two frames of a window.

    Examples
    --------
    >>> window_frames([True, True, False, True, True, True], [0.0, 0.2, 0.4, 0.6, 0.8, 1.0], range(0, 2), 0.45)
    range(0, 5)
    """
    stop = min(max(starts.stop, starts.start), len(times_s))
    if stop <= starts.start:
        return range(starts.start, starts.start)
    last, missing = stop, 2
    while last < len(times_s) and missing and times_s[last] - times_s[stop - 1] <= 2 * max_interval_s:
        missing -= bool(registered[last])
        last += 1
    return range(starts.start, last)
