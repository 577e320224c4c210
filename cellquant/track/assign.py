"""Sparse optimal assignment of cells to cells, divisions included."""

from collections.abc import Callable, Iterator

import numpy as np
from numba import njit
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, min_weight_full_bipartite_matching

from cellquant.track.movie import BoolArray, FloatArray, IntArray

Solver = Callable[[IntArray, IntArray, FloatArray, IntArray, FloatArray], tuple[IntArray, IntArray]]
# Beyond this many branches the best division set found so far is kept: a bound, not a tuning knob.
BRANCH_LIMIT = 200
PROGRAM_LIMIT = 4000  # options of one tangle; larger ones are solved by exchange
_BLOCK = 500  # options of tangles that are solved together
_ROUNDS = 10


def match(rows: IntArray, columns: IntArray, gains: FloatArray) -> IntArray:
    """Choose links so that no cell has two and the summed gain is greatest.

    Parameters
    ----------
    rows, columns
        (E,) ends of the possible links, integers from 0.
    gains
        (E,) gain of each link over leaving both cells alone; links without gain are not chosen.

    Returns
    -------
    numpy.ndarray
        Indices of the chosen links, ascending.
    """
    nobody = np.empty((0, 3), dtype=np.int64)
    return match_with_divisions(rows, columns, gains, nobody, np.empty(0))[0]


