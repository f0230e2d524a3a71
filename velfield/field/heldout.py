"""How well a field foretells the next passage: log-likelihood of passages held out, beside simpler models.

A passage counts once, however many segments it has: its log-likelihood is the mean over its segments. Where passages
are few, half of them make the models and the other half judges; every other passage by its time, so that both halves
see the same traffic.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray
from schemas.flight import FieldConfig
from velfield.field.bins import VelocityBins, band_radius_px, stationary_speed_px_per_s
from velfield.field.segments import Segments
from velfield.field.view import VelocityField

LEAST_SD_M_PER_S = 0.5
"""A Gaussian of a pixel's passages is not believed narrower than this."""
PRIOR_COUNTS_FOR = 1.0
"""Passages that the map's Gaussian counts for against a pixel's, as in the field's own prior."""
_BROAD = 0.02


@dataclass(frozen=True)
class Foretelling:
    """Mean log density per (m/s)^2 of a held-out passage, nats, by each model; and how many passages judged."""

    field: float
    whole_map: float
    gaussian: float
    passages: int


def foretell(segments: Segments, config: FieldConfig, *, gsd_m: float, shape: tuple[int, int]) -> Foretelling:
    """Learn from every other passage, judge by the rest.

    Parameters
    ----------
    segments
        Whole passages, sorted by passage and time.
    config
        Bins, kernel and band of the field.
    gsd_m, shape
        Metres a base pixel; (height, width) of the base image.
    """
    learnt, held = _halves(segments)
    field = VelocityField.from_segments(
        learnt,
        shape=shape,
        tile_size=config.tile_size_px,
        bins=VelocityBins.from_config(config, gsd_m),
        radius_px=band_radius_px(config, gsd_m),
        stationary_speed_px_per_s=stationary_speed_px_per_s(config, gsd_m),
    )
    place, velocity = _middles(held)
    to_metres = -2 * np.log(gsd_m)
    _, owner = np.unique(held["passage"], return_inverse=True)
    models = (
        field.log_density(place, velocity),
        field.log_density(np.full_like(place, -1e6), velocity),  # outside of the map only the map's mixture speaks
        _gaussian(learnt, place, velocity, config, gsd_m),
    )
    mine, of_map, normal = (
        float(np.mean(np.bincount(owner, values) / np.bincount(owner)) + to_metres) for values in models
    )
    return Foretelling(field=mine, whole_map=of_map, gaussian=normal, passages=int(owner.max()) + 1)


def _halves(segments: Segments) -> tuple[Segments, Segments]:
    passage, first = np.unique(segments["passage"], return_index=True)
    order = passage[np.argsort(segments["start_s"][first], kind="stable")]
    learnt = np.isin(segments["passage"], order[::2])
    return segments[learnt], segments[~learnt]


def _middles(segments: Segments) -> tuple[FloatArray, FloatArray]:
    place = 0.5 * np.column_stack([segments["x0_px"] + segments["x1_px"], segments["y0_px"] + segments["y1_px"]])
    return place, np.column_stack([segments["vx_px_per_s"], segments["vy_px_per_s"]])


def _gaussian(
    learnt: Segments, place: FloatArray, velocity: FloatArray, config: FieldConfig, gsd_m: float
) -> FloatArray:
    """Log density by one Gaussian a place: mean and covariance of what passed within the band, shrunk to the map's."""
    at, v = _middles(learnt)
    mean, spread = v.mean(axis=0), np.cov(v.T)
    least = np.eye(2) * (LEAST_SD_M_PER_S / gsd_m) ** 2
    # a passage leaves a middle every 0.2 s: so far along it, and the band's width across
    reach = max((band_radius_px(config, gsd_m) or 0.0), 0.1 * float(np.median(np.hypot(*v.T)))) + 2.0
    out = np.empty(len(place))
    tree = cKDTree(at)
    for k, where in enumerate(place):
        near = tree.query_ball_point(where, reach)
        n = len(np.unique(learnt["passage"][near]))
        centre, covariance = mean, spread
        if n:
            weight = n / (n + PRIOR_COUNTS_FOR)
            centre = v[near].mean(axis=0)
            own = np.cov(v[near].T, bias=True) if len(near) > 1 else np.zeros((2, 2))
            covariance = weight * own + (1 - weight) * 0.1 * spread + least
        narrow, wide = (_log_normal(velocity[k], *model) for model in ((centre, covariance), (mean, spread)))
        out[k] = np.logaddexp(np.log1p(-_BROAD) + narrow, np.log(_BROAD) + wide)
    return out


def _log_normal(v: FloatArray, mean: FloatArray, covariance: FloatArray) -> float:
    off = v - mean
    return float(-0.5 * off @ np.linalg.solve(covariance, off) - 0.5 * np.log(np.linalg.det(2 * np.pi * covariance)))
