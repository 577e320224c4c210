"""Kernels whose work threads share.

Numba builds the body of a parallel loop several times: as a function of its own, in a wrapper and
in the kernel around it, optimised anew each time. The process that compiles it runs another copy
than one that reads the cache, so where arithmetic may be reordered their last digits differ. Here
a body is compiled once, as a C function, and the loop calls it by its address.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import cfunc, njit, prange, typeof, types
from numba.extending import intrinsic


class Shared:
    """Work on a layer that is dealt out in parts; no result depends on their number.

    Decorates a function of (part, n_parts, arrays, modes, tension, torque) without a result: the
    number of this part and of all, the arrays read and written, and three tuples whose lengths
    say what is compiled. `fastmath` are the liberties that the compiler may take.
    """

    def __init__(self, function: Callable[..., None], fastmath: set[str]) -> None:
        self.function = function
        self.fastmath = fastmath
        self.__doc__ = function.__doc__
        self._compiled: dict[Any, Any] = {}

    def address(self, arrays: tuple[Any, ...], *features: tuple[int, ...]) -> int:
        """Where the code for such arrays starts; compiled or read from the cache if need be."""
        number = types.int64
        signature = types.void(number, number, *map(typeof, (arrays, *features)))
        if signature not in self._compiled:
            compiler = cfunc(signature, cache=True, fastmath=self.fastmath, error_model="numpy")
            self._compiled[signature] = compiler(self.function)
        address: int = self._compiled[signature].address
        return address


def shared(fastmath: set[str]) -> Callable[[Callable[..., None]], Shared]:
    """Decorator that makes a `Shared` of a function."""
    return partial(Shared, fastmath=fastmath)


def _call(_: Any, address: Any, arguments: Any) -> Any:
    """Call a C function without a result by its address."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kinds = [context.get_value_type(kind) for kind in signature.args[1]]
        function = ir.FunctionType(context.get_value_type(types.none), kinds)
        numbers = [builder.extract_value(values[1], k) for k in range(len(kinds))]
        builder.call(builder.inttoptr(values[0], function.as_pointer()), numbers)
        return context.get_dummy_value()

    return types.void(address, arguments), generate


call: Any = intrinsic(_call)


@njit(cache=True)
def alone(address: int, arrays: Any, modes: Any, tension: Any, torque: Any) -> None:
    """Do the work at `address` (see `Shared`) in one part, which costs no start of threads."""
    call(address, (0, 1, arrays, modes, tension, torque))


@njit(cache=True, parallel=True)
def share(address: int, n_parts: int, arrays: Any, modes: Any, tension: Any, torque: Any) -> None:
    """Do the work at `address` (see `Shared`), `n_parts` parts side by side."""
    for part in prange(n_parts):
        number: Any = np.int64(part)
        call(address, (number, n_parts, arrays, modes, tension, torque))
