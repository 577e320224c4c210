"""Sparse optimal assignment of the cells of two frames, divisions included."""

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, min_weight_full_bipartite_matching

from cellquant.track.movie import BoolArray, FloatArray, IntArray

# Beyond this many branches the best division set found so far is kept: a bound, not a tuning knob.
BRANCH_LIMIT = 200
PROGRAM_LIMIT = 4000  # options of one program; larger tangles are solved by exchange


def match(rows: IntArray, columns: IntArray, gains: FloatArray) -> IntArray:
    """Choose links so that no cell has two and the summed gain is greatest.

    Parameters
    ----------
    rows, columns
        (E,) ends of the possible links; any integers.
    gains
        (E,) gain of each link over leaving both cells alone; links without gain are not chosen.

    Returns
    -------
    numpy.ndarray
        Indices of the chosen links, ascending.
    """
    useful = np.flatnonzero(gains > 0.0)
    if useful.size == 0:
        return useful
    row_of, row, in_row = np.unique(rows[useful], return_inverse=True, return_counts=True)
    column_of, column, in_column = np.unique(
        columns[useful], return_inverse=True, return_counts=True
    )
    # Most pairs have no rival: only the others need an assignment.
    alone = (in_row[row] == 1) & (in_column[column] == 1)
    if alone.any():
        rest = useful[~alone]
        others = rest[match(rows[rest], columns[rest], gains[rest])]
        return np.sort(np.concatenate((useful[alone], others)))
    n, m = len(row_of), len(column_of)
    # Every row also has a column of its own that means "no partner". Its cost is the same in all
    # rows and above every gain, so that no stored entry is zero (zeros would be dropped).
    top = float(gains[useful].max()) + 1.0
    cost = csr_array(
        (
            np.concatenate((top - gains[useful], np.full(n, top))),
            (np.concatenate((row, np.arange(n))), np.concatenate((column, m + np.arange(n)))),
        ),
        shape=(n, m + n),
    )
    matched_row, matched_column = min_weight_full_bipartite_matching(cost)
    partner = np.full(n, -1)
    partner[matched_row] = matched_column
    chosen: IntArray = useful[partner[row] == column]
    return chosen


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
        Indices of the chosen links.
    divisions : numpy.ndarray
        Indices of the chosen divisions.

    The parts of the problem that a division can influence are small integer programs, the rest is
    an assignment. A part too large for a program is solved approximately, so that no input can
    make the cost explode.
    """
    none = np.empty(0, dtype=np.int64)
    if len(families) == 0:
        return match(rows, columns, gains), none
    row_of, row = np.unique(np.concatenate((rows, families[:, 0])), return_inverse=True)
    column_of, column = np.unique(
        np.concatenate((columns, families[:, 1], families[:, 2])), return_inverse=True
    )
    n, e, d = len(row_of), len(rows), len(families)
    mother, daughters = row[e:], (column[e : e + d], column[e + d :])
    size = n + len(column_of)
    graph = coo_array(
        (
            np.ones(e + 2 * d),
            (
                np.concatenate((row[:e], mother, mother)),
                n + np.concatenate((column[:e], *daughters)),
            ),
        ),
        shape=(size, size),
    )
    _, component = connected_components(graph, directed=False)
    divided = np.zeros(component.max() + 1, dtype=bool)
    divided[component[mother]] = True
    inside = np.flatnonzero(divided[component[row[:e]]] & (gains > 0.0))
    outside = np.flatnonzero(~divided[component[row[:e]]])
    chosen = [outside[match(rows[outside], columns[outside], gains[outside])]]
    split = []
    link_part, family_part = component[row[inside]], component[mother]
    for parts in _blocks(np.bincount(np.concatenate((link_part, family_part)))):
        one = inside[parts[link_part]]
        other = np.flatnonzero(parts[family_part])
        solve = _program if len(one) + len(other) <= PROGRAM_LIMIT else _exchange
        links, divisions = solve(
            row[one],
            n + column[one],
            gains[one],
            np.column_stack((mother, n + daughters[0], n + daughters[1]))[other],
            family_gains[other],
        )
        chosen.append(one[links])
        split.append(other[divisions])
    return np.sort(np.concatenate(chosen)), np.sort(np.concatenate(split))


def _blocks(sizes: IntArray) -> list[BoolArray]:
    """Components put together into programs of up to `PROGRAM_LIMIT` options, as masks."""
    blocks: list[BoolArray] = []
    filled = PROGRAM_LIMIT + 1
    for part in np.flatnonzero(sizes):
        if filled + sizes[part] > PROGRAM_LIMIT:
            blocks.append(np.zeros(len(sizes), dtype=bool))
            filled = 0
        blocks[-1][part] = True
        filled += int(sizes[part])
    return blocks


def _program(
    rows: IntArray, columns: IntArray, gains: FloatArray, families: IntArray, odds: FloatArray
) -> tuple[IntArray, IntArray]:
    """Best links and divisions by an integer program; every cell has one number."""
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
        options={"node_limit": BRANCH_LIMIT},
    )
    if solution.x is None:
        return _exchange(rows, columns, gains, families, odds)
    taken = solution.x > 0.5
    return np.flatnonzero(taken[:e]), np.flatnonzero(taken[e:])


def _exchange(
    rows: IntArray, columns: IntArray, gains: FloatArray, families: IntArray, odds: FloatArray
) -> tuple[IntArray, IntArray]:
    """Links first, then divisions that are worth more than the links they break, best first."""
    chosen = match(rows, columns, gains)
    held = np.zeros(int(max(rows.max(initial=0), columns.max(initial=0), families.max())) + 1)
    held[rows[chosen]] = held[columns[chosen]] = gains[chosen]
    partner = np.full(len(held), -1)
    partner[rows[chosen]], partner[columns[chosen]] = columns[chosen], rows[chosen]
    lost = held[families].sum(axis=1)
    for child in (1, 2):
        lost -= np.where(partner[families[:, 0]] == families[:, child], held[families[:, child]], 0)
    free = np.ones(len(held), dtype=bool)
    taken = []
    for index in np.argsort(lost - odds, kind="stable").tolist():
        if odds[index] > lost[index] and free[families[index]].all():
            free[families[index]] = False
            taken.append(index)
    rest = np.flatnonzero(free[rows] & free[columns])
    links = rest[match(rows[rest], columns[rest], gains[rest])]
    return links, np.array(sorted(taken), dtype=np.int64)
