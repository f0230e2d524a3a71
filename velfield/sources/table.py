"""Small hand-written CSV tables, read row by row, so that a message can name the line."""

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from velfield.errors import InputError

MAX_TABLE_BYTES = 512 * 1024 * 1024
"""A table larger than this is not one of labels or times."""


def read_text(path: Path, what: str) -> str:
    """Read a text file, UTF-8 with or without a byte order mark.

    Raises
    ------
    InputError
        Too large, unreadable, or not text.
    """
    try:
        size = path.stat().st_size
        if size > MAX_TABLE_BYTES:
            raise InputError(f"{path.name}: found {size} bytes, expected {what} of at most {MAX_TABLE_BYTES}; cut it")
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path.name}: found a file that is not UTF-8 text, expected {what}; save it as CSV") from None
    except OSError as error:
        raise InputError(
            f"{path.name}: could not be read ({error.strerror}), expected {what}; check the path"
        ) from None


def read_csv_rows(
    path: Path, *, required: Sequence[str], optional: Sequence[str] | None = None, what: str
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield (line number, row) of a CSV with a header; ``what`` names its content in messages.

    It must have the columns ``required`` and may have the ``optional`` ones; None allows any others.

    Raises
    ------
    InputError
        No such columns, columns that are not known, a row of another length.
    """
    text = read_text(path, f"{what} as CSV")
    reader = csv.reader(text.splitlines(), skipinitialspace=True)
    header = [name.strip() for name in next(reader, [])]
    expected = ",".join(required) + (f"[,{','.join(optional)}]" if optional else "")
    missing = [name for name in required if name not in header]
    unknown = [] if optional is None else [name for name in header if name not in (*required, *optional)]
    if missing or unknown or len(set(header)) != len(header):
        raise InputError(
            f"{path.name}: found the columns {','.join(header)[:120]!r}, expected {what} as CSV `{expected}`; fix "
            "line 1"
        )
    for row in reader:
        if not row or not any(cell.strip() for cell in row):
            continue
        if len(row) != len(header):
            raise InputError(
                f"{path.name}: line {reader.line_num}: found {len(row)} cells, expected {len(header)} "
                f"({','.join(header)}); fix line {reader.line_num}"
            )
        yield reader.line_num, {name: cell.strip() for name, cell in zip(header, row, strict=True)}


def finite_cell(path: Path, line: int, row: dict[str, str], name: str) -> float:
    """Number of a cell; NaN where the column is absent or the cell is empty.

    Raises
    ------
    InputError
        The cell is not a finite number.
    """
    text = row.get(name, "")
    if text == "":
        return math.nan
    if not is_number(text):
        raise InputError(f"{path.name}: line {line}: found {name} {text!r}, expected a finite number; fix line {line}")
    return float(text)


def is_number(text: str) -> bool:
    """Whether a cell is a finite number."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def number_cell(path: Path, line: int, row: dict[str, str], name: str) -> float:
    """Number of a cell.

    Raises
    ------
    InputError
        The column is absent, or the cell is empty or not a finite number.
    """
    value = finite_cell(path, line, row, name)
    if math.isnan(value):
        raise InputError(f"{path.name}: line {line}: found no {name}, expected a finite number; fix line {line}")
    return value
