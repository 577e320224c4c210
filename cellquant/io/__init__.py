"""Movies in and out: TIFF stacks, folders of frames, tracking folders, calibration."""

from cellquant.io.calibration import Calibration as Calibration
from cellquant.io.ctc import compare_lineage as compare_lineage
from cellquant.io.ctc import read_ctc_lineage as read_ctc_lineage
from cellquant.io.ctc import write_ctc as write_ctc
from cellquant.io.exports import FORMATS as FORMATS
from cellquant.io.exports import export_tracks as export_tracks
from cellquant.io.inspect import Inspection as Inspection
from cellquant.io.inspect import inspect_labels as inspect_labels
from cellquant.io.stack import ImageStack as ImageStack
from cellquant.io.stack import LabelStack as LabelStack
from cellquant.io.stack import read_images as read_images
from cellquant.io.stack import read_labels as read_labels
from cellquant.io.stack import write_labels as write_labels

__all__ = [
    "FORMATS",
    "Calibration",
    "ImageStack",
    "Inspection",
    "LabelStack",
    "compare_lineage",
    "export_tracks",
    "inspect_labels",
    "read_ctc_lineage",
    "read_images",
    "read_labels",
    "write_ctc",
    "write_labels",
]
