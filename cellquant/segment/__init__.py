"""Label masks: checked, measured, and made from images."""

from cellquant.segment.contours import Outlines, measure_outlines
from cellquant.segment.crackpaths import NEIGHBOUR_GAP
from cellquant.segment.labels import FAULTS, repair
from cellquant.segment.measure import FrameCells, measure_cells, measure_frame

__all__ = [
    "FAULTS",
    "NEIGHBOUR_GAP",
    "FrameCells",
    "Outlines",
    "measure_cells",
    "measure_frame",
    "measure_outlines",
    "repair",
]
