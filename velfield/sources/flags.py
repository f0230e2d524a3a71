"""What can be wrong with a frame, as bits of one number, so that a row of ``frames.zarr`` holds it."""

from enum import IntFlag


class FrameFlag(IntFlag):
    """Why a frame is not to be trusted; 0 where nothing is known against it.

    Examples
    --------
    >>> FrameFlag.BLACK in FrameFlag(9), FrameFlag.BLURRED in FrameFlag(9)
    (True, False)
    """

    SUSPECT = 1
    """The bitstream was damaged here or since the last key frame: the picture may be wrong."""
    UNREADABLE = 2
    """No picture could be read; what stands in its place is zeros."""
    DUPLICATE = 4
    """The same picture as the frame before, or the same time: between the two nothing moved or nothing can be said."""
    BLACK = 8
    """Black, or without any detail."""
    BLURRED = 16
    """Far less sharp than its neighbours. Advice only: registration decides."""
    FOREIGN = 32
    """Unlike its neighbours, which are like each other. Advice only: registration decides."""


UNUSABLE = FrameFlag.SUSPECT | FrameFlag.UNREADABLE | FrameFlag.DUPLICATE | FrameFlag.BLACK
"""A frame with any of these is in no tracklet."""


def describe_flags(flags: int) -> str:
    """Name the bits that are set, for people.

    Examples
    --------
    >>> describe_flags(9)
    'black, suspect'
    """
    return ", ".join(sorted(str(flag.name).lower() for flag in FrameFlag if flag & flags))
