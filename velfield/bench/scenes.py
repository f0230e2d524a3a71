"""Simulated pictures with labelled cars: what detectors are timed and trained on."""

import cv2
import numpy as np

from schemas.detector import CnnConfig
from velfield.detection.samples import LabelledImage
from velfield.detection.scale_search import working_scale
from velfield.synthetic.cases import small_flight


def simulated_image(seed: int, large_share: float | None = None) -> LabelledImage:
    """A frame of a simulated city, its sun and its buildings drawn from the seed; ``large_share`` of it no cars."""
    rng = np.random.default_rng(seed)
    scene = {
        "sun_azimuth_deg": float(rng.uniform(0, 360)),
        "sun_length": float(rng.uniform(0.2, 1.6)),
        "texture": float(rng.uniform(0.7, 1.6)),
    }
    traffic = {} if large_share is None else {"large_share": large_share}
    flight = small_flight(frames=1, seed=seed, scene=scene, traffic=traffic)
    factor = working_scale(CnnConfig(), flight.config.gsd_m)
    cars = flight.labels(0)[["x_px", "y_px", "orientation_rad", "length_px", "width_px"]].to_numpy(copy=True)
    cars[:, :2] = (cars[:, :2] + 0.5) * factor - 0.5
    cars[:, 3:] *= factor
    image = cv2.resize(flight.frame(0), None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return LabelledImage(image=np.asarray(image, np.uint8), cars=cars)
