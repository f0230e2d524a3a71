"""The lane graph as a record, and as GeoJSON."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from schemas.analysis import ConnectionRecord, JunctionRecord, LaneRecord, LanesRecord, NameRecord, Point
from schemas.arrays import FloatArray
from schemas.export import PER_M_PER_S, SpeedUnit
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.exports.georeference import Georeference


def lanes_record(analysis: TrafficAnalysis, unit: SpeedUnit) -> LanesRecord:
    """``lanes.json``: the lane graph, with the limits of lanes by signs in a unit, and the junctions' signals."""
    graph, gsd_m = analysis.lanes, analysis.trajectories.gsd_m
    known = [(road, sign) for road in analysis.free_flow if (sign := road.limit(unit))]
    limits = {lane: sign / PER_M_PER_S[unit] for road, sign in known for lane in road.lanes}
    return LanesRecord(
        gsd_m=gsd_m,
        lanes=tuple(
            LaneRecord(
                lane=lane.number,
                xy_px=points_px(lane.xy_m, gsd_m),
                length_m=round(lane.length_m, 2),
                width_m=round(lane.width_m, 2),
                width_source=lane.width_source,
                tracks=lane.tracks,
                left=lane.left,
                right=lane.right,
                predecessors=tuple(graph.predecessors[lane.number]),
                successors=tuple(graph.successors[lane.number]),
                limit_m_per_s=limits.get(lane.number),
            )
            for lane in graph
        ),
        connections=tuple(
            ConnectionRecord(start=c.start, end=c.end, tracks=c.tracks, share=round(c.share, 4), turn=c.turn)
            for c in graph.connections
        ),
        junctions=tuple(
            JunctionRecord(
                junction=junction.number,
                kind=analysis.junction_kind(junction.number),
                x_px=round(float(junction.centre_m[0] / gsd_m), 2),
                y_px=round(float(junction.centre_m[1] / gsd_m), 2),
                hull_px=points_px(junction.hull_m, gsd_m),
                lanes_in=junction.lanes_in,
                lanes_out=junction.lanes_out,
                lanes_inside=junction.lanes_inside,
                signalised=signal.signalised if (signal := analysis.signals.get(junction.number)) else None,
            )
            for junction in graph.junctions
        ),
    )


def map_names(analysis: TrafficAnalysis) -> Iterator[NameRecord]:
    """Names of the junctions, and of the roads by which vehicles enter and leave, with their places."""
    named = [(f"J{junction.number}", junction.centre_m) for junction in analysis.lanes.junctions]
    named += [(arm.name, arm.xy_m) for arm in analysis.scene.arms] if analysis.scene else []
    for name, xy_m in named:
        ((x, y),) = points_px(xy_m[None], analysis.trajectories.gsd_m)
        yield NameRecord(name=name, x_px=x, y_px=y)


def points_px(xy_m: FloatArray, gsd_m: float) -> tuple[Point, ...]:
    """Points in metres as (x, y) in base pixels, rounded to a hundredth."""
    return tuple((float(x), float(y)) for x, y in np.round(xy_m / gsd_m, 2))


def lanes_geojson(record: LanesRecord, georeference: Georeference) -> str:
    """Lanes and junctions as GeoJSON: longitude and latitude where the base image has a reference system, else base
    pixels, which the member ``coordinates`` of the collection says."""
    features = [*_lane_features(record, georeference), *_junction_features(record, georeference)]
    content = {
        "type": "FeatureCollection",
        "coordinates": "longitude, latitude" if georeference.has_crs else "base pixels",
        "features": features,
    }
    return json.dumps(content)


def _lane_features(record: LanesRecord, georeference: Georeference) -> Iterator[dict[str, Any]]:
    for lane in record.lanes:
        properties = lane.model_dump(exclude={"xy_px"})
        coordinates = _coordinates(lane.xy_px, georeference)
        yield _feature({"kind": "lane", **properties}, {"type": "LineString", "coordinates": coordinates})


def _junction_features(record: LanesRecord, georeference: Georeference) -> Iterator[dict[str, Any]]:
    for junction in record.junctions:
        properties = junction.model_dump(exclude={"hull_px", "kind"})
        ring = _coordinates((*junction.hull_px, junction.hull_px[0]), georeference)
        properties = {"kind": "junction", "junction_kind": junction.kind, **properties}
        yield _feature(properties, {"type": "Polygon", "coordinates": [ring]})


def _feature(properties: dict[str, Any], geometry: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def _coordinates(points: tuple[Point, ...], georeference: Georeference) -> list[list[float]]:
    xy = np.array(points, np.float64)
    rounded = np.round(georeference.to_lonlat(xy) if georeference.has_crs else xy, 7)
    return [[float(x), float(y)] for x, y in rounded]
