"""Fields on one grid add and subtract, exactly: ``merge(a, subtract(b, a)) == b`` to the bit.

The field of a whole is the sum of the fields of its parts as long as no track is split between parts.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from velfield.errors import InputError
from velfield.field.accumulate import FieldTile

_LARGEST = np.iinfo(np.int32).max


def merge_tiles(tiles: Sequence[FieldTile]) -> FieldTile:
    """The sum of tiles of the same pixels.

    Raises
    ------
    InputError
        The tiles differ in shape, or a sum does not fit 32 bits.

    Examples
    --------
    >>> pixel = np.ones((1, 1), np.int32)
    >>> one = FieldTile(np.ones((1, 1, 3, 3), np.int32), pixel, pixel, pixel)
    >>> merge_tiles([one, one]).count
    array([[2]], dtype=int32)
    """
    if not tiles:
        raise ValueError("merge_tiles needs at least one tile")
    total = tiles[0]
    for tile in tiles[1:]:
        total = FieldTile(*(_sum(a, b, name) for a, b, name in _layers(total, tile)))
    return total


def subtract_tile(whole: FieldTile, part: FieldTile) -> FieldTile:
    """The difference ``whole - part``.

    Raises
    ------
    InputError
        The tiles differ in shape, or ``part`` exceeds ``whole``, so is no part of it.
    """
    return FieldTile(*(_difference(a, b, name) for a, b, name in _layers(whole, part)))


def _layers(one: FieldTile, other: FieldTile) -> Iterator[tuple[NDArray[np.int32], NDArray[np.int32], str]]:
    """The layers of two tiles, and their names."""
    for a, b, name in zip(one, other, FieldTile._fields, strict=True):
        if a.shape != b.shape:
            raise InputError(
                f"the fields' {name} differ in shape, {a.shape} and {b.shape}: they must share grid and bins"
            )
        yield a, b, name


def _sum(a: NDArray[np.int32], b: NDArray[np.int32], name: str) -> NDArray[np.int32]:
    # Neither is negative, so a sum that overflows is below a summand.
    total = a + b
    if (total < a).any():
        raise InputError(f"the sum of two fields' {name} exceeds {_LARGEST}, the maximum of int32: merge fewer")
    return total


def _difference(a: NDArray[np.int32], b: NDArray[np.int32], name: str) -> NDArray[np.int32]:
    if (b > a).any():
        raise InputError(
            f"the field to subtract holds more {name} than the whole at {int((b > a).sum())} positions: "
            "it is no part of it; subtract a field that was merged into this one"
        )
    return a - b
