"""Held-out log-likelihood of the field as a prior, beside simpler models.

Every other track by time is held out, so that both halves are of the same traffic. A track's log-likelihood is the mean
over its segments, so that each track counts once.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from schemas.arrays import FloatArray
from schemas.flight import FieldConfig
from velfield.field.segments import Segments, VelocityBins, band_radius_px, stationary_speed_px_per_s
from velfield.field.view import VelocityField

MIN_SD_M_PER_S = 0.5
"""Lower bound of the standard deviation of a pixel's Gaussian."""
PRIOR_PSEUDOCOUNT = 1.0
"""Pseudocount of the map's Gaussian against a pixel's tracks, as in the field's prior."""
_BROAD_WEIGHT = 0.02
"""Mixture weight of the map's Gaussian."""


@dataclass(frozen=True)
class HeldoutLogLikelihood:
    """Mean log density per (m/s)^2 of a held-out track, nats, by each model; and the number of held-out tracks."""

    field: float
    whole_map: float
    gaussian: float
    tracks: int


def heldout_log_likelihood(
    segments: Segments, config: FieldConfig, *, gsd_m: float, shape: tuple[int, int]
) -> HeldoutLogLikelihood:
    """Fit the models to every other track and evaluate them on the rest.

    Parameters
    ----------
    segments
        Whole tracks, sorted by track and time.
    config
        Bins, kernel and band of the field.
    gsd_m, shape
        Metres a base pixel; (height, width) of the base image.
    """
    training, heldout = _halves(segments)
    field = VelocityField.from_segments(
        training,
        shape=shape,
        tile_size=config.tile_size_px,
        bins=VelocityBins.from_config(config, gsd_m),
        radius_px=band_radius_px(config, gsd_m),
        stationary_speed_px_per_s=stationary_speed_px_per_s(config, gsd_m),
    )
    position, velocity = _midpoints(heldout)
    to_metres = -2 * np.log(gsd_m)
    _, owner = np.unique(heldout["track"], return_inverse=True)
    models = (
        field.log_density(position, velocity),
        field.log_density(np.full_like(position, -1e6), velocity),  # outside the map the prior is the whole map's
        _gaussian(training, position, velocity, config, gsd_m),
    )
    by_pixel, by_map, by_gaussian = (
        float(np.mean(np.bincount(owner, values) / np.bincount(owner)) + to_metres) for values in models
    )
    return HeldoutLogLikelihood(field=by_pixel, whole_map=by_map, gaussian=by_gaussian, tracks=int(owner.max()) + 1)


def _halves(segments: Segments) -> tuple[Segments, Segments]:
    tracks, first = np.unique(segments["track"], return_index=True)
    order = tracks[np.argsort(segments["start_s"][first], kind="stable")]
    training = np.isin(segments["track"], order[::2])
    return segments[training], segments[~training]


def _midpoints(segments: Segments) -> tuple[FloatArray, FloatArray]:
    position = 0.5 * np.column_stack([segments["x0_px"] + segments["x1_px"], segments["y0_px"] + segments["y1_px"]])
    return position, np.column_stack([segments["vx_px_per_s"], segments["vy_px_per_s"]])


def _gaussian(
    training: Segments, position: FloatArray, velocity: FloatArray, config: FieldConfig, gsd_m: float
) -> FloatArray:
    """Log density under one Gaussian a position: mean and covariance of the training segments around it, shrunk
    towards the map's."""
    at, v = _midpoints(training)
    mean, map_covariance = v.mean(axis=0), np.cov(v.T)
    min_covariance = np.eye(2) * (MIN_SD_M_PER_S / gsd_m) ** 2
    # a track has a midpoint every 0.2 s: half of that along it, and the band's half width across
    reach = max((band_radius_px(config, gsd_m) or 0.0), 0.1 * float(np.median(np.hypot(*v.T)))) + 2.0
    out = np.empty(len(position))
    tree = cKDTree(at)
    for k, where in enumerate(position):
        near = tree.query_ball_point(where, reach)
        n = len(np.unique(training["track"][near]))
        centre, covariance = mean, map_covariance
        if n:
            weight = n / (n + PRIOR_PSEUDOCOUNT)
            centre = v[near].mean(axis=0)
            own = np.cov(v[near].T, bias=True) if len(near) > 1 else np.zeros((2, 2))
            covariance = weight * own + (1 - weight) * 0.1 * map_covariance + min_covariance
        narrow, wide = (_log_normal(velocity[k], *model) for model in ((centre, covariance), (mean, map_covariance)))
        out[k] = np.logaddexp(np.log1p(-_BROAD_WEIGHT) + narrow, np.log(_BROAD_WEIGHT) + wide)
    return out


def _log_normal(v: FloatArray, mean: FloatArray, covariance: FloatArray) -> float:
    d = v - mean
    return float(-0.5 * d @ np.linalg.solve(covariance, d) - 0.5 * np.log(np.linalg.det(2 * np.pi * covariance)))
