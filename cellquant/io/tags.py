"""The skeleton of a TIFF file, walked and checked before anything is decoded or allocated.

Reads every directory of the main chain with nothing but `struct`, so that a damaged or hostile
file is refused by name here: offsets and byte counts outside the file, loops, sizes that no data
in the file can stand behind.

References: TIFF 6.0 specification (Adobe, 1992); BigTIFF as described by AWare Systems.
"""

import math
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from cellquant.errors import InputError

#: Largest frame that is read, in pixels (padding of tiles included).
MAX_FRAME_PIXELS = 2**28
#: Most bytes that one compressed byte may stand for (zstd reaches half of it).
MAX_EXPANSION = 2**16

COMPRESSIONS = {
    1: "none",
    5: "LZW",
    8: "deflate",
    32773: "PackBits",
    32946: "deflate",
    34925: "LZMA",
    34926: "zstd",
    50000: "zstd",
}
_FORMATS = {1: "u", 2: "i", 3: "f"}
_KINDS = {
    "u1": "|u1", "i1": "|i1", "u2": "u2", "i2": "i2", "u4": "u4", "i4": "i4",
    "u8": "u8", "i8": "i8", "f2": "f2", "f4": "f4", "f8": "f8",
}  # fmt: skip
# Tags whose value we need, all others are only checked to lie inside the file.
_SUBFILE, _WIDTH, _LENGTH, _BITS, _COMPRESSION, _PHOTOMETRIC = 254, 256, 257, 258, 259, 262
_DESCRIPTION, _STRIP_OFFSETS, _SAMPLES, _ROWS, _STRIP_COUNTS = 270, 273, 277, 278, 279
_XRES, _YRES, _PREDICTOR, _TILE_WIDTH, _TILE_LENGTH = 282, 283, 317, 322, 323
_TILE_OFFSETS, _TILE_COUNTS, _FORMAT, _DEPTH, _STK = 324, 325, 339, 32997, 33629
_FILL_ORDER, _PLANAR = 266, 284
# A thumbnail, a pyramid level (1) or a transparency mask (4): not a frame.
_REDUCED = 5
_NEEDED = frozenset({
    _SUBFILE, _WIDTH, _LENGTH, _BITS, _COMPRESSION, _PHOTOMETRIC, _DESCRIPTION, _STRIP_OFFSETS,
    _SAMPLES, _ROWS, _STRIP_COUNTS, _XRES, _YRES, _PREDICTOR, _TILE_WIDTH, _TILE_LENGTH,
    _TILE_OFFSETS, _TILE_COUNTS, _FORMAT, _DEPTH, _FILL_ORDER, _PLANAR,
})  # fmt: skip
_TYPES = {
    1: "u1", 2: "S1", 3: "u2", 4: "u4", 5: "u4", 6: "i1", 7: "S1", 8: "i2", 9: "i4", 10: "i4",
    11: "f4", 12: "f8", 13: "u4", 16: "u8", 17: "i8", 18: "u8",
}  # fmt: skip
_RATIONAL = (5, 10)


@dataclass(frozen=True)
class Directory:
    """One page of a TIFF file: where it is and what it promises.

    Attributes
    ----------
    offset
        Position of the directory in the file.
    shape
        Rows and columns.
    dtype
        Type of the values in the machine's byte order.
    contiguous
        Position of the values where they lie uncompressed in one run; None otherwise.
    samples
        Values per pixel.
    planar
        More than one value per pixel, stored plane after plane.
    photometric
        How the values are meant: 2 for RGB, 3 for a colour map (TIFF 6.0, tag 262).
    """

    offset: int
    shape: tuple[int, int]
    dtype: np.dtype[np.generic]
    contiguous: int | None
    samples: int
    planar: bool
    photometric: int


