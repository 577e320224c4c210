"""Label masks to the table of cells."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from cellquant.io.faults import FrameFaults, find_faults, same_content
from cellquant.segment.contours import Outlines, measure_outlines
from cellquant.segment.labels import FAULTS, IntArray, repair
from cellquant.segment.occupied import OccupiedArea
from cellquant.tables import CELL_COLUMNS, Cells

if TYPE_CHECKING:
    from cellquant.io import LabelStack


@dataclass(frozen=True)
class FrameCells:
    """The cells of one frame, in pixels: ``label`` (n,), ``outlines`` and the fault counts."""

    label: IntArray
    outlines: Outlines
    faults: dict[str, int]


def measure_frame(labels: np.ndarray[Any, Any]) -> FrameCells:
    """Measure every cell of one frame, in pixels.

    Parameters
    ----------
    labels
        (H, W) integer labels, 0 for background; not altered.

    Returns
    -------
    FrameCells
        Ordered by label; the rules are those of `cellquant.segment.labels`.
    """
    labels = np.ascontiguousarray(labels)
    return _measure(labels, find_faults(labels))


def _measure(labels: np.ndarray[Any, Any], found: FrameFaults) -> FrameCells:
    repaired = repair(labels, found)
    outlines = measure_outlines(repaired.labels, repaired.row, repaired.column)
    faults = {
        "fragments": found.fragments,
        "specks": found.specks,
        "holes": found.holes,
        "enclosed_cells": int(outlines.enclosed.sum()),
        "border_cells": int(outlines.touches_border.sum()),
        "too_small_for_contour": int(np.isnan(outlines.perimeter).sum()),
    }
    return FrameCells(repaired.label, outlines, faults)


def measure_cells(
    stack: "LabelStack", *, progress: Callable[[int, int], None] | None = None
) -> Cells:
    """Measure every cell of every frame of a stack of label masks.

    p = P / sqrt(A), with P the length of the sub-pixel contour and A the area inside it.

    Parameters
    ----------
    stack
        Label masks with a calibration.
    progress
        Called with the number of frames done and of all frames.

    Returns
    -------
    Cells
        Rows by frame, then label; in the units of the stack's calibration.

    Raises
    ------
    InputError
        If the stack has no calibration and none was given.

    Undefined when
        perimeter and shape_index are NaN where the contour is too coarse to have a length;
        orientation is 0 where both axes are equal.
    """
    calibration = stack.calibration
    pixel = calibration.pixel_size
    height, width = stack.shape
    faults: Counter[str] = Counter(dict.fromkeys(FAULTS, 0))
    frames: list[pd.DataFrame] = []
    occupied = OccupiedArea(stack.shape)
    before: tuple[np.ndarray[Any, Any], FrameFaults] | None = None
    n_frames = len(stack)
    for index, number in enumerate(stack.frame_numbers):
        labels = stack[index]
        found = find_faults(labels)
        occupied.add(labels, found.n_labels)
        if found.n_labels == 0:
            faults["empty_frames"] += 1
        elif before is not None and same_content(before[0], labels, before[1], found):
            faults["duplicated_frames"] += 1
        else:
            cells = _measure(labels, found)
            faults.update(cells.faults)
            frames.append(_table(number, cells, pixel))
        before = labels, found
        if progress is not None:
            progress(index + 1, n_frames)
    empty = pd.DataFrame({name: np.empty(0, dtype) for name, dtype in CELL_COLUMNS.items()})
    return Cells(
        table=pd.concat(frames, ignore_index=True) if frames else empty,
        units=calibration.units,
        pixel_size=pixel,
        frame_interval=calibration.frame_interval,
        field_of_view=(width * pixel, height * pixel),
        n_frames=n_frames,
        occupied_area=occupied.areas() * pixel**2,
        faults=dict(faults),
    )


def _table(frame: int, cells: FrameCells, pixel: float) -> pd.DataFrame:
    outlines = cells.outlines
    return pd.DataFrame(
        {
            "frame": np.full(len(cells.label), frame, dtype=np.int64),
            "label": cells.label,
            "x": outlines.x * pixel,
            "y": outlines.y * pixel,
            "area": outlines.area * pixel**2,
            "perimeter": outlines.perimeter * pixel,
            "shape_index": outlines.perimeter / np.sqrt(outlines.area),
            "aspect_ratio": outlines.aspect_ratio,
            "orientation": outlines.orientation,
            "touches_border": outlines.touches_border,
            "n_neighbours": outlines.n_neighbours,
        }
    )
