"""One evaluation at one go: the kernels of a contact rule in turn, while nothing is to be decided.

The interpreter between them would cost a fifth of an evaluation of a hundred cells, and 3 % of one
of a thousand.
"""

from typing import Any

from numba import njit

from cellquant.sim.neighbours import inspect
from cellquant.sim.parts import call

NOTHING, OUTLINES, ALL = 0, 1, 2  # what was done


@njit(cache=True)
def evaluate(
    work: Any, state: Any, out: Any, record: Any, reference: Any, fault: Any, most: float,
    least: float,
) -> int:  # fmt: skip
    """Outline the cells, find their crossings if the rule does so, sum up; return what was done.

    `work` holds where the code of every kernel and its arrays are. Only the outlines are done where
    the neighbour list has aged by more than `most`, where a number is not finite or a waist is
    narrower than `least` of A0. Where more crossings are found than there is room for, nothing is.
    """
    call(work[0][0], (0, 1, work[0][1], state, out))
    age, broken, narrowest = inspect(record, reference)
    if broken >= 0 or narrowest < least or age > most:
        return OUTLINES
    if len(work) == 3:
        call(work[1][0], (0, 1, work[1][1], state, out))
        for block in range(len(fault)):
            if fault[block] != 0:
                return NOTHING
    call(work[-1][0], (0, 1, work[-1][1], state, out))
    return ALL
