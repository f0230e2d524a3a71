"""Read the telemetry of a source: subtitles or MISB KLV in the video or beside it, tags of the images."""

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from velfield.errors import Failure, InputError
from velfield.sources.folder import list_images
from velfield.sources.frames import SourceInfo, local_path
from velfield.sources.telemetry.find import note_unusable
from velfield.sources.telemetry.flight_log import is_flight_log, parse_flight_log
from velfield.sources.telemetry.image_tags import read_image_telemetry
from velfield.sources.telemetry.klv import KLV_KEY, KLV_SUFFIX, NEEDS_KLV, parse_klv
from velfield.sources.telemetry.srt import parse_srt, telemetry_from_cues
from velfield.sources.telemetry.telemetry import Telemetry
from velfield.sources.video.corruption import libav_log
from velfield.sources.video.packets import iter_packets, open_video, video_stream

MAX_IMAGES = 200
"""Maximum number of a folder's images whose tags are read, evenly spread: only the headers are read."""
_MAX_BYTES, _HEAD_BYTES = 256 * 2**20, 2**16
NOT_READ = "is not read"
"""In a failure: the source holds telemetry all the same, in a format of `_NOT_READ`."""
_KLV_NAMES = ("klv", "smpte_klv")
_NOT_READ = {"djmd": "DJI's binary telemetry (djmd)", "gpmd": "GoPro's telemetry (gpmd)"}
"""Streams of data that hold telemetry, which no kept and light library reads."""
_ISO6709 = re.compile(r"([-+]\d+(?:\.\d+)?)([-+]\d+(?:\.\d+)?)([-+]\d+(?:\.\d+)?)?")


def read_telemetry(source: Path, info: SourceInfo, given: Path | None = None) -> Telemetry | Failure:
    """The telemetry of a video or folder of images, from the file given (`read_telemetry_file`), else from itself.

    Raises
    ------
    InputError
        The file given cannot be read or holds no telemetry.
    """
    if given is not None:
        return read_telemetry_file(given, info)
    if info.kind == "folder":
        return _from_images(source, info)
    return _from_video(source)


def read_telemetry_file(path: Path, info: SourceInfo) -> Telemetry:
    """The telemetry of a source in a file: subtitles; a flight log; or, by the suffix ``.klv`` or its key, MISB KLV.

    Raises
    ------
    InputError
        It cannot be read or holds no telemetry.
    """
    file = local_path(path, "telemetry")
    if file.stat().st_size > _MAX_BYTES:
        raise InputError(f"{file.name}: found {file.stat().st_size >> 20} MiB, expected telemetry; check it")
    data = file.read_bytes()
    if file.suffix.lower() == KLV_SUFFIX or KLV_KEY in data[:_HEAD_BYTES]:
        found = parse_klv(data, file.name)
    elif is_flight_log(text := data.decode("utf-8-sig", "replace")):
        found = parse_flight_log(text, file.name, float(info.times_s[-1] - info.times_s[0]))
    else:
        found = parse_srt(text, file.name)
    if isinstance(found, Failure):
        raise InputError(f"{found.reason}; omit it, or give the drone's own .SRT, .klv or log as CSV")
    return found


def _from_images(folder: Path, info: SourceInfo) -> Telemetry | Failure:
    names = info.names or list_images(folder)
    step = -(-len(names) // MAX_IMAGES)
    records, notes = [], dict[str, None]()
    for index in range(0, len(names), step):
        try:
            tags, more = read_image_telemetry(folder / names[index])
        except InputError:
            continue  # the frame itself is reported where it is decoded
        if set(tags) - {"clock_s", "focal_35mm", "zoom"}:
            records.append((float(info.times_s[index] - info.times_s[0]), tags))
            notes |= dict.fromkeys(more)
    if not records:
        return Failure("the images have no position, height or attitude in EXIF or XMP")
    return Telemetry.from_records("the images' EXIF and XMP", records, list(notes))


def _from_video(path: Path) -> Telemetry | Failure:
    with libav_log(), ExitStack() as stack:
        container = stack.enter_context(open_video(path))
        unread = [what for stream in container.streams if (what := _unread_format(stream))]
        texts = [stream for stream in container.streams.subtitles if _is_text(stream)]
        klv = [stream for stream in container.streams.data if _has_format(stream, _KLV_NAMES)]
        found: Telemetry | Failure = Failure(
            note_unusable(path) or "the video has no subtitles, and there is no .SRT file next to it"
        )
        if texts:
            found = telemetry_from_cues(_embedded_cues(container, texts[0]), f"the subtitles of {path.name}")
        elif klv:
            found = _from_klv(container, klv[0], path)
        place = _place(container)
    if isinstance(found, Telemetry):
        return found
    if unread:
        found = Failure(f"{found.reason}; its {unread[0]} {NOT_READ}: write an .SRT from it, or give --gsd-m")
    if place is None:
        return found
    return Telemetry.from_records(f"the header of {path.name}", [(0.0, place)], [found.reason])


def _is_text(stream: Any) -> bool:
    return stream.codec_context is not None and stream.codec_context.name in ("mov_text", "subrip", "srt", "text")


def _unread_format(stream: Any) -> str | None:
    return next((name for key, name in _NOT_READ.items() if _has_format(stream, (key,))), None)


def _has_format(stream: Any, keys: Sequence[str]) -> bool:
    """Whether the codec, its tag or the handler of a stream has one of these names."""
    tag = str(stream.metadata.get("handler_name", "")).lower()
    codec = stream.codec_context.name if stream.codec_context is not None else getattr(stream, "name", None) or ""
    four = getattr(stream.codec_context, "codec_tag", "") if stream.codec_context is not None else ""
    return any(key in (codec, str(four).lower()) or key in tag for key in keys)


def _from_klv(container: Any, stream: Any, path: Path) -> Telemetry | Failure:
    """By the time stamps of the stream's packets: a set may begin in one and end in the next."""
    parts, times_s, size = [], dict[int, float](), 0
    for packet, _ in iter_packets(container, stream):
        stamp = packet.pts if packet.pts is not None else packet.dts
        if packet.size and stamp is not None and size < _MAX_BYTES:
            parts.append(bytes(packet))
            times_s[size] = float(stamp * packet.time_base)
            size += packet.size
    video, origin = video_stream(container, path), f"the MISB KLV of {path.name}"
    first_s = float((video.start_time or 0) * video.time_base)  # an MPEG-TS does not begin at 0
    try:
        return parse_klv(b"".join(parts), origin, {at: time_s - first_s for at, time_s in times_s.items()})
    except InputError:
        return Failure(f"{origin} {NOT_READ}: it {NEEDS_KLV}, or give --gsd-m")


def _embedded_cues(container: Any, stream: Any) -> Iterator[tuple[float, str]]:
    for packet, _ in iter_packets(container, stream):
        if packet.pts is None or packet.size == 0:
            continue
        data = bytes(packet)
        if stream.codec_context.name == "mov_text":  # two bytes of length, the text, boxes of style
            data = data[2 : 2 + int.from_bytes(data[:2], "big")]
        yield float(packet.pts * packet.time_base), data.decode("utf-8", "replace")


def _place(container: Any) -> dict[str, float] | None:
    """Longitude and latitude in the container's header (ISO 6709)."""
    names = ("com.apple.quicktime.location.ISO6709", "location", "location-eng")
    text = next((container.metadata[name] for name in names if name in container.metadata), "")
    match = _ISO6709.match(text)
    if match is None or float(match[1]) == float(match[2]) == 0.0:
        return None
    return {"latitude_deg": float(match[1]), "longitude_deg": float(match[2])}
