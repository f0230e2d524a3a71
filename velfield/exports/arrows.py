"""GeoJSON arrows: the modal velocity at a grid of points, for any map."""

import numpy as np
from numpy.typing import NDArray

from velfield.exports.place import Place
from velfield.exports.tracks import MPS_TO_KMH

_HEAD_SHARE, _HEAD_TURN = 0.35, 2.6  # length of the barbs by the shaft's, and how far they turn back, rad


def arrows_geojson(
    modal_velocity_px_per_s: NDArray[np.floating],
    count: NDArray[np.integer],
    place: Place,
    *,
    spacing_px: int = 12,
    min_count: int = 1,
    seconds: float = 0.5,
) -> dict[str, object]:
    """Arrows as a GeoJSON FeatureCollection (RFC 7946: longitude and latitude).

    Parameters
    ----------
    modal_velocity_px_per_s
        (h, w, 2) as (vx, vy); NaN where nothing is known.
    count
        (h, w) passages.
    spacing_px
        One arrow a cell of this size, at its pixel with most passages, which lies on the lane rather than beside it.
    min_count
        Fewer passages than this: no arrow.
    seconds
        An arrow is as long as the way gone in this time.

    Raises
    ------
    InputError
        The base image has no reference system.
    """
    rows, columns = _busiest(np.asarray(count), np.asarray(modal_velocity_px_per_s), spacing_px, min_count)
    velocity = np.asarray(modal_velocity_px_per_s, np.float64)[rows, columns]
    tail = np.column_stack([columns, rows]).astype(np.float64)
    strokes = _strokes(tail, velocity * seconds)
    lonlat = place.to_lonlat(strokes.reshape(-1, 2)).reshape(strokes.shape)
    heading = place.heading_deg(tail, velocity)
    speed = np.linalg.norm(velocity, axis=1)
    features = []
    for k, line in enumerate(lonlat):
        properties: dict[str, object] = {
            "heading_deg": round(float(heading[k]), 1),
            "speed_px_per_s": round(float(speed[k]), 3),
            "count": int(count[rows[k], columns[k]]),
            "x_px": int(columns[k]),
            "y_px": int(rows[k]),
        }
        if place.gsd_m is not None:
            properties["speed_km_per_h"] = round(float(speed[k]) * place.gsd_m * MPS_TO_KMH, 2)
        shaft, barbs = np.round(line[:2], 7).tolist(), np.round(line[2:], 7).tolist()
        geometry = {"type": "MultiLineString", "coordinates": [shaft, barbs]}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return {"type": "FeatureCollection", "features": features}


def _busiest(
    count: NDArray[np.integer], velocity: NDArray[np.floating], spacing: int, least: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column of each cell's pixel with most passages, cells with too few left out."""
    known = np.where(np.isfinite(velocity).all(axis=2), count, 0)
    height, width = (-(-size // spacing) * spacing for size in known.shape)
    padded = np.zeros((height, width), np.int64)
    padded[: known.shape[0], : known.shape[1]] = known
    cells = padded.reshape(height // spacing, spacing, width // spacing, spacing).swapaxes(1, 2)
    flat = cells.reshape(*cells.shape[:2], -1)
    best = flat.argmax(axis=2)
    ty, tx = np.nonzero(flat.max(axis=2) >= max(least, 1))
    inside = best[ty, tx]
    return ty * spacing + inside // spacing, tx * spacing + inside % spacing


def _strokes(tail: NDArray[np.float64], way: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 5, 2): tail and tip of the shaft, then barb, tip, barb."""
    tip = tail + way
    barbs = []
    for turn in (_HEAD_TURN, -_HEAD_TURN):
        cos, sin = np.cos(turn) * _HEAD_SHARE, np.sin(turn) * _HEAD_SHARE
        barbs.append(tip + np.column_stack([cos * way[:, 0] - sin * way[:, 1], sin * way[:, 0] + cos * way[:, 1]]))
    return np.stack([tail, tip, barbs[0], tip, barbs[1]], axis=1)
