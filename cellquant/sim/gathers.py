"""Vectors of numbers that lie scattered in an array: four neighbours at a time, transposed."""

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from cellquant.sim.lanes import NATIVE, PAIRS, kind_of, pointer, shuffle


def _transpose(builder: Any, a: Any, b: Any, c: Any, d: Any) -> list[Any]:
    ab = [shuffle(builder, a, b, order) for order in ([0, 4, 2, 6], [1, 5, 3, 7])]
    cd = [shuffle(builder, c, d, order) for order in ([0, 4, 2, 6], [1, 5, 3, 7])]
    return [
        shuffle(builder, ab[number % 2], cd[number % 2], order)
        for number, order in enumerate(([0, 1, 4, 5],) * 2 + ([2, 3, 6, 7],) * 2)
    ]


def _scatter(_: Any, array: Any, at: Any, stride: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Put lane r of four vectors of doubles side by side, at the flat index at + r stride."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place, step = args[1:3]
        for first in range(0, a.lanes, 4):
            order = list(range(first, first + 4))
            quads = [shuffle(builder, vector, vector, order) for vector in args[3:]]
            for vector in _transpose(builder, *quads):
                if array.dtype is types.float32:
                    vector = builder.fptrunc(vector, ir.VectorType(ir.FloatType(), 4))
                spot = pointer(context, builder, signature.args[0], args[0], place)
                builder.store(vector, builder.bitcast(spot, vector.type.as_pointer()), align=4)
                place = builder.add(place, step)
        return context.get_dummy_value()

    known = a.kind is types.float64
    return types.void(array, types.intp, types.intp, a, b, c, d) if known else None, generate


def _scatter_rows(
    _: Any, array: Any, rows: Any, at: Any, plus: Any, a: Any, b: Any, c: Any, d: Any
) -> Any:
    """Put lane r of four vectors of doubles side by side, at the flat index rows[at + r] + plus."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = args[2]
        for first in range(0, a.lanes, 4):
            order = list(range(first, first + 4))
            quads = [shuffle(builder, vector, vector, order) for vector in args[4:]]
            for vector in _transpose(builder, *quads):
                row = builder.load(pointer(context, builder, signature.args[1], args[1], place))
                row = builder.add(row, args[3])
                spot = pointer(context, builder, signature.args[0], args[0], row)
                builder.store(vector, builder.bitcast(spot, vector.type.as_pointer()), align=8)
                place = builder.add(place, ir.Constant(place.type, 1))
        return context.get_dummy_value()

    known = a.kind is types.float64
    signature = types.void(array, rows, types.intp, types.intp, a, b, c, d)
    return signature if known else None, generate


def _gatherer(pair: bool) -> Any:
    def gather(_: Any, array: Any, rows: Any, at: Any, plus: Any) -> Any:
        """Four vectors: the numbers at rows[at + lane] + plus + 0 .. 3 of an array.

        Every lane reads four neighbouring numbers at once; the lanes are then transposed.
        """
        kind = PAIRS[kind_of(array)] if pair else kind_of(array)

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            native = NATIVE[kind.kind]
            four = ir.VectorType(native, 4)
            size = native.get_abi_size(context.target_data)
            quads = []
            for lane in range(kind.lanes):
                place = builder.add(args[2], ir.Constant(args[2].type, lane))
                row = builder.load(pointer(context, builder, signature.args[1], args[1], place))
                row = builder.add(row, args[3])
                spot = pointer(context, builder, signature.args[0], args[0], row)
                quads.append(builder.load(builder.bitcast(spot, four.as_pointer()), align=size))
            parts = [
                _transpose(builder, *quads[first : first + 4]) for first in range(0, kind.lanes, 4)
            ]
            while len(parts) > 1:
                order = list(range(2 * parts[0][0].type.count))
                parts = [
                    [shuffle(builder, x, y, order) for x, y in zip(*two, strict=True)]
                    for two in zip(parts[::2], parts[1::2], strict=True)
                ]
            return context.make_tuple(builder, signature.return_type, parts[0])

        result = types.UniTuple(kind, 4)  # type: ignore[no-untyped-call]
        return result(array, rows, types.intp, types.intp), generate

    return intrinsic(gather)


gather: Any = _gatherer(False)
gather_pair: Any = _gatherer(True)
scatter: Any = intrinsic(_scatter)
scatter_rows: Any = intrinsic(_scatter_rows)
