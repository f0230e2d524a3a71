"""Numbers as people say them."""

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

_STEP = {"km/h": 10.0, "mph": 5.0}
_PER_M_PER_S = {"km/h": 3.6, "mph": 2.2369362920544}


def heading_deg(direction_rad: NDArray[np.floating], *, north_rad: float = -math.pi / 2) -> NDArray[np.float64]:
    """Compass heading in [0, 360), clockwise from north (by default the picture's up), of directions of motion.

    Examples
    --------
    >>> heading_deg(np.array([0.0, math.pi / 2])).tolist()
    [90.0, 180.0]
    """
    return np.degrees(np.asarray(direction_rad, np.float64) - north_rad) % 360.0


def customary_limit(speed_p85_m_per_s: float, unit: Literal["km/h", "mph"] = "km/h") -> float:
    """The round limit nearest to the 85th percentile of speed: what the usual rule would post, not what is posted.

    Examples
    --------
    >>> customary_limit(14.6), customary_limit(14.6, "mph")
    (50.0, 35.0)
    """
    step = _STEP[unit]
    return max(step, round(speed_p85_m_per_s * _PER_M_PER_S[unit] / step) * step)
