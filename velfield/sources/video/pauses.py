"""Decoders that wait where one part of a flight ends, for the part that begins there.

A part is decoded from the key frame before it on: where these are ten seconds apart, as programs that cut and convert
write them, most frames would be decoded twice or more. So parts that a process reads one after the other share a
decoder, and a part whose beginning is being reached by another waits for it.
"""

import threading
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.arrays import IntArray
from velfield.sources.frames import SourceFrame

FileState = tuple[Path, int, int]
"""A file, its size and time of change."""
_LONGEST_WAIT_S, _KEPT_S = 120.0, 10.0
"""How long a part waits for another at most, and a decoder for a part: it holds its threads and pictures."""


def file_state(path: Path) -> FileState | None:
    """State of a file; None of one that is gone."""
    try:
        found = path.stat()
    except OSError:
        return None
    return path, found.st_size, found.st_mtime_ns


@dataclass(frozen=True)
class Pause:
    """A decoder of ``file`` behind the frame ``last``, which goes on to the frames ``left``."""

    file: FileState
    last: SourceFrame
    left: IntArray
    frames: Generator[SourceFrame, None, None]


class Pauses:
    """The decoder of this process that waits, and the parts that are being read."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._being_read: list[tuple[FileState, int]] = []
        self._paused: Pause | None = None

    def announce(self, file: FileState, last: int) -> None:
        """Say that a part is being read that ends with the frame ``last``, behind which its decoder will wait."""
        with self._changed:
            self._being_read.append((file, last))

    def end(self, file: FileState, last: int, pause: Pause | None) -> None:
        """Take an announcement back; ``pause``: the decoder, None where the part was not read to its end."""
        with self._changed:
            self._being_read.remove((file, last))
            old = self._paused
            if pause is not None:
                self._paused = pause
            self._changed.notify_all()
        if pause is None:
            return
        if old is not None:
            old.frames.close()
        timer = threading.Timer(_KEPT_S, self._drop, [pause])
        timer.daemon = True
        timer.start()

    def take(self, file: FileState, asked: IntArray) -> Pause | None:
        """The decoder that waits behind the first of the frames ``asked`` and goes on to the others; one that is on its
        way there is waited for."""
        with self._changed:
            self._changed.wait_for(lambda: (file, int(asked[0])) not in self._being_read, _LONGEST_WAIT_S)
            found = self._paused
            if found is None or found.file != file or found.last.source_index != asked[0]:
                return None
            if not np.array_equal(found.left, asked[1:]):
                return None
            self._paused = None
            return found

    def _drop(self, pause: Pause) -> None:
        """Close a decoder that nobody has taken."""
        with self._changed:
            if self._paused is not pause:
                return
            self._paused = None
        pause.frames.close()
