"""What the text in the first page of a TIFF says: axes, number of planes, calibration.

Three dialects are understood: ImageJ (``key=value`` lines), OME (XML) and the JSON that tifffile
writes. A file without any of them is a plain sequence of pages.

References: Goldberg et al., Genome Biology 6, R47 (2005) for OME; the OME model 2016-06; the
``TiffDecoder`` of ImageJ for its keys.
"""

import json
import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median

from cellquant.errors import InputError
from cellquant.io.calibration import Metadata, micrometres_per, minutes_per

# Pixels whose edges differ by more than this fraction are not square.
_SQUARE = 1e-3
# Intervals between planes that differ by more than this fraction are not regular.
_REGULAR = 0.1
_EXPORT = "export one channel of one plane per time point"


@dataclass(frozen=True)
class Layout:
    """How the planes of a file follow one another.

    Attributes
    ----------
    n_planes
        Number of planes the description promises; None where it promises none.
    axes
        Axes as stored, ending in YX, those of length 1 left out.
    order
        Page of each plane where the file lists them; None where planes follow the pages.
    plane_shape
        Rows and columns where the description states them.
    metadata
        Calibration of the file.
    dialect
        ``ImageJ``, ``OME``, ``tifffile`` or ``plain``.
    """

    n_planes: int | None
    axes: str
    order: tuple[int, ...] | None
    plane_shape: tuple[int, int] | None
    metadata: Metadata
    dialect: str


def describe(path: Path, description: str, resolution: tuple[float, float] | None) -> Layout:
    """Interpret the ImageDescription of the first page.

    Parameters
    ----------
    path
        The file, for messages.
    description
        Its text.
    resolution
        Pixels per unit along x and y.

    Raises
    ------
    InputError
        If the file holds several channels, several images, or planes as well as time points.
    """
    text = description.strip()
    if text.startswith("ImageJ="):
        return _imagej(path, text, resolution)
    if text.startswith("<") and "<OME" in text[:4000]:
        return _ome(path, text)
    if text.startswith("{") and '"shape"' in text:
        return _tifffile(path, text)
    return Layout(None, "", None, None, Metadata(), "plain")


def _leading(path: Path, sizes: list[tuple[str, int]]) -> str:
    """The one axis longer than 1 that is time, whatever its name; refuse several, and channels."""
    long = [(name, size) for name, size in sizes if size != 1]
    listed = ", ".join(f"{size} along {name}" for name, size in long)
    if any(name in ("C", "S") for name, _ in long):
        raise InputError(f"{path} holds several channels ({listed}); {_EXPORT}.")
    if len(long) > 1:
        raise InputError(f"{path} holds more than a time series ({listed}); {_EXPORT}.")
    return long[0][0] if long else ""


def _imagej(path: Path, text: str, resolution: tuple[float, float] | None) -> Layout:
    keys: dict[str, str] = {}
    for line in text.splitlines():
        key, mark, value = line.partition("=")
        if mark:
            keys[key.strip()] = value.strip()
    sizes = {name: _count(path, keys, name) for name in ("frames", "slices", "channels", "images")}
    known = [("T", sizes["frames"]), ("Z", sizes["slices"]), ("C", sizes["channels"])]
    axis = _leading(path, [(name, size or 1) for name, size in known])
    n_planes = math.prod(size or 1 for _, size in known)
    images = sizes["images"]
    if n_planes == 1 and images is not None and images > 1:
        axis, n_planes = "I", images
    declared = None if n_planes == 1 and images is None else n_planes
    unit = keys.get("unit", "")
    pixel_size, problem = None, ""
    per = micrometres_per(unit)
    if per is not None and resolution is not None:
        width, height = per / resolution[0], per / resolution[1]
        yunit = keys.get("yunit", unit)
        height *= (micrometres_per(yunit) or per) / per
        pixel_size, problem = _square(width, height)
    interval = None
    minutes = minutes_per(keys.get("tunit", "sec"))
    seconds = _number(keys.get("finterval", ""))
    if seconds is not None and minutes is not None:
        interval = seconds * minutes
    return Layout(
        declared,
        axis + "YX",
        None,
        None,
        Metadata(pixel_size, interval, "ImageJ metadata", problem),
        "ImageJ",
    )


def _tifffile(path: Path, text: str) -> Layout:
    try:
        content = json.loads(text)
        shape = [int(size) for size in content["shape"]]
        axes = str(content.get("axes", ""))
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return Layout(None, "", None, None, Metadata(), "plain")
    if len(shape) < 2 or min(shape) < 1:
        raise InputError(
            f"{path} states the shape {shape}, which holds no pixel; give a stack with at least "
            "one frame."
        )
    if len(axes) != len(shape):
        axes = "Q" * (len(shape) - 2) + "YX"
    sizes = list(zip(axes, shape, strict=True))
    while len(sizes) > 2 and sizes[-1][1] == 1 and sizes[-1][0] not in "YX":
        sizes.pop()
    if sizes[-2][0] + sizes[-1][0] != "YX":
        raise InputError(
            f"{path} has the axes {axes}, whose last two are not rows and columns (YX); "
            "save it with time first."
        )
    axis = _leading(path, sizes[:-2])
    n_planes = math.prod(size for _, size in sizes[:-2])
    plane = (sizes[-2][1], sizes[-1][1])
    return Layout(n_planes, axis + "YX", None, plane, Metadata(), "tifffile")


