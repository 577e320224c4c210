"""Label masks: checked, measured, and made from images."""

from cellquant.segment.contours import Outlines, measure_outlines
from cellquant.segment.labels import FAULTS, Parts, find_parts
from cellquant.segment.measure import FrameCells, measure_cells, measure_frame

__all__ = [
    "FAULTS",
    "FrameCells",
    "Outlines",
    "Parts",
    "find_parts",
    "measure_cells",
    "measure_frame",
    "measure_outlines",
]
