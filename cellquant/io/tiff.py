"""One TIFF file as a sequence of equal frames, decoded one at a time."""

import contextlib
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import tifffile

from cellquant.errors import InputError
from cellquant.io.calibration import Metadata
from cellquant.io.descriptions import Layout, describe
from cellquant.io.tags import ByteOrder, Directory, Skeleton, walk

Array = np.ndarray[Any, np.dtype[Any]]

# Photometric interpretations of TIFF 6.0: RGB and YCbCr, and a colour map.
_COLOURS, _PALETTE = (2, 6), 3

# Its remarks about odd tags would land on the terminal; what matters is raised by the walk.
logging.getLogger("tifffile").addHandler(logging.NullHandler())


@dataclass(frozen=True)
class TiffMovie:
    """A checked TIFF file.

    Attributes
    ----------
    path
        The file.
    n_frames
        Number of frames.
    shape
        Rows and columns of each.
    dtype
        As stored.
    axes
        ``YX`` for a single frame, else the time axis under the name that the file gives it.
    metadata
        Calibration of the file.
    notes
        What a user should know about how the file was understood.
    """

    path: Path
    n_frames: int
    shape: tuple[int, int]
    dtype: np.dtype[np.generic]
    axes: str
    metadata: Metadata
    notes: tuple[str, ...]
    _pages: tuple[Directory, ...]
    _byteorder: ByteOrder
    _run: bool
    _planar: bool

    def read(self, index: int) -> Array:
        """Values of frame `index` (0 <= index < n_frames) as stored, in native byte order.

        Raises
        ------
        InputError
            If the values cannot be decoded.
        """
        with _reading(self.path, index):
            if self._run:
                return self._read_run(index)
            if self._planar:
                planes = self._read_page(self._pages[0], (self.n_frames, *self.shape))
                return np.array(planes[index])
            return self._read_page(self._pages[index], self.shape)

    def _read_run(self, index: int) -> Array:
        start = self._pages[0].contiguous
        if start is None:
            raise ValueError("a run of frames needs uncompressed values in one piece")
        n_values = self.shape[0] * self.shape[1]
        stored = self.dtype.newbyteorder(self._byteorder)
        offset = start + index * n_values * self.dtype.itemsize
        values = np.fromfile(self.path, dtype=stored, count=n_values, offset=offset)
        return values.reshape(self.shape).astype(self.dtype, copy=False)

    def _read_page(self, page: Directory, shape: tuple[int, ...]) -> Array:
        with tifffile.TiffFile(self.path) as file:
            file.filehandle.seek(page.offset)
            values: Array = tifffile.TiffPage(file, 0).asarray(maxworkers=1)
        if values.shape != shape:
            raise ValueError(f"decoded to {values.shape} instead of {shape}")
        return values


@contextlib.contextmanager
def _reading(path: Path, index: int) -> Iterator[None]:
    """Turn whatever a decoder says about damaged values into one sentence."""
    try:
        yield
    except MemoryError as error:
        raise InputError(
            f"{path}, frame {index}, does not fit into memory; crop or bin the movie."
        ) from error
    except FileNotFoundError as error:
        raise InputError(f"{path} has vanished since it was opened; put it back.") from error
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise InputError(
            f"{path}, frame {index}, cannot be decoded ({reason}); the file is damaged: "
            "copy or export it again."
        ) from error


