"""A new base image of the small simulated flight, whose map onto the old one is exactly known."""

from pathlib import Path

import cv2
import numpy as np

SCALE, TURN_RAD, SHIFT_PX = 0.9, 0.05, (14.0, 9.0)
NEW_FROM_OLD = np.array(
    [
        [SCALE * np.cos(TURN_RAD), -SCALE * np.sin(TURN_RAD), SHIFT_PX[0]],
        [SCALE * np.sin(TURN_RAD), SCALE * np.cos(TURN_RAD), SHIFT_PX[1]],
    ]
)
"""Base pixels -> pixels of the new image: exactly known."""


def write_new_base(flight: Path, path: Path) -> Path:
    """The same place from another sensor: smaller, turned, of other tones, noisy."""
    old = cv2.imread(str(flight / "base.png"), cv2.IMREAD_GRAYSCALE)
    moved = cv2.warpAffine(old, NEW_FROM_OLD, (old.shape[1], old.shape[0]), flags=cv2.INTER_AREA, borderValue=90)
    toned = 255 * (moved / 255.0) ** 0.8 * 0.8 + 20 + np.random.default_rng(0).normal(0, 3, moved.shape)
    cv2.imwrite(str(path), np.clip(toned, 0, 255).astype(np.uint8))
    return path
