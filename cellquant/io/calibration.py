"""Pixel size and frame interval: from options, from the file, or refused."""

import math
from dataclasses import dataclass

from cellquant.errors import InputError
from cellquant.tables import PHYSICAL, PIXEL, Units

_MICROMETRES = {
    "um": 1.0,
    "micron": 1.0,
    "microns": 1.0,
    "micrometer": 1.0,
    "micrometers": 1.0,
    "micrometre": 1.0,
    "micrometres": 1.0,
    "nm": 1e-3,
    "nanometer": 1e-3,
    "nanometers": 1e-3,
    "nanometre": 1e-3,
    "nanometres": 1e-3,
    "å": 1e-4,
    "angstrom": 1e-4,
    "pm": 1e-6,
    "mm": 1e3,
    "millimeter": 1e3,
    "millimeters": 1e3,
    "millimetre": 1e3,
    "cm": 1e4,
    "centimeter": 1e4,
    "centimetre": 1e4,
    "m": 1e6,
    "meter": 1e6,
    "metre": 1e6,
}
_MINUTES = {
    "s": 1 / 60,
    "sec": 1 / 60,
    "secs": 1 / 60,
    "second": 1 / 60,
    "seconds": 1 / 60,
    "ms": 1 / 60e3,
    "msec": 1 / 60e3,
    "millisecond": 1 / 60e3,
    "milliseconds": 1 / 60e3,
    "us": 1 / 60e6,
    "µs": 1 / 60e6,
    "min": 1.0,
    "mins": 1.0,
    "minute": 1.0,
    "minutes": 1.0,
    "h": 60.0,
    "hr": 60.0,
    "hour": 60.0,
    "hours": 60.0,
    "d": 1440.0,
    "day": 1440.0,
    "days": 1440.0,
}


@dataclass(frozen=True)
class Calibration:
    """Size of a pixel and time between frames.

    Attributes
    ----------
    pixel_size
        Edge of a pixel in ``units.length``.
    frame_interval
        Time between consecutive frame numbers in ``units.time``.
    units
        `cellquant.tables.PHYSICAL` (um, min) or `cellquant.tables.PIXEL` (px, frame).
    source
        Where the two numbers come from, in words.
    """

    pixel_size: float
    frame_interval: float
    units: Units
    source: str


@dataclass(frozen=True)
class Metadata:
    """What a file says of its own calibration; None where it says nothing.

    Attributes
    ----------
    pixel_size
        In um.
    frame_interval
        In min.
    source
        ``ImageJ metadata`` or ``OME metadata``; empty where there is none.
    problem
        Why a pixel size in the file cannot be used; empty where there is no such reason.
    """

    pixel_size: float | None = None
    frame_interval: float | None = None
    source: str = ""
    problem: str = ""


def micrometres_per(unit: str) -> float | None:
    """Length of one `unit` in um; None for a unit that is not a length we know."""
    name = unit.strip().replace("\\u00B5", "u").replace("\\u00b5", "u")
    name = name.replace("\u00b5", "u").replace("\u03bc", "u")
    return _MICROMETRES.get(name.lower())


def minutes_per(unit: str) -> float | None:
    """Duration of one `unit` in min; None for a unit that is not a time we know."""
    name = unit.strip().replace("\u03bc", "\u00b5")
    return _MINUTES.get(name.lower())


def check_options(
    pixel_size: float | None, frame_interval: float | None, units: str | None
) -> None:
    """Refuse calibration options that are no positive number or contradict each other.

    Raises
    ------
    InputError
        Naming the option, its value and the remedy.
    """
    for name, value, unit in (
        ("pixel_size", pixel_size, "um"),
        ("frame_interval", frame_interval, "min"),
    ):
        if value is None:
            continue
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not number or not math.isfinite(value) or value <= 0:
            raise InputError(
                f"{name} must be a finite number > 0 {unit}, got {value!r}; give the value of "
                "the microscope, or leave it out to use the file's own."
            )
    if units not in (None, "pixel"):
        raise InputError(
            f"units must be 'pixel' or left out, got {units!r}; leave it out for um and min."
        )
    if units == "pixel" and (pixel_size is not None or frame_interval is not None):
        raise InputError(
            "units='pixel' and a pixel_size or frame_interval contradict each other; "
            "give either the calibration or units='pixel'."
        )


def resolve(
    where: str,
    metadata: Metadata,
    *,
    pixel_size: float | None,
    frame_interval: float | None,
    units: str | None,
    n_frames: int,
) -> Calibration:
    """Decide the calibration: options first, then the file's own, else refuse.

    Parameters
    ----------
    where
        Name of the stack for messages.
    metadata
        What the file says.
    pixel_size, frame_interval
        Options in um and min; None to use the file's.
    units
        ``"pixel"`` for pixels and frames as units, whatever the file says.
    n_frames
        A single frame needs no frame interval.

    Raises
    ------
    InputError
        Where a number is missing or the file's own cannot be used.
    """
    if units == "pixel":
        return Calibration(1.0, 1.0, PIXEL, "units pixel by option")
    sources = []
    missing = []
    if pixel_size is not None:
        sources.append("pixel size by option")
    elif metadata.problem:
        raise InputError(
            f"{where}: {metadata.problem}; give the pixel size (--pixel-size UM) or --units pixel."
        )
    elif metadata.pixel_size is not None:
        pixel_size = metadata.pixel_size
        sources.append(f"pixel size from {metadata.source}")
    else:
        missing.append("pixel size (--pixel-size UM)")
    if frame_interval is not None:
        sources.append("frame interval by option")
    elif metadata.frame_interval is not None:
        frame_interval = metadata.frame_interval
        sources.append(f"frame interval from {metadata.source}")
    elif n_frames == 1:
        frame_interval = 1.0
        sources.append("single frame, its frame interval of 1 min is never used")
    else:
        missing.append("frame interval (--frame-interval MIN)")
    if missing or pixel_size is None or frame_interval is None:
        raise InputError(
            f"{where} carries no calibration: give its {' and '.join(missing)}, or say "
            "--units pixel for results in pixels and frames."
        )
    return Calibration(float(pixel_size), float(frame_interval), PHYSICAL, ", ".join(sources))
