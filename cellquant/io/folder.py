"""From a path to a movie: a TIFF file, a folder of frames, a pattern, or a tracking folder."""

import glob
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from math import gcd
from pathlib import Path
from typing import Any

import numpy as np

from cellquant.errors import InputError
from cellquant.io.calibration import Metadata
from cellquant.io.tags import walk
from cellquant.io.tiff import TiffMovie, open_tiff

Array = np.ndarray[Any, np.dtype[Any]]

_SUFFIXES = (".tif", ".tiff")
# Masks of the Cell Tracking Challenge, by the tool that writes them.
_CTC_NAME = re.compile(r"(man_track|mask)\d+", re.IGNORECASE)
LINEAGES = ("man_track.txt", "res_track.txt")
_PICKLES = (".npy", ".npz", ".pkl", ".pickle")
# Names whose numbers span more than this many times the number of files count no frames.
_MAX_SPAN = 100
# No frame has a number above this.
_MAX_NUMBER = 10**6
# Regular steps in the numbering are only taken for a numbering habit from this many files on.
_MIN_REGULAR = 3


@dataclass(frozen=True)
class Movie:
    """Frames of one size, wherever they come from; fields as those of `LabelStack`."""

    path: Path
    shape: tuple[int, int]
    dtype: np.dtype[np.generic]
    axes: str
    frame_numbers: tuple[int, ...]
    metadata: Metadata
    notes: tuple[str, ...]
    read: Callable[[int], Array]


def open_movie(path: str | Path, *, labels: bool) -> Movie:
    """Find out what `path` is and open it; decodes nothing.

    Parameters
    ----------
    path
        TIFF file, folder, or pattern.
    labels
        Look for masks of the Cell Tracking Challenge inside a folder.

    Raises
    ------
    InputError
        If it is missing, no movie, ambiguous, or damaged.
    """
    text = str(path)
    path = Path(path)
    if path.is_dir():
        folder = ctc_folder(path) if labels else path
        return _open_files(folder, _frame_files(folder, labels=labels))
    if not path.exists() and glob.has_magic(text):
        files = sorted((Path(name) for name in glob.glob(text)), key=_natural)
        files = [file for file in files if file.suffix.lower() in _SUFFIXES]
        if not files:
            raise InputError(f"no TIFF file matches {text}; check the pattern.")
        return _open_file(files[0]) if len(files) == 1 else _open_files(path.parent, files)
    if path.suffix.lower() in _PICKLES:
        raise InputError(
            f"{path} is a NumPy or pickle file, which is never loaded because it can run code; "
            "save the masks as TIFF."
        )
    return _open_file(path)


def ctc_folder(path: Path) -> Path:
    """The folder with the masks at or below `path`, for any spelling of the challenge.

    Looks for masks in `path` itself, then ``TRA``, then ``*_GT/TRA`` and ``*_RES``; a folder
    without any of them is returned unchanged.

    Raises
    ------
    InputError
        If several sets of masks are there.
    """
    if _tiff_files(path):
        return path
    below = [path / "TRA"] if (path / "TRA").is_dir() else []
    if not below:
        below = sorted([*path.glob("*_GT/TRA"), *path.glob("*_RES")])
    if len(below) > 1:
        names = ", ".join(str(folder.relative_to(path)) for folder in below)
        raise InputError(f"{path} holds several sets of masks ({names}); give one of them.")
    return below[0] if below else path


def _open_file(path: Path) -> Movie:
    movie = open_tiff(path)
    return Movie(
        path, movie.shape, movie.dtype, movie.axes, tuple(range(movie.n_frames)), movie.metadata,
        movie.notes, movie.read,
    )  # fmt: skip


def _tiff_files(folder: Path) -> list[Path]:
    try:
        entries = [entry for entry in folder.iterdir() if entry.suffix.lower() in _SUFFIXES]
    except OSError as error:
        raise InputError(
            f"{folder} cannot be read ({error.strerror or error}); check its permissions."
        ) from error
    return sorted((entry for entry in entries if not entry.name.startswith(".")), key=_natural)


def _frame_files(folder: Path, *, labels: bool) -> list[Path]:
    files = _tiff_files(folder)
    if not files:
        raise InputError(f"{folder} holds no TIFF file; give a folder with one TIFF per frame.")
    if labels:
        masks = [file for file in files if _CTC_NAME.fullmatch(file.stem)]
        kinds = {re.sub(r"\d+$", "", file.stem).lower() for file in masks}
        if len(kinds) > 1:
            raise InputError(
                f"{folder} holds two sets of masks ({' and '.join(sorted(kinds))}); "
                "give a pattern such as 'man_track*.tif'."
            )
        files = masks or files
    return files


