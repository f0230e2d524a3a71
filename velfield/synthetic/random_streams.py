"""Independent streams of random numbers, one for each component, so that changing one effect leaves all others
unchanged."""

from enum import IntEnum

import numpy as np


class RandomStream(IntEnum):
    """The component that a stream of random numbers is for. The numbers determine what a seed gives: never change
    them."""

    TIMES = 0
    CAMERA = 1
    RELIEF = 2
    PLAN = 3
    TRAFFIC = 4
    PAINT = 5
    GRAIN = 6
    APPEARANCE = 7
    PARKED = 8
    OTHER_SENSOR = 9
    FRAME = 10
    TELEMETRY = 11


def random_generator(seed: int, stream: RandomStream, *number: int) -> np.random.Generator:
    """The generator of one stream of a flight, e.g. of a frame's noise:
    ``random_generator(seed, RandomStream.FRAME, 17)``."""
    return np.random.default_rng([seed, int(stream), *number])
