"""Streams of random numbers, one a matter, so that changing one effect leaves all others as they are."""

from enum import IntEnum

import numpy as np


class Matter(IntEnum):
    """What a stream of random numbers is for. Numbers are part of what a seed means: never change them."""

    TIMES = 0
    CAMERA = 1
    RELIEF = 2
    PLAN = 3
    TRAFFIC = 4
    PAINT = 5
    GRAIN = 6
    LOOKS = 7
    PARKED = 8
    OTHER_SENSOR = 9
    FRAME = 10


def stream(seed: int, matter: Matter, *number: int) -> np.random.Generator:
    """The stream of one matter of a flight, e.g. of one frame's noise: ``stream(seed, Matter.FRAME, 17)``."""
    return np.random.default_rng([seed, int(matter), *number])
