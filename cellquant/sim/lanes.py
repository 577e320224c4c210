"""Memory and bits for loops that the compiler turns into vector instructions.

Inner loops run over `LANES` entries with an unsigned index (a sign would need a branch) and write
to the stack only: of anything else the compiler cannot know that it is apart from what is read.
"""

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8


def _stack(kind: Any, native: Any) -> Any:
    def room(_: Any, modes: Any, fixed: Any, per_mode: Any) -> Any:
        size = LANES * (fixed.literal_value + per_mode.literal_value * len(modes))

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            place = cgutils.alloca_once(builder, native, ir.Constant(ir.IntType(64), size))  # type: ignore[no-untyped-call]
            place.align = 64
            return place

        pointer = types.CPointer(kind)  # type: ignore[no-untyped-call]
        return pointer(modes, fixed, per_mode), generate

    room.__doc__ = f"Stack for (fixed + per_mode len(modes)) LANES numbers of type {kind}."
    return intrinsic(prefer_literal=True)(room)


def _cast(source: Any, target: Any, native: Any) -> Any:
    def cast(_: Any, x: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.bitcast(args[0], native)

        return target(source), generate

    cast.__doc__ = f"Read the bits of a {source} as a {target}."
    return intrinsic(cast)


doubles = _stack(types.float64, ir.DoubleType())
singles = _stack(types.float32, ir.FloatType())
integers = _stack(types.int32, ir.IntType(32))
words = _stack(types.uint64, ir.IntType(64))
bits_of_double = _cast(types.float64, types.uint64, ir.IntType(64))
double_of_bits = _cast(types.uint64, types.float64, ir.DoubleType())
bits_of_single = _cast(types.float32, types.int32, ir.IntType(32))
single_of_bits = _cast(types.int32, types.float32, ir.FloatType())


def _bytes_of(_: Any, place: Any) -> Any:
    """Point to the single bytes of words on the stack."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(8).as_pointer())

    pointer = types.CPointer(types.uint8)  # type: ignore[no-untyped-call]
    return pointer(place), generate


def _trailing_zeros(_: Any, word: Any) -> Any:
    """Count the zero bits below the lowest one of a word that is not zero."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), generate


bytes_of: Any = intrinsic(_bytes_of)
trailing_zeros: Any = intrinsic(_trailing_zeros)
