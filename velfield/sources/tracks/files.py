"""Files of tracks as tables of their columns: CSV of any encoding and separator, wide rows, Parquet, SUMO's XML."""

import csv
import gzip
import io
import re
import xml.etree.ElementTree as ElementTree
import zlib
from pathlib import Path

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray
from velfield.errors import InputError, one_line
from velfield.sources.table import is_number
from velfield.sources.tracks.formats import MOT_COLUMNS, normal_name

_SEPARATORS = (";", "\t", "|", ",")
_BOMS = ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))
_OTHERS = (
    (b"SQLite format 3", "an SQLite database", "export its table of tracks as CSV or Parquet"),
    (b"PK\x03\x04", "a ZIP or Excel file", "unpack it, or save the sheet as CSV"),
    (b"\x89HDF", "an HDF5 file", "export the tracks as CSV or Parquet"),
    (b"MATLAB", "a MATLAB file", "export the tracks as CSV"),
    (b"{", "JSON", "export the tracks as CSV or Parquet"),
    (b"[", "JSON", "export the tracks as CSV or Parquet"),
)
_WIDE_FIXED = ("trackid", "type", "traveledd", "avgspeed")
_FIRST_LINES = 200
EXPECTED = "CSV with a header, Parquet, or SUMO's FCD"


def read_columns(path: Path) -> pd.DataFrame:
    """Read the columns of a file of tracks, a row a vehicle and time.

    They are the file's own; wide rows (DataFromSky, pNEUMA) are unrolled, SUMO's FCD has the columns that its tool
    ``xml2csv`` gives. Numbers with decimal commas are numbers.

    Raises
    ------
    InputError
        The file cannot be read, or is of another kind.
    """
    if not path.is_file():
        raise InputError(f"{path}: not found; give a {EXPECTED} with tracks")
    data = _read_bytes(path)
    if data[:4] == b"PAR1":
        return _read_parquet(path, data)
    for magic, what, remedy in _OTHERS:
        if data.startswith(magic):
            raise InputError(f"{path}: found {what}, expected a {EXPECTED}; {remedy}")
    text = _decode(path, data)
    if text.lstrip().startswith("<"):
        return _read_fcd(path, data)
    return _read_csv(path, text)


def numbers(series: pd.Series, path: Path) -> FloatArray:
    """A column as (n,) numbers; NaN where it is empty.

    Raises
    ------
    InputError
        A value is not a finite number; or a comma may be a decimal or a thousands one.
    """
    if not (pd.api.types.is_numeric_dtype(series) or pd.api.types.is_bool_dtype(series)):
        series = _with_points(series, path)
    values = pd.to_numeric(series, errors="coerce").to_numpy(np.float64, na_value=np.nan)
    bad = (np.isnan(values) & series.notna().to_numpy()) | np.isinf(values)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        found = series.iloc[[row]].tolist()[0]
        raise InputError(f"{path}: found {found!r} in column {series.name}, row {row + 2}, expected a number")
    return values


def _with_points(series: pd.Series, path: Path) -> pd.Series:
    """Text with decimal points where it has commas; empty cells are NaN."""
    text = series.where(series.isna(), series.astype(str).str.strip().str.strip("\"'").str.replace("\u2212", "-"))
    text = text.mask(text.isin(["", "-", "nan", "NaN", "NA", "None", "null"]))
    known = text.dropna()
    commas = known[known.str.contains(",", regex=False)]
    if not len(commas):
        return text
    if commas.str.contains(".", regex=False).any():
        thousands = "." if (commas.str.rfind(",") > commas.str.rfind(".")).all() else ","
        text = text.str.replace(thousands, "", regex=False)
    elif commas.str.fullmatch(r"-?\d{1,3}(,\d{3})+").all() and known.str.contains(".", regex=False).any():
        text = text.str.replace(",", "", regex=False)
    elif commas.str.count(",").max() > 1:
        raise InputError(
            f"{path}: found {commas.iloc[0]!r} in column {series.name}, expected a number with one decimal sign; "
            "write it without thousands separators"
        )
    return text.str.replace(",", ".", regex=False)


