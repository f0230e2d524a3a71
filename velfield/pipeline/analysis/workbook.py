"""The tables as an Excel workbook: a sheet a table, an estimate in four columns."""

import io
from collections.abc import Iterator, Sequence

import xlsxwriter

from schemas.analysis import AnalysisRecord, AnalysisTable
from velfield.pipeline.analysis.cells import Value, flat_columns

_PARTS = {"low": "90 % from", "high": "to", "n": "n"}


def workbook_bytes(record: AnalysisRecord) -> bytes:
    """The file's content."""
    buffer = io.BytesIO()
    book = xlsxwriter.Workbook(buffer, {"in_memory": True})
    bold, wrapped = book.add_format({"bold": True}), book.add_format({"text_wrap": True})
    for table in record.tables:
        sheet = book.add_worksheet(table.name[:31])
        sheet.write(0, 0, table.title, bold)
        sheet.write(1, 0, table.note, wrapped)
        for k, (title, values) in enumerate(_columns(table)):
            sheet.write(3, k, title, bold)
            for row, value in enumerate(values, start=4):
                if value is not None:
                    sheet.write(row, k, value)
        sheet.freeze_panes(4, 1)
        sheet.set_column(0, 40, 14)
    book.close()
    return buffer.getvalue()


def _columns(table: AnalysisTable) -> Iterator[tuple[str, Sequence[Value]]]:
    """Titles and values; last, where each row is on the map."""
    for column, part, values in flat_columns(table):
        title = f"{column.title}, {column.unit}" if column.unit else column.title
        yield _PARTS.get(part, title), [None if part == "n" and not value else value for value in values]
    places = [row.geometry.xy_px[0] if row.geometry else (None, None) for row in table.rows]
    yield "x, px", [x for x, _ in places]
    yield "y, px", [y for _, y in places]
