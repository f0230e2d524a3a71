"""Tables of answers (`schemas.analysis.AnalysisTable`): their cells, rows and geometries."""

from collections.abc import Iterable

import numpy as np

from schemas.analysis import AnalysisColumn, AnalysisRow, AnalysisTable, Cell, EstimateRecord, GeometryRecord
from schemas.arrays import FloatArray
from velfield.analysis.intervals import Estimate
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.pipeline.analysis.lanes_record import points_px

KM_PER_H = 3.6
Columns = dict[str, tuple[str, str]]
"""Name -> title and unit."""


def make_table(
    name: str, section: str, title: str, note: str, columns: Columns, rows: Iterable[AnalysisRow]
) -> AnalysisTable:
    """A table of rows whose cells have the columns' names."""
    made = tuple(AnalysisColumn(name=key, title=text, unit=unit) for key, (text, unit) in columns.items())
    return AnalysisTable(name=name, section=section, title=title, note=note, columns=made, rows=tuple(rows))


def make_row(cells: dict[str, Cell], geometry: GeometryRecord | None) -> AnalysisRow:
    """A row, and where it is on the map."""
    return AnalysisRow(cells=cells, geometry=geometry)


def estimate_cell(estimate: Estimate | None, factor: float = 1.0) -> EstimateRecord:
    """A cell in another unit; too little data gives one without a value."""
    if estimate is None:
        return EstimateRecord()
    scaled = estimate.in_units(factor)
    value, low, high = (float(f"{number:.4g}") for number in (scaled.value, scaled.low, scaled.high))
    return EstimateRecord(value=value, low=low, high=high, n=estimate.n)


def point_geometry(xy_m: FloatArray, analysis: TrafficAnalysis) -> GeometryRecord:
    """A place (2,) m."""
    return GeometryRecord(type="Point", xy_px=points_px(np.atleast_2d(xy_m), analysis.trajectories.gsd_m))


def line_geometry(xy_m: FloatArray, analysis: TrafficAnalysis) -> GeometryRecord:
    """A line (n, 2) m."""
    return GeometryRecord(type="LineString", xy_px=points_px(xy_m, analysis.trajectories.gsd_m))


def polygon_geometry(corners_m: FloatArray, analysis: TrafficAnalysis) -> GeometryRecord:
    """An area of corners (n, 2) m."""
    return GeometryRecord(type="Polygon", xy_px=points_px(corners_m, analysis.trajectories.gsd_m))
