"""Open a video and read its packets, safely and past corrupt ones."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av

from velfield.errors import InputError
from velfield.sources.video.corruption import capture_errors

# Demuxers that read this one file: playlists (HLS, ffconcat, SDP, image patterns) could name other files or hosts.
_FORMATS = "mov,mp4,avi,matroska,webm,mpegts,mpeg,h264,hevc,m4v,mpegvideo,flv,mxf,asf,ogg,nut,ivf,av1,obu,dv,gif"
_OPTIONS = {"protocol_whitelist": "file", "format_whitelist": _FORMATS}
_MAX_ERRORS = 100


def open_video(path: Path) -> Any:
    """Open for reading; only local files, only demuxers that read this one file."""
    try:
        with capture_errors():
            return av.open(str(path), mode="r", options=_OPTIONS, metadata_errors="replace")
    except (av.error.FFmpegError, OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{path.name}: could not be opened as video ({why}), expected MP4, MOV, AVI, MKV, TS or the like, whole; "
            "give a video or a folder of images"
        ) from None


def video_stream(container: Any, path: Path) -> Any:
    """The first video stream that is no cover image or thumbnail (DJI files hold both)."""
    streams = list(container.streams.video)
    videos = [stream for stream in streams if not int(stream.disposition) & int(av.stream.Disposition.attached_pic)]
    if not videos:
        raise InputError(f"{path.name}: found no video stream, expected one; give a video or a folder of images")
    if videos[0].codec_context is None:
        raise InputError(
            f"{path.name}: found a video stream without a decoder, expected H.264, HEVC or the like; convert it"
        )
    return videos[0]


def iter_packets(container: Any, stream: Any) -> Iterator[tuple[Any, list[str]]]:
    """Packets of a stream, each with the demuxer's errors; continues after corrupt data."""
    packets, failures = iter(container.demux(stream)), 0
    while failures < _MAX_ERRORS:
        errors: list[str] = []
        try:
            with capture_errors() as errors:
                packet = next(packets, None)
        except (av.error.FFmpegError, OSError, IndexError):  # IndexError: PyAV, where corruption makes up a stream
            packets, failures = iter(container.demux(stream)), failures + 1
            continue
        if packet is None:
            return
        yield packet, errors
