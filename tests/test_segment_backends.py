"""Masks from images: the watershed on drawn and recorded cells, micro-sam by a stand-in."""

import stat
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

from cellquant.errors import InputError
from cellquant.io import read_images, read_labels
from cellquant.segment.backends import (
    guess_modality,
    segment_frame,
    segment_micro_sam,
    segment_watershed,
)

CENTRES = [(30, 30), (32, 80), (80, 40), (90, 95), (85, 70)]


def fluorescent(seed: int = 0) -> np.ndarray:
    """Five bright discs of 10 px radius on a dark noisy field, two of them touching."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:120, :130]
    image = rng.normal(100, 3, size=y.shape)
    for k, (row, column) in enumerate(CENTRES):
        image += (np.hypot(y - row, x - column) < 10) * (60 + 200 * k)
    return image.astype(np.uint16)


@pytest.fixture
def movie(tmp_path: Path) -> Path:
    path = tmp_path / "images.tif"
    frames = np.stack([fluorescent(0), fluorescent(1)])
    tifffile.imwrite(path, frames, metadata={"axes": "TYX"}, photometric="minisblack")
    return path


def best_overlaps(labels: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Intersection over union of each true cell with its best match."""
    overlaps = []
    for number in np.unique(truth)[1:]:
        cell = truth == number
        others = np.unique(labels[cell])
        overlaps.append(
            max(
                (np.sum(cell & (labels == o)) / np.sum(cell | (labels == o)) for o in others if o),
                default=0.0,
            )
        )
    return np.array(overlaps)


def test_watershed_finds_drawn_cells(movie: Path, tmp_path: Path) -> None:
    output, calls = tmp_path / "out" / "masks.tif", []
    segment_watershed(read_images(movie), output, progress=lambda *done: calls.append(done))
    masks = read_labels(output, units="pixel")
    assert (masks.n_frames, masks.shape, masks.dtype) == (2, (120, 130), np.uint16)
    assert calls == [(1, 2), (2, 2)]
    y, x = np.mgrid[:120, :130]
    for labels in masks:
        assert labels.max() == 5
        for row, column in CENTRES:
            found = labels == labels[row, column]
            assert found.sum() == pytest.approx(np.pi * 100, rel=0.2)
            assert np.hypot(x[found].mean() - column, y[found].mean() - row) < 1


def test_equal_input_gives_equal_bytes(movie: Path, tmp_path: Path) -> None:
    for name in ("a.tif", "b.tif"):
        segment_watershed(read_images(movie), tmp_path / name, cell_diameter=20)
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()


@pytest.mark.parametrize("modality", ["fluorescence", "phase_contrast"])
@pytest.mark.parametrize("image", [np.zeros((60, 70)), np.full((60, 70), 9), np.eye(64) * 50])
def test_images_without_cells_give_no_cells(modality: str, image: np.ndarray) -> None:
    labels = segment_frame(image.astype(np.uint8), modality=modality, cell_diameter=20)
    assert labels.shape == image.shape
    assert labels.max() == 0 or np.all(np.bincount(labels.ravel())[1:] >= 0.08 * 400)


def test_options_are_checked(movie: Path, tmp_path: Path) -> None:
    images = read_images(movie)
    with pytest.raises(InputError, match="modality must be"):
        segment_watershed(images, tmp_path / "m.tif", modality="brightfield")
    with pytest.raises(InputError, match="cell_diameter must be"):
        segment_watershed(images, tmp_path / "m.tif", cell_diameter=0)
    blank = tmp_path / "blank.tif"
    tifffile.imwrite(blank, np.zeros((2, 60, 60), np.uint8), photometric="minisblack")
    with pytest.raises(InputError, match="no cell was found"):
        segment_watershed(read_images(blank), tmp_path / "m.tif")
    assert not (tmp_path / "m.tif").exists()


