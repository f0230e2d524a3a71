"""Instructions on vectors for numba's intrinsics, where numba alone makes loops over single values: it does not know
that arrays do not overlap.
"""

from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.core import cgutils

_WORD, LONG = ir.IntType(32), ir.IntType(64)


class Place(NamedTuple):
    """A place in an array: its address, and the type of the array's values, which a pointer may lack."""

    address: Any
    element: Any


class Vectors:
    """Builds instructions on vectors of ``lanes`` values where the builder of a numba intrinsic stands.

    No sum is reordered, and no product fused with it.

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

    def spread(self, value: Any) -> Any:
        """The same value in every lane."""
        first = self.build.insert_element(ir.Constant(self.kind(value.type), ir.Undefined), value, _WORD(0))
        return self.build.shuffle_vector(first, first, ir.Constant(ir.VectorType(_WORD, self.lanes), [0] * self.lanes))

    def place(self, start: Place, *offsets: Any) -> Place:
        """The place by the sum of these offsets further on: numbers or 64-bit values, each in values of the array."""
        address = start.address
        for offset in offsets:
            step = LONG(offset) if isinstance(offset, int) else offset
            address = self.build.gep(address, [step], source_etype=start.element)
        return Place(address, start.element)

    def load(self, start: Place, *offsets: Any) -> Any:
        """Load the vector at the `place` of the same arguments; it need not be aligned."""
        return self.build.load(self.place(start, *offsets).address, align=1, typ=self.kind(start.element))

    def store(self, value: Any, start: Place, *offsets: Any) -> None:
        """Store a value at the `place` of the same arguments; it need not be aligned."""
        address = self.place(start, *offsets).address
        self.build.store(value, self.build.bitcast(address, value.type.as_pointer()), align=1)

    def add(self, value: Any, start: Any, *offsets: Any) -> None:
        """Add a vector of reals to what is stored at a `place`."""
        self.store(self.build.fadd(self.load(start, *offsets), value), start, *offsets)