@dataclass(frozen=True)
class Skeleton:
    """All pages of a TIFF file, with the description and resolution of the first.

    Attributes
    ----------
    byteorder
        ``<`` or ``>``.
    big
        BigTIFF with 64-bit offsets.
    size
        Bytes of the file.
    pages
        Frames in the order of the file, thumbnails and masks left out.
    n_reduced
        Number of pages left out.
    description
        ImageDescription of the first page; empty where there is none.
    resolution
        Pixels per unit along x and y, as XResolution and YResolution say; None where absent.
    """

    byteorder: Literal["<", ">"]
    big: bool
    size: int
    pages: tuple[Directory, ...]
    n_reduced: int
    description: str
    resolution: tuple[float, float] | None


ByteOrder = Literal["<", ">"]


class _Damaged(Exception):
    """The reason why the file cannot be what it claims to be."""


def walk(path: Path) -> Skeleton:
    """Read and check the directories of a TIFF file.

    Raises
    ------
    InputError
        If the file is missing, is no TIFF, is truncated or damaged, or holds what is no frame of
        a movie (volumes, compression or value types that are not read).
    """
    try:
        with path.open("rb") as file:
            return _walk(path, file, os.fstat(file.fileno()).st_size)
    except FileNotFoundError as error:
        raise InputError(
            f"{path} does not exist; give the path of a TIFF file or of a folder of TIFF files."
        ) from error
    except OSError as error:
        raise InputError(
            f"{path} cannot be read ({error.strerror or error}); check the path and its "
            "permissions."
        ) from error
    except _Damaged as error:
        raise InputError(
            f"{path} is truncated or damaged: {error}; copy or export the file again."
        ) from error


def _walk(path: Path, file: BinaryIO, size: int) -> Skeleton:
    order, big, offset = _header(path, file, size)
    pages: list[Directory] = []
    description: str | None = None
    resolution: tuple[float, float] | None = None
    seen: set[int] = set()
    n_reduced = 0
    while offset:
        number = len(seen)
        if offset in seen:
            raise _Damaged(f"page {number} points back to an earlier page")
        seen.add(offset)
        try:
            tags, following = _directory(file, offset, size, order, big)
            if number == 0 and _STK in tags:
                raise InputError(
                    f"{path} is a MetaMorph STK file, whose planes share one page; "
                    "export it as ImageJ or OME TIFF."
                )
            if _one(tags, _SUBFILE, 0) & _REDUCED:
                n_reduced += 1
            else:
                pages.append(_page(f"{path}, page {number}", offset, tags, size))
        except _Damaged as error:
            raise _Damaged(f"page {number}: {error}") from error
        if len(pages) == 1 and description is None:
            description, resolution = _text(tags), _resolution(tags)
        offset = following
    if not pages:
        raise InputError(f"{path} holds no image; give a TIFF stack with at least one frame.")
    return Skeleton(order, big, size, tuple(pages), n_reduced, description or "", resolution)


def _header(path: Path, file: BinaryIO, size: int) -> tuple[ByteOrder, bool, int]:
    """Byte order, whether BigTIFF, and the position of the first directory."""
    head = file.read(16)
    if size == 0:
        raise InputError(f"{path} is empty (0 bytes); copy or export the file again.")
    orders: dict[bytes, ByteOrder] = {b"II": "<", b"MM": ">"}
    order = orders.get(head[:2])
    version = struct.unpack(order + "H", head[2:4])[0] if order and len(head) >= 4 else 0
    if order is None or version not in (42, 43):
        raise InputError(
            f"{path} is not a TIFF file (it starts with {head[:8]!r}); export the masks or "
            "images as TIFF."
        )
    if version == 42 and len(head) >= 8:
        return order, False, int(struct.unpack(order + "I", head[4:8])[0])
    if version == 43 and len(head) == 16 and struct.unpack(order + "HH", head[4:8]) == (8, 0):
        return order, True, int(struct.unpack(order + "Q", head[8:])[0])
    raise _Damaged("its header is incomplete")


_Tags = dict[int, "np.ndarray[tuple[int], np.dtype[np.generic]]"]