def _ome(path: Path, text: str) -> Layout:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path} has OME-XML with a document type, which is not read; export it.")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise InputError(
            f"{path} has OME-XML that cannot be parsed ({error}); export the file again."
        ) from error
    images = [element for element in root.iter() if _name(element) == "Pixels"]
    if len(images) != 1:
        raise InputError(
            f"{path} holds {len(images)} OME images; export one image or position per file."
        )
    pixels = images[0]
    names = [("T", "SizeT"), ("Z", "SizeZ"), ("C", "SizeC")]
    sizes = {axis: _count(path, dict(pixels.attrib), key) or 1 for axis, key in names}
    axis = _leading(path, list(sizes.items()))
    n_planes = math.prod(sizes.values())
    order = _ome_order(path, pixels, axis, n_planes)
    pixel_size, problem = None, ""
    width = _length(pixels, "PhysicalSizeX")
    height = _length(pixels, "PhysicalSizeY")
    if width is not None:
        pixel_size, problem = _square(width, width if height is None else height)
    interval = _number(pixels.get("TimeIncrement", ""))
    minutes = minutes_per(pixels.get("TimeIncrementUnit", "s"))
    interval = None if interval is None or minutes is None else interval * minutes
    if interval is None and axis == "T":
        interval = _interval_of_planes(pixels)
    metadata = Metadata(pixel_size, interval, "OME metadata", problem)
    return Layout(n_planes, axis + "YX", order, None, metadata, "OME")


def _ome_order(
    path: Path, pixels: ElementTree.Element, axis: str, n_planes: int
) -> tuple[int, ...] | None:
    """Page of each plane as the TiffData elements list them; None where they list nothing."""
    blocks = [element for element in pixels if _name(element) == "TiffData"]
    names = {
        element.get("FileName", "").lower()
        for block in blocks
        for element in block
        if _name(element) == "UUID" and element.get("FileName")
    }
    if len(names) > 1:
        raise InputError(
            f"{path} is one of {len(names)} files of an OME set; export the movie as one file, "
            "or give a folder of single frames."
        )
    if not any("IFD" in block.attrib or f"First{axis}" in block.attrib for block in blocks):
        return None
    pages: dict[int, int] = {}
    for block in blocks:
        fields = {
            key: _whole(path, block.get(key))
            for key in ("IFD", "PlaneCount", f"First{axis or 'T'}")
        }
        count = fields["PlaneCount"]
        if count is None:
            count = 1 if fields["IFD"] is not None else n_planes
        for step in range(min(count, n_planes)):
            pages[(fields[f"First{axis or 'T'}"] or 0) + step] = (fields["IFD"] or 0) + step
    missing = [plane for plane in range(n_planes) if plane not in pages]
    if missing:
        raise InputError(
            f"{path} has OME-XML that says nothing of frame {missing[0]} of {n_planes}; "
            "export the file again."
        )
    return tuple(pages[plane] for plane in range(n_planes))


def _interval_of_planes(pixels: ElementTree.Element) -> float | None:
    """Time between planes in min where each states when it was taken, at regular intervals."""
    moments: dict[int, float] = {}
    for plane in pixels:
        minutes = minutes_per(plane.get("DeltaTUnit", "s"))
        if _name(plane) != "Plane" or minutes is None:
            continue
        try:
            moments[int(plane.get("TheT", ""))] = float(plane.get("DeltaT", "")) * minutes
        except ValueError:
            return None
    times = [moments[number] for number in sorted(moments)]
    steps = [after - before for before, after in pairwise(times)]
    if not steps or sorted(moments) != list(range(len(moments))):
        return None
    middle = median(steps)
    regular = math.isfinite(middle) and middle > 0
    regular = regular and all(abs(step - middle) <= _REGULAR * middle for step in steps)
    return middle if regular else None


def _name(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def _length(pixels: ElementTree.Element, key: str) -> float | None:
    value = _number(pixels.get(key, ""))
    per = micrometres_per(pixels.get(f"{key}Unit", "um"))
    return None if value is None or per is None else value * per


def _square(width: float, height: float) -> tuple[float | None, str]:
    if not (math.isfinite(width) and math.isfinite(height)) or min(width, height) <= 0:
        return None, ""
    if abs(width - height) > _SQUARE * width:
        return None, f"its pixels are not square ({width:.6g} x {height:.6g} um)"
    return width, ""


def _number(text: str) -> float | None:
    """A positive finite number, or None; 0 is how ImageJ says that it does not know."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and value > 0 else None


def _whole(path: Path, text: str | None) -> int | None:
    if text is None:
        return None
    try:
        value = int(text)
    except ValueError:
        value = -1
    if not 0 <= value < 2**31:
        raise InputError(
            f"{path} says {text[:40]!r} where its description must hold a number of planes; "
            "export the file again."
        )
    return value


def _count(path: Path, keys: dict[str, str], name: str) -> int | None:
    value = _whole(path, keys.get(name))
    if value == 0:
        raise InputError(f"{path} is an empty stack: its description says {name} = 0; give frames.")
    return value
