"""Pixel size and frame interval: from the file, from options, or refused."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from cellquant.errors import InputError
from cellquant.io import Calibration, LabelStack, read_labels
from cellquant.tables import PHYSICAL, PIXEL

FRAMES = np.ones((5, 6, 7), np.uint16)


def imagej(path: Path, *, resolution: tuple[float, float] | None, **metadata: Any) -> Calibration:
    tifffile.imwrite(path, FRAMES, imagej=True, resolution=resolution,
                     metadata={"axes": "TYX", **metadata})  # fmt: skip
    return read_labels(path).calibration


def ome(path: Path, **metadata: Any) -> Calibration:
    tifffile.imwrite(path, FRAMES, ome=True, metadata={"axes": "TYX", **metadata})
    return read_labels(path).calibration


@pytest.mark.parametrize(
    ("unit", "pixels_per_unit"),
    [("um", 1 / 0.65), ("micron", 1 / 0.65), ("\\u00B5m", 1 / 0.65),
     ("nm", 1 / 650), ("mm", 1e3 / 0.65), ("cm", 1e4 / 0.65)],
)  # fmt: skip
def test_imagej_length_units(tmp_path: Path, unit: str, pixels_per_unit: float) -> None:
    found = imagej(tmp_path / "m.tif", resolution=(pixels_per_unit, pixels_per_unit), unit=unit,
                   finterval=600)  # fmt: skip
    assert found.pixel_size == pytest.approx(0.65, rel=1e-6)
    assert found.frame_interval == pytest.approx(10, rel=1e-12)
    assert found.units == PHYSICAL
    assert found.source == "pixel size from ImageJ metadata, frame interval from ImageJ metadata"


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
@pytest.mark.parametrize("sign", ["\u00b5", "\u03bc"])
def test_imagej_micro_sign_as_bytes(tmp_path: Path, encoding: str, sign: str) -> None:
    if (encoding, sign) == ("latin-1", "\u03bc"):
        return
    tifffile.imwrite(tmp_path / "m.tif", FRAMES, resolution=(2, 2), metadata=None,
                     description=f"ImageJ=1.54f\nimages=5\nframes=5\nunit={sign}m\nfinterval=60\n"
                     .encode(encoding))  # fmt: skip
    found = read_labels(tmp_path / "m.tif").calibration
    assert (found.pixel_size, found.frame_interval) == (0.5, 1)


@pytest.mark.parametrize(
    ("tunit", "value"), [("sec", 600), ("s", 600), ("min", 10), ("ms", 600_000), ("h", 1 / 6)]
)
def test_imagej_time_units(tmp_path: Path, tunit: str, value: float) -> None:
    found = imagej(tmp_path / "m.tif", resolution=(2, 2), unit="um", finterval=value, tunit=tunit)
    assert found.frame_interval == pytest.approx(10, rel=1e-12)
    assert found.pixel_size == pytest.approx(0.5, rel=1e-9)


@pytest.mark.parametrize(
    ("size", "unit"), [(0.65, None), (0.65, "µm"), (650, "nm"), (0.65e-3, "mm"), (6500, "Å")]
)
@pytest.mark.parametrize(("interval", "tunit"), [(600, None), (10, "min"), (600_000, "ms")])
def test_ome_units(
    tmp_path: Path, size: float, unit: str | None, interval: float, tunit: str | None
) -> None:
    metadata: dict[str, Any] = {
        "PhysicalSizeX": size, "PhysicalSizeY": size, "TimeIncrement": interval,
    }  # fmt: skip
    if unit is not None:
        metadata |= {"PhysicalSizeXUnit": unit, "PhysicalSizeYUnit": unit}
    if tunit is not None:
        metadata["TimeIncrementUnit"] = tunit
    found = ome(tmp_path / "m.tif", **metadata)
    assert found.pixel_size == pytest.approx(0.65, rel=1e-12)
    assert found.frame_interval == pytest.approx(10, rel=1e-12)
    assert "OME" in found.source


@pytest.mark.parametrize(
    ("moments", "interval"),
    [([0, 601, 1200, 1799, 2400], 10), ([0, 600, 1200, 1800, 9000], None), ([0] * 5, None)],
)
def test_ome_times_of_planes(tmp_path: Path, moments: list[float], interval: float | None) -> None:
    plane = {"DeltaT": moments}
    if interval is None:
        with pytest.raises(InputError, match="frame interval"):
            ome(tmp_path / "m.tif", PhysicalSizeX=0.65, PhysicalSizeY=0.65, Plane=plane)
    else:
        found = ome(tmp_path / "m.tif", PhysicalSizeX=0.65, PhysicalSizeY=0.65, Plane=plane)
        assert found.frame_interval == pytest.approx(interval, rel=0.01)


def test_options_override_the_file(tmp_path: Path) -> None:
    imagej(tmp_path / "m.tif", resolution=(2, 2), unit="um", finterval=60)
    found = read_labels(tmp_path / "m.tif", pixel_size=0.9).calibration
    assert (found.pixel_size, found.frame_interval) == (0.9, 1)
    assert found.source == "pixel size by option, frame interval from ImageJ metadata"
    found = read_labels(tmp_path / "m.tif", pixel_size=0.9, frame_interval=7).calibration
    assert (found.pixel_size, found.frame_interval) == (0.9, 7)
    found = read_labels(tmp_path / "m.tif", units="pixel").calibration
    assert (found.pixel_size, found.frame_interval, found.units) == (1, 1, PIXEL)


def test_without_calibration_physical_results_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", FRAMES)
    stack = read_labels(tmp_path / "m.tif")
    assert stack[0].shape == (6, 7)
    with pytest.raises(InputError, match=r"m\.tif carries no calibration.*--units pixel"):
        _ = stack.calibration
    with pytest.raises(InputError, match=r"give its frame interval"):
        _ = read_labels(tmp_path / "m.tif", pixel_size=1.0).calibration
    assert read_labels(tmp_path / "m.tif", units="pixel").calibration.units == PIXEL


def test_half_a_calibration_names_the_missing_half(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"give its frame interval \(--frame-interval MIN\), or"):
        imagej(tmp_path / "m.tif", resolution=(2, 2), unit="um")
    with pytest.raises(InputError, match=r"give its pixel size \(--pixel-size UM\), or"):
        imagej(tmp_path / "m.tif", resolution=None, finterval=60)


@pytest.mark.parametrize("unit", ["pixel", "inch", "", "furlong"])
def test_units_that_are_no_calibration(tmp_path: Path, unit: str) -> None:
    with pytest.raises(InputError, match="carries no calibration"):
        imagej(tmp_path / "m.tif", resolution=(72, 72), unit=unit)


def test_print_resolution_is_no_pixel_size(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", FRAMES, resolution=(300, 300), resolutionunit="INCH")
    with pytest.raises(InputError, match="carries no calibration"):
        _ = read_labels(tmp_path / "m.tif").calibration


def test_pixels_that_are_not_square(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"not square \(0\.5 x 0\.25 um\)"):
        imagej(tmp_path / "m.tif", resolution=(2, 4), unit="um", finterval=60)
    assert read_labels(tmp_path / "m.tif", pixel_size=0.5).calibration.pixel_size == 0.5
    with pytest.raises(InputError, match="not square"):
        ome(tmp_path / "o.tif", PhysicalSizeX=0.5, PhysicalSizeY=0.6, TimeIncrement=1)


def test_one_frame_needs_no_interval() -> None:
    found = LabelStack.from_array(FRAMES[0], pixel_size=0.5).calibration
    assert found.pixel_size == 0.5
    assert "never used" in found.source


@pytest.mark.parametrize("name", ["pixel_size", "frame_interval"])
@pytest.mark.parametrize("value", [0, -1, math.nan, math.inf, -math.inf, "0.65", True])
def test_wrong_options(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"{name} must be a finite number > 0"):
        LabelStack.from_array(FRAMES, **{name: value})


def test_contradictory_options() -> None:
    with pytest.raises(InputError, match="contradict"):
        LabelStack.from_array(FRAMES, pixel_size=0.5, units="pixel")
    with pytest.raises(InputError, match="units must be 'pixel'"):
        LabelStack.from_array(FRAMES, units="inch")