def _read_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
        return gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path}: could not be read ({one_line(error)}); copy it again") from None


def _decode(path: Path, data: bytes) -> str:
    encoding = next((name for bom, name in _BOMS if data.startswith(bom)), None)
    if encoding is None and b"\x00" in data[:200]:
        encoding = "utf-16-le" if data[1:2] == b"\x00" else "utf-16-be"
    try:
        text = data.decode(encoding or "utf-8")
    except UnicodeDecodeError:
        text = data.decode("cp1252", errors="replace")  # whose bytes are all characters: names may be wrong, no number
    if "\x00" in text[:2000]:
        raise InputError(f"{path}: found binary data, expected a {EXPECTED}")
    return text


def _read_parquet(path: Path, data: bytes) -> pd.DataFrame:
    try:
        return pd.read_parquet(io.BytesIO(data)).reset_index(drop=True)
    except Exception as error:  # pyarrow's own kinds, some of which are OSError
        raise InputError(
            f"{path}: this is no Parquet file that can be read ({one_line(error)}); write it again"
        ) from None


def _read_csv(path: Path, text: str) -> pd.DataFrame:
    text = text.replace("\r\n", "\n").replace("\r", "\n").lstrip("\n")
    match = re.match(r"sep=(.)\n", text)
    if match:  # Excel's line
        text = text[match.end() :]
    separator = match[1] if match else _separator(text)
    text = _without_comments(text, separator)
    first = _rows(text.split("\n", _FIRST_LINES)[:_FIRST_LINES], separator)
    if not first:
        raise InputError(f"{path}: no tracks in it; expected a {EXPECTED}")
    header, rest = first[0], first[1:]
    wide = _wide_columns(header)
    if wide is not None:
        return _unroll(path, text, separator, *wide)
    names: list[str] | None = None
    if all(is_number(cell) or cell.lower() == "nan" for cell in header if cell):
        if len(header) not in (9, 10) or separator != ",":
            raise InputError(f"{path}: found numbers in line 1, expected a header; name the columns there")
        names = [*MOT_COLUMNS[: len(header)]]
    elif len(header) == 1:
        raise InputError(
            f"{path}: found 1 column in line 1 ({text[:60].splitlines()[0]!r}), expected those of track, time and "
            "position; separate them with commas, semicolons or tabs"
        )
    for number, row in enumerate(rest, 2):
        if len(row) > len(header) and any(row[len(header) :]):
            commas = separator == "," and len(row) % 2 == 1
            why = "decimal commas? Separate the columns with semicolons" if commas else f"fix line {number}"
            raise InputError(
                f"{path}: found {len(row)} cells in line {number} and {len(header)} columns in line 1; {why}"
            )
    trailing = max((len(row) for row in rest), default=len(header)) - len(header)
    columns = names or header
    try:
        table = pd.read_csv(
            io.StringIO(text),
            sep=r"\s+" if separator == " " else separator,
            skipinitialspace=True,
            header=None,
            names=[*columns, *(f"empty {k}" for k in range(trailing))] if trailing > 0 else columns,
            skiprows=0 if names else 1,
            index_col=False,
            low_memory=False,
            dtype=None,
            keep_default_na=True,
        )
    except (ValueError, pd.errors.ParserError, csv.Error) as error:
        raise InputError(f"{path}: no table of tracks ({one_line(error)}); expected a {EXPECTED}") from None
    return table.dropna(how="all", ignore_index=True)


def _rows(lines: list[str], separator: str) -> list[list[str]]:
    if separator == " ":
        return [line.split() for line in lines if line.strip()]
    rows = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    return [[cell.strip() for cell in row] for row in rows if any(cell.strip() for cell in row)]


