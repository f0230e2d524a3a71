"""What tracking reads of a frame, and which frames a part of the flight reads."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.arrays import ByteArray, FloatArray, IntArray
from velfield.tracking.gates import Places
from velfield.tracking.limits import Limits
from velfield.tracking.refine import Chips


@dataclass(frozen=True)
class FrameTable:
    """What tracking knows of one frame.

    Attributes
    ----------
    frame, time_s
        Index in ``frames.zarr``, and its true time.
    registered
        Whether it may take part: registered, and not flagged.
    residual_px
        Registration residual, base px; widens the gates.
    detection_id, x_px, y_px, orientation_rad, orientation_sd_rad, score
        (n,) as in the detections' table. Orientations may be NaN.
    patches
        (n, length, width) uint8 oriented patches in working px; none: looks do not count.
    chips
        (n, 32, 32) uint8 upright crops in working px, centred on ``round(x_work), round(y_work)``; none: places are
        not refined.
    x_work, y_work
        (n,) places in working px of this frame's warped picture; with ``chips`` only.
    working_scale
        Working px a base px.
    registration_sd_px
        Standard error of the frame's map, base px; part of a displacement's standard deviation.
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
    chips: ByteArray | None = None
    x_work: FloatArray | None = None
    y_work: FloatArray | None = None
    working_scale: float = 1.0
    registration_sd_px: float = 0.0

    def places(self, limits: Limits) -> Places:
        """The detections as the gates read them."""
        return Places(
            x_px=np.asarray(self.x_px, np.float64),
            y_px=np.asarray(self.y_px, np.float64),
            axis_rad=np.asarray(self.orientation_rad, np.float64),
            axis_sd_rad=np.asarray(self.orientation_sd_rad, np.float64),
            sd_px=limits.place_sd_px(self.residual_px),
            time_s=self.time_s,
        )

    def crops(self) -> Chips | None:
        """The upright crops, and where their centres are in base px."""
        if self.chips is None or self.x_work is None or self.y_work is None:
            return None
        return Chips(
            pixels=self.chips,
            centre_x_px=self.x_px + (np.rint(self.x_work) - self.x_work) / self.working_scale,
            centre_y_px=self.y_px + (np.rint(self.y_work) - self.y_work) / self.working_scale,
            axis_rad=np.asarray(self.orientation_rad, np.float64),
            scale=self.working_scale,
        )


def window_frames(registered: Sequence[bool], times_s: Sequence[float], starts: range, max_interval_s: float) -> range:
    """Frames (positions) that the windows starting in ``starts`` read, so that a part of a flight can be cut out.

    Parameters
    ----------
    registered, times_s
        Of every frame of the flight, in time order.
    starts
        Positions at which a window may start.
    max_interval_s
        Longest interval in a window.

    Examples
    --------
    >>> window_frames([True, True, False, True, True, True], [0.0, 0.2, 0.4, 0.6, 0.8, 1.0], range(0, 2), 0.45)
    range(0, 5)
    """
    stop = min(max(starts.stop, starts.start), len(times_s))
    if stop <= starts.start:
        return range(starts.start, starts.start)
    last, wanted = stop, 2
    while last < len(times_s) and wanted and times_s[last] - times_s[stop - 1] <= 2 * max_interval_s:
        wanted -= bool(registered[last])
        last += 1
    return range(starts.start, last)