def match_with_divisions(
    rows: IntArray,
    columns: IntArray,
    gains: FloatArray,
    families: IntArray,
    family_gains: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Choose links and divisions together, so that no cell is used twice.

    Parameters
    ----------
    rows, columns, gains
        Possible links, as for `match`.
    families
        (D, 3) mother (a row) and two daughters (columns) of each possible division.
    family_gains
        (D,) gain of each over leaving the three cells alone.

    Returns
    -------
    links : numpy.ndarray
        Indices of the chosen links, ascending.
    divisions : numpy.ndarray
        Indices of the chosen divisions, ascending.

    What gains more than all that it could displace is taken at once. The rest falls into small
    tangles: an assignment where there are links alone, an integer program where divisions compete
    with them. A tangle too large for a program is solved approximately, so that no input can make
    the cost explode.
    """
    e, d = len(rows), len(families)
    first = int(max(rows.max(initial=-1), families[:, 0].max(initial=-1))) + 1
    cells = np.full((e + d, 3), -1, dtype=np.int64)
    cells[:e, 0], cells[:e, 1] = rows, columns + first
    cells[e:] = families + np.array([0, first, first])
    gain = np.concatenate((gains, family_gains))
    state = np.where(gain > 0.0, 0, -1)
    _settle(cells, gain, int(cells.max(initial=-1)) + 1, _ROUNDS, state)
    rest = np.flatnonzero(state == 0)
    taken = [np.flatnonzero(state == 1)]
    for part, solve in _tangles(cells[rest], rest >= e):
        block = rest[part]
        one, other = block[block < e], block[block >= e]
        links, divisions = solve(cells[one, 0], cells[one, 1], gain[one], cells[other], gain[other])
        taken += [one[links], other[divisions]]
    chosen = np.sort(np.concatenate(taken))
    return chosen[chosen < e], chosen[chosen >= e] - e


@njit(cache=True)
def _settle(cells: IntArray, gain: FloatArray, n: int, rounds: int, state: IntArray) -> None:
    """Take options (state 1) worth more than the best others of their cells together.

    cells (O, 3), -1 where an option has fewer; options whose cell is taken are dropped (-1), those
    in doubt stay 0. Two options that share a cell cannot both be worth more than the other.
    """
    best, second = np.empty(n), np.empty(n)
    top = np.empty(n, dtype=np.int64)
    used = np.zeros(n, dtype=np.bool_)
    for _ in range(rounds):
        best[:] = 0.0
        second[:] = 0.0
        top[:] = -1
        for o in range(len(gain)):
            if state[o] != 0:
                continue
            for c in cells[o]:
                if c < 0:
                    continue
                if gain[o] > best[c]:
                    best[c], second[c], top[c] = gain[o], best[c], o
                elif gain[o] > second[c]:
                    second[c] = gain[o]
        changed = False
        for o in range(len(gain)):
            if state[o] != 0:
                continue
            rival = 0.0
            for c in cells[o]:
                if c >= 0:
                    rival += second[c] if top[c] == o else best[c]
            if gain[o] > rival:
                state[o] = 1
                changed = True
                for c in cells[o]:
                    if c >= 0:
                        used[c] = True
        if not changed:
            return
        for o in range(len(gain)):
            if state[o] == 0:
                for c in cells[o]:
                    if c >= 0 and used[c]:
                        state[o] = -1
                        break


def _tangles(cells: IntArray, division: BoolArray) -> Iterator[tuple[IntArray, Solver]]:
    """Options that hang together, small tangles in one block, with the way to solve them."""
    if len(cells) == 0:
        return
    cells = np.where(cells < 0, cells[:, 1:2], cells)
    used, number = np.unique(cells, return_inverse=True)
    one, two, three = number.reshape(-1, 3).T
    graph = coo_array(
        (np.ones(2 * len(one)), (np.tile(one, 2), np.concatenate((two, three)))),
        shape=(len(used), len(used)),
    )
    _, component = connected_components(graph, directed=False)
    tangle = component[one]
    size = np.bincount(tangle, minlength=component.max() + 1)
    divided = np.zeros(len(size), dtype=bool)
    divided[tangle[division]] = True
    kinds: tuple[tuple[BoolArray, Solver], ...] = (
        (~divided, _assignment),
        (divided & (size <= PROGRAM_LIMIT), _program),
        (divided & (size > PROGRAM_LIMIT), _exchange),
    )
    for kind, solve in kinds:
        block = np.cumsum(np.where(kind, size, 0)) // _BLOCK
        options = np.flatnonzero(kind[tangle])
        order = np.argsort(block[tangle[options]], kind="stable")
        ends = np.flatnonzero(np.diff(block[tangle[options[order]]])) + 1
        for part in np.split(options[order], ends):
            if len(part):
                yield part, solve


def _assignment(
    rows: IntArray, columns: IntArray, gains: FloatArray, families: IntArray, odds: FloatArray
) -> tuple[IntArray, IntArray]:
    """Best links where no division competes with them."""
    row_of, row = np.unique(rows, return_inverse=True)
    column_of, column = np.unique(columns, return_inverse=True)
    n, m = len(row_of), len(column_of)
    # Every row also has a column of its own that means "no partner". Its cost is the same in all
    # rows and above every gain, so that no stored entry is zero (zeros would be dropped).
    top = float(gains.max()) + 1.0
    cost = csr_array(
        (
            np.concatenate((top - gains, np.full(n, top))),
            (np.concatenate((row, np.arange(n))), np.concatenate((column, m + np.arange(n)))),
        ),
        shape=(n, m + n),
    )
    matched_row, matched_column = min_weight_full_bipartite_matching(cost)
    partner = np.full(n, -1)
    partner[matched_row] = matched_column
    return np.flatnonzero(partner[row] == column), np.empty(0, dtype=np.int64)


def _program(
    rows: IntArray, columns: IntArray, gains: FloatArray, families: IntArray, odds: FloatArray
) -> tuple[IntArray, IntArray]:
    """Best links and divisions by an integer program."""
    e, d = len(rows), len(families)
    cells = np.concatenate((rows, columns, families.T.reshape(-1)))
    options = np.concatenate((np.tile(np.arange(e), 2), np.tile(e + np.arange(d), 3)))
    used, constraint = np.unique(cells, return_inverse=True)
    usage = csr_array((np.ones(len(cells)), (constraint, options)), shape=(len(used), e + d))
    solution = milp(
        -np.concatenate((gains, odds)),
        integrality=np.ones(e + d),
        bounds=Bounds(0.0, 1.0),
        constraints=LinearConstraint(usage, -np.inf, 1.0),
        options={"node_limit": BRANCH_LIMIT, "mip_rel_gap": 0.0},
    )
    if solution.x is None:
        return _exchange(rows, columns, gains, families, odds)
    taken = solution.x > 0.5
    return np.flatnonzero(taken[:e]), np.flatnonzero(taken[e:])


def _exchange(
    rows: IntArray, columns: IntArray, gains: FloatArray, families: IntArray, odds: FloatArray
) -> tuple[IntArray, IntArray]:
    """Links first, then divisions that are worth more than the links they break, best first."""
    cells = np.concatenate((rows, columns, families.reshape(-1)))
    used, number = np.unique(cells, return_inverse=True)
    e = len(rows)
    rows, columns, families = number[:e], number[e : 2 * e], number[2 * e :].reshape(-1, 3)
    chosen = match(rows, columns, gains)
    held = np.zeros(len(used))
    held[rows[chosen]] = held[columns[chosen]] = gains[chosen]
    partner = np.full(len(used), -1)
    partner[rows[chosen]], partner[columns[chosen]] = columns[chosen], rows[chosen]
    lost = held[families].sum(axis=1)
    for child in (1, 2):
        lost -= np.where(partner[families[:, 0]] == families[:, child], held[families[:, child]], 0)
    free = np.ones(len(used), dtype=bool)
    taken = []
    for index in np.argsort(lost - odds, kind="stable").tolist():
        if odds[index] > lost[index] and free[families[index]].all():
            free[families[index]] = False
            taken.append(index)
    rest = np.flatnonzero(free[rows] & free[columns])
    links = rest[match(rows[rest], columns[rest], gains[rest])]
    return links, np.array(sorted(taken), dtype=np.int64)
