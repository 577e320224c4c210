"""What is wrong with a frame of label masks, counted in one pass over its pixels.

A part is a set of pixels of one label that touch by an edge or a corner. The largest part of a
label is its body; among equals the most compact one, and of congruent ones the first in reading
order.
"""

from dataclasses import dataclass
from typing import Any

import numba as nb
import numpy as np

Ints = np.ndarray[Any, np.dtype[np.int64]]
Floats = np.ndarray[Any, np.dtype[np.float64]]

# Columns of the table of parts; row and column are those of the first pixel in reading order.
_LABEL, _PIXELS, _SUM_X, _SUM_Y, _SUM_SQUARES, _EULER, _BORDER, _ROW, _COLUMN = range(9)


@dataclass(frozen=True)
class FrameFaults:
    """Labels of one frame and what is wrong with them.

    Attributes
    ----------
    label
        (n,) the labels, rising.
    area
        (n,) pixels of each label, all its parts together.
    x, y
        (n,) centroid of each label in pixels, all its parts together.
    body
        (n, 3) row, column of the first pixel in reading order, and pixels of each body.
    spare
        (m, 2) row, column of the first pixel of every part that is no body, or of one pixel.
    fragmented
        The labels that have a second part of more than one pixel, rising.
    fragments
        Number of parts of more than one pixel beside the bodies.
    specks
        Number of parts of a single pixel, labels of one pixel included.
    holes
        Number of holes inside the bodies of more than one pixel, whatever fills them.
    border_cells
        Number of labels whose body touches the edge of the image.
    """

    label: Ints
    area: Ints
    x: Floats
    y: Floats
    body: Ints
    spare: Ints
    fragmented: Ints
    fragments: int
    specks: int
    holes: int
    border_cells: int

    @property
    def n_labels(self) -> int:
        """Number of labels in the frame."""
        return len(self.label)


def find_faults(labels: np.ndarray[Any, Any]) -> FrameFaults:
    """Count fragments, specks, holes and border cells of a frame of label masks.

    The number of holes follows from Euler's relation for horizontal runs of equal pixels,
    parts - holes = runs - contacts between runs of consecutive rows.

    Parameters
    ----------
    labels
        (H, W) integers, 0 for background; not altered.

    Returns
    -------
    FrameFaults

    References
    ----------
    Gray, IEEE Transactions on Computers C-20, 551 (1971), for the Euler number by local counts.
    """
    parts = _scan(np.ascontiguousarray(labels))
    # The spread about the centroid, times the square of the number of pixels, in exact integers:
    # it does not change when the image is turned. Stable: reading order last.
    spread = parts[:, _PIXELS] * parts[:, _SUM_SQUARES]
    spread -= parts[:, _SUM_X] ** 2 + parts[:, _SUM_Y] ** 2
    order = np.lexsort((spread, -parts[:, _PIXELS], parts[:, _LABEL]))
    parts = parts[order]
    starts = np.flatnonzero(np.diff(parts[:, _LABEL], prepend=0))
    body = np.zeros(len(parts), dtype=bool)
    body[starts] = True
    large = parts[:, _PIXELS] > 1
    fragments = parts[~body & large]
    sums = np.add.reduceat(parts, starts) if len(starts) else parts
    area = sums[:, _PIXELS]
    return FrameFaults(
        label=parts[starts, _LABEL],
        area=area,
        x=sums[:, _SUM_X] / area,
        y=sums[:, _SUM_Y] / area,
        body=parts[starts][:, [_ROW, _COLUMN, _PIXELS]],
        spare=parts[~(body & large)][:, [_ROW, _COLUMN]],
        fragmented=np.unique(fragments[:, _LABEL]),
        fragments=len(fragments),
        specks=int(np.count_nonzero(~large)),
        holes=int(np.sum(1 - parts[body & large, _EULER])),
        border_cells=int(np.sum(parts[body, _BORDER])),
    )


