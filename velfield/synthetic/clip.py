"""A simulated flight as a drone's clip: H.264, and the drone's telemetry as subtitles in DJI's format.

The telemetry has the errors of such drones: a barometer that is off by as much over the whole flight, a compass too,
satellites, and a focal length in whole millimetres of the 35 mm equivalent.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from schemas.simulation import SimulationConfig
from velfield.sources.telemetry.attitude import DIAGONAL_35MM
from velfield.synthetic.camera import Camera
from velfield.synthetic.random_streams import RandomStream, random_generator

CLIP_NAME, SUBTITLE_NAME = "DJI_0001.MP4", "DJI_0001.SRT"
_TIME_BASE = Fraction(1, 90_000)
_START = datetime(2026, 5, 4, 8, 30, tzinfo=UTC)
_ASS_HEADER = b"""[Script Info]
ScriptType: v4.00+

[V4+ Styles]
Format: Name, Fontname, Fontsize, PrimaryColour, Alignment, Encoding
Style: Default,Arial,16,&Hffffff,2,1

[Events]
Format: Layer, Start, End, Style, Name, MarginL, MarginR, MarginV, Effect, Text
"""
"""Style header that libav's subtitle encoder requires."""


def simulate_telemetry(config: SimulationConfig, camera: Camera, base_shape: tuple[int, int]) -> list[str]:
    """The subtitle of each frame; the middle of the base image (h, w) is at the configured longitude and latitude."""
    t, rng = config.telemetry, random_generator(config.seed, RandomStream.TELEMETRY)
    offset = rng.normal(0.0, (t.position_sd_m, t.position_sd_m, t.height_sd_m, t.heading_sd_deg))
    poses = np.concatenate([camera.row_table(k, np.array([camera.height / 2])) for k in range(config.frames)])
    height_m = -poses[:, 11] * config.gsd_m * (1 + rng.normal(0.0, t.height_sd_share)) + offset[2]
    longitude, latitude = _positions(config, poses[:, 9:11], base_shape, offset[:2])
    yaw, pitch, roll = _attitude(poses[:, :9].reshape(-1, 3, 3), t.north_deg, float(offset[3]), rng)
    whole = np.hypot(config.width, config.height) / camera.focal_px
    focal = round(DIAGONAL_35MM / float(whole))
    return [
        _subtitle(k, camera.times_s, focal, (longitude[k], latitude[k]), height_m[k], (yaw[k], pitch[k], roll[k]))
        for k in range(config.frames)
    ]