def open_tiff(path: Path) -> TiffMovie:
    """Check a TIFF file and find its frames; decodes nothing.

    Raises
    ------
    InputError
        If the file is missing, no TIFF, truncated, damaged, of several channels or images, or of
        frames that differ in size or type.
    """
    skeleton = walk(path)
    pages = skeleton.pages
    first = pages[0]
    if first.samples > 1 and not first.planar:
        _refuse_colour(path, first)
    layout = describe(path, skeleton.description, skeleton.resolution)
    for number, page in enumerate(pages):
        if page.shape != first.shape or page.dtype != first.dtype:
            raise InputError(
                f"{path}: frame {number} is {_words(page)}, frame 0 is {_words(first)}; "
                "give a stack whose frames are all alike."
            )
    if layout.plane_shape not in (None, first.shape):
        raise InputError(
            f"{path} describes planes of {layout.plane_shape}, but its pages are {first.shape}; "
            "save it with axes TYX."
        )
    notes: list[str] = []
    planar = first.samples > 1
    if planar:
        if not _planes_are_frames(first, layout, len(pages)):
            _refuse_colour(path, first)
        notes.append(
            f"{first.samples} colour planes of one page are read as {first.samples} frames, as "
            "the description of the file says"
        )
    declared = layout.n_planes
    n_pages, run = len(pages), False
    n_frames, axes = n_pages, layout.axes
    if planar:
        n_frames = first.samples
    elif declared is not None and declared > n_pages:
        if n_pages > 1 or first.contiguous is None:
            raise InputError(
                f"{path} is truncated: it describes {declared} frames and holds {n_pages}; "
                "copy or export the file again."
            )
        _check_run(path, skeleton, declared)
        n_frames, run = declared, True
    elif declared is not None and declared < n_pages:
        if declared > 1 and layout.dialect != "ImageJ":
            raise InputError(
                f"{path} holds several image series ({n_pages} pages, the first series has "
                f"{declared}); save one series per file."
            )
        notes.append(f"{n_pages} separately written pages are read as {n_pages} frames")
        axes = ""
    if n_frames == 1:
        axes = "YX"
    elif len(axes) != 3:
        axes = "IYX"
    if n_frames > 1 and axes[0] != "T":
        notes.append(
            f"axes {axes}: the first axis ({axes[0]}) is not named time and is read as time"
        )
    if skeleton.n_reduced:
        notes.append(f"{skeleton.n_reduced} thumbnails or reduced pages are left out")
    if first.photometric == _PALETTE:
        notes.append("the colour map is ignored: pixel values are read as they are")
    if layout.order is not None and n_frames == n_pages and declared == n_pages:
        if max(layout.order) >= n_pages:
            raise InputError(
                f"{path} has OME-XML that refers to page {max(layout.order)} of {n_pages}; "
                "export the file again."
            )
        pages = tuple(pages[number] for number in layout.order)
    return TiffMovie(
        path, n_frames, first.shape, first.dtype, axes, layout.metadata, tuple(notes), pages,
        skeleton.byteorder, run, planar,
    )  # fmt: skip


def _planes_are_frames(page: Directory, layout: Layout, n_pages: int) -> bool:
    """Whether a page of several values per pixel is a short movie.

    tifffile stores an array of 3 or 4 frames as the planes of one colour picture, unless it is
    told not to; its description gives the array away.
    """
    movie = page.planar and n_pages == 1 and layout.dialect == "tifffile"
    return movie and (layout.n_planes, layout.plane_shape) == (page.samples, page.shape)


def _refuse_colour(path: Path, page: Directory) -> NoReturn:
    kind = "an RGB picture" if page.photometric in _COLOURS else "several channels"
    raise InputError(
        f"{path} has {page.samples} values per pixel ({kind}); give a single-channel stack: "
        "label masks, or one channel of the images."
    )


def _check_run(path: Path, skeleton: Skeleton, n_frames: int) -> None:
    """Frames after the first lie behind it without a page of their own: are they all there?"""
    page = skeleton.pages[0]
    needed = (page.contiguous or 0) + (
        n_frames * page.shape[0] * page.shape[1] * page.dtype.itemsize
    )
    if needed > skeleton.size:
        raise InputError(
            f"{path} is truncated: its {n_frames} frames should end at byte {needed} of "
            f"{skeleton.size}; copy or export the file again."
        )


def _words(page: Directory) -> str:
    return f"{page.shape[0]} x {page.shape[1]} {page.dtype}"
