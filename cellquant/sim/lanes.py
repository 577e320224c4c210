"""Vectors of numbers, each one register, for compiled code: 8 singles or 4 doubles.

A kernel that works on several cells, samples or crossings at once says so: it loads vectors, adds
and multiplies them, and stores them again. Nothing is left to the compiler's guess whether a loop
may become vector instructions, and the result does not depend on it.

A pair of registers may be one vector as well (`load_pair` and so on): the operations on one then
fill the waits of the other, which long chains of operations need.

Arithmetic between vectors and plain numbers spreads the number over all lanes. Comparisons give
masks, for `choose` and `bits`. Arrays are read and written at a flat index, contiguous and without
a check of bounds; numbers that lie scattered are read and written four at a time by `gathers`.
"""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

LANES = 8  # singles in a vector, and cells of a tile
QUAD = 4  # doubles in a vector
LINE = 64  # bytes of a cache line
CONTRACT = ("contract", "nsz")  # products and sums may be fused; nothing else is reordered
LOOSE = ("contract", "nsz", "arcp", "afn", "reassoc", "nnan", "ninf")


def zeros(*shape: int, kind: Any = np.float64) -> Any:
    """Array of zeros that starts on a cache line, so that few vectors lie across two of them."""
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    room = np.zeros(size + LINE, np.uint8)
    start = -room.ctypes.data % LINE
    return room[start : start + size].view(kind).reshape(shape)


class Vector(types.Type):
    """Numbers of one kind in a register; of booleans a mask."""

    def __init__(self, kind: Any, lanes: int) -> None:
        self.kind = kind
        self.lanes = lanes
        super().__init__(name=f"Vector({kind}, {lanes})")

    @property
    def native(self) -> Any:
        """The type of the compiler."""
        return ir.VectorType(NATIVE[self.kind], self.lanes)


NATIVE = {
    types.float64: ir.DoubleType(),
    types.float32: ir.FloatType(),
    types.boolean: ir.IntType(1),
}
DOUBLES, SINGLES = Vector(types.float64, QUAD), Vector(types.float32, LANES)
PAIRS = {kind: Vector(kind.kind, 2 * kind.lanes) for kind in (DOUBLES, SINGLES)}


@register_model(Vector)
class VectorModel(models.PrimitiveModel):
    """A vector is an LLVM vector."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, kind.native)  # type: ignore[no-untyped-call]


def _common(a: Any, b: Any) -> Any:
    """Type of a vector with a vector or a number, or None."""
    if isinstance(a, Vector) and isinstance(b, Vector):
        return a if a == b else None
    if isinstance(a, Vector) and isinstance(b, types.Number) and a.kind is not types.boolean:
        return a
    if isinstance(b, Vector) and isinstance(a, types.Number) and b.kind is not types.boolean:
        return b
    return None


def _spread(context: Any, builder: Any, value: Any, kind: Any, vector: Any) -> Any:
    """The same number in every lane; vectors stay what they are."""
    if isinstance(kind, Vector):
        return value
    value = context.cast(builder, value, kind, vector.kind)
    undefined = ir.Constant(vector.native, ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    return shuffle(builder, one, undefined, [0] * vector.lanes)


def shuffle(builder: Any, a: Any, b: Any, order: list[int]) -> Any:
    places = ir.Constant(ir.VectorType(ir.IntType(32), len(order)), order)
    return builder.shuffle_vector(a, b, places)


def _define(op: Any, generate: Callable[..., Any], *, mask: bool = False) -> None:
    """Teach the compiler a binary operator between vectors and numbers."""

    @type_callable(op)
    def typed(context: Any) -> Any:
        def typer(a: Any, b: Any) -> Any:
            common = _common(a, b)
            return Vector(types.boolean, common.lanes) if mask and common is not None else common

        return typer

    def lower(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        common = _common(*signature.args)
        a, b = (
            _spread(context, builder, value, kind, common)
            for value, kind in zip(args, signature.args, strict=True)
        )
        return generate(builder, a, b)

    for pair in ((Vector, Vector), (Vector, types.Number), (types.Number, Vector)):
        lower_builtin(op, *pair)(lower)  # type: ignore[no-untyped-call]


for ops, name in (
    ((operator.add, operator.iadd), "fadd"),
    ((operator.sub, operator.isub), "fsub"),
    ((operator.mul, operator.imul), "fmul"),
    ((operator.truediv, operator.itruediv), "fdiv"),
):
    for op in ops:
        _define(op, lambda builder, a, b, name=name: getattr(builder, name)(a, b, flags=CONTRACT))
for op, sign in (
    (operator.gt, ">"), (operator.ge, ">="), (operator.lt, "<"), (operator.le, "<="),
    (operator.ne, "!="), (operator.eq, "=="),
):  # fmt: skip
    _define(op, lambda builder, a, b, sign=sign: _compare(builder, sign, a, b), mask=True)
for op, name in ((operator.and_, "and_"), (operator.or_, "or_"), (operator.xor, "xor")):
    _define(op, lambda builder, a, b, name=name: getattr(builder, name)(a, b))


def _compare(builder: Any, sign: str, a: Any, b: Any) -> Any:
    if a.type.element == ir.IntType(1):
        return builder.xor(a, b) if sign == "!=" else builder.icmp_unsigned(sign, a, b)
    return builder.fcmp_ordered(sign, a, b)


@type_callable(operator.neg)
def _typed_neg(context: Any) -> Any:
    return lambda a: a if isinstance(a, Vector) and a.kind is not types.boolean else None


@lower_builtin(operator.neg, Vector)  # type: ignore[no-untyped-call]
def _neg(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    return builder.fneg(args[0], flags=CONTRACT)


def pointer(context: Any, builder: Any, array_type: Any, array: Any, at: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [at])


def kind_of(array: Any) -> Any:
    kinds = {types.float64: DOUBLES, types.float32: SINGLES}
    return kinds.get(array.dtype) if isinstance(array, types.Array) else None


def _loader(pair: bool) -> Any:
    def load(_: Any, array: Any, at: Any) -> Any:
        """The numbers from a flat index of an array on."""
        kind = PAIRS[kind_of(array)] if pair else kind_of(array)

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            place = pointer(context, builder, signature.args[0], args[0], args[1])
            size = NATIVE[kind.kind].get_abi_size(context.target_data)
            return builder.load(builder.bitcast(place, kind.native.as_pointer()), align=size)

        return kind(array, types.intp), generate

    return intrinsic(load)


def _store(_: Any, array: Any, at: Any, vector: Any) -> Any:
    """Put a vector at a flat index of an array, doubles also in single precision."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = pointer(context, builder, signature.args[0], args[0], args[1])
        size = NATIVE[array.dtype].get_abi_size(context.target_data)
        value = args[2]
        if array.dtype != vector.kind:
            value = builder.fptrunc(value, ir.VectorType(NATIVE[array.dtype], vector.lanes))
        builder.store(value, builder.bitcast(place, value.type.as_pointer()), align=size)
        return context.get_dummy_value()

    kinds = array.dtype, vector.kind
    known = kinds[0] == kinds[1] or kinds == (types.float32, types.float64)
    return types.void(array, types.intp, vector) if known else None, generate


