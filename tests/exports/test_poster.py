"""`velfield export --format poster`: the sheet as PDF and SVG, read back."""

import re
import xml.etree.ElementTree as ET
import zlib
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.export import ExportOptions
from schemas.summary import RunSummary
from velfield import open_run
from velfield.errors import InputError
from velfield.exports.export import export_run

OPTIONS = ExportOptions(width_px=400, start=datetime(2024, 5, 1, 12, tzinfo=UTC))


def test_a_pdf_holds_its_texts_and_both_maps(whole: tuple[Path, RunSummary], tmp_path: Path) -> None:
    data = export_run(open_run(whole[0]), "poster", tmp_path / "sheet.pdf", OPTIONS).read_bytes()
    table = int(data[data.rindex(b"startxref") :].split()[1])
    places = [int(line[:10]) for line in data[table:].split(b"\n")[3:] if line.endswith(b" n ")]
    for number, at in enumerate(places, 1):
        assert data[at:].startswith(f"{number} 0 obj\n".encode())
    drawn = zlib.decompress(data[data.index(b"stream\n") + 7 : data.index(b"\nendstream")]).decode("cp1252")
    texts = re.findall(r"\((.*?)\) Tj", drawn)
    vehicles = open_run(whole[0]).vehicles()
    assert f"n = {(vehicles['state'] != 'parked').sum()} vehicles in traffic" in texts[1]
    assert "2024-05-01 12:00 UTC" in texts[1]
    assert {"Direction of travel", "Speed, km/h", "up"} <= set(texts)
    assert sum(bool(re.fullmatch(r"\d+ m", text)) for text in texts) == 2  # a scale bar a map
    images = re.findall(rb"/DCTDecode /Length (\d+) >>\nstream\n", data)
    at = [m.end() for m in re.finditer(rb"/DCTDecode /Length \d+ >>\nstream\n", data)]
    sizes = [
        cv2.imdecode(np.frombuffer(data[a : a + int(n)], np.uint8), 1).shape[1] for a, n in zip(at, images, strict=True)
    ]
    assert sizes == [400, 400]


def test_an_svg_is_whole_and_asks_for_nothing(whole: tuple[Path, RunSummary], tmp_path: Path) -> None:
    text = export_run(open_run(whole[0]), "poster", tmp_path / "sheet.svg", OPTIONS).read_text()
    root = ET.fromstring(text)
    tags = [element.tag.rpartition("}")[2] for element in root.iter()]
    assert (tags.count("image"), tags[0]) == (2, "svg")
    assert tags.count("polygon") > 100  # the legends are drawn, not images
    assert not re.findall(r'href="(?!data:)', text)
    for element in root.iter("{http://www.w3.org/2000/svg}image"):
        x, width = float(element.get("x", "")), float(element.get("width", ""))
        assert x > 0
        assert x + width < float(root.get("viewBox", "").split()[2])


def test_another_type_is_refused(whole: tuple[Path, RunSummary], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"found a poster as \.png, expected \.pdf or \.svg"):
        export_run(open_run(whole[0]), "poster", tmp_path / "sheet.png", OPTIONS)
