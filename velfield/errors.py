"""Errors and warnings, and words of messages: bad input, a damaged run, a full disk, a frame or chunk that fails."""

import errno
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

_LONGEST = 1200
"""Characters of a message: what was found may itself be a megabyte on one line."""


class InputError(Exception):
    """Bad input or configuration. The message is one line: what was found, what was expected, what to do.

    Examples
    --------
    >>> print(InputError("a name\\nof two lines; give another"))
    a name of two lines; give another
    """

    def __init__(self, message: str) -> None:
        line = " ".join(message.splitlines()) if "\n" in message or "\r" in message else message
        half = _LONGEST // 2
        super().__init__(line if len(line) <= _LONGEST else f"{line[:half]} [...] {line[-half:]}")


class StoreError(RuntimeError):
    """A store or a file of a run is damaged or not as expected: names it, and the chunk."""


class IneffectiveSettingWarning(UserWarning):
    """A setting that the chosen method does not read. The message says which setting chose the method."""


class CacheWarning(RuntimeWarning):
    """Compiled code or settings are kept in a temporary folder. The message says where, and what to set."""


class DeviceWarning(RuntimeWarning):
    """The network does not run as fast as it was to on this machine. The message says why, and what to do."""


_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def is_disk_full(error: BaseException) -> bool:
    """Whether an error says that there is no room to write: nothing is gained by trying again at once.

    Examples
    --------
    >>> is_disk_full(OSError(28, "No space left on device")), is_disk_full(OSError(5, "Input/output error"))
    (True, False)
    """
    return isinstance(error, OSError) and error.errno in _FULL


def one_line(error: object) -> str:
    """An error of a library, or its message, in one line of at most 160 characters; its kind where it is empty.

    Examples
    --------
    >>> one_line(ValueError("two\\n   lines")), one_line(TimeoutError())
    ('two lines', 'TimeoutError')
    """
    return " ".join(str(error).split())[:160] or type(error).__name__


def count_text(n: float, noun: str) -> str:
    """A number, rounded, and its noun.

    Examples
    --------
    >>> count_text(1, "lane"), count_text(2, "lane"), count_text(0.9, "lane")
    ('1 lane', '2 lanes', '1 lane')
    """
    number = f"{n:.0f}"
    return f"{number} {noun}" if number == "1" else f"{number} {noun}s"


def parse_json(data: str | bytes) -> Any:
    """Parse JSON from an untrusted file.

    Raises
    ------
    ValueError
        It is not JSON, or arrays and objects lie too deep in each other.

    Examples
    --------
    >>> parse_json('{"a": 1}')
    {'a': 1}
    """
    try:
        return json.loads(data)
    except RecursionError:
        raise ValueError("arrays and objects lie too deep in each other") from None


@dataclass(frozen=True)
class Failure:
    """A result that could not be had, and why. Falsy, so that ``if not result`` reads as it should.

    Examples
    --------
    >>> bool(Failure("12 control points, 40 needed"))
    False
    """

    reason: str

    def __bool__(self) -> bool:
        return False


def list_text(names: Sequence[str], word: str = "and") -> str:
    """Names for people, with a word before the last.

    Examples
    --------
    >>> list_text(["N", "S", "W"]), list_text(["N", "S"], "or")
    ('N, S and W', 'N or S')
    """
    return f" {word} ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