def same_content(
    before: np.ndarray[Any, Any],
    after: np.ndarray[Any, Any],
    faults_before: FrameFaults,
    faults_after: FrameFaults,
) -> bool:
    """Tell whether two frames show the same cells at the same pixels, whatever their numbers.

    Parameters
    ----------
    before, after
        (H, W) integer labels.
    faults_before, faults_after
        What `find_faults` said of them; decides nearly every case without looking at pixels.

    Returns
    -------
    bool
        False where a frame has no label at all.
    """
    if faults_before.n_labels != faults_after.n_labels or faults_before.n_labels == 0:
        return False
    if not np.array_equal(_places(faults_before), _places(faults_after)):
        return False
    ranks_before = np.searchsorted(faults_before.label, before.ravel())
    ranks_after = np.searchsorted(faults_after.label, after.ravel())
    inside = before.ravel() != 0
    if not np.array_equal(inside, after.ravel() != 0):
        return False
    pairs = ranks_before[inside] * np.int64(faults_after.n_labels) + ranks_after[inside]
    # Equal counts and as many pairs as labels leave no pair that is not one to one.
    return len(np.unique(pairs)) == faults_before.n_labels == len(np.unique(ranks_after[inside]))


def _places(faults: FrameFaults) -> Floats:
    """Area and centroid of every label, in an order that does not depend on the numbers."""
    order = np.lexsort((faults.area, faults.x, faults.y))
    return np.stack((faults.area.astype(np.float64), faults.x, faults.y))[:, order]


@nb.njit(cache=True)
def _root(parent, part):  # type: ignore[no-untyped-def]
    while parent[part] != part:
        parent[part] = parent[parent[part]]
        part = parent[part]
    return part


@nb.njit(cache=True)
def _scan(labels):  # type: ignore[no-untyped-def]
    """Table of the parts of all labels in reading order, columns as named above.

    Rows are cut into runs; each run joins the parts of the runs above that it touches.
    """
    height, width = labels.shape
    size = 1024
    parent = np.empty(size, np.int64)
    table = np.zeros((size, 9), np.int64)
    n_parts = 0
    # Runs of the row above and of this one: first column, column after the last, part.
    above = np.empty((width, 3), np.int64)
    here = np.empty((width, 3), np.int64)
    n_above = 0
    for row in range(height):
        n_here = 0
        first = 0  # first run above that can still touch
        stop = 0
        while stop < width:
            start = stop
            label = labels[row, start]
            stop += 1
            while stop < width and labels[row, stop] == label:
                stop += 1
            if label == 0:
                continue
            while first < n_above and above[first, 1] < start:
                first += 1
            part = -1
            contacts = 0
            other = first
            while other < n_above and above[other, 0] <= stop:
                above_part = above[other, 2]
                if table[above_part, 0] == label:
                    contacts += 1
                    root = _root(parent, above_part)
                    if part < 0:
                        part = root
                    elif root != part:
                        low, high = min(part, root), max(part, root)
                        parent[high] = low
                        part = low
                other += 1
            if part < 0:
                if n_parts == size:
                    size *= 2
                    longer = np.empty(size, np.int64)
                    longer[:n_parts] = parent
                    parent = longer
                    taller = np.zeros((size, 9), np.int64)
                    taller[:n_parts] = table
                    table = taller
                part = n_parts
                parent[part] = part
                table[part, 0] = label
                table[part, 7] = row
                table[part, 8] = start
                n_parts += 1
            length = stop - start
            table[part, 1] += length
            table[part, 2] += (start + stop - 1) * length // 2
            table[part, 3] += row * length
            table[part, 4] += row * row * length
            # Sum of the squares from start to stop - 1.
            table[part, 4] += (stop - 1) * stop * (2 * stop - 1) // 6
            table[part, 4] -= (start - 1) * start * (2 * start - 1) // 6
            table[part, 5] += 1 - contacts
            if row == 0 or row == height - 1 or start == 0 or stop == width:
                table[part, 6] = 1
            here[n_here, 0] = start
            here[n_here, 1] = stop
            here[n_here, 2] = part
            n_here += 1
        above, here = here, above
        n_above = n_here
    # Parts that were joined later hand over what they collected; roots come before members.
    n_roots = 0
    place = np.empty(n_parts, np.int64)
    for part in range(n_parts):
        root = _root(parent, part)
        if root == part:
            place[part] = n_roots
            for column in range(9):
                table[n_roots, column] = table[part, column]
            n_roots += 1
        else:
            target = place[root]
            for column in range(1, 6):
                table[target, column] += table[part, column]
            table[target, 6] |= table[part, 6]
    return table[:n_roots].copy()