def _positions(
    config: SimulationConfig, xy_px: FloatArray, base_shape: tuple[int, int], offset_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    t = config.telemetry
    x, y = ((xy_px - np.array(base_shape[::-1]) / 2) * config.gsd_m).T
    up = np.radians(t.north_deg)  # heading of the base image's top
    east, north = x * np.cos(up) - y * np.sin(up), -x * np.sin(up) - y * np.cos(up)
    phi = np.radians(t.latitude_deg)
    metres_north = 111_132.95 - 559.85 * np.cos(2 * phi) + 1.175 * np.cos(4 * phi)
    metres_east = 111_412.88 * np.cos(phi) - 93.5 * np.cos(3 * phi) + 0.118 * np.cos(5 * phi)
    longitude = t.longitude_deg + (east + offset_m[0]) / metres_east
    return longitude, t.latitude_deg + (north + offset_m[1]) / metres_north


def _attitude(
    rotation: FloatArray, north_deg: float, offset_deg: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Yaw, pitch and roll in degrees of the rotations (n, 3, 3) camera -> base, as a gimbal reports them."""
    right, axis = rotation[:, :, 0], rotation[:, :, 2]
    yaw = np.degrees(np.arctan2(right[:, 1], right[:, 0])) + north_deg + offset_deg
    along = np.einsum("ni,ni->n", rotation[:, :, 1], np.array([0.0, 0.0, 1.0])[None])
    across = np.einsum("ni,ni->n", right, np.array([0.0, 0.0, 1.0])[None])
    tilt, roll = np.degrees(np.arctan2(along, axis[:, 2])), np.degrees(np.arctan2(across, axis[:, 2]))
    noise = rng.normal(0.0, 0.1, size=(3, len(yaw)))
    return (yaw + noise[0] + 180) % 360 - 180, -90 + tilt + noise[1], roll + noise[2]


def _subtitle(
    frame: int,
    times_s: FloatArray,
    focal: int,
    place: tuple[float, float],
    height_m: float,
    attitude: tuple[float, float, float],
) -> str:
    step_s = times_s[min(frame + 1, len(times_s) - 1)] - times_s[frame]
    clock = (_START + timedelta(seconds=float(times_s[frame]))).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]
    yaw, pitch, roll = attitude
    return (
        f'<font size="28">FrameCnt: {frame + 1}, DiffTime: {1000 * step_s:.0f}ms\n{clock}\n'
        f"[iso: 100] [shutter: 1/1000.0] [fnum: 2.8] [ev: 0] [color_md: default] [focal_len: {focal:.2f}] "
        f"[dzoom_ratio: 1.00] [latitude: {place[1]:.6f}] [longitude: {place[0]:.6f}] "
        f"[rel_alt: {height_m:.3f} abs_alt: {height_m + 121.4:.3f}] "
        f"[gb_yaw: {yaw:.1f} gb_pitch: {pitch:.1f} gb_roll: {roll:.1f}] </font>"
    )


def srt_text(subtitles: Iterable[str], times_s: FloatArray) -> str:
    """Subtitles as a file, a cue a frame."""
    ends = np.append(times_s[1:], times_s[-1] + 0.033)
    cues = zip(subtitles, times_s, ends, strict=True)
    return "\n".join(
        f"{k}\n{_stamp(start)} --> {_stamp(end)}\n{text}\n" for k, (text, start, end) in enumerate(cues, start=1)
    )


def _stamp(seconds: float) -> str:
    milliseconds = round(1000 * seconds)
    hours, rest = divmod(milliseconds, 3_600_000)
    return f"{hours:02d}:{rest // 60_000:02d}:{rest // 1000 % 60:02d},{rest % 1000:03d}"


class ClipWriter:
    """Encodes frames, in order, and their subtitles where they are embedded; see `open_clip`."""

    def __init__(self, container: Any, config: SimulationConfig, times_s: FloatArray, subtitles: list[str]) -> None:
        self._container, self._times_s, self._subtitles = container, times_s, subtitles
        self._video = container.add_stream("libx264", rate=round(config.times.fps))
        self._video.width, self._video.height, self._video.pix_fmt = config.width, config.height, "yuv420p"
        self._video.codec_context.time_base = _TIME_BASE
        # with B-frames, of which drones make none, x264 gives the same frames other bytes now and then
        self._video.options = {"crf": "16", "preset": "veryfast", "bf": "0"}
        self._text = container.add_stream("mov_text") if subtitles else None
        if self._text is not None:
            self._text.codec_context.subtitle_header = _ASS_HEADER
            self._text.time_base = Fraction(1, 1000)

    def write(self, frame: int, grey: NDArray[np.uint8]) -> None:
        """Encode the next frame."""
        picture = av.VideoFrame.from_ndarray(grey, format="gray").reformat(format="yuv420p")
        picture.time_base, picture.pts = _TIME_BASE, round(float(self._times_s[frame]) / _TIME_BASE)
        self._container.mux(self._video.encode(picture))
        if self._text is not None:
            self._container.mux(self._packet(frame))

    def _packet(self, frame: int) -> Any:
        text = self._subtitles[frame].encode()
        packet = av.Packet(len(text).to_bytes(2, "big") + text)
        packet.stream, packet.time_base = self._text, Fraction(1, 1000)
        packet.pts = packet.dts = round(1000 * float(self._times_s[frame]))
        packet.duration = 33
        return packet

    def close(self) -> None:
        """Encode what is left."""
        self._container.mux(self._video.encode())


@contextmanager
def open_clip(out: Path, config: SimulationConfig, times_s: FloatArray, subtitles: list[str]) -> Iterator[ClipWriter]:
    """The writer of ``DJI_0001.MP4`` in a folder; its subtitles go into it, or into ``DJI_0001.SRT`` beside it."""
    if config.clip == "beside":
        (out / SUBTITLE_NAME).write_text(srt_text(subtitles, times_s), encoding="utf-8")
    metadata = {"creation_time": _START.isoformat(), "encoder": "velfield simulate"}
    with av.open(str(out / CLIP_NAME), "w", format="mp4") as container:
        container.metadata.update(metadata)
        writer = ClipWriter(container, config, times_s, subtitles if config.clip == "embedded" else [])
        yield writer
        writer.close()
