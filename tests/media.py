"""Videos and images for the tests of sources: a textured ground that drifts below the camera."""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image


def ground(width: int, height: int, seed: int = 0) -> NDArray[np.uint8]:
    """A ground of blobs of several sizes, (height, width) uint8."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), sigma) * sigma for sigma in (1.5, 4, 12)]
    total = np.sum(layers, axis=0)
    return np.clip(128 + 45 * total / total.std(), 0, 255).astype(np.uint8)


def drifting(count: int, width: int = 160, height: int = 120, seed: int = 0) -> Iterator[NDArray[np.uint8]]:
    """`count` frames, the camera drifting by a pixel a frame, with sensor noise."""
    scene = ground(width + count, height + count, seed)
    rng = np.random.default_rng(seed + 1)
    for step in range(count):
        frame = scene[step : step + height, step // 2 : step // 2 + width]
        yield np.clip(frame + rng.normal(0, 2, frame.shape), 0, 255).astype(np.uint8)


def write_video(
    path: Path,
    frames: Sequence[NDArray[np.uint8]],
    *,
    codec: str = "libx264",
    times: Sequence[int] | None = None,
    time_base: Fraction = Fraction(1, 25),
    key_interval: int = 12,
    options: dict[str, str] | None = None,
    container_options: dict[str, str] | None = None,
    metadata: dict[str, str] | None = None,
    rotation_deg: int = 0,
) -> Path:
    """Encode grey frames; `times` are presentation times in `time_base`, else 0, 1, 2, ..."""
    height, width = frames[0].shape
    with av.open(str(path), "w", options=container_options or {}) as container:
        container.metadata.update(metadata or {})
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.time_base = time_base
        stream.gop_size = key_interval
        stream.options = options or ({"preset": "veryfast"} if codec == "libx264" else {})
        if rotation_deg:
            stream.set_display_rotation(rotation_deg)
        stream.bit_rate = 4_000_000  # MPEG-2 has no other setting of quality
        for number, grey in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(grey, format="gray").reformat(format="yuv420p")
            frame.time_base = time_base
            frame.pts = number if times is None else times[number]
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def write_images(folder: Path, frames: Sequence[NDArray[np.uint8]], *, name: str = "f{}.png") -> list[str]:
    """Save frames as images, numbered from 1; their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [name.format(number) for number in range(1, len(frames) + 1)]
    for file, grey in zip(names, frames, strict=True):
        Image.fromarray(grey).save(folder / file)
    return names


def write_times(path: Path, rows: Sequence[tuple[str | int, float]]) -> Path:
    """Write a CSV ``frame,time_s``."""
    path.write_text("frame,time_s\n" + "".join(f"{frame},{time_s!r}\n" for frame, time_s in rows))
    return path


def flip_bytes(source: Path, damaged: Path, *, start: float, stop: float, count: int, seed: int) -> Path:
    """Copy a file with `count` bytes changed between the fractions `start` and `stop` of its length."""
    content = bytearray(source.read_bytes())
    rng = np.random.default_rng(seed)
    for place in rng.integers(int(start * len(content)), int(stop * len(content)), count):
        content[place] ^= int(rng.integers(1, 256))
    damaged.write_bytes(bytes(content))
    return damaged
