"""Check one frame of a label mask, and say by stated rules what of it is measured.

The masks themselves are never altered. The rules, each counted under the name in brackets:

- Pixels of one label that touch by an edge or a corner form a part. The largest part of a label
  is the cell (the first in reading order among equals); each other part is left out
  [``fragments``], or [``specks``] when it is a single pixel.
- A label of one single pixel is no cell and is left out [``specks``].
- What a cell encloses belongs to it: holes are filled [``holes``].
- A label that lies wholly inside another one is measured [``enclosed_cells``]; the area of the
  outer cell then holds it as well.
- A frame that repeats the one before it is not measured [``duplicated_frames``]; a frame without
  any label has no cells [``empty_frames``]. Both are missing frames to whatever follows, never
  frames without motion.
- A cell on the edge of the image is measured and flagged [``border_cells``].
- A cell whose contour is too coarse to have a length has no perimeter and no shape index
  [``too_small_for_contour``].
"""

from dataclasses import dataclass
from typing import Any

import numba as nb
import numpy as np

IntArray = np.ndarray[Any, np.dtype[np.int64]]

FAULTS = (
    "fragments",
    "specks",
    "holes",
    "enclosed_cells",
    "duplicated_frames",
    "empty_frames",
    "border_cells",
    "too_small_for_contour",
)


@dataclass(frozen=True)
class Parts:
    """The part of each label that is measured, and the runs of pixels that make up the frame.

    Attributes
    ----------
    label
        (n,) the labels that are cells, rising.
    row, column
        (n,) the first pixel of the cell in reading order.
    runs
        (m, 4) horizontal runs of equal non-zero label: row, first column, column after the last,
        label; in reading order.
    dropped
        (m,) True where a run is left out of the measurement.
    fragments, specks, holes
        Counts over the frame; holes of what is measured.
    """

    label: IntArray
    row: IntArray
    column: IntArray
    runs: IntArray
    dropped: np.ndarray[Any, np.dtype[np.bool_]]
    fragments: int
    specks: int
    holes: int


def find_parts(labels: np.ndarray[Any, Any]) -> Parts:
    """Find the connected parts of every label and choose the one that is measured.

    Holes follow from Euler's relation: parts - holes = runs - contacts between runs of
    consecutive rows.

    Parameters
    ----------
    labels
        (H, W) integer labels, 0 for background.

    Returns
    -------
    Parts
    """
    runs = _find_runs(np.ascontiguousarray(labels))
    root, contacts = _join_runs(runs)
    first = np.flatnonzero(root == np.arange(len(runs)))  # one run per part, in reading order
    part = np.searchsorted(first, root)
    n_parts = len(first)
    pixels = np.bincount(part, weights=runs[:, 2] - runs[:, 1], minlength=n_parts).astype(np.int64)
    n_runs = np.bincount(part, minlength=n_parts)
    n_contacts = np.bincount(part, weights=contacts, minlength=n_parts).astype(np.int64)

    # Best part of each label first: by label, then size, then reading order.
    order = np.lexsort((first, -pixels, runs[first, 3]))
    is_best = np.ones(n_parts, dtype=bool)
    is_best[1:] = np.diff(runs[first[order], 3]) != 0
    chosen = order[is_best & (pixels[order] > 1)]
    keep = np.zeros(n_parts, dtype=bool)
    keep[chosen] = True
    return Parts(
        label=runs[first[chosen], 3],
        row=runs[first[chosen], 0],
        column=runs[first[chosen], 1],
        runs=runs,
        dropped=~keep[part],
        fragments=int(np.count_nonzero(~keep & (pixels > 1))),
        specks=int(np.count_nonzero(pixels == 1)),
        holes=int((n_contacts - n_runs + 1)[chosen].sum()),
    )


def without_dropped(labels: np.ndarray[Any, Any], parts: Parts) -> np.ndarray[Any, Any]:
    """Return the frame with every part that is left out set to background.

    Parameters
    ----------
    labels
        (H, W) integer labels; returned as they are when nothing is left out.
    parts
        What `find_parts` said of them.
    """
    if not parts.dropped.any():
        return labels
    cleaned = labels.copy()
    for row, start, stop, _ in parts.runs[parts.dropped]:
        cleaned[row, start:stop] = 0
    return cleaned


@nb.njit(cache=True)
def _find_runs(labels):  # type: ignore[no-untyped-def]
    height, width = labels.shape
    runs = np.empty((max(64, height * width // 64), 4), np.int64)
    n = 0
    for row in range(height):
        column = 0
        while column < width:
            label = labels[row, column]
            start = column
            column += 1
            while column < width and labels[row, column] == label:
                column += 1
            if label == 0:
                continue
            if n == len(runs):
                longer = np.empty((2 * n, 4), np.int64)
                longer[:n] = runs
                runs = longer
            runs[n, 0] = row
            runs[n, 1] = start
            runs[n, 2] = column
            runs[n, 3] = label
            n += 1
    return runs[:n].copy()


@nb.njit(cache=True)
def _join_runs(runs):  # type: ignore[no-untyped-def]
    """Root run of each run (the first of its part), and its contacts with the row before."""
    n = len(runs)
    parent = np.arange(n)
    contacts = np.zeros(n, np.int64)
    previous, current = 0, 0  # first runs of the row before and of this row
    while current < n:
        row = runs[current, 0]
        after = current
        while after < n and runs[after, 0] == row:
            after += 1
        if current > 0 and runs[previous, 0] == row - 1:
            above = previous
            for run in range(current, after):
                while above < current and runs[above, 2] < runs[run, 1]:
                    above += 1
                touching = above
                while touching < current and runs[touching, 1] <= runs[run, 2]:
                    if runs[touching, 3] == runs[run, 3]:
                        contacts[run] += 1
                        a, b = touching, run
                        while parent[a] != a:
                            parent[a] = parent[parent[a]]
                            a = parent[a]
                        while parent[b] != b:
                            parent[b] = parent[parent[b]]
                            b = parent[b]
                        parent[max(a, b)] = min(a, b)
                    touching += 1
        previous = current
        current = after
    for run in range(n):
        parent[run] = parent[parent[run]]  # parents come first, so theirs are roots already
    return parent, contacts
