"""Movies of label masks and of raw images, read lazily, one frame at a time."""

import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, SupportsIndex

import numpy as np
import tifffile

from cellquant.errors import InputError
from cellquant.io.calibration import Calibration, Metadata, check_options, resolve
from cellquant.io.folder import open_movie
from cellquant.storage import atomic_path

Array = np.ndarray[Any, np.dtype[Any]]
_INT32_MAX = np.iinfo(np.int32).max


@dataclass(frozen=True)
class _Options:
    pixel_size: float | None
    frame_interval: float | None
    units: str | None


class _Stack:
    """Frames of one size behind one reader; see `LabelStack` and `ImageStack`."""

    def __init__(
        self,
        *,
        path: Path | None,
        shape: tuple[int, int],
        dtype: np.dtype[np.generic],
        axes: str,
        frame_numbers: tuple[int, ...],
        notes: tuple[str, ...],
        metadata: Metadata,
        options: _Options,
        read: Callable[[int], Array],
    ) -> None:
        self.path = path
        self.shape = shape
        self.dtype = dtype
        self.axes = axes
        self.frame_numbers = frame_numbers
        self.notes = notes
        self._metadata = metadata
        self._options = options
        self._read = read

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.frame_numbers)

    @property
    def name(self) -> str:
        """What to call the stack in a message."""
        return "the array" if self.path is None else str(self.path)

    @property
    def calibration(self) -> Calibration:
        """Pixel size and frame interval.

        Raises
        ------
        InputError
            If neither the options nor the file give them and units are not ``"pixel"``.
        """
        return resolve(
            self.name,
            self._metadata,
            pixel_size=self._options.pixel_size,
            frame_interval=self._options.frame_interval,
            units=self._options.units,
            n_frames=self.n_frames,
        )

    def __len__(self) -> int:
        return self.n_frames

    def __getitem__(self, index: SupportsIndex) -> Array:
        position = operator.index(index)
        if not -self.n_frames <= position < self.n_frames:
            raise IndexError(f"frame index {position} of {self.n_frames} frames")
        return self._frame(position % self.n_frames)

    def __iter__(self) -> Iterator[Array]:
        return (self[index] for index in range(self.n_frames))

    def __repr__(self) -> str:
        rows, columns = self.shape
        return (
            f"<{type(self).__name__} {self.name}: {self.n_frames} frames of {rows} x {columns}, "
            f"{self.dtype}>"
        )

    def _frame(self, index: int) -> Array:
        return np.ascontiguousarray(self._read(index))


class LabelStack(_Stack):
    """A movie of label masks: 0 is background, each cell has one positive integer per frame.

    ``stack[i]`` reads frame i as a 2-D C-contiguous array, int32 where its labels fit and int64
    where they do not; iterating reads one frame after the other. Nothing is kept in memory.

    Attributes
    ----------
    path : pathlib.Path or None
        File or folder; None for an array in memory.
    n_frames : int
        Number of frames.
    shape : tuple of int
        Rows and columns.
    dtype : numpy.dtype
        Type of the values as stored.
    axes : str
        Axes as stored, ``TYX`` or another name for time in front, ``YX`` for a single frame.
    frame_numbers : tuple of int
        Number of each frame, rising; a gap is a frame that is missing from the folder.
    notes : tuple of str
        How the input was understood, where that is not obvious.
    calibration : Calibration
        Pixel size and frame interval; raises `InputError` when there are none.
    """

    @classmethod
    def from_array(
        cls,
        array: Array,
        *,
        pixel_size: float | None = None,
        frame_interval: float | None = None,
        units: str | None = None,
    ) -> "LabelStack":
        """Label masks that are in memory already.

        Parameters
        ----------
        array
            (T, H, W), or (H, W) for a single frame; integers or whole numbers.
        pixel_size
            Edge of a pixel, um.
        frame_interval
            Time between frames, min.
        units
            ``"pixel"`` for results in pixels and frames.

        Raises
        ------
        InputError
            If the array is not 2-D or 3-D, is empty, or an option is wrong.
        """
        check_options(pixel_size, frame_interval, units)
        array = np.asarray(array)
        if array.ndim == 2:
            array = array[np.newaxis]
        if array.ndim != 3 or 0 in array.shape:
            raise InputError(
                f"label masks must have the shape (T, H, W) with at least one frame and pixel, "
                f"got {array.shape}; add or drop axes."
            )
        _check_kind("the array", array.dtype)
        return cls(
            path=None,
            shape=(array.shape[1], array.shape[2]),
            dtype=array.dtype,
            axes="TYX",
            frame_numbers=tuple(range(array.shape[0])),
            notes=(),
            metadata=Metadata(),
            options=_Options(pixel_size, frame_interval, units),
            read=array.__getitem__,
        )

    def _frame(self, index: int) -> Array:
        where = f"{self.name}, frame {self.frame_numbers[index]}"
        return _as_labels(where, self._read(index))


