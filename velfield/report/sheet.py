"""A sheet of print: images, lines, areas and text at places in millimetres, written as SVG or PDF without rasterising.

No library draws this little: the text is Helvetica's (every PDF reader has it), images stay JPEG.
"""

import zlib
from base64 import b64encode
from dataclasses import dataclass, field
from html import escape

from schemas.arrays import RGBImage
from velfield.report.figures import jpeg_bytes

Colour = tuple[int, int, int]
Point = tuple[float, float]
BLACK: Colour = (20, 22, 26)
_PT_PER_MM = 72 / 25.4
_PT_TO_MM = 25.4 / 72
_WIDTH_EM = 0.53
"""Mean width of Helvetica's letters; of its digits 0.556."""


@dataclass(frozen=True)
class _Image:
    data: bytes
    size_px: tuple[int, int]
    at: Point
    size: Point


@dataclass(frozen=True)
class _Text:
    at: Point
    text: str
    size_pt: float
    bold: bool
    centred: bool
    colour: Colour


@dataclass(frozen=True)
class _Area:
    points: tuple[Point, ...]
    colour: Colour


@dataclass(frozen=True)
class _Line:
    points: tuple[Point, ...]
    width: float
    colour: Colour


@dataclass
class Sheet:
    """Width and height in mm; (0, 0) is the upper left corner, y points down.

    Examples
    --------
    >>> sheet = Sheet(100, 50)
    >>> sheet.text((10, 20), "North")
    >>> sheet.to_svg().startswith(b"<svg"), sheet.to_pdf().startswith(b"%PDF-1.4")
    (True, True)
    """

    width: float
    height: float
    items: list[_Image | _Text | _Area | _Line] = field(default_factory=list)

    def image(self, rgb: RGBImage, at: Point, size: Point, *, quality: int = 90) -> None:
        """An image in a box."""
        self.items.append(_Image(jpeg_bytes(rgb, quality=quality), (rgb.shape[1], rgb.shape[0]), at, size))

    def text(
        self,
        at: Point,
        text: str,
        *,
        size_pt: float = 9,
        bold: bool = False,
        centred: bool = False,
        colour: Colour = BLACK,
    ) -> None:
        """A line of text, from a point of its baseline on, or centred there."""
        self.items.append(_Text(at, text, size_pt, bold, centred, colour))

    def area(self, points: list[Point], colour: Colour) -> None:
        """A filled polygon."""
        self.items.append(_Area(tuple(points), colour))

    def line(self, points: list[Point], *, width: float = 0.3, colour: Colour = BLACK) -> None:
        """A line through points."""
        self.items.append(_Line(tuple(points), width, colour))

    def to_svg(self) -> bytes:
        """The sheet as SVG 1.1."""
        body = "\n".join(_svg(item) for item in self.items)
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{self.width:g}mm" height="{self.height:g}mm" '
            f'viewBox="0 0 {self.width:g} {self.height:g}" font-family="Helvetica, Arial, sans-serif">\n'
            f'<rect width="100%" height="100%" fill="#fff"/>\n{body}\n</svg>\n'
        ).encode()

    def to_pdf(self) -> bytes:
        """The sheet as a PDF of one page."""
        images = [item for item in self.items if isinstance(item, _Image)]
        drawn = "\n".join(_pdf(item, self.height, images) for item in self.items).encode("cp1252", "replace")
        stream = zlib.compress(drawn)
        names = " ".join(f"/I{k} {6 + k} 0 R" for k in range(len(images)))
        box = f"0 0 {self.width * _PT_PER_MM:.2f} {self.height * _PT_PER_MM:.2f}"
        fonts = "".join(
            f"/{name} << /Type /Font /Subtype /Type1 /BaseFont /{base} /Encoding /WinAnsiEncoding >> "
            for name, base in (("F0", "Helvetica"), ("F1", "Helvetica-Bold"))
        )
        objects = [
            b"<< /Type /Catalog /Pages 2 0 R >>",
            b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            f"<< /Type /Page /Parent 2 0 R /MediaBox [{box}] /Contents 4 0 R /Resources 5 0 R >>".encode(),
            f"<< /Length {len(stream)} /Filter /FlateDecode >>\nstream\n".encode() + stream + b"\nendstream",
            f"<< /Font << {fonts}>> /XObject << {names} >> >>".encode(),
            *(_pdf_image(image) for image in images),
            b"<< /Producer (velfield) >>",
        ]
        return _pdf_file(objects)


