"""The size of a car by the shipped detector, where neither scale nor labels are given.

The network was trained on cars of one length in pixels. At the right scale of the image its scores are highest, and
what it finds has a car's length and width; at others the network finds parts of things that look like cars, of any
size. So the image is searched at every scale, and the scale is taken where the product of both is greatest.
"""

from collections.abc import Callable, Iterable

import numpy as np

from schemas.arrays import FloatArray, GreyImage, Mask
from schemas.detector import DetectorConfig
from velfield.detection.detect import oriented_strips
from velfield.detection.frame import half_resolution
from velfield.detection.interface import Detector

STEP = 1.25
"""Between the scales that are tried: the network finds cars that are a quarter larger or smaller too."""
_TOP = 20
"""Detections a frame whose scores count."""
_LENGTHS, _WIDTHS, _MAX_SD = (0.8, 1.5), (0.31, 0.62), 0.13
"""Length and width of a car, in units of `working_car_length_px`; largest relative deviation of a measured length."""
_MIN_DETECTIONS = 12
_MIN_AGREEMENT = 0.04
"""Mean score times the fraction of the size of cars: 0.07 to 0.14 at the right scale of real and simulated images,
0.03 to 0.05 at wrong ones."""
_RIGHT_AGREEMENT = 0.06
_MIN_RATIO = 1.3
"""The best scale must surpass all that are not beside it by this factor."""
View = tuple[GreyImage, Mask]
Measure = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
"""Lengths, their standard deviations and widths (n,) by strips (n, 32, 10), px of the image."""


def find_scale(
    views: Callable[[float], Iterable[View]], detector: Detector, scales: FloatArray, measure: Measure
) -> float | None:
    """Scale at which cars are of the detector's size.

    Parameters
    ----------
    views
        Images and where they are valid, (h, w) each, resampled by a factor; the same ones for every factor.
    detector
        Its record has `working_car_length_px`.
    scales
        (n,) factors to try, ascending by `STEP`.
    measure
        Measures vehicles on strips along their axes.

    Returns
    -------
    A factor between two of ``scales``, right to some 15 %; None where no factor is clearly better than others.
    """
    found = [_agreement([_judge(view, detector, measure) for view in views(float(scale))]) for scale in scales]
    agreement, count = np.array(found).reshape(-1, 2).T
    if not len(agreement):
        return None
    best = int(agreement.argmax())
    apart = np.abs(np.arange(len(scales)) - best) > 2
    surpassed = agreement[best] > _MIN_RATIO * agreement[apart].max(initial=0.0)
    if agreement[best] < _MIN_AGREEMENT or count[best] < _MIN_DETECTIONS or not surpassed:
        return None
    beside = slice(max(best - 1, 0), best + 2)
    return float(np.exp(np.average(np.log(scales[beside]), weights=agreement[beside] ** 2)))


def is_plausible_scale(views: Iterable[View], detector: Detector, measure: Measure) -> bool:
    """Whether the detector finds cars of its size in images of one scale, as it does at the right one."""
    agreement, count = _agreement([_judge(view, detector, measure) for view in views])
    return agreement >= _RIGHT_AGREEMENT and count >= _MIN_DETECTIONS


def working_scale(config: DetectorConfig, gsd_m: float) -> float:
    """Working px a base px at which a usual car is `working_car_length_px` long, by the ground sample distance, m."""
    return config.working_car_length_px * gsd_m / config.car_length_m


def _judge(view: View, detector: Detector, measure: Measure) -> tuple[FloatArray, Mask]:
    """Scores of what is found, the highest, and which of all have the size of a car."""
    image, valid = view
    cars = detector.detect(image, valid)
    if not len(cars):
        return np.empty(0), np.empty(0, bool)
    strips = oriented_strips(half_resolution(image), cars.xy, cars.orientation_rad)
    length, length_sd, width = measure(np.asarray(strips, np.float64))
    car_px = float(detector.record.working_car_length_px)
    is_car = length_sd < _MAX_SD * length
    for values, (low, high) in ((length, _LENGTHS), (width, _WIDTHS)):
        is_car &= (values > low * car_px) & (values < high * car_px)
    return np.sort(cars.score)[::-1][:_TOP], is_car


def _agreement(parts: list[tuple[FloatArray, Mask]]) -> tuple[float, float]:
    """Mean of the highest scores times the fraction that has the size of a car; and the number of detections."""
    score = np.concatenate([np.empty(0), *(part[0] for part in parts)])
    is_car = np.concatenate([np.empty(0, bool), *(part[1] for part in parts)])
    return (float(score.mean() * is_car.mean()), float(len(is_car))) if len(is_car) else (0.0, 0.0)
