"""Inputs are local files: addresses and protocols are refused before any library sees them."""

import re
from pathlib import Path

from velfield.errors import InputError

# Two letters or more before the colon: "C:\flight.mp4" is a path. A Path keeps one slash of "http://".
_PROTOCOL = re.compile(r"^([A-Za-z][A-Za-z0-9+.\-]+):")


def local_path(path: Path | str, what: str) -> Path:
    """Resolve `path` to an existing file or folder of this machine.

    Parameters
    ----------
    path
        As given by the user.
    what
        What it is, for the message: "video or image folder", "base image".

    Returns
    -------
    Absolute path: no library can take it for a protocol (``concat:``, ``http:``) or an option.

    Raises
    ------
    InputError
        It is an address, or nothing is there.
    """
    text = str(path)
    if "\0" in text:
        raise InputError(f"found a {what} path with a NUL in it, expected a path; fix the path")
    protocol = _PROTOCOL.match(text)
    if protocol and not Path(text).exists():
        raise InputError(
            f"found {text!r} as {what}: the protocol {protocol[1]!r} is refused, expected a local path; fetch it first"
        )
    try:
        return Path(text).resolve(strict=True)
    except (OSError, RuntimeError) as error:
        raise InputError(f"found no {what} at {text!r} ({_why(error)}), expected an existing path; check it") from None


def _why(error: Exception) -> str:
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)
