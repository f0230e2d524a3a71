"""Instructions on vectors of values, for loops that numba alone leaves to single values."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

BYTE, SHORT, WORD, LONG = (ir.IntType(bits) for bits in (8, 16, 32, 64))
REAL, DOUBLE = ir.FloatType(), ir.DoubleType()


class Vectors:
    """Builds instructions on vectors of ``lanes`` values within a numba intrinsic.

    Numba does not know that arrays do not overlap, and makes loops over single values where several are written. No sum
    is reordered and no product fused, so that all processors agree to the bit.
    """

    def __init__(self, context: Any, build: Any, signature: Any, arguments: Any, lanes: int) -> None:
        self.build, self.lanes = build, lanes
        self.arguments = [
            cgutils.create_struct_proxy(kind)(context, build, value).data if isinstance(kind, types.Array) else value
            for kind, value in zip(signature.args, arguments, strict=True)
        ]
        """Of the intrinsic: pointers to the first value of arrays, all else as it is."""

    def kind(self, element: Any) -> Any:
        """The type of a vector of such elements."""
        return ir.VectorType(element, self.lanes)

    def constant(self, element: Any, values: Any) -> Any:
        """A vector of one number, or of as many as there are lanes."""
        return ir.Constant(self.kind(element), list(np.broadcast_to(values, self.lanes).tolist()))

    def spread(self, value: Any) -> Any:
        """The same value in every lane."""
        first = self.build.insert_element(ir.Constant(self.kind(value.type), ir.Undefined), value, WORD(0))
        return self.build.shuffle_vector(first, first, self.constant(WORD, 0))

    def place(self, start: Any, *offsets: Any) -> Any:
        """Pointer to the vector at the sum of these offsets, numbers or 64-bit values."""
        for offset in offsets:
            start = self.build.gep(start, [LONG(offset) if isinstance(offset, int) else offset])
        return self.build.bitcast(start, self.kind(start.type.pointee).as_pointer())

    def load(self, start: Any, *offsets: Any) -> Any:
        """The vector at the sum of these offsets; it need not be aligned."""
        loaded = self.build.load(self.place(start, *offsets))
        loaded.align = 1
        return loaded

    def store(self, value: Any, start: Any, *offsets: Any) -> None:
        """Store a vector at the sum of these offsets."""
        self.build.store(value, self.place(start, *offsets)).align = 1

    def add(self, value: Any, start: Any, *offsets: Any) -> None:
        """Add a vector of reals to what is stored there."""
        self.store(self.build.fadd(self.load(start, *offsets), value), start, *offsets)

    def call(self, name: str, *values: Any, returns: Any = None) -> Any:
        """An instruction ``llvm.<name>`` on vectors of one type, which it returns unless another type is given."""
        kind = values[-1].type
        short = {BYTE: "i8", SHORT: "i16", WORD: "i32", LONG: "i64", REAL: "f32", DOUBLE: "f64"}[kind.element]
        declared = ir.FunctionType(returns or kind, [value.type for value in values])
        full = f"llvm.{name}.v{self.lanes}{short}"
        return self.build.call(cgutils.get_or_insert_function(self.build.module, declared, full), values)
