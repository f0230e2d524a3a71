"""Opening a video and reading its packets, safely, past damaged places."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av

from velfield.errors import InputError
from velfield.sources.video.corruption import captured_errors

# Demuxers that read what stands in the file and nothing else: playlists (HLS, ffconcat, SDP, image patterns) could name
# other files or hosts.
_FORMATS = "mov,mp4,avi,matroska,webm,mpegts,mpeg,h264,hevc,m4v,mpegvideo,flv,mxf,asf,ogg,nut,ivf,av1,obu,dv,gif"
_OPTIONS = {"protocol_whitelist": "file", "format_whitelist": _FORMATS}
_MAX_STUMBLES = 100


def open_video(path: Path) -> Any:
    """Open for reading; only local files, only demuxers that read this one file."""
    try:
        with captured_errors():
            return av.open(str(path), mode="r", options=_OPTIONS, metadata_errors="replace")
    except (av.error.FFmpegError, OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{path.name}: could not be opened as video ({why}), expected MP4, MOV, AVI, MKV, TS or the like, whole; "
            "give a video or a folder of pictures"
        ) from None


def video_stream(container: Any, path: Path) -> Any:
    """The first stream that is a film, not a cover picture or a thumbnail (DJI files hold both)."""
    streams = list(container.streams.video)
    films = [stream for stream in streams if not int(stream.disposition) & int(av.stream.Disposition.attached_pic)]
    if not films:
        raise InputError(f"{path.name}: found no video stream, expected one; give a video or a folder of pictures")
    if films[0].codec_context is None:
        raise InputError(
            f"{path.name}: found a video stream without a decoder, expected H.264, HEVC or the like; convert it"
        )
    return films[0]


def demuxed(container: Any, stream: Any) -> Iterator[tuple[Any, list[str]]]:
    """Packets of a stream, each with what the demuxer complained of; goes on behind a damaged place."""
    packets, stumbles = iter(container.demux(stream)), 0
    while stumbles < _MAX_STUMBLES:
        errors: list[str] = []
        try:
            with captured_errors() as errors:
                packet = next(packets, None)
        except (av.error.FFmpegError, OSError, IndexError):  # IndexError: PyAV, where damage makes up a stream
            packets, stumbles = iter(container.demux(stream)), stumbles + 1
            continue
        if packet is None:
            return
        yield packet, errors
