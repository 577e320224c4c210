"""Label masks to the table of cells."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from cellquant.segment.contours import Outlines, measure_outlines
from cellquant.segment.labels import FAULTS, IntArray, Parts, find_parts, without_dropped
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
    return _measure_parts(labels, find_parts(labels))


def _measure_parts(labels: np.ndarray[Any, Any], parts: Parts) -> FrameCells:
    outlines = measure_outlines(without_dropped(labels, parts), parts.row, parts.column)
    faults = {
        "fragments": parts.fragments,
        "specks": parts.specks,
        "holes": parts.holes,
        "enclosed_cells": int(outlines.enclosed.sum()),
        "border_cells": int(outlines.touches_border.sum()),
        "too_small_for_contour": int(np.isnan(outlines.perimeter).sum()),
    }
    return FrameCells(parts.label, outlines, faults)


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
    previous: IntArray | None = None
    n_frames = len(stack)
    for index, number in enumerate(stack.frame_numbers):
        labels = stack[index]
        parts = find_parts(labels)
        repeats = previous is not None and np.array_equal(parts.runs, previous)
        previous = parts.runs
        if len(parts.runs) == 0:
            faults["empty_frames"] += 1
        elif repeats:
            faults["duplicated_frames"] += 1
        else:
            cells = _measure_parts(labels, parts)
            faults.update(cells.faults)
            frames.append(_table(number, cells, pixel))
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
        occupied_area=np.full(n_frames, width * height * pixel * pixel),
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
