"""Plain PNGs, read without Pillow's decoder: the same pixels, and of a damaged file the same refusal."""

import io
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from velfield.errors import InputError
from velfield.sources import images
from velfield.sources.images import read_grey_image
from velfield.sources.png_filters import luma, undo_filters

COLOUR_TYPES = {1: 0, 2: 4, 3: 2, 4: 6}
"""Channels -> PNG's number of how they are stored."""


def chunk(name: bytes, data: bytes) -> bytes:
    return len(data).to_bytes(4) + name + data + zlib.crc32(name + data).to_bytes(4)


def predict(kind: int, a: int, b: int, c: int) -> int:
    """The prediction of a byte from those to the left, above, and above to the left, as the standard has it."""
    if kind == 4:
        p = a + b - c
        return min((abs(p - a), 0, a), (abs(p - b), 1, b), (abs(p - c), 2, c))[2]
    return (0, a, b, (a + b) // 2)[kind]


def filter_rows(pixels: np.ndarray, kinds: np.ndarray) -> np.ndarray:
    """Rows behind the numbers of their filters, (h, 1 + w * channels), of pixels (h, w, channels)."""
    height, width, channels = pixels.shape
    lines = pixels.reshape(height, width * channels)
    around = np.zeros((height + 1, (width + 1) * channels), np.uint8)
    around[1:, channels:] = lines
    left, above, corner = around[1:, :-channels], around[:-1, channels:], around[:-1, :-channels]
    predicted = np.vectorize(predict)(kinds[:, None], *(part.astype(int) for part in (left, above, corner)))
    return np.column_stack([kinds.astype(np.uint8), lines - predicted.astype(np.uint8)])


def png(pixels: np.ndarray, kinds: np.ndarray, *, part: int = 10**6, before: bytes = b"", behind: bytes = b"") -> bytes:
    """A PNG by hand: each row with its filter, its pixels in chunks of `part` bytes, and more chunks about them."""
    deflated = zlib.compress(filter_rows(pixels, kinds).tobytes())
    return assemble(pixels.shape, [deflated[k : k + part] for k in range(0, len(deflated), part)], before, behind)


def assemble(shape: tuple[int, ...], parts: list[bytes], before: bytes = b"", behind: bytes = b"") -> bytes:
    height, width, channels = shape
    head = width.to_bytes(4) + height.to_bytes(4) + bytes([8, COLOUR_TYPES[channels], 0, 0, 0])
    pixels = b"".join(chunk(b"IDAT", data) for data in parts)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + before + pixels + behind + chunk(b"IEND", b"")


def read_plain(data: bytes) -> np.ndarray | None:
    return images._read_plain_png(PngImagePlugin.PngImageFile(io.BytesIO(data)))


def read_by_pillow(path: Path, monkeypatch: pytest.MonkeyPatch) -> np.ndarray | str:
    with monkeypatch.context() as patch:
        patch.setattr(images, "_read_plain_png", lambda _: None)
        return outcome(path)


def outcome(path: Path) -> np.ndarray | str:
    """The pixels, or why there are none."""
    try:
        return read_grey_image(path, 10**6)
    except InputError as error:
        return str(error)


def random_image(seed: int, height: int, width: int, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels, of large and of small differences, and a filter for each row."""
    random = np.random.default_rng(seed)
    pixels = random.integers(0, 256, (height, width, channels)) // random.choice([1, 1, 30]) + random.integers(0, 200)
    return pixels.astype(np.uint8), random.integers(0, 5, height)


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 10**6),
    st.integers(1, 140),
    st.integers(1, 150),
    st.sampled_from([1, 2, 3, 4]),
    st.sampled_from([13, 17, 10**6]),
)
def test_any_filters_of_any_size_are_undone_as_pillow_undoes_them(
    seed: int, height: int, width: int, channels: int, part: int
) -> None:
    pixels, kinds = random_image(seed, height, width, channels)
    data = png(pixels, kinds, part=part)
    found = read_plain(data)
    assert found is not None
    np.testing.assert_array_equal(found, images._to_grey(Path("a"), PngImagePlugin.PngImageFile(io.BytesIO(data))))
    undone = np.zeros((height, width * channels), np.uint8)
    assert undo_filters(filter_rows(pixels, kinds).reshape(-1), channels, undone)
    np.testing.assert_array_equal(undone, pixels.reshape(height, -1))


@pytest.mark.parametrize("kind", range(5))
@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 300, 1), (300, 1, 1), (64, 128, 1), (129, 65, 3), (2, 1, 4)])
def test_each_filter_in_all_rows(kind: int, shape: tuple[int, int, int]) -> None:
    pixels, _ = random_image(kind, *shape)
    found = read_plain(png(pixels, np.full(shape[0], kind)))
    expected = pixels[..., 0] if shape[2] == 1 else np.asarray(Image.fromarray(pixels).convert("L"))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA"])
@pytest.mark.parametrize("level", [0, 1, 6, 9])
def test_what_encoders_write_is_read_as_by_pillow(mode: str, level: int) -> None:
    smooth = cv2.GaussianBlur(random_image(level, 150, 203, 4)[0], (0, 0), 2)
    image = Image.fromarray(smooth).convert(mode)
    for options in ({"compress_level": level}, {"optimize": True}, {"dpi": (72, 72)}):
        file = io.BytesIO()
        image.save(file, "PNG", **options)
        np.testing.assert_array_equal(read_plain(file.getvalue()), images._to_grey(Path("a"), image))
    if mode != "LA":
        for strategy in range(5):
            settings_of = [cv2.IMWRITE_PNG_COMPRESSION, level, cv2.IMWRITE_PNG_STRATEGY, strategy]
            data = cv2.imencode(".png", np.asarray(image), settings_of)[1].tobytes()
            by_pillow = images._to_grey(Path("a"), PngImagePlugin.PngImageFile(io.BytesIO(data)))
            np.testing.assert_array_equal(read_plain(data), by_pillow)


def test_luma_is_that_of_pillow() -> None:
    levels = np.arange(0, 256, 3, dtype=np.uint8)
    colours = np.stack(np.meshgrid(levels, levels, levels), -1).reshape(len(levels), -1, 3)
    np.testing.assert_array_equal(luma(colours), np.asarray(Image.fromarray(colours).convert("L")))


PIXELS, KINDS = random_image(5, 40, 30, 1)
FILTERED = filter_rows(PIXELS, KINDS).tobytes()
WHOLE = png(PIXELS, KINDS, part=200)
COLOURED, COLOURED_KINDS = random_image(6, 40, 30, 3)


def with_pixels(filtered: bytes, behind: bytes = b"") -> bytes:
    return assemble(PIXELS.shape, [zlib.compress(filtered) + behind])


def with_adler_wrong() -> bytes:
    deflated = zlib.compress(FILTERED)
    return assemble(PIXELS.shape, [deflated[:-1] + bytes([deflated[-1] ^ 1])])


def saved(image: Image.Image, **options: object) -> bytes:
    file = io.BytesIO()
    image.save(file, "PNG", **options)
    return file.getvalue()


def with_time_between() -> bytes:
    at = WHOLE.rindex(b"IDAT") - 4
    return WHOLE[:at] + chunk(b"tIME", bytes(7)) + WHOLE[at:]


def interlaced() -> bytes:
    at = WHOLE.index(b"IHDR")
    head = WHOLE[at + 4 : at + 16] + b"\1"
    return WHOLE.replace(WHOLE[at - 4 : at + 21], chunk(b"IHDR", head))


NOT_PLAIN: dict[str, Callable[[], bytes]] = {
    "truncated in the pixels": lambda: WHOLE[: len(WHOLE) // 2],
    "truncated before the end": lambda: WHOLE[:-12],
    "truncated in the last checksum": lambda: WHOLE[:-14],
    "the checksum of the pixels is wrong": with_adler_wrong,
    "a row too few": lambda: with_pixels(FILTERED[:-31]),
    "a byte too few": lambda: with_pixels(FILTERED[:-1]),
    "a byte too many": lambda: with_pixels(FILTERED + b"\0"),
    "far too many": lambda: with_pixels(FILTERED + bytes(10**7)),
    "more behind the deflated": lambda: with_pixels(FILTERED, b"more"),
    "more deflated in a chunk of its own": lambda: assemble(PIXELS.shape, [zlib.compress(FILTERED), b"more"]),
    "no pixels": lambda: assemble(PIXELS.shape, [b""]),
    "an unknown filter": lambda: with_pixels(FILTERED[: 31 * 20] + b"\5" + FILTERED[31 * 20 + 1 :]),
    "text behind the pixels": lambda: png(PIXELS, KINDS, behind=chunk(b"tEXt", b"key\0value")),
    "another chunk between the pixels": with_time_between,
    "transparent grey": lambda: png(PIXELS, KINDS, before=chunk(b"tRNS", b"\0\7")),
    "a transparent colour": lambda: png(COLOURED, COLOURED_KINDS, before=chunk(b"tRNS", b"\0\7\0\7\0\7")),
    "interlaced": interlaced,
    "a palette": lambda: saved(Image.fromarray(PIXELS[..., 0]).convert("P")),
    "one bit": lambda: saved(Image.fromarray(PIXELS[..., 0]).convert("1")),
    "sixteen bits": lambda: saved(Image.fromarray(PIXELS[..., 0].astype(np.uint16) * 257)),
    "sixteen bits a colour": lambda: cv2.imencode(".png", COLOURED.astype(np.uint16) * 250)[1].tobytes(),
    "several frames": lambda: saved(
        Image.fromarray(PIXELS[..., 0]), save_all=True, append_images=[Image.fromarray(255 - PIXELS[..., 0])]
    ),
}


@pytest.mark.parametrize("name", NOT_PLAIN)
def test_what_is_not_plain_and_whole_is_left_to_pillow(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = NOT_PLAIN[name]()
    assert read_plain(data) is None
    (tmp_path / "a.png").write_bytes(data)
    found, by_pillow = outcome(tmp_path / "a.png"), read_by_pillow(tmp_path / "a.png", monkeypatch)
    assert type(found) is type(by_pillow)
    np.testing.assert_array_equal(found, by_pillow)


@settings(deadline=None, max_examples=200)
@given(st.integers(0, len(WHOLE) - 1), st.integers(0, 255), st.booleans())
def test_any_damage_ends_as_with_pillow(tmp_path_factory: pytest.TempPathFactory, at: int, to: int, cut: bool) -> None:
    path = tmp_path_factory.mktemp("damaged") / "a.png"
    path.write_bytes(WHOLE[:at] if cut else WHOLE[:at] + bytes([to]) + WHOLE[at + 1 :])
    with pytest.MonkeyPatch.context() as monkeypatch:
        found, by_pillow = outcome(path), read_by_pillow(path, monkeypatch)
    assert type(found) is type(by_pillow)
    np.testing.assert_array_equal(found, by_pillow)


def test_a_png_with_far_more_bytes_than_pixels_is_left_to_pillow() -> None:
    """Else all of them would be read at once."""
    pixels = np.zeros((4, 5, 1), np.uint8)
    plain = png(pixels, np.zeros(4, int))
    assert read_plain(plain) is not None
    empty = chunk(b"IDAT", b"") * 10_000
    assert read_plain(plain.replace(chunk(b"IEND", b""), empty + chunk(b"IEND", b""))) is None