def _peek(_: Any, array: Any, at: Any) -> Any:
    """The number at a flat index of an array, which is not counted from its end."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(pointer(context, builder, signature.args[0], args[0], args[1]))

    return array.dtype(array, types.intp), generate


def _poke(_: Any, array: Any, at: Any, value: Any) -> Any:
    """Put a number at a flat index of an array."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], pointer(context, builder, signature.args[0], args[0], args[1]))
        return context.get_dummy_value()

    return types.void(array, types.intp, array.dtype), generate


def _fetch(_: Any, array: Any, at: Any) -> Any:
    """Have the number at a flat index of an array brought close, for it is needed soon."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
        callee = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")  # type: ignore[no-untyped-call]
        place = pointer(context, builder, signature.args[0], args[0], args[1])
        builder.call(callee, [builder.bitcast(place, byte), word(0), word(3), word(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


def _choose(_: Any, mask: Any, a: Any, b: Any) -> Any:
    """Lane by lane a where the mask is true, else b."""
    common = _common(a, b)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        a_, b_ = (
            _spread(context, builder, value, kind, common)
            for value, kind in zip(args[1:], signature.args[1:], strict=True)
        )
        return builder.select(args[0], a_, b_)

    return common(mask, a, b), generate


def _extreme(sign: str) -> Any:
    def extreme(_: Any, a: Any, b: Any) -> Any:
        common = _common(a, b)

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            a_, b_ = (
                _spread(context, builder, value, kind, common)
                for value, kind in zip(args, signature.args, strict=True)
            )
            return builder.select(builder.fcmp_ordered(sign, a_, b_), a_, b_)

        return common(a, b), generate

    extreme.__doc__ = f"Lane by lane a where a {sign} b, else b."
    return intrinsic(extreme)


def _call(name: str, flags: tuple[str, ...] = CONTRACT) -> Any:
    def function(_: Any, a: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            native = args[0].type
            suffix = f"v{a.lanes}f{64 if a.kind is types.float64 else 32}"
            kind = ir.FunctionType(native, [native])
            callee = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
                builder.module, kind, f"llvm.{name}.{suffix}"
            )
            return builder.call(callee, args, fastmath=flags)

        return a(a), generate

    function.__doc__ = f"The {name} of every lane."
    return intrinsic(function)


def _rough_root(_: Any, a: Any) -> Any:
    """1 / sqrt of every lane, in single precision, positive and finite, to about 1e-7."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        native = args[0].type
        callee = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
            builder.module, ir.FunctionType(native, [native]), f"llvm.sqrt.v{a.lanes}f32"
        )
        root = builder.call(callee, args, fastmath=LOOSE)
        return builder.fdiv(ir.Constant(native, [1.0] * a.lanes), root, flags=LOOSE)

    return a(a) if a.kind is types.float32 else None, generate


