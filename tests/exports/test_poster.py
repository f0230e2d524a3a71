"""`velfield export --format poster`: the sheet as PDF and SVG, read back."""

import re
import xml.etree.ElementTree as ET
from datetime import UTC, datetime
from pathlib import Path

import pytest

from schemas.export import ExportOptions
from velfield import open_run
from velfield.errors import InputError
from velfield.exports.export import export_run

OPTIONS = ExportOptions(width_px=400, start=datetime(2024, 5, 1, 12, tzinfo=UTC))


def test_a_pdf_is_one_page_with_both_maps_and_the_same_bytes_each_time(whole: Path, tmp_path: Path) -> None:
    first, second = (
        export_run(open_run(whole), "poster", tmp_path / f"{k}.pdf", OPTIONS).read_bytes() for k in range(2)
    )
    assert first == second
    assert first.startswith(b"%PDF-")
    assert re.findall(rb"/Count (\d+)", first) == [b"1"]
    assert len(re.findall(rb"/Width 400\b", first)) == 2


def test_an_svg_holds_its_texts_and_asks_for_nothing(whole: Path, tmp_path: Path) -> None:
    text = export_run(open_run(whole), "poster", tmp_path / "sheet.svg", OPTIONS).read_text()
    root = ET.fromstring(text)
    texts = ["".join(e.itertext()) for e in root.iter("{http://www.w3.org/2000/svg}text")]
    vehicles = open_run(whole).vehicles()
    facts = next(line for line in texts if "vehicles move or wait in a lane" in line)
    assert f"n = {(vehicles['state'] != 'parked').sum()} vehicles move or wait in a lane" in facts
    assert "2024-05-01 12:00 UTC" in facts
    assert {"Direction of", "travel", "Speed, km/h", "up"} <= set(texts)
    assert sum(bool(re.fullmatch(r"\d+ m", line)) for line in texts) == 2  # a scale bar a map
    assert not re.findall(r'href="(?!data:|#)', text)


def test_another_type_is_refused(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"found a poster as \.png, expected \.pdf or \.svg"):
        export_run(open_run(whole), "poster", tmp_path / "sheet.png", OPTIONS)
