"""The figures of a run's report, read from its maps."""

from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from schemas.report import ReportFigure
from velfield.report.figures import jpeg_bytes

_PICTURE_SIDE_PX = 1600
_CAPTIONS = {
    "direction": (
        "Direction of travel",
        "The modal direction of travel at every pixel that vehicles passed, as hue; none where they are stationary.",
        "map of the modal direction over the base image",
    ),
    "speed": (
        "Speed",
        "The modal speed at every pixel that vehicles passed.",
        "map of the modal speed over the base image",
    ),
    "lens": (
        "The lens",
        "A frame as taken, and undistorted. The orange grid is straight on the ground: kerbs and roofs along it "
        "follow it in both.",
        "a frame before and after undistortion",
    ),
    "registration": (
        "Registration error",
        "Hold-out error of the control points, px, by cell of the frame, over all frames.",
        "registration error by cell over a frame",
    ),
}
"""Image of ``maps/`` -> title, caption and alternative text."""


def report_figures(maps: Path) -> dict[str, ReportFigure]:
    """The figures of a run's report from its folder of maps, their bytes in them, by name."""
    figures = {}
    for name, (title, caption, alt_text) in _CAPTIONS.items():
        path = maps / f"{name}.png"
        if not path.exists():
            continue  # a pinhole lens has no such figure
        picture = Image.open(BytesIO(path.read_bytes())).convert("RGB")  # Pillow opens no object of S3
        figures[name] = ReportFigure(
            title=title,
            caption=caption,
            alt_text=alt_text,
            mime="image/jpeg",
            data=jpeg_bytes(np.asarray(picture), max_side=_PICTURE_SIDE_PX),
            full_size=f"maps/{name}.png",
        )
    return figures
