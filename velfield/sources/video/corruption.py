"""Damage in a bitstream, known from libav's log alone: decoders hide it and return a picture for every frame.

What a damaged packet spoils is every frame decoded after it until the next key frame, which is not the same as every
frame shown after it. So the log is kept in the order of decoding, and a frame is asked about when it comes out.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import av.logging

# At this level h264 and mpeg4 say "concealing ... errors" of pictures whose slices ended too soon, and no error.
_LEVEL = av.logging.DEBUG
_CONCEALED = "concealing"
# Said of sound files too: odd side data of cameras, not pictures.
_HARMLESS = (
    "SEI",
    "skipping unregistered",
    "Could not find codec parameters",
    "timescale not set",
    "unsupported color",
)

# The first bytes of a burst often decode without a word: so many frames before the first error are suspect, too.
_MARGIN = 4

_lock = threading.Lock()
_users = 0
_before: tuple[int | None, bool] = (None, True)


@contextmanager
def libav_log() -> Iterator[None]:
    """Let libav talk while frames are read, and no longer. Its level is the whole process's, so users are counted."""
    global _users, _before
    with _lock:
        if _users == 0:
            _before = (av.logging.get_level(), av.logging.get_skip_repeated())
            av.logging.set_level(_LEVEL)
            av.logging.set_skip_repeated(False)  # the same damage twice is twice damage
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0:
                av.logging.set_level(_before[0])
                av.logging.set_skip_repeated(_before[1])


@contextmanager
def captured_errors() -> Iterator[list[str]]:
    """Collect the errors that libav logs on this thread meanwhile; the list is filled when the block ends."""
    errors: list[str] = []
    with av.logging.Capture(local=True) as lines:
        try:
            yield errors
        finally:
            errors += [message.strip() for level, _, message in lines if _is_error(level, message)]


def _is_error(level: int, message: str) -> bool:
    if message.startswith(_CONCEALED):
        return True
    return level <= av.logging.ERROR and not any(words in message for words in _HARMLESS)


class DamageLog:
    """Which frames are spoilt, given the packets in decoding order and the errors as they are logged.

    Attributes
    ----------
    last_error
        What libav said last, for the message.
    """

    def __init__(self, *, lasting: bool = False, midway: bool = False) -> None:
        self.last_error = ""
        self.lasting = lasting  # frames known by their order alone: after a loss nobody knows which is which
        self._midway = midway  # entered at a later key frame: it bids the decoder forget pictures that it never saw
        self._count = 0
        self._group = 0  # counted by key frames; group 0 stands before the first one and cannot be decoded
        self._key_index = -1
        self._first_error: dict[int, int] = {0: 0}
        self._place: dict[int, tuple[int, int, bool]] = {}
        self._key_of: dict[int, int] = {}
        self._gradual = False

    def feed(self, packet: Any, index: int | None) -> None:
        """A packet, that of frame `index`, is about to be decoded."""
        self._count += 1
        if packet.is_keyframe and packet.size:
            self._group += 1
            self._key_index = -1 if index is None else index
            self._key_of[self._group] = self._key_index
        if index is not None:
            # Shown before the key frame it follows in the file: it may lean on the group before, too.
            self._place[index] = (self._count, self._group, index < self._key_index)

    def mark(self, message: str) -> None:
        """Something was logged while the last packet was decoded."""
        if self._midway and self._group == 1 and message.startswith("mmco"):
            return
        self.last_error = message
        self._first_error.setdefault(self._group, self._count - _MARGIN)

    def mark_frame(self, index: int) -> None:
        """Frame `index` came out marked as corrupt."""
        place = self._place.get(index)
        self.last_error = self.last_error or "marked as corrupt by the decoder"
        if place is not None:
            count, group, _ = place
            self._first_error[group] = min(count - _MARGIN, self._first_error.get(group, count))

    def mark_break(self, index: int) -> None:
        """Frame `index` holds blocks that nothing led up to. On a key frame after damage that is the repair."""
        group = self._place.get(index, (0, self._group, False))[1]
        at_key = index == self._key_of.get(group)
        if at_key and group > 1:
            if group - 1 in self._first_error:
                return
            self._first_error[group - 1] = 0  # either of the two may be the wrong one
        self.mark_frame(index)
        self.last_error = "blocks that the frame before does not lead up to"

    def mark_lost(self, index: int) -> None:
        """A frame shown before frame `index` never came out: what came after it may lean on it."""
        place = self._place.get(index)
        self.last_error = self.last_error or "a frame was lost"
        if place is not None:
            self._first_error.setdefault(place[1], 0)

    def is_suspect(self, index: int) -> bool:
        """Whether frame `index` may be wrong, by what is known up to now."""
        # Where packets carry no time of their own (AVI), the frame's is not known: then any damage since the key frame
        # before the last one counts.
        count, group, leading = self._place.get(index, (self._count, self._group, True))
        if self.lasting and len(self._first_error) > 1:
            return True
        own = group in self._first_error and count >= self._first_error[group]
        return own or ((leading or self._gradual) and group - 1 in self._first_error)

    def note_key_picture(self, is_intra: bool) -> None:
        """A key frame came out. One that is no intra picture starts a gradual refresh, whole only at the next one."""
        self._gradual = self._gradual or not is_intra
