"""Read one image safely: a local file, of a known format and bounded size, whole, as stored (no EXIF rotation).

A folder of images as a source: natural order, times from a CSV or from a frame rate that the user gives.
"""

import io
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin

from schemas.arrays import FloatArray, GreyImage, IntArray
from schemas.flight import FramesConfig
from velfield.errors import InputError
from velfield.sources.frames import FootageLoss, SourceFrame, SourceInfo, local_path, unreadable_frame
from velfield.sources.png_filters import luma, undo_filters
from velfield.sources.quality import FrameFlag
from velfield.sources.timestamps import read_timestamps

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
_MAX_TAG_BYTES = 2**20
_PNG_XMP = b"XML:com.adobe.xmp\0\0\0\0\0"
"""Key, no compression, no language, no translated key."""
_PNG_CHANNELS = {"L": 1, "LA": 2, "RGB": 3, "RGBA": 4}
"""Bytes a pixel of the plain PNGs, by Pillow's name of how they are stored; with 16 bits or a palette it is another."""
_PNG_OVERHEAD = 2**16
"""Bytes of a PNG's chunks beside its pixels, at most."""
_INFLATED_AT_A_TIME = 2**17
"""Bytes of a PNG, inflated between two looks at how many pixels there are; smaller and larger parts take longer."""


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
            plain = _read_plain_png(image) if isinstance(image, PngImagePlugin.PngImageFile) else None
            return _to_grey(file, image) if plain is None else plain
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


def _read_plain_png(image: PngImagePlugin.PngImageFile) -> GreyImage | None:
    """Grey levels of a whole and plain PNG, in half of Pillow's time (see `velfield.sources.png_filters`).

    None of one with a palette, 16 bits, interlacing, transparent colours or several frames, with a chunk behind its
    pixels, or with anything wrong: those are Pillow's, to read or to refuse. Like Pillow, this looks at the checksum of
    the pixels, not at those of the chunks that hold them.
    """
    if image.is_animated or {"interlace", "transparency", "bbox"} & image.info.keys() or len(image.tile) != 1:
        return None
    codec, extents, offset, stored = image.tile[0]
    channels = _PNG_CHANNELS.get(str(stored), 0)
    if codec != "zip" or extents != (0, 0, *image.size) or not channels or image.fp is None:
        return None
    size = image.height * (1 + image.width * channels)
    most = 2 * size + _PNG_OVERHEAD  # what cannot be compressed takes little more: beyond, it is not plain
    image.fp.seek(offset - 8)
    data = image.fp.read(most + 1)
    filtered = None if len(data) > most else _inflate_pixels(data, size)
    pixels = np.empty((image.height, image.width * channels), np.uint8)
    if filtered is None or not undo_filters(filtered, channels, pixels):
        return None
    if stored == "L":
        return pixels
    coloured = pixels.reshape(image.height, image.width, channels)
    return np.ascontiguousarray(coloured[..., 0]) if stored == "LA" else np.asarray(luma(coloured), np.uint8)


def _inflate_pixels(data: bytes, size: int) -> NDArray[np.uint8] | None:
    """The `size` bytes that a PNG's chunks of pixels hold, where only the end of the file follows them; else None.

    `data` is the file from the first of these chunks on.
    """
    view, start, parts = memoryview(data), 0, []
    while data[start + 4 : start + 8] == b"IDAT":
        end = start + 8 + int.from_bytes(data[start : start + 4])
        parts.append(view[start + 8 : end])
        start = end + 4
    if data[start + 4 : start + 8] != b"IEND":
        return None
    deflated = memoryview(b"".join(parts))
    inflated, count, inflater = np.empty(size, np.uint8), 0, zlib.decompressobj()
    target = inflated.data
    try:
        for start in range(0, len(deflated), _INFLATED_AT_A_TIME):
            # One more than there may be, so that what is too large shows before memory is taken for it.
            part = inflater.decompress(deflated[start : start + _INFLATED_AT_A_TIME], size - count + 1)
            if count + len(part) > size:
                return None
            target[count : count + len(part)] = part
            count += len(part)
    except zlib.error:
        return None
    return inflated if count == size and inflater.eof and not inflater.unused_data else None


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


_DIGITS = re.compile(r"(\d+)")
_FEW = 5


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Sort key that puts numbers in order of value.

    Examples
    --------
    >>> sorted(["f10.png", "f9.png", "F1.png"], key=natural_key)
    ['F1.png', 'f9.png', 'f10.png']
    """
    parts = _DIGITS.split(name.casefold())
    return (*((0, int(part)) if part.isdecimal() else (1, part) for part in parts), (1, name))


def probe_folder(path: Path, *, frames: FramesConfig, timestamps: Path | None) -> SourceInfo:
    """Facts of a folder (`velfield.sources.source.probe`). Reads every image's header, no pixels."""
    names = list_images(path)
    names, times_s, warnings = _with_times(path, names, frames, timestamps)
    sizes, broken = _group_by_size(path, names, frames.max_pixels)
    if not sizes:
        raise InputError(
            f"{path.name}: found {len(names)} images, none of them readable, expected frames; {broken[0][1]}"
        )
    width, height = _common_size(path, sizes)
    if broken:
        warnings += (f"{len(broken)} of {len(names)} images cannot be read (first: {broken[0][1]})",)
    return SourceInfo(
        kind="folder",
        width=width,
        height=height,
        frame_count=len(names),
        times_s=times_s,
        names=names,
        warnings=warnings,
        fps=frames.fps,
        max_pixels=frames.max_pixels,
    )


