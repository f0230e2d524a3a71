"""Tables of answers (`schemas.analysis.AnalysisTable`) of columns: each once, with its key, title, unit and value."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

import numpy as np
import pandas as pd

from schemas.analysis import AnalysisColumn, AnalysisRow, AnalysisTable, Cell, EstimateRecord, GeometryRecord
from schemas.arrays import FloatArray
from schemas.export import PER_M_PER_S, SpeedUnit
from velfield.analysis.intervals import Estimate
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.pipeline.analysis.lanes_record import points_px

KM_PER_H = 3.6
T = TypeVar("T")
Value = bool | int | float | str | None


@dataclass(frozen=True)
class Column(Generic[T]):
    """A column: key of its cells, title, unit, and the value of a row's item; numbers are rounded to ``digits``."""

    key: str
    title: str
    unit: str
    value: Callable[[T], Cell]
    digits: int | None = None

    def cell(self, item: T) -> Cell:
        """The value of an item."""
        value = self.value(item)
        return round(value, self.digits) if self.digits is not None and isinstance(value, float) else value


def estimates(key: str, title: str, unit: str, value: Callable[[T], Estimate | None], factor: float = 1.0) -> Column[T]:
    """A column of estimates, which are multiplied by ``factor`` into its unit."""
    return Column(key, title, unit, lambda item: estimate_cell(value(item), factor))


def make_table(
    analysis: TrafficAnalysis,
    name: str,
    section: str,
    title: str,
    note: str,
    columns: Sequence[Column[T]],
    items: Iterable[T],
    place_m: Callable[[T], FloatArray | None],
    *,
    is_area: bool = False,
    named_by: int = 1,
) -> AnalysisTable:
    """A table with a row for each item.

    ``place_m`` gives its place on the map, m: a point (2,), a line (n, 2) or, with ``is_area``, the corners (n, 2) of
    an area; None without one. ``named_by``: so many columns, the first, say what a row is of; others, and
    rows, are ``unknown`` where no number is in them.
    """
    gsd_m = analysis.trajectories.gsd_m

    def row(item: T) -> AnalysisRow:
        geometry = _geometry(place_m(item), gsd_m, is_area=is_area)
        cells = {c.key: c.cell(item) for c in columns}
        unknown = all(map(_is_unknown, list(cells.values())[named_by:])) and len(cells) > named_by
        return AnalysisRow(cells=cells, geometry=geometry, unknown=unknown)

    rows = tuple(map(row, items))

    def is_unknown(key: str) -> bool:
        return bool(rows) and all(_is_unknown(one.cells[key]) for one in rows)

    return AnalysisTable(
        name=name,
        section=section,
        title=title,
        note=note,
        columns=tuple(
            AnalysisColumn(name=c.key, title=c.title, unit=c.unit, unknown=k >= named_by and is_unknown(c.key))
            for k, c in enumerate(columns)
        ),
        rows=rows,
    )


def _is_unknown(cell: Cell) -> bool:
    return cell is None or (isinstance(cell, EstimateRecord) and cell.value is None)


def _geometry(xy_m: FloatArray | None, gsd_m: float, *, is_area: bool) -> GeometryRecord | None:
    if xy_m is None:
        return None
    kind: Literal["Point", "LineString", "Polygon"] = "Polygon" if is_area else "LineString"
    return GeometryRecord(type="Point" if xy_m.ndim == 1 else kind, xy_px=points_px(np.atleast_2d(xy_m), gsd_m))


def in_speed_unit(table: AnalysisTable, unit: SpeedUnit) -> AnalysisTable:
    """A table whose columns in km/h are in another unit.

    Examples
    --------
    >>> speed = AnalysisColumn(name="speed", title="Speed", unit="km/h")
    >>> table = AnalysisTable(name="speed", section="", title="", columns=(speed,), rows=())
    >>> in_speed_unit(table.model_copy(update={"rows": (AnalysisRow(cells={"speed": 100.0}),)}), "mph").rows[0].cells
    {'speed': 62.14}
    """
    factor = PER_M_PER_S[unit] / KM_PER_H
    names = {column.name for column in table.columns if column.unit == "km/h"}
    if unit == "km/h" or not names:
        return table

    def converted(cell: Cell) -> Cell:
        if isinstance(cell, EstimateRecord) and cell.value is not None:
            ends = {name: float(f"{getattr(cell, name) * factor:.4g}") for name in ("value", "low", "high")}
            return cell.model_copy(update=ends)
        return float(f"{cell * factor:.4g}") if isinstance(cell, float) else cell

    columns = (c.model_copy(update={"unit": unit}) if c.name in names else c for c in table.columns)
    rows = (
        row.model_copy(update={"cells": {k: converted(v) if k in names else v for k, v in row.cells.items()}})
        for row in table.rows
    )
    return table.model_copy(update={"columns": tuple(columns), "rows": tuple(rows)})


def data_frame(table: AnalysisTable) -> pd.DataFrame:
    """A table with units in the names of its columns; an estimate has four: its value, ``low``, ``high`` and ``n``.

    Examples
    --------
    >>> speed = AnalysisColumn(name="p50", title="Speed p50", unit="km/h")
    >>> rows = (AnalysisRow(cells={"p50": EstimateRecord(value=48.0, low=45.0, high=51.0, n=30)}),)
    >>> data_frame(AnalysisTable(name="speed", section="", title="", columns=(speed,), rows=rows)).columns.tolist()
    ['p50_km_per_h', 'p50_low_km_per_h', 'p50_high_km_per_h', 'p50_n']
    """
    out: dict[str, list[Value]] = {}
    for column, part, values in flat_columns(table):
        unit = column.unit.replace("/", "_per_").replace("%", "percent").replace(" ", "_")
        words = (column.name, "" if part == "value" else part, "" if part == "n" else unit)
        out["_".join(word for word in words if word)] = values
    return pd.DataFrame(out)


def flat_columns(table: AnalysisTable) -> Iterator[tuple[AnalysisColumn, str, list[Value]]]:
    """Columns with their values, those of estimates in four parts: ``value``, ``low``, ``high`` and ``n``."""
    for column in table.columns:
        cells = [row.cells.get(column.name) for row in table.rows]
        if any(isinstance(cell, EstimateRecord) for cell in cells):
            for part in ("value", "low", "high", "n"):
                yield column, part, [getattr(cell, part, None) for cell in cells]
        else:
            yield column, "value", [None if isinstance(cell, EstimateRecord) else cell for cell in cells]


def estimate_cell(estimate: Estimate | None, factor: float = 1.0) -> EstimateRecord:
    """A cell in another unit; too little data gives one without a value."""
    if estimate is None:
        return EstimateRecord()
    scaled = estimate.in_units(factor)
    value, low, high = (round(float(f"{number:.4g}"), 2) for number in (scaled.value, scaled.low, scaled.high))
    return EstimateRecord(value=value, low=low, high=high, n=estimate.n)