def _hex(colour: Colour) -> str:
    return "#" + "".join(f"{value:02x}" for value in colour)


def _svg(item: _Image | _Text | _Area | _Line) -> str:
    if isinstance(item, _Image):
        (x, y), (width, height) = item.at, item.size
        data = b64encode(item.data).decode()
        return (
            f'<image x="{x:.3f}" y="{y:.3f}" width="{width:.3f}" height="{height:.3f}" preserveAspectRatio="none" '
            f'href="data:image/jpeg;base64,{data}"/>'
        )
    if isinstance(item, _Text):
        extra = (' font-weight="bold"' if item.bold else "") + (' text-anchor="middle"' if item.centred else "")
        return (
            f'<text x="{item.at[0]:.3f}" y="{item.at[1]:.3f}" font-size="{item.size_pt * _PT_TO_MM:.3f}" '
            f'fill="{_hex(item.colour)}"{extra}>{escape(item.text)}</text>'
        )
    points = " ".join(f"{x:.3f},{y:.3f}" for x, y in item.points)
    if isinstance(item, _Area):
        return f'<polygon points="{points}" fill="{_hex(item.colour)}"/>'
    return f'<polyline points="{points}" fill="none" stroke="{_hex(item.colour)}" stroke-width="{item.width:.3f}"/>'


def _pdf(item: _Image | _Text | _Area | _Line, height: float, images: list[_Image]) -> str:
    def place(point: Point) -> str:
        return f"{point[0] * _PT_PER_MM:.2f} {(height - point[1]) * _PT_PER_MM:.2f}"

    if isinstance(item, _Image):
        width_pt, height_pt = (side * _PT_PER_MM for side in item.size)
        corner = place((item.at[0], item.at[1] + item.size[1]))
        number = next(k for k, image in enumerate(images) if image is item)
        return f"q {width_pt:.2f} 0 0 {height_pt:.2f} {corner} cm /I{number} Do Q"
    colour = " ".join(f"{value / 255:.3f}" for value in item.colour)
    if isinstance(item, _Text):
        x = item.at[0] - (len(item.text) * _WIDTH_EM * item.size_pt * _PT_TO_MM / 2 if item.centred else 0.0)
        text = item.text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        return f"{colour} rg BT /F{int(item.bold)} {item.size_pt:g} Tf {place((x, item.at[1]))} Td ({text}) Tj ET"
    path = " ".join(f"{place(point)} {'l' if k else 'm'}" for k, point in enumerate(item.points))
    if isinstance(item, _Area):
        return f"{colour} rg {path} h f"
    return f"{colour} RG {item.width * _PT_PER_MM:.2f} w {path} S"


def _pdf_image(image: _Image) -> bytes:
    width, height = image.size_px
    head = (
        f"<< /Type /XObject /Subtype /Image /Width {width} /Height {height} /ColorSpace /DeviceRGB "
        f"/BitsPerComponent 8 /Filter /DCTDecode /Length {len(image.data)} >>\nstream\n"
    )
    return head.encode() + image.data + b"\nendstream"


def _pdf_file(objects: list[bytes]) -> bytes:
    """Objects, numbered from 1, with their table of places."""
    out = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n")
    places = []
    for number, content in enumerate(objects, 1):
        places.append(len(out))
        out += f"{number} 0 obj\n".encode() + content + b"\nendobj\n"
    table = len(out)
    out += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n".encode()
    out += b"".join(f"{at:010d} 00000 n \n".encode() for at in places)
    out += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R /Info {len(objects)} 0 R >>\n".encode()
    out += f"startxref\n{table}\n%%EOF\n".encode()
    return bytes(out)
