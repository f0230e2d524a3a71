"""Attitudes as rotations (angles of Euler are ambiguous where a camera looks straight down), and the film format."""

import numpy as np

from schemas.arrays import FloatArray

DIAGONAL_35MM = 43.267
"""Diagonal of 36 mm x 24 mm film, mm: equivalent focal lengths compare diagonal angles of view."""


def rotation_to_ned(yaw_deg: float, pitch_deg: float, roll_deg: float) -> FloatArray:
    """The matrix (3, 3) from forward, right, down of a body to north, east, down: by roll, then pitch, then yaw.

    Examples
    --------
    >>> (rotation_to_ned(90.0, 0.0, 0.0) @ [1, 0, 0]).round(6) + 0.0  # forward is east
    array([0., 1., 0.])
    """
    y, p, r = np.radians([yaw_deg, pitch_deg, roll_deg])
    about_down = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
    about_right = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    about_forward = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    return np.asarray(about_down @ about_right @ about_forward)


def camera_angles(rotation: FloatArray) -> dict[str, float]:
    """Yaw, pitch and roll in `Telemetry`'s sense of a camera whose forward, right and down (3, 3) go to these columns.

    Yaw is where the top of the picture points, also where pitch is -90 and yaw and roll turn about one axis.

    Examples
    --------
    >>> {name: round(angle) for name, angle in camera_angles(rotation_to_ned(30.0, -90.0, 180.0)).items()}
    {'yaw_deg': -150, 'pitch_deg': -90, 'roll_deg': 0}
    """
    forward, right, down = np.asarray(rotation).T
    yaw_deg = float(np.degrees(np.arctan2(right[1], right[0]))) - 90.0
    return {
        "yaw_deg": (yaw_deg + 180.0) % 360.0 - 180.0,
        "pitch_deg": float(np.degrees(np.arctan2(down[2], forward[2]))) - 90.0,
        "roll_deg": float(np.degrees(np.arctan2(right[2], forward[2]))),
    }
