"""The scale of an image by the shipped detector, where neither scale nor labels are given.

The network was trained on cars of one length in pixels. At the right scale of the image it finds the most cars, with
the highest scores and of a car's length and width; at others it finds parts of things that look like cars, of any size.
So parts of the image are searched at every scale (the scan), and about the best one more of it, where the median length
of the cars that are found gives the scale (the refinement).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from schemas.arrays import FloatArray, GreyImage, Mask
from schemas.detector import DetectorConfig
from velfield.detection.interface import Detector
from velfield.parallel import parallel_map

STEP = 1.25
"""Ratio of two scales of the scan: the network finds cars that are a quarter larger or smaller too."""
SCAN_PX, REFINE_PX = 800_000, 2_500_000
"""Area that is searched at a scale of the scan, and in the refinement, working px."""
_COLUMNS, _ROWS = 3, 2
"""Windows of an image that is larger than that."""
_TOP = 20
"""Detections whose scores count for the agreement, the highest."""
_LENGTHS, _WIDTHS, _MAX_SD = (0.8, 1.5), (0.31, 0.62), 0.18
"""Length and width of a car, in units of `working_car_length_px`; largest standard deviation of the logarithm of a
measured length."""
_LENGTH_BIAS = 1.035
"""Ratio of the median measured length to the true one near the right scale: 0.95 to 1.1 on KIT AIS, minsk, songdo,
kharkiv and simulated cities."""
_MIN_COUNTED = 3
"""Cars at a scale of the scan: an image made very small has a high density by one false detection."""
_MIN_DETECTIONS, _MIN_CARS = 12, 6
"""Of any size; of a car's size."""
_MIN_AGREEMENT = 0.04
"""Mean score times the fraction of the size of cars: 0.07 to 0.28 at the right scale of real and simulated images,
0.03 to 0.08 at wrong ones."""
_RIGHT_AGREEMENT = 0.06
_MIN_RATIO = 1.3
"""The density of cars at the best scale must surpass that at all scales but its neighbours by this factor."""
_CLOSE = 1.1
"""The refinement is repeated where it changes the scale by more than this factor: lengths are unbiased near the right
scale alone."""
View = tuple[GreyImage, Mask]
Views = Callable[[float, int], Iterable[View]]
"""Images and where they are valid, (h, w) each, resampled by a factor, of some total area in px of these."""
Window = tuple[int, int, int, int]
"""x, y, width, height."""


@dataclass(frozen=True)
class _Finds:
    """Detections at one scale."""

    count: int
    """Of any size."""
    agreement: float
    """Mean of the highest scores times the fraction that has the size of a car."""
    density: float
    """Sum of the scores of those of the size of a car, per megapixel; 0 of fewer than `_MIN_COUNTED`."""
    length_px: FloatArray
    """(n,) of those of the size of a car."""

    @property
    def is_enough(self) -> bool:
        """Whether there are cars."""
        return self.count >= _MIN_DETECTIONS and len(self.length_px) >= _MIN_CARS and self.agreement >= _MIN_AGREEMENT


def find_scale(views: Views, detector: Detector, scales: FloatArray) -> float | None:
    """Scale at which the median car is of the detector's length.

    Parameters
    ----------
    views
        Parts of the image.
    detector
        It measures vehicles, and its record has `working_car_length_px`.
    scales
        (n,) factors to try, ascending by `STEP`.

    Returns
    -------
    A factor, right to some 5 % of the length of the cars in view; None where no factor is clearly better than others.
    """
    if not len(scales):
        return None
    density = np.array([_search(views(float(scale), SCAN_PX), detector).density for scale in scales])
    best = int(density.argmax())
    apart = np.abs(np.arange(len(scales)) - best) > 2
    if density[best] <= _MIN_RATIO * density[apart].max(initial=0.0):
        return None
    beside = slice(max(best - 1, 0), best + 2)
    scale = float(np.exp(np.average(np.log(scales[beside]), weights=density[beside] ** 2)))
    for _ in range(2):
        found = _search(views(scale, REFINE_PX), detector)
        if not found.is_enough:
            return None
        factor = _LENGTH_BIAS * detector.record.working_car_length_px / float(np.median(found.length_px))
        scale *= factor
        if 1 / _CLOSE < factor < _CLOSE:
            break
    return scale


def is_plausible_scale(views: Iterable[View], detector: Detector) -> bool:
    """Whether the detector finds cars of its size in images of one scale, as it does at the right one."""
    found = _search(views, detector)
    return found.agreement >= _RIGHT_AGREEMENT and found.count >= _MIN_DETECTIONS


def working_scale(config: DetectorConfig, gsd_m: float) -> float:
    """Working px a base px at which a usual car is `working_car_length_px` long, by the ground sample distance, m."""
    return config.working_car_length_px * gsd_m / config.car_length_m


def spread_windows(width: int, height: int, area: float) -> list[Window]:
    """Windows of an image, spread over it, of some total area: one where that holds it whole."""
    share = min(1.0, float(np.sqrt(area / (width * height))))
    columns, rows = (1, 1) if share == 1.0 else (_COLUMNS, _ROWS)
    cell = width / columns, height / rows
    size = [max(1, int(side * share)) for side in cell]
    corners = [
        [int((k + 0.5) * side - part / 2) for k in range(n)]
        for side, part, n in zip(cell, size, (columns, rows), strict=True)
    ]
    return [(x, y, size[0], size[1]) for y in corners[1] for x in corners[0]]


def _search(views: Iterable[View], detector: Detector) -> _Finds:
    """Detect and measure cars in all views."""
    car_px = float(detector.record.working_car_length_px)

    def find(view: View) -> tuple[int, FloatArray, FloatArray, Mask]:
        image, valid = view
        cars = detector.detect(image, valid)
        length, width, length_sd, _ = cars.sizes.T
        is_car = length_sd < _MAX_SD
        for values, (low, high) in ((length, _LENGTHS), (width, _WIDTHS)):
            is_car &= (values > low * car_px) & (values < high * car_px)
        return int(valid.sum()), cars.score, length, np.asarray(is_car)

    found = parallel_map(find, views)
    area = sum(view[0] for view in found)
    score, length, is_car = (np.concatenate([np.empty(0, bool), *(view[k] for view in found)]) for k in (1, 2, 3))
    if not len(score):
        return _Finds(0, 0.0, 0.0, length)
    agreement = float(np.sort(score)[-_TOP:].mean() * is_car.mean())
    few = is_car.sum() < _MIN_COUNTED
    density = 0.0 if few else float(np.maximum(score, 0)[is_car].sum()) / area * 1e6
    return _Finds(len(score), agreement, density, length[is_car])
