"""The path along the cracks between a cell and all others, and where it may have corners.

Where the label beside the cell changes, the contour may have a corner. Of a cell that background
lines cut out, the cells across the lines are what it has beside it.
"""

import numba as nb
import numpy as np

NEIGHBOUR_GAP = 3
"""Pixels of background that may lie between two cells that count as neighbours."""

# Cracks beside one other label that make an arc of its own.
_MIN_ARC = 3
# Pixels around a background pixel, nearest first, in which the cell across a line is looked for.
_AROUND = np.array(
    sorted(
        (x * x + y * y, x, y)
        for x in range(-NEIGHBOUR_GAP, NEIGHBOUR_GAP + 1)
        for y in range(-NEIGHBOUR_GAP, NEIGHBOUR_GAP + 1)
        if 0 < x * x + y * y <= NEIGHBOUR_GAP**2
    )
)

# Steps along a crack: right, down, left, up.
DX = np.array([1, 0, -1, 0])
DY = np.array([0, 1, 0, -1])


@nb.njit(cache=True)
def trace(labels, row, column, steps, outside):  # type: ignore[no-untyped-def]
    """Follow the cracks around one cell; returns steps, label outside of each, and their number.

    Starts at the upper left corner of the first pixel. Pixels that touch by a corner belong
    together. Outside the image the label is -1.
    """
    height, width = labels.shape
    label = labels[row, column]
    x, y, step, n = column, row, 0, 0
    while True:
        if n == len(steps):
            longer_steps = np.empty(2 * n, np.int8)
            longer_steps[:n] = steps
            steps = longer_steps
            longer_outside = np.empty(2 * n, np.int64)
            longer_outside[:n] = outside
            outside = longer_outside
        # The pixel to the left of the crack from (x, y) in direction step.
        column_out = x - (1 if step == 2 or step == 3 else 0)
        row_out = y - (1 if step == 0 or step == 3 else 0)
        if 0 <= column_out < width and 0 <= row_out < height:
            outside[n] = labels[row_out, column_out]
        else:
            outside[n] = -1
        steps[n] = step
        n += 1
        x += DX[step]
        y += DY[step]
        # Turn left if the pixel ahead on the left is in, else go straight or turn right.
        left_x = x - (1 if step == 2 or step == 3 else 0)
        left_y = y - (1 if step == 0 or step == 3 else 0)
        right_x = x - (1 if step == 1 or step == 2 else 0)
        right_y = y - (1 if step == 2 or step == 3 else 0)
        if 0 <= left_x < width and 0 <= left_y < height and labels[left_y, left_x] == label:
            step = (step + 3) % 4
        elif not (
            0 <= right_x < width and 0 <= right_y < height and labels[right_y, right_x] == label
        ):
            step = (step + 1) % 4
        if x == column and y == row and step == 0:
            return steps, outside, n


@nb.njit(cache=True)
def corners_of_contacts(outside, n, junctions):  # type: ignore[no-untyped-def]
    """Cracks at which the contour passes from one neighbour (or background) to the next; count.

    A stretch beside one other label counts from `_MIN_ARC` cracks on. A shorter one between two
    stretches beside the same label belongs to them; between two different ones, the junction is
    put in its middle.
    """
    first = -1
    for i in range(n):
        if outside[i] != outside[i - 1 if i > 0 else n - 1]:
            first = i
            break
    if first < 0:
        return 0
    n_junctions = 0
    stop, label = -1, 0  # end and label of the last stretch that counts
    opening, opening_label = -1, 0  # start and label of the first one
    i = first
    while i < first + n:
        start = i
        beside = outside[i % n]
        while i < first + n and outside[i % n] == beside:
            i += 1
        if i - start < _MIN_ARC:
            continue
        if stop < 0:
            opening, opening_label = start, beside
        elif beside != label:
            junctions[n_junctions] = (stop + start) // 2
            n_junctions += 1
        stop, label = i, beside
    if stop >= 0 and label != opening_label:
        junctions[n_junctions] = (stop + opening + n) // 2
        n_junctions += 1
    return n_junctions


@nb.njit(cache=True)
def nearest_across(labels, row, column, label, touching, n_touching):  # type: ignore[no-untyped-def]
    """Label nearest to a background pixel other than that of the cell; 0 where there is none.

    None, too, is what two labels at one distance are, and a cell that touches this one.
    """
    height, width = labels.shape
    nearest, reach = np.int64(0), 0
    for k in range(len(_AROUND)):
        if nearest != 0 and _AROUND[k, 0] > reach:
            break
        x, y = column + _AROUND[k, 1], row + _AROUND[k, 2]
        if not (0 <= x < width and 0 <= y < height):
            continue
        other = np.int64(labels[y, x])
        if other == 0 or other == label or other == nearest:  # noqa: SIM109
            continue
        if nearest != 0:
            return 0
        nearest, reach = other, _AROUND[k, 0]
    for k in range(n_touching):
        if touching[k] == nearest:
            return 0
    return nearest


@nb.njit(cache=True)
def look_across_lines(  # type: ignore[no-untyped-def]
    labels, row, column, steps, outside, n, touching, n_touching, across
):
    """Cells across lines of background, crack by crack; 0 for none, -1 at a contact.

    Returns how many cracks have one.
    """
    label = np.int64(labels[row, column])
    x, y = column, row
    n_across = 0
    for i in range(n):
        step = steps[i]
        across[i] = -1
        if outside[i] == 0:
            column_out = x - (1 if step == 2 or step == 3 else 0)
            row_out = y - (1 if step == 0 or step == 3 else 0)
            across[i] = nearest_across(labels, row_out, column_out, label, touching, n_touching)
            n_across += across[i] > 0
        x += DX[step]
        y += DY[step]
    return n_across


@nb.njit(cache=True)
def corners_of_lines(across, n, junctions, n_junctions):  # type: ignore[no-untyped-def]
    """Add the cracks at which the contour passes from one cell across a line to the next.

    As in `corners_of_contacts`, stretches shorter than `_MIN_ARC` do not count. Where open
    background or a contact lies between two cells, no corner is theirs.
    """
    first = -1
    for i in range(n):
        if across[i] != across[i - 1 if i > 0 else n - 1]:
            first = i
            break
    if first < 0:
        return n_junctions
    n_before = n_junctions
    stop, label = -1, 0
    opening, opening_label = -1, 0
    i = first
    while i < first + n:
        start = i
        beside = across[i % n]
        while i < first + n and across[i % n] == beside:
            i += 1
        if i - start < _MIN_ARC:
            continue
        if stop < 0:
            opening, opening_label = start, beside
        elif beside > 0 and label > 0 and beside != label:
            junctions[n_junctions] = (stop + start) // 2 % n
            n_junctions += 1
        stop, label = i, beside
    if label > 0 and opening_label > 0 and label != opening_label:
        junctions[n_junctions] = (stop + opening + n) // 2 % n
        n_junctions += 1
    if n_junctions > n_before:
        for k in range(n_before):
            junctions[k] %= n
        junctions[:n_junctions].sort()
    return n_junctions
