"""Values at given ranks of several sorted arrays together, which are never joined."""

import numpy as np

from cellquant.observables.trajectories import FloatArray, IntArray


def at_ranks(parts: list[FloatArray], ranks: IntArray, without: IntArray) -> FloatArray:
    """Values that have given ranks, from 0 on, among all values of several sorted arrays.

    Found by bisection over the floating-point numbers, which takes at most 64 steps.

    Parameters
    ----------
    parts
        Sorted arrays of finite values, none of them empty.
    ranks
        (n,) ranks.
    without
        (n,) which part each rank leaves out; -1 for none.
    """
    low, high = (
        np.full(ranks.size, _number(np.array([pick(p[end] for p in parts)]))[0])
        for pick, end in ((min, 0), (max, -1))
    )
    while (low < high).any():
        middle = (low >> 1) + (high >> 1) + (low & high & 1)
        value = _value(middle)
        count = np.zeros(ranks.size, dtype=np.int64)
        for index, part in enumerate(parts):
            count += np.where(without == index, 0, np.searchsorted(part, value, side="right"))
        reached = count > ranks
        low, high = np.where(reached, low, middle + 1), np.where(reached, middle, high)
    return _value(low)


def _number(value: FloatArray) -> IntArray:
    """Whole numbers in the order of the floating-point numbers."""
    bits = value.view(np.int64)
    return np.where(bits < 0, np.iinfo(np.int64).min - bits, bits)


def _value(number: IntArray) -> FloatArray:
    """The floating-point numbers again."""
    return np.where(number < 0, np.iinfo(np.int64).min - number, number).view(np.float64)
