"""The tables as an Excel workbook: a sheet a table, an estimate in four columns."""

import io

import xlsxwriter

from schemas.analysis import AnalysisRecord, AnalysisTable, EstimateRecord


def workbook_bytes(record: AnalysisRecord) -> bytes:
    """The file's content."""
    buffer = io.BytesIO()
    book = xlsxwriter.Workbook(buffer, {"in_memory": True})
    bold, wrapped = book.add_format({"bold": True}), book.add_format({"text_wrap": True})
    for table in record.tables:
        sheet = book.add_worksheet(table.name[:31])
        sheet.write(0, 0, table.title, bold)
        sheet.write(1, 0, table.note, wrapped)
        for column, title in enumerate(_titles(table)):
            sheet.write(3, column, title, bold)
        for k, values in enumerate(_values(table)):
            for column, value in enumerate(values):
                if value is not None:
                    sheet.write(4 + k, column, value)
        sheet.freeze_panes(4, 1)
        sheet.set_column(0, 40, 14)
    book.close()
    return buffer.getvalue()


def _estimates(table: AnalysisTable) -> set[str]:
    """Names of the columns that hold estimates."""
    return {name for row in table.rows for name, cell in row.cells.items() if isinstance(cell, EstimateRecord)}


def _titles(table: AnalysisTable) -> list[str]:
    titles = []
    for column in table.columns:
        title = f"{column.title}, {column.unit}" if column.unit else column.title
        titles += [title, "90 % from", "to", "n"] if column.name in _estimates(table) else [title]
    return [*titles, "x, px", "y, px"]


def _values(table: AnalysisTable) -> list[list[str | float | int | None]]:
    estimates, out = _estimates(table), []
    for row in table.rows:
        values: list[str | float | int | None] = []
        for column in table.columns:
            cell = row.cells.get(column.name)
            if column.name in estimates:
                known = cell if isinstance(cell, EstimateRecord) else EstimateRecord()
                values += [known.value, known.low, known.high, known.n or None]
            else:
                values.append(cell if not isinstance(cell, EstimateRecord) else None)
        at = row.geometry.xy_px[0] if row.geometry else (None, None)
        out.append([*values, *at])
    return out