def _open_files(folder: Path, files: Sequence[Path]) -> Movie:
    """One movie of one frame per file; a single file may be a stack."""
    if len(files) == 1:
        movie = _open_file(files[0])
        if len(movie.frame_numbers) > 1:
            return movie
    raw, notes = _numbers(folder, files)
    listed = any((folder / name).is_file() for name in LINEAGES)
    numbers = raw if listed else _from_zero(raw, notes)
    if numbers[-1] - numbers[0] >= _MAX_SPAN * len(files) or numbers[-1] > _MAX_NUMBER:
        raise InputError(
            f"{folder} has names such as {files[0].name} and {files[-1].name}, whose numbers are "
            "too large or too far apart to count frames; rename the files to frame numbers."
        )
    _note_gaps(numbers, notes)
    first = open_tiff(files[0])
    dtype: np.dtype[Any] = first.dtype
    for file, number in zip(files, raw, strict=True):
        pages = walk(file).pages
        if len(pages) != 1:
            raise InputError(
                f"{file} (frame {number}) holds {len(pages)} pages; a folder of frames needs one "
                "2-D image per file, or give the file itself as a stack."
            )
        if pages[0].shape != first.shape:
            raise InputError(
                f"{file} (frame {number}) is {pages[0].shape[0]} x {pages[0].shape[1]} pixels, "
                f"{files[0].name} is {first.shape[0]} x {first.shape[1]}; "
                "give frames of one size."
            )
        if pages[0].dtype != dtype:
            note = f"files store different types, among them {dtype} and {pages[0].dtype}"
            dtype = np.result_type(dtype, pages[0].dtype)
            if not any(text.startswith("files store") for text in notes):
                notes.append(note)
    axes = "TYX" if len(files) > 1 else "YX"

    def read(index: int) -> Array:
        frame = open_tiff(files[index])
        _check_single(frame, first)
        return frame.read(0)

    return Movie(
        folder, first.shape, dtype, axes, tuple(numbers), first.metadata,
        (*first.notes, *notes), read,
    )  # fmt: skip


def _check_single(frame: TiffMovie, first: TiffMovie) -> None:
    if frame.n_frames != 1 or frame.shape != first.shape:
        raise InputError(
            f"{frame.path} holds {frame.n_frames} frames of {frame.shape[0]} x {frame.shape[1]} "
            f"pixels; give one frame of {first.shape[0]} x {first.shape[1]} per file."
        )


def _natural(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts frame10 behind frame9."""
    parts = re.split(r"(\d+)", path.name)
    return tuple(
        (1, int(part), part) if place % 2 else (0, 0, part) for place, part in enumerate(parts)
    )


def _numbers(folder: Path, files: Sequence[Path]) -> tuple[list[int], list[str]]:
    """Number of each file as its name says: the one group of digits that changes."""
    stems = [file.stem for file in files]
    if len(set(stems)) < len(stems):
        repeated = next(stem for stem in stems if stems.count(stem) > 1)
        raise InputError(
            f"{folder} holds two files named {repeated}; give the frames of one movie, each once."
        )
    split = [re.split(r"(\d+)", stem) for stem in stems]
    words = {tuple(parts[::2]) for parts in split}
    if len(words) > 1:
        if not any(len(parts) > 1 for parts in split):
            return list(range(len(files))), [
                "file names carry no number: frames follow the names in order"
            ]
        other = next(
            file for file, parts in zip(files, split, strict=True) if parts[::2] != split[0][::2]
        )
        raise InputError(
            f"{folder} mixes names such as {files[0].name} and {other.name}; keep the frames of "
            "one movie in a folder, or give a pattern such as 'mask*.tif'."
        )
    digits = [[int(part) for part in parts[1::2]] for parts in split]
    changing = [place for place in range(len(digits[0])) if len({row[place] for row in digits}) > 1]
    if len(files) == 1:
        return [digits[0][-1] if digits[0] else 0], []
    if len(changing) > 1:
        raise InputError(
            f"{folder} has names whose frame number is not clear, such as {files[0].name} and "
            f"{files[-1].name}: {len(changing)} numbers change; give a pattern for one movie."
        )
    place = changing[0] if changing else -1  # the same number in every name is an error below
    numbers = [row[place] for row in digits]
    order = np.argsort(np.array(numbers, dtype=object), kind="stable")
    if [int(i) for i in order] != list(range(len(files))) or len(set(numbers)) < len(numbers):
        twice = next((n for n in numbers if numbers.count(n) > 1), numbers[0])
        raise InputError(f"{folder} has frame number {twice} more than once; remove one of them.")
    return numbers, []


def _from_zero(numbers: list[int], notes: list[str]) -> list[int]:
    """Count from 0, and in steps of 1 where the numbering has a regular larger step."""
    start = numbers[0]
    steps = [after - before for before, after in pairwise(numbers)]
    step = reduce(gcd, steps, 0) if len(numbers) >= _MIN_REGULAR else 1
    regular = step > 1 and set(steps) == {step}
    if not regular:
        step = 1
    if start and len(numbers) > 1:
        notes.append(f"numbering starts at {start}, which is frame 0 here")
    if regular:
        notes.append(
            f"numbering advances in steps of {step}: each file is one frame, and the frame "
            "interval is the time between consecutive files"
        )
    return [(number - start) // step for number in numbers]


def _note_gaps(numbers: Sequence[int], notes: list[str]) -> None:
    missing = [(before + 1, after - 1) for before, after in pairwise(numbers) if after > before + 1]
    if missing:
        count = sum(last - first + 1 for first, last in missing)
        listed = ", ".join(
            str(first) if first == last else f"{first} to {last}" for first, last in missing[:10]
        )
        more = ", ..." if len(missing) > 10 else ""
        notes.append(f"{count} frames are missing: {listed}{more}")
