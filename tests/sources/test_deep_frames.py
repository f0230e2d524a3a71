"""Frames of more than 8 bits: stretched by one range for the flight, whichever way they are stored."""

from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from schemas.flight import FramesConfig
from tests.media import drifting
from velfield.errors import InputError
from velfield.sources.quality import FrameFlag
from velfield.sources.source import iter_frames, probe

FPS = FramesConfig(fps=5)


def radiometric(grey: np.ndarray) -> np.ndarray:
    return (28500 + grey.astype(float) / 255 * 1500).astype(np.uint16)  # hundredths of a kelvin


def bordered(values: np.ndarray, level: float) -> np.ndarray:
    """With a border that holds no data."""
    values = values.copy()
    values[:12] = level
    return values


WRITERS: dict[str, tuple[str, Callable[[Path, np.ndarray], object]]] = {
    "radiometric TIFF": (".tif", lambda p, g: Image.fromarray(radiometric(g)).save(p, compression="tiff_lzw")),
    "12 bits in 16": (".png", lambda p, g: Image.fromarray(g.astype(np.uint16) * 16).save(p)),
    "16 bits": (".png", lambda p, g: Image.fromarray(g.astype(np.uint16) * 257).save(p)),
    "kelvin as floats": (".tif", lambda p, g: Image.fromarray((g / 20.0 + 280).astype(np.float32)).save(p)),
    "degrees as floats": (".tif", lambda p, g: Image.fromarray((g / 20.0 - 10).astype(np.float32)).save(p)),
    "floats without data": (
        ".tif",
        lambda p, g: Image.fromarray(bordered((g / 20.0 + 280).astype(np.float32), -9999)).save(p),
    ),
    "floats that are no numbers": (
        ".tif",
        lambda p, g: Image.fromarray(bordered((g / 20.0 + 280).astype(np.float32), np.nan)).save(p),
    ),
    "16 bits without data": (".tif", lambda p, g: Image.fromarray(bordered(radiometric(g), 0)).save(p)),
    "32 bits": (".tif", lambda p, g: Image.fromarray(g.astype(np.int32) * 1000 - 70_000).save(p)),
    "colours of 16 bits": (".png", lambda p, g: cv2.imwrite(str(p), np.dstack([g.astype(np.uint16) * 16] * 3))),
    "colours of 16 bits, TIFF": (".tif", lambda p, g: cv2.imwrite(str(p), np.dstack([g.astype(np.uint16) * 16] * 3))),
    "colours and opacity of 16 bits": (
        ".png",
        lambda p, g: cv2.imwrite(str(p), np.dstack([*[g.astype(np.uint16) * 16] * 3, g.astype(np.uint16)])),
    ),
    "8 bits": (".png", lambda p, g: Image.fromarray(g).save(p)),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_frames_are_stretched_by_one_range(kind: str, tmp_path: Path) -> None:
    suffix, write = WRITERS[kind]
    frames = [
        np.clip(grey * factor, 0, 255).astype(np.uint8)
        for grey, factor in zip(drifting(4), (1, 1, 0.5, 1), strict=True)
    ]
    for k, grey in enumerate(frames):
        write(tmp_path / f"f{k}{suffix}", grey)
    info = probe(tmp_path, frames=FPS)
    assert any("become 0 to 255 in all frames" in warning for warning in info.warnings) == (kind != "8 bits")
    read = list(iter_frames(tmp_path, info, range(4)))
    assert not any(frame.flags & ~FrameFlag.DUPLICATE for frame in read)
    stored = np.concatenate([grey[12:].ravel() for grey in frames]).astype(float)
    shown = np.concatenate([frame.grey[12:].ravel() for frame in read]).astype(float)
    slope, offset = np.polyfit(stored, shown, 1)  # the same for all frames: the dim one stays dim
    assert 0.9 < slope < 3
    assert np.abs(np.clip(slope * stored + offset, 0, 255) - shown).mean() < 2


def test_pages_of_a_tiff_are_no_frame_and_overviews_are_none(tmp_path: Path) -> None:
    pages = [Image.fromarray(grey) for grey in drifting(3)]
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=[page.reduce(2) for page in pages[:1]])
    assert probe(tmp_path, frames=FPS).frame_count == 1
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:])
    with pytest.raises(InputError, match=r"found 3 pages of .*; write each page as a file"):
        probe(tmp_path, frames=FPS)


@pytest.mark.parametrize("pixels", ["gray16le", "gray10le", "gray"])
def test_a_grey_video_of_more_than_8_bits_is_stretched_by_one_range(pixels: str, tmp_path: Path) -> None:
    frames = list(drifting(6))
    with av.open(str(tmp_path / "x.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = frames[0].shape[1], frames[0].shape[0], pixels
        for grey in frames:
            deep = grey if pixels == "gray" else radiometric(grey)
            frame = av.VideoFrame.from_ndarray(deep, format="gray" if pixels == "gray" else "gray16le")
            container.mux(stream.encode(frame.reformat(format=pixels)))
        container.mux(stream.encode(None))
    info = probe(tmp_path / "x.mkv", frames=FramesConfig())
    assert (info.levels is None) == (pixels == "gray")
    for frame, grey in zip(iter_frames(tmp_path / "x.mkv", info, range(6)), frames, strict=True):
        assert not frame.flags
        assert np.corrcoef(frame.grey.ravel(), grey.ravel())[0, 1] > 0.99
        assert frame.grey.std() > 0.9 * grey.std()
