"""Instructions on vectors for numba's intrinsics, where numba alone makes loops over single values: it does not know
that arrays do not overlap.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

BYTE, WORD, LONG = (ir.IntType(bits) for bits in (8, 32, 64))
REAL = ir.FloatType()
"""Types of values in vectors: integers of 8, 32 and 64 bits, with a sign or without, and float32."""


class Place(NamedTuple):
    """A place in an array: its address, and the type of the array's values, which a pointer need not tell."""

    address: Any
    element: Any


class Vectors:
    """Builds instructions on vectors of ``lanes`` values where the builder of a numba intrinsic stands.

    No sum is reordered, and no product fused but by `multiply_add`, so that all processors agree to the bit.

    Parameters
    ----------
    context, build, signature, arguments
        Arguments that numba passes to an intrinsic's code generator.
    lanes
        Values in a vector, a power of two. LLVM makes of a vector as many of the processor's as it needs.

    Attributes
    ----------
    build
        The builder itself, for instructions that are the same on vectors: ``v.build.fadd(one, other)``.
    lanes
        As given.
    arguments
        Arguments of the intrinsic: the `Place` of the first value of each array, all else unchanged.
    """

    def __init__(self, context: Any, build: Any, signature: Any, arguments: Any, lanes: int) -> None:
        self.build, self.lanes = build, lanes
        self.arguments = [
            self._first(context, kind, value) if isinstance(kind, types.Array) else value
            for kind, value in zip(signature.args, arguments, strict=True)
        ]

    def _first(self, context: Any, kind: types.Array, value: Any) -> Place:
        data = cgutils.create_struct_proxy(kind)(context, self.build, value).data
        return Place(data, context.get_data_type(kind.dtype))

    def kind(self, element: Any) -> Any:
        """The type of a vector of such elements."""
        return ir.VectorType(element, self.lanes)

    def constant(self, element: Any, values: Any) -> Any:
        """A vector of one number, or of as many as there are lanes; ValueError: of another number of them."""
        return ir.Constant(self.kind(element), list(np.broadcast_to(values, self.lanes).tolist()))

    def spread(self, value: Any) -> Any:
        """The same value in every lane."""
        first = self.build.insert_element(ir.Constant(self.kind(value.type), ir.Undefined), value, WORD(0))
        return self.build.shuffle_vector(first, first, self.constant(WORD, 0))

    def join(self, parts: Sequence[Any]) -> Any:
        """One vector of a power of two of vectors of one length, in this order; ValueError: of another number."""
        while len(parts) > 1:
            size = 2 * parts[0].type.count
            order = ir.Constant(ir.VectorType(WORD, size), list(range(size)))
            pairs = zip(parts[::2], parts[1::2], strict=True)
            parts = [self.build.shuffle_vector(one, other, order) for one, other in pairs]
        return parts[0]

    def place(self, start: Place, *offsets: Any) -> Place:
        """The place by the sum of these offsets further on: numbers or 64-bit values, each in values of the array."""
        address = start.address
        for offset in offsets:
            step = LONG(offset) if isinstance(offset, int) else offset
            address = self.build.gep(address, [step], source_etype=start.element)
        return Place(address, start.element)

    def load(self, start: Place, *offsets: Any, kind: Any = None) -> Any:
        """Load what lies at the `place` of the same arguments; it need not be aligned.

        It is a vector of the array's values, unless the type of something else is given as ``kind``.
        """
        address = self.place(start, *offsets).address
        return self.build.load(address, align=1, typ=kind or self.kind(start.element))

    def store(self, value: Any, start: Place, *offsets: Any) -> None:
        """Store a value at the `place` of the same arguments; it need not be aligned."""
        address = self.place(start, *offsets).address
        self.build.store(value, self.build.bitcast(address, value.type.as_pointer()), align=1)

    def add(self, value: Any, start: Any, *offsets: Any) -> None:
        """Add a vector of reals to what is stored at a `place`."""
        self.store(self.build.fadd(self.load(start, *offsets), value), start, *offsets)

    def call(self, name: str, *values: Any, returns: Any = None) -> Any:
        """An instruction ``llvm.<name>`` on vectors of one type, which it returns unless another type is given."""
        kind = values[-1].type
        declared = ir.FunctionType(returns or kind, [value.type for value in values])
        full = f"llvm.{name}.v{kind.count}{kind.element.intrinsic_name}"
        return self.build.call(cgutils.get_or_insert_function(self.build.module, declared, full), values)

    def multiply_add(self, one: Any, other: Any, total: Any) -> Any:
        """The product of two vectors of reals, added to a third unless it is None.

        Both are rounded at once on processors with fused multiplication and addition, the product first on others.
        """
        return self.build.fmul(one, other) if total is None else self.call("fmuladd", one, other, total)
