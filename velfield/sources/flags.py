"""Defects of a frame as the bits of one integer, a column of ``frames.zarr``."""

from enum import IntFlag


class FrameFlag(IntFlag):
    """Why a frame is not to be trusted; 0 where no defect is known.

    Examples
    --------
    >>> FrameFlag.BLACK in FrameFlag(9), FrameFlag.BLURRED in FrameFlag(9)
    (True, False)
    """

    SUSPECT = 1
    """The bitstream was corrupt here or since the last key frame: the image may be wrong."""
    UNREADABLE = 2
    """No image could be read; its pixels are zeros."""
    DUPLICATE = 4
    """The same image as the frame before, or the same time: no motion can be measured between the two."""
    BLACK = 8
    """Black, or without any detail."""
    BLURRED = 16
    """Far less sharp than its neighbours."""
    OUTLIER = 32
    """Correlates with neither neighbour, while those two correlate: it is not of the flight."""


UNUSABLE = (
    FrameFlag.SUSPECT
    | FrameFlag.UNREADABLE
    | FrameFlag.DUPLICATE
    | FrameFlag.BLACK
    | FrameFlag.BLURRED
    | FrameFlag.OUTLIER
)
"""A frame with any of these is in no tracklet."""


def describe_flags(flags: int) -> str:
    """Names of the bits that are set.

    Examples
    --------
    >>> describe_flags(9)
    'black, suspect'
    """
    return ", ".join(sorted(str(flag.name).lower() for flag in FrameFlag if flag & flags))
