"""A city, its traffic and its camera, with the truth.

>>> from velfield.synthetic import small_flight
>>> flight = small_flight(frames=2, width=320, height=240)
>>> flight.frame(0).shape
(240, 320)
"""

from velfield.synthetic.cases import (
    homography_only,
    lens_and_wobble,
    lens_only,
    small_flight,
    two_term_lens,
    vibration_and_drift,
)
from velfield.synthetic.flight import Flight, simulate
from velfield.synthetic.score import fit_homography, score_detections, score_field, score_registration, score_tracklets
from velfield.synthetic.truth import Truth, load_truth, make_truth
from velfield.synthetic.write import write_flight

__all__ = [
    "Flight",
    "Truth",
    "fit_homography",
    "homography_only",
    "lens_and_wobble",
    "lens_only",
    "load_truth",
    "make_truth",
    "score_detections",
    "score_field",
    "score_registration",
    "score_tracklets",
    "simulate",
    "small_flight",
    "two_term_lens",
    "vibration_and_drift",
    "write_flight",
]
