"""Read one image safely: a local file, of a known format and bounded size, whole, as stored (no EXIF rotation)."""

import io
import struct
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin

from schemas.arrays import FloatArray, GreyImage
from velfield.errors import InputError
from velfield.sources.frames import local_path

# The format comes from the first bytes, never from the name: GDAL and others open a VRT named .tif, which reads other
# files. The plugins are called directly: `Image.open` would bring its own limit on pixels, a global of the process.
_MAGIC: tuple[tuple[bytes, type], ...] = (
    (b"\x89PNG\r\n\x1a\n", PngImagePlugin.PngImageFile),
    (b"\xff\xd8\xff", JpegImagePlugin.JpegImageFile),
    (b"II*\0", TiffImagePlugin.TiffImageFile),
    (b"MM\0*", TiffImagePlugin.TiffImageFile),
    (b"BM", BmpImagePlugin.BmpImageFile),
)
Levels = tuple[float, float]
"""Levels that become 0 and 255."""
_PERCENTILES, _FILLED, _SAMPLED = (0.1, 99.9), 0.005, 16
_BGR_LUMA = np.array([0.114, 0.587, 0.299])
_READ = "PNG, JPEG, TIFF or BMP"
_DAMAGED = (OSError, ValueError, SyntaxError, EOFError, OverflowError, MemoryError, UserWarning)
_MAX_TAG_BYTES = 2**20
_PNG_XMP = b"XML:com.adobe.xmp\0\0\0\0\0"
"""Key, no compression, no language, no translated key."""


def check_size(path: Path, width: int, height: int, max_pixels: int) -> None:
    """Refuse an image whose header declares more than `max_pixels`, before memory is taken.

    Raises
    ------
    InputError
        It does, or it has no size at all.
    """
    if width < 1 or height < 1:
        raise InputError(
            f"{path.name}: found an image of {width}x{height} px, expected at least 1x1; the file is damaged"
        )
    if width * height > max_pixels:
        raise InputError(
            f"{path.name}: found {width}x{height} = {width * height} px, expected at most {max_pixels}; "
            "make it smaller, or raise --set frames.max_pixels"
        )


def image_size(path: Path, *, max_pixels: int) -> tuple[int, int]:
    """Size of an image from its header, (width, height).

    Raises
    ------
    InputError
        Not an image of a format that is read, or too large.
    """
    with _open_image(path) as image:
        check_size(path, *image.size, max_pixels)
        return int(image.width), int(image.height)


def read_image_tags(path: Path) -> tuple[Image.Exif, bytes]:
    """EXIF and XMP of an image, without its pixels; empty where it has none.

    Raises
    ------
    InputError
        Not an image of a format that is read.
    """
    with _open_image(path) as image:
        xmp = image.info.get("xmp", b"") or image.info.get("XML:com.adobe.xmp", b"")
        exif = Image.Image.getexif(image)
        if image.format == "PNG" and not (exif and xmp):
            # Pillow's own `getexif` decodes all pixels to look behind them, 0.05 s a frame of 5 Mpx.
            late_exif, late_xmp = _read_png_tail(path)
            exif, xmp = exif or late_exif, xmp or late_xmp
        return exif, xmp.encode() if isinstance(xmp, str) else bytes(xmp)


def _read_png_tail(path: Path) -> tuple[Image.Exif, bytes]:
    """EXIF and XMP in chunks behind a PNG's pixels, where ExifTool puts them; the pixels are skipped."""
    exif, xmp = Image.Exif(), b""
    with path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8 and head[4:] != b"IEND":
            size, name = int.from_bytes(head[:4]), head[4:]
            data = file.read(size) if name in (b"eXIf", b"iTXt") and size <= _MAX_TAG_BYTES else b""
            file.seek(size - len(data) + 4, io.SEEK_CUR)
            if name == b"eXIf":
                with suppress(SyntaxError, ValueError, struct.error):  # damaged: as if it had none
                    exif.load(data)
            elif data.startswith(_PNG_XMP):
                xmp = data[len(_PNG_XMP) :]
    return exif, xmp


def read_grey_image(path: Path | str, max_pixels: int, levels: Levels | None = None) -> GreyImage:
    """Read a PNG, JPEG, TIFF or BMP as grey (h, w) uint8, rows as stored; colours by ITU-R 601 luma.

    ``levels`` of an image of more than 8 bits a channel become 0 and 255; None: by `stretch_levels` of itself.

    Raises
    ------
    InputError
        An address, another format, several pages, too large, truncated or damaged, or colours of another space.
    """
    file = local_path(path, "image")
    with _open_image(file) as image:
        check_size(file, *image.size, max_pixels)
        try:
            image.draft("L", image.size)  # a JPEG's luma is decoded alone
            return _to_grey(file, image, levels)
        except InputError:
            raise
        except _DAMAGED as error:
            raise InputError(
                f"{file.name}: the image is truncated or damaged ({error}), expected a whole one; replace it"
            ) from None