def _directory(
    file: BinaryIO, offset: int, size: int, order: ByteOrder, big: bool
) -> tuple[_Tags, int]:
    """Needed tags of the directory at `offset`, and the position of the next directory."""
    head, entry, word = (8, 20, 8) if big else (2, 12, 4)
    if offset + head > size:
        raise _Damaged(f"it should start at byte {offset} of {size}")
    file.seek(offset)
    count = int.from_bytes(file.read(head), "little" if order == "<" else "big")
    if count == 0 or offset + head + count * entry + word > size:
        raise _Damaged(f"its {count} entries do not fit into the file of {size} bytes")
    block = file.read(count * entry)
    following = int.from_bytes(file.read(word), "little" if order == "<" else "big")
    tags: _Tags = {}
    total = 0
    for code, kind, number, raw in struct.iter_unpack(order + ("HHQ8s" if big else "HHI4s"), block):
        dtype = _TYPES.get(kind)
        if dtype is None:
            continue
        length = number * (8 if kind in _RATIONAL else np.dtype(dtype).itemsize)
        inline = length <= word
        where = 0 if inline else int.from_bytes(raw, "little" if order == "<" else "big")
        if not inline:
            total += length
            if where + length > size or total > size:
                raise _Damaged(f"the value of tag {code} lies outside the file of {size} bytes")
        if code in _NEEDED or code == _STK:
            if not inline:
                file.seek(where)
                raw = file.read(length)
            tags[code] = np.frombuffer(raw[:length], dtype=np.dtype(dtype).newbyteorder(order))
    return tags, following


def _page(where: str, offset: int, tags: _Tags, size: int) -> Directory:
    height, width = _one(tags, _LENGTH, 0), _one(tags, _WIDTH, 0)
    if height < 1 or width < 1:
        raise _Damaged(f"its size is {height} x {width} pixels")
    tiled = _TILE_WIDTH in tags
    if tiled:
        rows, columns = _one(tags, _TILE_LENGTH, 0), _one(tags, _TILE_WIDTH, 0)
        if rows < 1 or columns < 1:
            raise _Damaged(f"its tiles are {rows} x {columns} pixels")
    else:
        rows, columns = min(_one(tags, _ROWS, height), height), width
        if rows < 1:
            raise _Damaged(f"its strips have {rows} rows")
    down, across = math.ceil(height / rows), math.ceil(width / columns)
    stored = (down * rows if tiled else height) * across * columns
    if stored > MAX_FRAME_PIXELS:
        raise InputError(
            f"{where} promises {height} x {width} pixels; frames of more than "
            f"{MAX_FRAME_PIXELS} pixels are not read: crop or bin the movie, or export it again "
            "if that size is wrong."
        )
    if _one(tags, _DEPTH, 1) != 1:
        raise InputError(f"{where} is a volume; give one plane per frame.")
    samples, expected = _one(tags, _SAMPLES, 1), down * across
    planar = samples > 1 and _one(tags, _PLANAR, 1) == 2
    if planar:
        expected *= samples
    stored *= samples
    dtype = _dtype(where, tags)
    compression = _compression(where, tags)
    offsets, counts = _segments(tags, tiled, expected, size, compression, stored, dtype)
    bits = _one(tags, _BITS, 1)
    needed = math.ceil(stored * bits / 8)
    total = int(counts.sum())
    if compression == "none":
        if total < needed and bits >= 8:
            raise _Damaged(f"it needs {needed} bytes of values and has {total}")
    elif needed > total * MAX_EXPANSION:
        raise _Damaged(
            f"it promises {needed} bytes of values from {total} compressed bytes, more than "
            f"{MAX_EXPANSION} for one"
        )
    starts = offsets.astype(np.int64)
    joined = bool(np.all(starts[1:] == starts[:-1] + counts[:-1]))
    plain = compression == "none" and _one(tags, _PREDICTOR, 1) == 1 and bits >= 8
    plain = plain and _one(tags, _FILL_ORDER, 1) == 1
    contiguous = int(starts[0]) if plain and not tiled and joined else None
    colours = _one(tags, _PHOTOMETRIC, 1)
    return Directory(offset, (height, width), dtype, contiguous, samples, planar, colours)


