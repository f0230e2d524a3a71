"""What goes wrong, in two kinds: the user's input, and a frame or chunk that cannot be done; and two warnings."""

from dataclasses import dataclass


class InputError(Exception):
    """Bad input or configuration. The message is one line: what was found, what was expected, what to do."""


class OldNameWarning(FutureWarning):
    """A name of an earlier format was given; it is read for this release. The message says the present name."""


class IneffectiveSettingWarning(UserWarning):
    """A setting that the chosen method does not read. The message says which setting chose the method."""


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