def _halved_bits(_: Any, a: Any, constant: Any) -> Any:
    """Take half the bits of every lane, as a whole number, from a constant."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        whole = _whole(a)
        halves = builder.lshr(builder.bitcast(args[0], whole), ir.Constant(whole, [1] * a.lanes))
        number = ir.Constant(whole, [constant.literal_value] * a.lanes)
        return builder.bitcast(builder.sub(number, halves), args[0].type)

    return a(a, constant) if a.kind is types.float64 else None, generate


def _whole(kind: Any) -> Any:
    """Whole numbers as wide as the lanes of a vector."""
    return ir.VectorType(ir.IntType(64 if kind.kind is types.float64 else 32), kind.lanes)


def _signs(name: str) -> Any:
    def combine(_: Any, a: Any, b: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            left, right = (builder.bitcast(arg, _whole(a)) for arg in args)
            return builder.bitcast(getattr(builder, name)(left, right), a.native)

        return a(a, b) if a == b else None, generate

    combine.__doc__ = f"Lane by lane {name.strip('_')} of the bits, of which the sign is meant."
    return intrinsic(combine)


def _pick(_: Any, sign: Any, a: Any, b: Any) -> Any:
    """Lane by lane a where the sign is set, else b."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        a_, b_ = (
            _spread(context, builder, value, kind, sign)
            for value, kind in zip(args[1:], signature.args[1:], strict=True)
        )
        whole = _whole(sign)
        below = builder.icmp_signed("<", builder.bitcast(args[0], whole), ir.Constant(whole, None))
        return builder.select(below, a_, b_)

    return sign(sign, a, b), generate


def _widener(pair: bool) -> Any:
    kind = PAIRS[DOUBLES] if pair else DOUBLES

    def widen(_: Any, array: Any, at: Any) -> Any:
        """Doubles from a flat index of an array of singles on."""

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            place = pointer(context, builder, signature.args[0], args[0], args[1])
            narrow = ir.VectorType(ir.FloatType(), kind.lanes)
            value = builder.load(builder.bitcast(place, narrow.as_pointer()), align=4)
            return builder.fpext(value, kind.native)

        return kind(array, types.intp) if kind_of(array) == SINGLES else None, generate

    return intrinsic(widen)


def _spreader(kind: Any) -> Any:
    def spread(_: Any, x: Any) -> Any:
        """A number in all lanes."""

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return _spread(context, builder, args[0], signature.args[0], kind)

        return kind(x), generate

    return intrinsic(spread)


def _bits(_: Any, mask: Any) -> Any:
    """A mask as the low bits of a number, lane 0 the lowest."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(mask.lanes)), ir.IntType(64))

    return types.uint64(mask), generate


def _trailing_zeros(_: Any, word: Any) -> Any:
    """Count the zero bits below the lowest one of a word that is not zero."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.intp(types.uint64), generate


def _count_ones(_: Any, word: Any) -> Any:
    """Count the bits of a word that are set."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return types.intp(types.uint64), generate


load: Any = _loader(False)
load_pair: Any = _loader(True)
store: Any = intrinsic(_store)
peek: Any = intrinsic(_peek)
poke: Any = intrinsic(_poke)
fetch: Any = intrinsic(_fetch)
choose: Any = intrinsic(_choose)
least: Any = _extreme("<")
greatest: Any = _extreme(">")
root: Any = _call("sqrt")
absolute: Any = _call("fabs")
floor: Any = _call("floor")
ceiling: Any = _call("ceil")
rough_root: Any = intrinsic(_rough_root)
halved_bits: Any = intrinsic(prefer_literal=True)(_halved_bits)
either: Any = _signs("or_")
both: Any = _signs("and_")
differ: Any = _signs("xor")
pick: Any = intrinsic(_pick)
widen_pair: Any = _widener(True)
doubles: Any = _spreader(DOUBLES)
doubles_pair: Any = _spreader(PAIRS[DOUBLES])
singles: Any = _spreader(SINGLES)
singles_pair: Any = _spreader(PAIRS[SINGLES])
bits: Any = intrinsic(_bits)
trailing_zeros: Any = intrinsic(_trailing_zeros)
count_ones: Any = intrinsic(_count_ones)