def _segments(
    tags: _Tags,
    tiled: bool,
    expected: int,
    size: int,
    compression: str,
    stored: int,
    dtype: np.dtype[np.generic],
) -> tuple["np.ndarray[tuple[int], np.dtype[np.int64]]", ...]:
    """Offsets and byte counts of strips or tiles, each inside the file."""
    offsets = tags.get(_TILE_OFFSETS if tiled else _STRIP_OFFSETS)
    counts = tags.get(_TILE_COUNTS if tiled else _STRIP_COUNTS)
    if offsets is None and tiled:
        offsets, counts = tags.get(_STRIP_OFFSETS), tags.get(_STRIP_COUNTS)
    if counts is None and offsets is not None and len(offsets) == 1 and compression == "none":
        counts = np.array([stored * dtype.itemsize], dtype=np.uint64)
    if offsets is None or counts is None or len(offsets) == 0:
        raise _Damaged("it does not say where its values are")
    if offsets.dtype.kind != "u" or counts.dtype.kind != "u":
        raise _Damaged("the places of its values are no positive integers")
    if len(offsets) != len(counts) or len(offsets) != expected:
        raise _Damaged(f"it should have {expected} strips or tiles and lists {len(offsets)}")
    ends = offsets.astype(np.float64) + counts.astype(np.float64)
    if ends.max() > size:
        raise _Damaged(f"its values should end at byte {ends.max():.0f} of {size}")
    if counts.min() == 0 or offsets.min() == 0:
        raise _Damaged("a strip or tile has no values")
    return offsets.astype(np.int64), counts.astype(np.int64)


def _dtype(where: str, tags: _Tags) -> np.dtype[np.generic]:
    bits = _one(tags, _BITS, 1)
    kind = _FORMATS.get(_one(tags, _FORMAT, 1))
    if bits == 1 and kind == "u":
        return np.dtype(bool)
    name = _KINDS.get(f"{kind}{bits // 8}") if bits % 8 == 0 else None
    if name is None:
        raise InputError(
            f"{where} stores {bits}-bit values of sample format {_one(tags, _FORMAT, 1)}; "
            "save it with 8, 16, 32 or 64 bits."
        )
    return np.dtype(name)


def _compression(where: str, tags: _Tags) -> str:
    code = _one(tags, _COMPRESSION, 1)
    name = COMPRESSIONS.get(code)
    if name is None or _one(tags, _PREDICTOR, 1) not in (1, 2, 3):
        raise InputError(
            f"{where} uses compression {code} with predictor {_one(tags, _PREDICTOR, 1)}, which "
            "is not read; save it uncompressed or with LZW, deflate or zstd."
        )
    return name


def _one(tags: _Tags, code: int, default: int) -> int:
    values = tags.get(code)
    if values is None or len(values) == 0:
        return default
    if values.dtype.kind not in "ui":
        raise _Damaged(f"tag {code} is not an integer")
    return int(values[0])


def _text(tags: _Tags) -> str:
    values = tags.get(_DESCRIPTION)
    if values is None:
        return ""
    raw = values.tobytes().split(b"\0", 1)[0]
    try:
        return raw.decode()
    except UnicodeDecodeError:
        return raw.decode("latin-1")  # how older programs write the micro sign


def _resolution(tags: _Tags) -> tuple[float, float] | None:
    found = []
    for code in (_XRES, _YRES):
        values = tags.get(code)
        if values is None or len(values) < 2 or values.dtype.kind not in "ui" or values[1] == 0:
            return None
        found.append(float(values[0]) / float(values[1]))
    return (found[0], found[1]) if min(found) > 0 else None