class ImageStack(_Stack):
    """A movie of raw images of one channel, the companion of a `LabelStack`.

    ``stack[i]`` reads frame i as a 2-D C-contiguous array of the stored type. Attributes as those
    of `LabelStack`.
    """


def read_labels(
    path: str | Path,
    *,
    pixel_size: float | None = None,
    frame_interval: float | None = None,
    units: str | None = None,
) -> LabelStack:
    """Open label masks; frames are read when they are asked for.

    Parameters
    ----------
    path
        A TIFF stack (multi-page, ImageJ, OME, BigTIFF), a folder with one TIFF per frame, a folder
        of the Cell Tracking Challenge or one that holds it, or a pattern such as ``"t1/*.tif"``.
    pixel_size
        Edge of a pixel, um; overrides the file's own.
    frame_interval
        Time between consecutive frame numbers, min; overrides the file's own.
    units
        ``"pixel"`` for results in pixels and frames where there is no calibration.

    Returns
    -------
    LabelStack

    Raises
    ------
    InputError
        If the input is missing, no movie of labels, damaged, or an option is wrong. Values are
        checked when a frame is read: negative or fractional ones are refused there.
    """
    check_options(pixel_size, frame_interval, units)
    movie = open_movie(path, labels=True)
    _check_kind(str(movie.path), movie.dtype)
    notes = movie.notes
    if movie.dtype.kind == "f":
        notes += (f"stored as {movie.dtype}: read as integers, refused where not whole",)
    return LabelStack(
        path=movie.path,
        shape=movie.shape,
        dtype=movie.dtype,
        axes=movie.axes,
        frame_numbers=movie.frame_numbers,
        notes=notes,
        metadata=movie.metadata,
        options=_Options(pixel_size, frame_interval, units),
        read=movie.read,
    )


def read_images(
    path: str | Path,
    *,
    pixel_size: float | None = None,
    frame_interval: float | None = None,
    units: str | None = None,
) -> ImageStack:
    """Open raw images of one channel; frames are read when they are asked for.

    Parameters, returned attributes and errors as for `read_labels`, except that any real type of
    pixel value is accepted.
    """
    check_options(pixel_size, frame_interval, units)
    movie = open_movie(path, labels=False)
    return ImageStack(
        path=movie.path,
        shape=movie.shape,
        dtype=movie.dtype,
        axes=movie.axes,
        frame_numbers=movie.frame_numbers,
        notes=movie.notes,
        metadata=movie.metadata,
        options=_Options(pixel_size, frame_interval, units),
        read=movie.read,
    )


