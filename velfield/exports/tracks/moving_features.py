"""Trajectories as OGC Moving Features JSON (19-045r3): MovingPoint with times, for MovingPandas and GIS."""

import json
from datetime import UTC, timedelta
from pathlib import Path

import numpy as np

from schemas.export import ExportOptions
from velfield.exports.export import start_time
from velfield.exports.georeference import Georeference
from velfield.run.run import Run

FILE_NAME = "trajectories.mf.json"


def encode(run: Run, _path: Path, options: ExportOptions) -> bytes:
    """A feature a vehicle, with its speed in m/s by time: see `velfield.exports.export.ExportModule`.

    Positions are longitude and latitude where the base image has a reference system, else metres to the right of its
    lower left corner and up from it, and ``crs`` is null. Times count from `start_time`.
    """
    paths, georeference = run.analysis.trajectories, Georeference.from_grid(run.grid)
    xy_px = paths.xy_m / paths.gsd_m
    places = georeference.to_lonlat(xy_px) if georeference.has_crs else georeference.to_metres(xy_px)
    rounded = np.round(places, 7 if georeference.has_crs else 2).tolist()
    start = start_time(run, options)
    start = start if start.tzinfo else start.replace(tzinfo=UTC)
    times = [(start + timedelta(seconds=s)).isoformat(timespec="milliseconds") for s in paths.time_s.tolist()]
    speeds = np.round(paths.speed_m_per_s, 2).tolist()
    features = []
    for number, rows in enumerate(paths):
        when = times[rows]
        point = {"type": "MovingPoint", "datetimes": when, "coordinates": rounded[rows], "interpolation": "Linear"}
        speed = {"type": "Measure", "form": "MTS", "values": speeds[rows], "interpolation": "Linear"}
        features.append(
            {
                "type": "Feature",
                "properties": {"track_id": paths.id_of(number)},
                "temporalGeometry": point,
                "temporalProperties": [{"datetimes": when, "speed": speed}],
            }
        )
    collection: dict[str, object] = {"type": "FeatureCollection", "features": features}
    if not georeference.has_crs:
        collection["crs"] = None  # left out, it would be WGS 84
    return json.dumps(collection).encode()