def list_images(path: Path) -> tuple[str, ...]:
    """Names of the images in a folder, naturally sorted; without hidden files (``._x.jpg`` of a Mac).

    Raises
    ------
    InputError
        There is none.
    """
    try:
        names = [entry.name for entry in path.iterdir() if entry.suffix.lower() in IMAGE_SUFFIXES]
    except OSError as error:
        raise InputError(f"{path.name}: the folder cannot be listed ({error.strerror}); check it") from None
    names = [name for name in names if not name.startswith(".")]
    if not names:
        raise InputError(
            f"{path.name}: found no images in the folder, expected {', '.join(IMAGE_SUFFIXES)}; "
            "give the folder that holds them, or a video"
        )
    return tuple(sorted(names, key=natural_key))


def iter_folder(path: Path, info: SourceInfo, indices: IntArray) -> Iterator[SourceFrame]:
    """Read the images `indices`; one that cannot be read is yielded with the flag UNREADABLE."""
    for index in indices:
        yield _read(path, info, int(index))


def _read(path: Path, info: SourceInfo, index: int) -> SourceFrame:
    name = info.names[index]
    try:
        check_size(path / name, *image_size(path / name, max_pixels=info.max_pixels), info.max_pixels)
        grey = read_grey_image(path / name, info.max_pixels)
    except InputError as error:
        return unreadable_frame(path, info, index, int(FrameFlag.UNREADABLE), str(error))
    if grey.shape != info.shape:
        raise InputError(
            f"{path.name}: found {name} of {grey.shape[1]}x{grey.shape[0]}, expected {info.width}x{info.height}; "
            "the folder changed meanwhile, start again"
        )
    return SourceFrame(index, name, float(info.times_s[index]), grey, 0)


def _with_times(
    path: Path, names: tuple[str, ...], frames: FramesConfig, timestamps: Path | None
) -> tuple[tuple[str, ...], FloatArray, tuple[str, ...]]:
    """Names and times in order of time, and notes on irregularities."""
    if timestamps is None:
        if frames.fps is None:
            raise InputError(
                f"{path.name}: found {len(names)} images without times, expected them from a side file or a rate; "
                "give --timestamps CSV (frame,time_s) or --fps F"
            )
        return names, np.arange(len(names)) / frames.fps, ()
    side = read_timestamps(timestamps)
    kept = tuple(name for name in names if name in side)
    if not kept:
        raise InputError(
            f"{timestamps.name}: found frames such as {next(iter(side))!r}, none an image of {path.name} "
            f"(such as {names[0]!r}), expected the images' file names as `frame`; fix them"
        )
    return _sorted_by_time(
        kept, np.array([side[name] for name in kept]), _unmatched_notes(path, timestamps, names, kept, side)
    )


def _unmatched_notes(
    path: Path, timestamps: Path, names: tuple[str, ...], kept: tuple[str, ...], side: dict[str, float]
) -> tuple[str, ...]:
    untimed = [name for name in names if name not in side]
    absent = sorted(set(side) - set(kept), key=natural_key)
    notes: tuple[str, ...] = ()
    if untimed:
        notes += (
            FootageLoss(f"{len(untimed)} of {len(names)} images have no time and are dropped ({_shorten(untimed)})"),
        )
    if absent:
        notes += (
            FootageLoss(f"{len(absent)} frames of {timestamps.name} are not in {path.name} ({_shorten(absent)})"),
        )
    return notes


def _sorted_by_time(
    names: tuple[str, ...], times_s: FloatArray, notes: tuple[str, ...]
) -> tuple[tuple[str, ...], FloatArray, tuple[str, ...]]:
    order = np.argsort(times_s, kind="stable")
    backwards = int(np.count_nonzero(np.diff(times_s) < 0))
    times_s = times_s[order]
    equal = int(np.count_nonzero(np.diff(times_s) == 0))
    if backwards:
        notes += (f"times run backwards {backwards} times in the order of names: frames are taken in order of time",)
    if equal:
        notes += (FootageLoss(f"{equal} frames have the time of the frame before and are dropped"),)
    return tuple(names[i] for i in order), times_s, notes


def _group_by_size(
    path: Path, names: tuple[str, ...], max_pixels: int
) -> tuple[dict[tuple[int, int], list[str]], list[tuple[str, str]]]:
    """Names by size, and the names of unreadable images with the reason; one too large is an error."""
    sizes: dict[tuple[int, int], list[str]] = {}
    broken: list[tuple[str, str]] = []
    for name in names:
        try:
            size = image_size(path / name, max_pixels=max(max_pixels, 2**62))
        except InputError as error:
            broken.append((name, str(error)))
            continue
        check_size(path / name, *size, max_pixels)
        sizes.setdefault(size, []).append(name)
    return sizes, broken


def _common_size(path: Path, sizes: dict[tuple[int, int], list[str]]) -> tuple[int, int]:
    size, usual = max(sizes.items(), key=lambda item: len(item[1]))
    if len(sizes) > 1:
        (width, height), odd = next((other, names) for other, names in sizes.items() if other != size)
        raise InputError(
            f"{path.name}: found {odd[0]} of {width}x{height}, expected {size[0]}x{size[1]} as {len(usual)} others; "
            "take it out of the folder, frames must be of one size"
        )
    return size


def _shorten(names: list[str]) -> str:
    return ", ".join(names[:_FEW]) + (", ..." if len(names) > _FEW else "")