@pytest.mark.parametrize(
    ("name", "modality", "share", "overlap"),
    [
        ("hela_fluorescence", "fluorescence", 0.8, 0.8),
        ("t98g_phase_contrast", "phase_contrast", 0.4, 0.6),
    ],
)
def test_recorded_cells(
    recordings: Path, name: str, modality: str, share: float, overlap: float
) -> None:
    """At default settings, at least a share of the given cells is found, with a mean overlap."""
    image = read_images(recordings / name / "images.tif")[0]
    truth = read_labels(recordings / name / "masks.tif", units="pixel")[0]
    assert guess_modality(image) == modality
    diameter = 27 if modality == "fluorescence" else 60
    found = best_overlaps(segment_frame(image, modality=modality, cell_diameter=diameter), truth)
    assert np.mean(found > 0.5) > share
    assert found[found > 0.5].mean() > overlap


PROGRAM = """#!{python}
import argparse, sys, time
import numpy as np, tifffile
parser = argparse.ArgumentParser()
for flags in (("-i", "--input_path"), ("-o", "--output_path"), ("-m", "--model_type")):
    parser.add_argument(*flags, required=True)
parser.add_argument("-n", "--ndim", type=int)
arguments = parser.parse_args()
images = tifffile.imread(arguments.input_path)
mode = arguments.model_type
if mode == "crash":
    print("loading", file=sys.stderr)
    print("RuntimeError: CUDA out of memory", file=sys.stderr)
    sys.exit(3)
if mode == "sleep":
    time.sleep(60)
if mode == "nothing":
    sys.exit(0)
assert arguments.ndim == (3 if images.ndim == 3 else 2)
masks = (images > 130).astype(np.uint32)
if mode == "small":
    masks = masks[..., :-1]
if mode == "empty":
    masks[:] = 0
if mode == "float":
    masks = masks + 0.5
if mode == "garbage":
    open(arguments.output_path, "wb").write(b"II*")
else:
    tifffile.imwrite(arguments.output_path, masks, compression="zlib")
"""


@pytest.fixture
def stand_in(tmp_path: Path) -> str:
    """A program that takes micro-sam's options and writes files as it does."""
    path = tmp_path / "micro_sam_stand_in"
    path.write_text(PROGRAM.format(python=sys.executable))
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


def test_micro_sam_masks_are_written(movie: Path, stand_in: str, tmp_path: Path) -> None:
    output = tmp_path / "masks.tif"
    segment_micro_sam(movie, output, executable=stand_in)
    masks = read_labels(output, units="pixel")
    assert (masks.n_frames, masks.dtype) == (2, np.uint32)
    with tifffile.TiffFile(output) as file:
        assert file.series[0].axes == "QYX"
    np.testing.assert_array_equal(masks[1] > 0, fluorescent(1) > 130)
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_micro_sam_command_with_arguments(movie: Path, stand_in: str, tmp_path: Path) -> None:
    single = tmp_path / "one.tif"
    tifffile.imwrite(single, fluorescent())
    segment_micro_sam(single, tmp_path / "m.tif", executable=f"{sys.executable} {stand_in}")
    assert read_labels(tmp_path / "m.tif", units="pixel").n_frames == 1


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("crash", "exit code 3.*loading / RuntimeError: CUDA out of memory"),
        ("sleep", "took longer than 2 s"),
        ("nothing", "wrote no masks"),
        ("small", "2 frames of \\(120, 129\\)"),
        ("empty", "they hold no cell"),
        ("float", "which is no label"),
        ("garbage", "cannot be used"),
    ],
)
def test_micro_sam_failures(
    movie: Path, stand_in: str, tmp_path: Path, model: str, message: str
) -> None:
    output = tmp_path / "masks.tif"
    output.write_text("what was there before")
    timeout = 2 if model == "sleep" else 60
    with pytest.raises(InputError, match=message):
        segment_micro_sam(movie, output, executable=stand_in, model=model, timeout=timeout)
    assert output.read_text() == "what was there before"
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_micro_sam_that_is_not_there(movie: Path, tmp_path: Path) -> None:
    for executable in ("no-such-micro-sam", ""):
        with pytest.raises(InputError, match="was not found"):
            segment_micro_sam(movie, tmp_path / "m.tif", executable=executable)
