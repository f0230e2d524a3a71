"""Figures of geometric quality: a frame before and after undistortion, the registration error over the frame."""

from pathlib import Path

import numpy as np

from velfield.pipeline.plan import Plan
from velfield.report.figures import png_bytes
from velfield.report.quality_figures import registration_error_figure, undistortion_figure
from velfield.run.commits import write_atomically
from velfield.run.frame_transforms import read_lens
from velfield.run.stores import open_frames, open_registration

_FULL_PX = 1.0
"""Maximum of the colour scale of the error map."""


def write_certificates(plan: Plan) -> list[Path]:
    """Write ``maps/registration.png``, and ``maps/lens.png`` where the lens has distortion."""
    layout = plan.layout
    errors = open_registration(layout.registration).column("error_px")
    seen = np.isfinite(errors).any(axis=(1, 2))
    if not seen.any():
        return []
    grey = open_frames(layout.frames).read(int(np.flatnonzero(seen)[0]))
    known = np.isfinite(errors)
    mean_square = np.sum(np.where(known, errors, 0.0) ** 2, axis=0) / np.maximum(known.sum(axis=0), 1)
    by_cell = np.where(known.any(axis=0), np.sqrt(mean_square), np.nan)
    pictures = {layout.maps / "registration.png": registration_error_figure(grey, by_cell, full_px=_FULL_PX)}
    lens = read_lens(layout)
    if not lens.is_identity:
        pictures[layout.maps / "lens.png"] = undistortion_figure(grey, lens)
    else:
        (layout.maps / "lens.png").unlink(missing_ok=True)
    for path, picture in pictures.items():
        write_atomically(path, png_bytes(picture))
    return list(pictures)
