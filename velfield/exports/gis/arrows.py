"""GeoJSON arrows: the modal velocity on a grid of points."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray
from schemas.export import ExportOptions
from velfield.exports.georeference import MPS_TO_KMH, Georeference
from velfield.run.run import Run

FILE_NAME = "arrows.geojson"

_ARROW_S = 0.5
"""An arrow is as long as the distance covered in this time."""
_BARB_FRACTION, _BARB_ANGLE_RAD = 0.35, 2.6  # length of the barbs by the shaft's, and their angle to it


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    georeference = Georeference.from_grid(run.grid)
    return json.dumps(arrows_geojson(run.field.modal_velocity(), run.field.count(), georeference)).encode()


def arrows_geojson(
    modal_velocity_px_per_s: NDArray[np.floating],
    count: NDArray[np.integer],
    georeference: Georeference,
    *,
    spacing_px: int = 12,
    min_count: int = 1,
) -> dict[str, object]:
    """Arrows as a GeoJSON FeatureCollection (RFC 7946: longitude and latitude).

    Parameters
    ----------
    modal_velocity_px_per_s
        (h, w, 2) as (vx, vy); NaN where no vehicle passed.
    count
        (h, w) vehicles.
    spacing_px
        One arrow a cell of this size, at its pixel with most vehicles, which is on the lane rather than beside it.
    min_count
        Fewer vehicles than this: no arrow.

    Raises
    ------
    InputError
        The base image has no reference system.
    """
    rows, columns = _max_count_per_cell(np.asarray(count), np.asarray(modal_velocity_px_per_s), spacing_px, min_count)
    velocity = np.asarray(modal_velocity_px_per_s, np.float64)[rows, columns]
    tail = np.column_stack([columns, rows]).astype(np.float64)
    strokes = _strokes(tail, velocity * _ARROW_S)
    lonlat = georeference.to_lonlat(strokes.reshape(-1, 2)).reshape(strokes.shape)
    heading = georeference.heading_deg(tail, velocity)
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
        if georeference.gsd_m is not None:
            properties["speed_km_per_h"] = round(float(speed[k]) * georeference.gsd_m * MPS_TO_KMH, 2)
        shaft, barbs = np.round(line[:2], 7).tolist(), np.round(line[2:], 7).tolist()
        geometry = {"type": "MultiLineString", "coordinates": [shaft, barbs]}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return {"type": "FeatureCollection", "features": features}


def _max_count_per_cell(
    count: NDArray[np.integer], velocity: NDArray[np.floating], spacing: int, min_count: int
) -> tuple[IntArray, IntArray]:
    """Row and column of each cell's pixel with most vehicles, without cells of fewer than `min_count`."""
    known = np.where(np.isfinite(velocity).all(axis=2), count, 0)
    height, width = (-(-size // spacing) * spacing for size in known.shape)
    padded = np.zeros((height, width), np.int64)
    padded[: known.shape[0], : known.shape[1]] = known
    cells = padded.reshape(height // spacing, spacing, width // spacing, spacing).swapaxes(1, 2)
    flat = cells.reshape(*cells.shape[:2], -1)
    best = flat.argmax(axis=2)
    ty, tx = np.nonzero(flat.max(axis=2) >= max(min_count, 1))
    inside = best[ty, tx]
    return ty * spacing + inside // spacing, tx * spacing + inside % spacing


def _strokes(tail: FloatArray, shaft: FloatArray) -> FloatArray:
    """(n, 5, 2): tail and tip of the shaft, then barb, tip, barb."""
    tip = tail + shaft
    barbs = []
    for angle in (_BARB_ANGLE_RAD, -_BARB_ANGLE_RAD):
        cos, sin = np.cos(angle) * _BARB_FRACTION, np.sin(angle) * _BARB_FRACTION
        barbs.append(
            tip + np.column_stack([cos * shaft[:, 0] - sin * shaft[:, 1], sin * shaft[:, 0] + cos * shaft[:, 1]])
        )
    return np.stack([tail, tip, barbs[0], tip, barbs[1]], axis=1)