def write_labels(
    path: str | Path,
    frames: Sequence[Array] | LabelStack | Array,
    *,
    pixel_size: float | None = None,
    frame_interval: float | None = None,
) -> None:
    """Write label masks as a compressed OME-TIFF, byte-equal for equal input.

    Values are stored as uint16 where every label fits and as uint32 where not. Frames are taken
    one at a time (twice: once for the largest label), so a lazy sequence is never held in memory.

    Parameters
    ----------
    path
        File to write; replaced only when everything has been written.
    frames
        (T, H, W) array, `LabelStack`, or any sequence of 2-D integer arrays of one shape.
    pixel_size
        Edge of a pixel, um; written as PhysicalSizeX and PhysicalSizeY.
    frame_interval
        Time between frames, min; written as TimeIncrement in seconds.

    Raises
    ------
    InputError
        If there is no frame, frames differ in size, a label is negative or above 2^32 - 1, or
        the path cannot be written.
    """
    check_options(pixel_size, frame_interval, None)
    n_frames = len(frames)
    if n_frames == 0:
        raise InputError(f"{path}: there is no frame to write; give at least one.")
    shape, largest = np.shape(frames[0]), 0
    for index in range(n_frames):
        frame = _as_labels(f"{path}, frame {index}", np.asarray(frames[index]))
        if frame.ndim != 2 or frame.shape != shape or 0 in shape:
            raise InputError(
                f"{path}: frame {index} has the shape {frame.shape}, frame 0 has {shape}; "
                "give 2-D frames of one size."
            )
        largest = max(largest, int(frame.max()))
    if largest > np.iinfo(np.uint32).max:
        raise InputError(f"{path}: label {largest} does not fit into 32 bits; relabel the cells.")
    dtype = np.dtype(np.uint16 if largest <= np.iinfo(np.uint16).max else np.uint32)
    metadata: dict[str, Any] = {"axes": "TYX", "UUID": "00000000-0000-0000-0000-000000000000"}
    if pixel_size is not None:
        metadata |= {"PhysicalSizeX": pixel_size, "PhysicalSizeXUnit": "µm"}
        metadata |= {"PhysicalSizeY": pixel_size, "PhysicalSizeYUnit": "µm"}
    if frame_interval is not None:
        metadata |= {"TimeIncrement": frame_interval * 60, "TimeIncrementUnit": "s"}
    with atomic_path(path) as temporary:
        tifffile.imwrite(
            temporary,
            (np.asarray(frames[index]).astype(dtype) for index in range(n_frames)),
            shape=(n_frames, *shape),
            dtype=dtype,
            ome=True,
            bigtiff=n_frames * shape[0] * shape[1] * dtype.itemsize > 2**31,
            compression="zlib",
            photometric="minisblack",
            metadata=metadata,
            maxworkers=1,
        )


def _check_kind(where: str, dtype: np.dtype[np.generic]) -> None:
    if dtype.kind not in "buif":
        raise InputError(f"{where} holds {dtype} values; labels must be integers.")


def _as_labels(where: str, values: Array) -> Array:
    """Values as int32 or int64 labels; refuse what is no label."""
    kind = values.dtype.kind
    if kind == "f":
        whole = np.isfinite(values) & (values == np.floor(values)) & (np.abs(values) < 2.0**53)
        if not whole.all():
            row, column = np.argwhere(~whole)[0]
            raise InputError(
                f"{where} holds {values[row, column]:g} at row {row}, column {column}, which is "
                "no label; give label masks (integers), not images or probabilities."
            )
        values = values.astype(np.int64)
    small = kind == "b" or (kind in "iu" and values.dtype.itemsize < 4)
    if kind != "u" and kind != "b" and values.size and values.min() < 0:
        row, column = np.argwhere(values < 0)[0]
        raise InputError(
            f"{where} holds the negative label {values[row, column]} at row {row}, column "
            f"{column}; set background to 0 and number cells from 1."
        )
    largest = 0 if small or not values.size else int(values.max())
    if largest > np.iinfo(np.int64).max:
        raise InputError(f"{where} holds the label {largest}, above 2^63 - 1; relabel the cells.")
    dtype = np.int32 if largest <= _INT32_MAX else np.int64
    return np.ascontiguousarray(values, dtype=dtype)
