"""Read one image safely: a local file, of a known format and bounded size, whole, as stored (no EXIF rotation)."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin

from schemas.arrays import GreyImage
from velfield.errors import InputError
from velfield.sources.paths import local_path

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Files of a folder that are images."""

# The format comes from the first bytes, never from the name: GDAL and others open a VRT named .tif, which reads other
# files. The plugins are called directly: `Image.open` would bring its own limit on pixels, a global of the process.
_MAGIC: tuple[tuple[bytes, type], ...] = (
    (b"\x89PNG\r\n\x1a\n", PngImagePlugin.PngImageFile),
    (b"\xff\xd8\xff", JpegImagePlugin.JpegImageFile),
    (b"II*\0", TiffImagePlugin.TiffImageFile),
    (b"MM\0*", TiffImagePlugin.TiffImageFile),
    (b"BM", BmpImagePlugin.BmpImageFile),
)
_READ = "PNG, JPEG, TIFF or BMP"


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


def read_grey_image(path: Path | str, max_pixels: int) -> GreyImage:
    """Read an image as grey.

    Parameters
    ----------
    path
        PNG, JPEG, TIFF or BMP on this machine.
    max_pixels
        Most pixels that memory is allocated for.

    Returns
    -------
    (h, w) uint8, rows as stored; colours by ITU-R 601 luma; 16 bits by their upper 8.

    Raises
    ------
    InputError
        An address, another format, too large, truncated or damaged, or pixels that are no grey levels (float).
    """
    file = local_path(path, "image")
    with _open_image(file) as image:
        check_size(file, *image.size, max_pixels)
        try:
            image.draft("L", image.size)  # a JPEG's luma is decoded alone
            return _to_grey(file, image)
        except InputError:
            raise
        except (OSError, ValueError, SyntaxError, EOFError, OverflowError, MemoryError, UserWarning) as error:
            raise InputError(
                f"{file.name}: the image is truncated or damaged ({error}), expected a whole one; replace it"
            ) from None


def _open_image(path: Path) -> Image.Image:
    plugin = _image_plugin(path)
    try:
        image: Image.Image = plugin(path)
    except (
        OSError,
        ValueError,
        SyntaxError,
        EOFError,
        OverflowError,
        KeyError,
        TypeError,
        IndexError,
        UserWarning,
    ) as error:
        raise InputError(
            f"{path.name}: the image's header is damaged ({error}), expected {_READ}; replace it"
        ) from None
    return image


def _image_plugin(path: Path) -> type:
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise InputError(
            f"{path.name}: could not be read ({error.strerror}), expected an image; check the path"
        ) from None
    for magic, plugin in _MAGIC:
        if head.startswith(magic):
            return plugin
    if head.lstrip().startswith((b"<VRT", b"<?xml")):
        raise InputError(
            f"{path.name}: found a VRT, which names other files, expected {_READ}; write it out with gdal_translate"
        )
    raise InputError(f"{path.name}: found the bytes {head[:4].hex(' ')} at its start, expected {_READ}; convert it")


def _to_grey(path: Path, image: Image.Image) -> GreyImage:
    mode = image.mode
    if mode.startswith("I;16"):
        return np.asarray(np.asarray(image).astype(np.uint16) >> 8, np.uint8)
    if mode == "I":
        return _upper_bits(path, np.asarray(image))
    if mode in ("F", "LAB", "HSV"):
        raise InputError(
            f"{path.name}: found pixels of mode {mode!r}, expected grey or colour levels of 8 or 16 bits; convert it"
        )
    if mode in ("P", "PA"):
        image = image.convert("RGB")
    elif mode in ("LA", "La"):
        return np.ascontiguousarray(np.asarray(image)[..., 0], np.uint8)
    return np.array(image.convert("L"), np.uint8)


def _upper_bits(path: Path, values: NDArray[np.int32]) -> GreyImage:
    if values.min() < 0 or values.max() > 65535:
        raise InputError(
            f"{path.name}: found levels {values.min()} to {values.max()}, expected 0 to 65535; convert it to 8 bits"
        )
    return np.asarray(values >> 8, np.uint8)