def _open_image(path: Path) -> Image.Image:
    plugin = _image_plugin(path)
    try:
        image: Image.Image = plugin(path)
        if getattr(image, "n_frames", 1) > 1 and isinstance(image, TiffImagePlugin.TiffImageFile):
            _refuse_pages(path, image)
    except (*_DAMAGED, KeyError, TypeError, IndexError) as error:
        raise InputError(
            f"{path.name}: the image's header is damaged ({error}), expected {_READ}; replace it"
        ) from None
    return image


def _refuse_pages(path: Path, image: TiffImagePlugin.TiffImageFile) -> None:
    """Refuse a TIFF of several frames; reduced copies of the first page (overviews) are none."""
    size = image.size
    image.seek(1)
    if image.size == size:
        pages = image.n_frames
        image.close()
        raise InputError(
            f"{path.name}: found {pages} pages of {size[0]}x{size[1]}, expected one frame a file; write each "
            "page as a file"
        )
    image.seek(0)


def read_magic(path: Path, expected: str) -> bytes:
    """The first 16 bytes of a file, which tell its format.

    Raises
    ------
    InputError
        It cannot be read; ``expected`` ends the message.
    """
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise InputError(f"{path.name}: could not be read ({error.strerror}), expected {expected}") from None


def _image_plugin(path: Path) -> type:
    head = read_magic(path, "an image; check the path")
    for magic, plugin in _MAGIC:
        if head.startswith(magic):
            return plugin
    if head.lstrip().startswith((b"<VRT", b"<?xml")):
        raise InputError(
            f"{path.name}: found a VRT, which names other files, expected {_READ}; write it out with gdal_translate"
        )
    raise InputError(f"{path.name}: found the bytes {head[:4].hex(' ')} at its start, expected {_READ}; convert it")


def _to_grey(path: Path, image: Image.Image, levels: Levels | None) -> GreyImage:
    mode = image.mode
    deep = _deep_values(path, image)
    if deep is not None:
        return stretch(deep, levels or stretch_levels([deep]))
    if mode in ("LAB", "HSV"):
        raise InputError(f"{path.name}: found pixels of mode {mode!r}, expected grey or colour levels; convert it")
    if mode in ("P", "PA"):
        image = image.convert("RGB")
    elif mode in ("LA", "La"):
        return np.ascontiguousarray(np.asarray(image)[..., 0], np.uint8)
    return np.array(image.convert("L"), np.uint8)


def _deep_values(path: Path, image: Image.Image) -> FloatArray | None:
    """Grey levels (h, w) of an image of more than 8 bits a channel, as stored; else None."""
    if image.mode.startswith("I") or image.mode == "F":
        return np.asarray(image, np.float64)
    if ";16" not in str(getattr(image, "tile", "")):
        return None
    colours = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)  # Pillow keeps the upper 8 bits alone
    if colours is None:
        raise InputError(f"{path.name}: the image is truncated or damaged, expected a whole one; replace it")
    return np.asarray(colours[..., :3] @ _BGR_LUMA if colours.ndim == 3 else colours, np.float64)


def stretch(image: FloatArray, levels: Levels) -> GreyImage:
    """An image (h, w) in 8 bits, its levels mapped to 0 and 255."""
    low, high = levels
    return np.asarray(np.clip(np.nan_to_num((image - low) * (255.0 / (high - low))), 0, 255).round(), np.uint8)


def describe_levels(levels: Levels) -> str:
    """Describe the conversion of frames of more than 8 bits, in one line."""
    return f"frames of more than 8 bits: levels {levels[0]:g} to {levels[1]:g} become 0 to 255 in all frames"


def stretch_levels(images: Iterable[FloatArray]) -> Levels:
    """The levels of images (h, w) of more than 8 bits that become 0 and 255: their 0.1 and 99.9 percentile.

    A level that fills much of an image at either end is no data (a border, a saturated area), and does not count.
    """
    sample = np.concatenate([np.asarray(image, np.float64)[::4, ::4].ravel() for image in images])
    sample = sample[np.isfinite(sample)]
    if not len(sample):
        return 0.0, 1.0
    for end in (np.min, np.max):
        filled = sample == end(sample)
        if _FILLED < filled.mean() < 1:
            sample = sample[~filled]
    low, high = (float(level) for level in np.percentile(sample, _PERCENTILES))
    return low, max(high, low + 1e-6 * max(abs(low), 1.0))


def folder_levels(files: Sequence[Path], max_pixels: int) -> Levels | None:
    """One range of levels for images of a flight, by some of them; None where they have 8 bits a channel."""
    found = []
    for file in files[:: -(-len(files) // _SAMPLED)]:
        try:
            with _open_image(file) as image:
                check_size(file, *image.size, max_pixels)
                deep = _deep_values(file, image)
        except (InputError, *_DAMAGED):
            continue  # the frame itself is reported where it is read
        if deep is None:
            return None
        found.append(deep)
    return stretch_levels(found) if found else None