def _separator(text: str) -> str:
    """The separator of the header outside of quotes, brackets aside."""
    line = re.sub(r'"[^"]*"', "", next((one for one in text.split("\n", 50) if one.strip(" #")), ""))
    counts = {sign: line.count(sign) for sign in _SEPARATORS}
    best = max(_SEPARATORS, key=lambda sign: counts[sign])
    return best if counts[best] else " "


def _without_comments(text: str, separator: str) -> str:
    """Without the lines that begin with # before the header, unless the last of them is the header."""
    while text.startswith("#"):
        line, _, rest = text.partition("\n")
        after = rest.split("\n", 1)[0]
        if not after.startswith("#") and line.count(separator) == after.count(separator) > 0:
            return text[1:].lstrip(" ")
        text = rest
    return text


def _wide_columns(header: list[str]) -> tuple[list[str], list[str], str] | None:
    """Names of the fixed columns and of those that repeat in wide rows, and the format; None: one row a time."""
    start = next((k for k, name in enumerate(header) if name.lower().startswith("trajectory(")), None)
    if start is not None:
        names = [header[start][len("trajectory(") :], *header[start + 1 :]]
        group = [name.strip() for name in names if name.strip(" )")]
        if group and group[-1].endswith(")") and "(" not in group[-1]:
            group[-1] = group[-1][:-1]
        return header[:start], group, "DataFromSky"
    normal = tuple(normal_name(name) for name in header)
    if normal[:4] == _WIDE_FIXED and normal[4:10] == ("lat", "lon", "speed", "lonacc", "latacc", "time"):
        return header[:4], header[4:10], "pNEUMA"
    return None


def _unroll(path: Path, text: str, separator: str, fixed: list[str], group: list[str], name: str) -> pd.DataFrame:
    """A row a vehicle and time of rows with one vehicle each."""
    ids: list[str] = []
    parts: list[FloatArray] = []
    lines = text.split("\n")
    delimiter = ";" if separator == ";" or (len(lines) > 1 and lines[1].count(";") > lines[1].count(",")) else separator
    width = len(group)
    for number, line in enumerate(lines[1:], 2):
        if not line.strip(" ;,\t"):
            continue
        cells = [cell.strip() for cell in line.split(delimiter)]
        values = cells[len(fixed) :]
        while values and not values[-1]:
            values.pop()
        if delimiter == ";":
            values = [value.replace(",", ".") for value in values]
        try:
            part = np.array(values, np.float64).reshape(-1, width)
        except ValueError:
            raise InputError(
                f"{path}: found {len(values)} values after {len(fixed)} in line {number}, expected numbers in groups "
                f"of {width} ({', '.join(group)}) as of {name}"
            ) from None
        ids += [cells[0]] * len(part)
        parts.append(part)
    whole = np.concatenate(parts) if parts else np.empty((0, width))
    table = pd.DataFrame(whole, columns=group)
    table.insert(0, fixed[0], ids)
    return table.assign(**{name: 0})


def _read_fcd(path: Path, data: bytes) -> pd.DataFrame:
    """Floating car data of SUMO: vehicles by time step."""
    rows: list[tuple[str, float, float, float, float]] = []
    time = 0.0
    try:
        for event, element in ElementTree.iterparse(io.BytesIO(data), events=("start", "end")):
            tag = element.tag.rsplit("}", 1)[-1]
            if event == "start" and tag == "timestep":
                time = float(element.attrib["time"])
            elif event == "end" and tag == "vehicle":
                a = element.attrib
                rows.append((a["id"], time, float(a["x"]), float(a["y"]), float(a.get("speed", "nan"))))
                element.clear()
            elif event == "end" and tag == "timestep":
                element.clear()
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise InputError(
            f"{path}: no FCD output of SUMO ({error}); expected <timestep time><vehicle id x y/>"
        ) from None
    return pd.DataFrame(rows, columns=["vehicle_id", "timestep_time", "vehicle_x", "vehicle_y", "vehicle_speed"])
