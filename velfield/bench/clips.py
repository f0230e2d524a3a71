"""Simulated clips like people's: H.264 of 1080p and 4K, H.265 of 10 bits; and libav's own time to decode one."""

import time
from pathlib import Path
from typing import Any

import av

from schemas.simulation import SimulationConfig
from velfield.parallel import usable_processors
from velfield.synthetic.clip import CLIP_NAME
from velfield.synthetic.write import write_flight

CLIPS: dict[str, tuple[int, int]] = {"1080p H.264": (1920, 1080), "4K H.264": (3840, 2160), "1080p H.265": (1920, 1080)}
"""Name -> width and height."""
_FPS = 30.0


def make_clip(name: str, root: Path, frames: int) -> Path:
    """One of `CLIPS` without telemetry, of so many frames; one that is there is used again."""
    width, height = CLIPS[name]
    path = root / f"{name.replace(' ', '-')}-{frames}.mp4"
    if path.exists():
        return path
    if name.endswith("H.265"):
        _encode(make_clip(name.replace("H.265", "H.264"), root, frames), path)
        return path
    flight = path.with_suffix("")
    config = SimulationConfig(frames=frames, width=width, height=height, seed=77)
    write_flight(flight, config.as_clip("beside", fps=_FPS))
    (flight / CLIP_NAME).rename(path)
    return path


def _encode(source: Path, path: Path) -> None:
    """A clip as H.265 of 10 bits."""
    part = path.with_suffix(".part.mp4")
    with av.open(str(source)) as given, av.open(str(part), "w") as made:
        video: Any = given.streams.video[0]
        stream: Any = made.add_stream("libx265", rate=round(_FPS))
        stream.width, stream.height, stream.pix_fmt = video.width, video.height, "yuv420p10le"
        stream.codec_context.time_base = video.time_base
        stream.options = {"crf": "20", "preset": "fast", "x265-params": "log-level=none"}
        for frame in given.decode(video):
            made.mux(stream.encode(frame.reformat(format="yuv420p10le")))
        made.mux(stream.encode())
    part.rename(path)


def decode_s(path: Path) -> float:
    """Processor time of libav alone over a clip, every frame decoded and none converted, s."""
    start = time.process_time()
    with av.open(str(path)) as container:
        stream: Any = container.streams.video[0]
        stream.codec_context.thread_type, stream.codec_context.thread_count = "AUTO", usable_processors()
        for _ in container.decode(stream):
            pass
    return time.process_time() - start
