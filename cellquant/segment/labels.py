"""What of a label mask is measured, by stated rules.

The masks themselves are never altered. The rules, each counted under the name in brackets:

- Pixels of one label that touch by an edge or a corner form a part. The largest part of a label
  is the cell: among equals the most compact one (least spread about its centroid), of congruent
  ones the first in reading order. Every other part is left out [``fragments``], or [``specks``]
  when it is a single pixel.
- A label of one single pixel is no cell and is left out [``specks``].
- What a cell encloses belongs to it: holes are filled [``holes``].
- A label with another one all around it is measured as well [``enclosed_cells``], and the area of
  the outer cell holds it too.
- A frame that repeats the one before it, whatever its numbers, is not measured
  [``duplicated_frames``]; a frame without any label has no cells [``empty_frames``]. Both are
  missing frames to whatever follows, never frames without motion.
- A cell on the edge of the image is measured and flagged [``border_cells``].
- A cell of less than 10 pixels, or one pixel wide, has no perimeter and no shape index
  [``too_small_for_contour``].
"""

from typing import Any, NamedTuple

import numba as nb
import numpy as np

from cellquant.io.faults import FrameFaults

IntArray = np.ndarray[Any, np.dtype[np.int64]]

FAULTS = (
    "fragments",
    "specks",
    "holes",
    "enclosed_cells",
    "border_cells",
    "too_small_for_contour",
    "duplicated_frames",
    "empty_frames",
)


class Repaired(NamedTuple):
    """One frame as it is measured.

    Attributes
    ----------
    label
        (n,) the labels that are cells, rising.
    row, column
        (n,) first pixel of each cell in reading order.
    labels
        (H, W) the frame without the parts that are left out; the input itself where there are
        none.
    """

    label: IntArray
    row: IntArray
    column: IntArray
    labels: np.ndarray[Any, Any]


def repair(labels: np.ndarray[Any, Any], found: FrameFaults) -> Repaired:
    """Leave out of a frame what is no cell.

    Parameters
    ----------
    labels
        (H, W) integer labels, 0 for background; not altered.
    found
        What `cellquant.io.faults.find_faults` said of them.

    Returns
    -------
    Repaired
    """
    is_cell = found.body[:, 2] > 1
    if len(found.spare):
        labels = labels.copy()
        _erase(labels, found.spare)
    return Repaired(
        label=found.label[is_cell],
        row=np.ascontiguousarray(found.body[is_cell, 0]),
        column=np.ascontiguousarray(found.body[is_cell, 1]),
        labels=labels,
    )


@nb.njit(cache=True)
def _erase(labels, starts):  # type: ignore[no-untyped-def]
    """Set the parts with the given first pixels to background."""
    height, width = labels.shape
    waiting = np.empty((64, 2), np.int64)
    for k in range(len(starts)):
        label = labels[starts[k, 0], starts[k, 1]]
        waiting[0, 0], waiting[0, 1] = starts[k, 0], starts[k, 1]
        labels[starts[k, 0], starts[k, 1]] = 0
        n = 1
        while n > 0:
            n -= 1
            row, column = waiting[n, 0], waiting[n, 1]
            for y in range(max(row - 1, 0), min(row + 2, height)):
                for x in range(max(column - 1, 0), min(column + 2, width)):
                    if labels[y, x] != label:
                        continue
                    labels[y, x] = 0
                    if n == len(waiting):
                        longer = np.empty((2 * n, 2), np.int64)
                        longer[:n] = waiting
                        waiting = longer
                    waiting[n, 0], waiting[n, 1] = y, x
                    n += 1
