"""Kernels whose work threads share.

Numba builds the body of a parallel loop several times: as a function of its own, in a wrapper and
in the kernel around it, optimised anew each time. The process that compiles it runs another copy
than one that reads the cache, so where arithmetic may be reordered their last digits differ. Here
a body is compiled once, as a C function, and the loop calls it by its address.

To hand over an array costs about half a microsecond, and a kernel reads some twenty. The arrays
that stay the same from call to call are described once, in memory, and called by address as well.

Vectors for which there is no register are kept on the stack. Where that starts is a matter of
chance; unless it is aligned, they may lie across two cache lines, or two pages, and the same code
takes up to a tenth longer in one process than in another.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import cfunc, njit, prange, typeof, types
from numba.extending import intrinsic, models, register_model

STACK = 32  # bytes of a vector


class Kept(types.Type):
    """Address of the descriptions of arrays (see `Bound`), and what code is compiled for.

    `features` says how long three tuples of zeros are: one entry for each shape mode n >= 2, and
    one, or none, for tension and for torque.
    """

    def __init__(self, arrays: Any, features: tuple[int, int, int]) -> None:
        self.arrays = arrays
        self.features = features
        super().__init__(name=f"Kept({arrays}, {features})")


@register_model(Kept)
class KeptModel(models.PrimitiveModel):
    """An address is a whole number."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ir.IntType(64))  # type: ignore[no-untyped-call]


def _taken(_: Any, kept: Any) -> Any:
    """The arrays that were described."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        native = context.get_value_type(kept.arrays)
        # An alignment alone would not be written down.
        builder.function.attributes.add("nounwind")
        builder.function.attributes.alignstack = STACK
        return builder.load(builder.inttoptr(values[0], native.as_pointer()))

    return kept.arrays(kept), generate


def _features(_: Any, kept: Any) -> Any:
    """Modes, tension and torque: tuples whose lengths say what is compiled."""
    kinds = [types.UniTuple(types.int64, number) for number in kept.features]  # type: ignore[no-untyped-call]

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return ir.Constant(context.get_value_type(signature.return_type), None)

    return types.Tuple(kinds)(kept), generate  # type: ignore[no-untyped-call]


def _call(_: Any, address: Any, arguments: Any) -> Any:
    """Call a C function without a result by its address."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kinds = [context.get_value_type(kind) for kind in signature.args[1]]
        function = ir.FunctionType(context.get_value_type(types.none), kinds)
        numbers = [builder.extract_value(values[1], k) for k in range(len(kinds))]
        builder.call(builder.inttoptr(values[0], function.as_pointer()), numbers)
        return context.get_dummy_value()

    return types.void(address, arguments), generate


taken: Any = intrinsic(_taken)
features_of: Any = intrinsic(_features)
call: Any = intrinsic(_call)


@njit(cache=True)
def alone(address: int, kept: int, state: Any, out: Any) -> None:
    """Do the work at `address` (see `Shared`) in one part, which costs no start of threads."""
    call(address, (0, 1, kept, state, out))


@njit(cache=True, parallel=True)
def share(address: int, n_parts: int, kept: int, state: Any, out: Any) -> None:
    """Do the work at `address` (see `Shared`), `n_parts` parts side by side."""
    for part in prange(n_parts):
        number: Any = np.int64(part)
        call(address, (number, n_parts, kept, state, out))


class Bound:
    """Work with the arrays that it reads and writes, ready to be done on one state after another.

    Parameters
    ----------
    work
        What is done.
    arrays
        Arrays, in the order in which the kernel takes them.
    features
        What is compiled, see `Kept`.
    """

    def __init__(
        self, work: "Shared", arrays: tuple[Any, ...], features: tuple[int, int, int]
    ) -> None:
        self._words = np.zeros(sum(5 + 2 * array.ndim for array in arrays), np.int64)
        self.kept: int = self._words.ctypes.data
        self.address = work.address(arrays, features)
        self.describe(arrays)

    def describe(self, arrays: tuple[Any, ...]) -> None:
        """Take other arrays, of the same kinds."""
        self.arrays = arrays  # they live as long as they are in use
        words: list[int] = []
        for array in arrays:
            # As compiled code has it: owner and counter (none), entries, address, shape, strides.
            words += 0, 0, array.size, array.itemsize, array.ctypes.data
            words += *array.shape, *array.strides
        self._words[:] = words

    def __call__(self, n_parts: int, state: Any, out: Any) -> None:
        """Do it, in parts side by side."""
        if n_parts == 1:
            alone(self.address, self.kept, state, out)
        else:
            share(self.address, n_parts, self.kept, state, out)


class Shared:
    """Work on a layer that is dealt out in parts; no result depends on their number.

    Decorates a function of (part, n_parts, kept, state, out) without a result: the number of this
    part and of all, the arrays read and written (see `taken` and `features_of`), states and what
    is made of them. `fastmath` are the liberties that the compiler may take.
    """

    def __init__(self, function: Callable[..., None], fastmath: set[str]) -> None:
        self.function = function
        self.fastmath = fastmath
        self.__doc__ = function.__doc__
        self._compiled: dict[Any, Any] = {}

    def address(self, arrays: tuple[Any, ...], features: tuple[int, int, int]) -> int:
        """Where the code for such arrays starts; compiled or read from the cache if need be."""
        number, states = types.int64, types.float64[:, ::1]
        kept = Kept(typeof(arrays), features)  # type: ignore[no-untyped-call]
        signature = types.void(number, number, kept, states, states)
        if signature not in self._compiled:
            compiler = cfunc(signature, cache=True, fastmath=self.fastmath, error_model="numpy")
            self._compiled[signature] = compiler(self.function)
        address: int = self._compiled[signature].address
        return address


def shared(fastmath: set[str]) -> Callable[[Callable[..., None]], Shared]:
    """Decorator that makes a `Shared` of a function."""
    return partial(Shared, fastmath=fastmath)
