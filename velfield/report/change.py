"""A change between two fields over the dimmed base image: blue for less, orange for more."""

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import GreyImage, RGBImage
from velfield.report.colours import change_colours
from velfield.report.figures import MapScale, beside, blend_over_image, round_up
from velfield.report.panel import Legend


def change_figure(grey: GreyImage, change: NDArray[np.floating], scale: MapScale, *, title: str) -> RGBImage:
    """The figure of one quantity's change.

    Parameters
    ----------
    grey
        (h, w) base image.
    change
        (h, w) change, in the unit in the title. NaN is not drawn.
    scale
        Scale of the map, for the legend.

    Returns
    -------
    ndarray
        (h, w + legend, 3) uint8 RGB.

    Raises
    ------
    InputError
        Where the shapes differ.
    """
    known = np.isfinite(change)
    top = round_up(float(np.percentile(np.abs(change[known]), 99))) if known.any() else 10.0
    image = blend_over_image(grey, change, change_colours(change / top))
    note = "After minus before, where significant. Bare grey: no significant change."
    return beside(image, Legend(title, note, "change", top, scale.gsd_m, scale.north_rad))
