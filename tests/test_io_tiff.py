"""Reading TIFF files of every kind, and refusing what is no movie."""

import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from cellquant.errors import InputError
from cellquant.io import LabelStack, read_images, read_labels, write_labels


def masks(n: int = 5, height: int = 30, width: int = 41, *, dtype: Any = np.uint16) -> np.ndarray:
    """A movie in which no two frames, rows or columns are alike."""
    rng = np.random.default_rng(7)
    array = rng.integers(0, 200, size=(n, height, width)).astype(dtype)
    array[:, 0, 0] = np.arange(1, n + 1)
    return array


def assert_frames(stack: LabelStack, expected: np.ndarray) -> None:
    assert len(stack) == stack.n_frames == len(expected)
    assert stack.shape == expected.shape[1:]
    for index, frame in enumerate(stack):
        assert frame.flags.c_contiguous
        assert frame.dtype in (np.int32, np.int64)
        np.testing.assert_array_equal(frame, expected[index])


KINDS: dict[str, dict[str, Any]] = {
    "plain": {"metadata": None},
    "tifffile": {"metadata": {"axes": "TYX"}},
    "imagej": {"imagej": True, "metadata": {"axes": "TYX"}},
    "ome": {"ome": True, "metadata": {"axes": "TYX"}},
    "bigtiff": {"bigtiff": True},
    "big-endian": {"byteorder": ">"},
    "big-endian bigtiff": {"byteorder": ">", "bigtiff": True, "compression": "zlib"},
    "lzw": {"compression": "lzw"},
    "lzw with predictor": {"compression": "lzw", "predictor": True},
    "zlib": {"compression": "zlib"},
    "zlib big-endian predictor": {"compression": "zlib", "predictor": True, "byteorder": ">"},
    "zstd": {"compression": "zstd"},
    "deflate": {"compression": "deflate"},
    "lzma": {"compression": "lzma"},
    "packbits": {"compression": "packbits"},
    "tiled": {"tile": (16, 32)},
    "tiled zstd": {"tile": (16, 16), "compression": "zstd"},
    "strips": {"rowsperstrip": 7, "compression": "zlib"},
    "uncompressed strips": {"rowsperstrip": 7},
    "single directory": {"metadata": {"axes": "TYX"}, "truncate": True},
    "single directory, big-endian": {"truncate": True, "byteorder": ">"},
    "singleton axes": {"metadata": {"axes": "TZCYX"}, "expand": True},
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_tiff(tmp_path: Path, kind: str) -> None:
    options = dict(KINDS[kind])
    array = masks()
    stored = array[:, None, None] if options.pop("expand", False) else array
    tifffile.imwrite(tmp_path / "m.tif", stored, photometric="minisblack", **options)
    stack = read_labels(tmp_path / "m.tif")
    assert_frames(stack, array)
    assert stack.frame_numbers == (0, 1, 2, 3, 4)
    assert stack.dtype == np.uint16


@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", ">u4", "f4"])
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_every_type_of_label(tmp_path: Path, dtype: str, compression: str | None) -> None:
    array = (masks() % 120).astype(dtype)
    byteorder = ">" if dtype.startswith(">") else "<"
    tifffile.imwrite(tmp_path / "m.tif", array, compression=compression, byteorder=byteorder,
                     photometric="minisblack")  # fmt: skip
    assert_frames(read_labels(tmp_path / "m.tif"), array)


def test_labels_beyond_16_and_32_bits(tmp_path: Path) -> None:
    array = masks(dtype=np.uint64)
    array[0, 3, 3] = 70_000
    array[1, 3, 3] = 2**40
    tifffile.imwrite(tmp_path / "m.tif", array)
    stack = read_labels(tmp_path / "m.tif")
    assert_frames(stack, array)
    assert [frame.dtype for frame in stack] == [np.int32, np.int64, np.int32, np.int32, np.int32]
    array[2, 3, 3] = 2**63
    tifffile.imwrite(tmp_path / "m.tif", array)
    with pytest.raises(InputError, match=r"frame 2 holds the label 9223372036854775808"):
        read_labels(tmp_path / "m.tif")[2]


def test_bilevel_masks(tmp_path: Path) -> None:
    array = masks() > 100
    tifffile.imwrite(tmp_path / "m.tif", array)
    assert_frames(read_labels(tmp_path / "m.tif"), array)


def test_single_frame(tmp_path: Path) -> None:
    array = masks(1)
    tifffile.imwrite(tmp_path / "m.tif", array[0])
    stack = read_labels(tmp_path / "m.tif")
    assert_frames(stack, array)
    assert stack.axes == "YX"


@pytest.mark.parametrize("shape", [(5, 1, 9), (1, 1, 1), (2, 3, 4), (3, 3, 3)])
def test_thin_frames(tmp_path: Path, shape: tuple[int, int, int]) -> None:
    array = np.arange(np.prod(shape), dtype=np.uint16).reshape(shape)
    tifffile.imwrite(tmp_path / "m.tif", array, photometric="minisblack")
    assert_frames(read_labels(tmp_path / "m.tif"), array)


@pytest.mark.parametrize(("axes", "name"), [("ZYX", "Z"), ("QYX", "Q"), (None, "Q")])
def test_first_axis_is_time_and_said_so(tmp_path: Path, axes: str | None, name: str) -> None:
    metadata = {} if axes is None else {"axes": axes}
    tifffile.imwrite(tmp_path / "m.tif", masks(dtype=np.uint32), compression="zlib",
                     metadata=metadata)  # fmt: skip
    stack = read_labels(tmp_path / "m.tif")
    assert_frames(stack, masks())
    assert stack.axes == f"{name}YX"
    assert any(f"({name}) is not named time and is read as time" in note for note in stack.notes)


def test_imagej_slices_are_read_as_time(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", masks(), imagej=True, metadata={"axes": "ZYX"})
    stack = read_labels(tmp_path / "m.tif")
    assert_frames(stack, masks())
    assert stack.axes == "ZYX"


def test_pages_written_one_by_one(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "m.tif") as writer:
        for frame in masks():
            writer.write(frame)
    stack = read_labels(tmp_path / "m.tif")
    assert_frames(stack, masks())
    assert any("separately written" in note for note in stack.notes)


def test_ome_planes_in_any_order(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", masks(), ome=True, metadata={"axes": "TYX"})
    text = tifffile.tiffcomment(tmp_path / "m.tif")
    start = text.index("<TiffData")
    stop = text.index("/>", start) + 2
    blocks = "".join(f'<TiffData IFD="{4 - t}" FirstT="{t}" PlaneCount="1"/>' for t in range(5))
    tifffile.tiffcomment(tmp_path / "m.tif", (text[:start] + blocks + text[stop:]).encode())
    assert_frames(read_labels(tmp_path / "m.tif"), masks()[::-1])


def test_thumbnails_are_left_out(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "m.tif") as writer:
        writer.write(masks(), metadata=None)
        writer.write(np.zeros((8, 8, 3), np.uint8), subfiletype=1, photometric="rgb")
    stack = read_labels(tmp_path / "m.tif")
    assert_frames(stack, masks())
    assert any("thumbnails" in note for note in stack.notes)


def test_palette_is_ignored_and_said_so(tmp_path: Path) -> None:
    colours = np.zeros((3, 256), np.uint16)
    tifffile.imwrite(tmp_path / "m.tif", masks(dtype=np.uint8), photometric="palette",
                     colormap=colours)  # fmt: skip
    stack = read_labels(tmp_path / "m.tif")
    assert_frames(stack, masks())
    assert any("colour map" in note for note in stack.notes)


def test_whole_float_labels_are_read_and_noted(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", masks(dtype=np.float32))
    stack = read_labels(tmp_path / "m.tif")
    assert_frames(stack, masks())
    assert any("float32" in note for note in stack.notes)


def test_images_keep_their_type(tmp_path: Path) -> None:
    array = masks(dtype=np.float32) + 0.5
    tifffile.imwrite(tmp_path / "i.tif", array)
    stack = read_images(tmp_path / "i.tif")
    assert stack[1].dtype == np.float32
    np.testing.assert_array_equal(stack[-1], array[-1])


def test_memory_stays_flat_in_the_number_of_frames(tmp_path: Path) -> None:
    peaks = []
    for n_frames in (5, 40):
        path = tmp_path / f"{n_frames}.tif"
        tifffile.imwrite(path, masks(n_frames, 256, 256), compression="zlib")
        tracemalloc.start()
        assert sum(int(frame[0, 0]) for frame in read_labels(path)) > 0
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # 35 more frames of 128 kB each (256 kB as int32) may cost no more than one of them.
    assert peaks[1] < peaks[0] + 256 * 256 * 4


def test_indexing(tmp_path: Path) -> None:
    stack = LabelStack.from_array(masks())
    assert_frames(stack, masks())
    np.testing.assert_array_equal(stack[np.int64(-1)], masks()[-1])
    with pytest.raises(IndexError):
        stack[5]


# What is refused.


def refused(path: Path, words: str) -> None:
    """Opening or reading every frame raises an InputError that names the path."""
    with pytest.raises(InputError, match=words) as info:
        list(read_labels(path))
    assert path.name in str(info.value)
    assert "\n" not in str(info.value)


def test_missing_file(tmp_path: Path) -> None:
    refused(tmp_path / "none.tif", "does not exist")


def test_not_a_tiff(tmp_path: Path) -> None:
    (tmp_path / "m.tif").write_bytes(b"\x89PNG\r\n\x1a\n and more")
    refused(tmp_path / "m.tif", "not a TIFF")


def test_empty_file(tmp_path: Path) -> None:
    (tmp_path / "m.tif").touch()
    refused(tmp_path / "m.tif", "is empty")


def test_no_page(tmp_path: Path) -> None:
    (tmp_path / "m.tif").write_bytes(struct.pack("<2sHI", b"II", 42, 0))
    refused(tmp_path / "m.tif", "holds no image")


@pytest.mark.parametrize("name", ["m.npy", "m.npz", "m.pkl"])
def test_pickles_are_never_loaded(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"cos\nsystem\n(S'touch hacked'\ntR.")
    refused(tmp_path / name, "never loaded")


@pytest.mark.parametrize("kind", ["plain", "imagej", "ome", "bigtiff", "zlib", "tiled zstd",
                                  "single directory"])  # fmt: skip
def test_truncated_at_open(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "m.tif"
    tifffile.imwrite(path, masks(12, 64, 64), photometric="minisblack", **KINDS[kind])
    content = path.read_bytes()
    for fraction in (0.02, 0.3, 0.5, 0.9, 0.99):
        path.write_bytes(content[: int(len(content) * fraction)])
        with pytest.raises(InputError, match=r"truncated|damaged"):
            read_labels(path)


def test_frames_lost_from_a_described_stack(tmp_path: Path) -> None:
    path = tmp_path / "m.tif"
    tifffile.imwrite(path, masks(), metadata={"axes": "TYX"}, compression="zlib")
    with tifffile.TiffFile(path, mode="r+") as file:
        # Cut the chain of pages after the third.
        link = file.pages[2].offset + 2 + 12 * len(file.pages[2].tags)
        file.filehandle.seek(link)
        file.filehandle.write(struct.pack("<I", 0))
    refused(path, "describes 5 frames and holds 3")


def test_pages_in_a_circle(tmp_path: Path) -> None:
    path = tmp_path / "m.tif"
    tifffile.imwrite(path, masks(), metadata=None)
    with tifffile.TiffFile(path, mode="r+") as file:
        first, last = file.pages[1].offset, file.pages[4]
        file.filehandle.seek(last.offset + 2 + 12 * len(last.tags))
        file.filehandle.write(struct.pack("<I", first))
    refused(path, "points back")


def test_damaged_values_name_the_frame(tmp_path: Path) -> None:
    path = tmp_path / "m.tif"
    tifffile.imwrite(path, masks(), compression="zlib")
    with tifffile.TiffFile(path) as file:
        start = file.pages[2].dataoffsets[0]
    content = bytearray(path.read_bytes())
    content[start + 20 : start + 40] = bytes(20)
    path.write_bytes(bytes(content))
    stack = read_labels(path)
    np.testing.assert_array_equal(stack[1], masks()[1])
    with pytest.raises(InputError, match=r"m\.tif, frame 2, cannot be decoded"):
        stack[2]


def test_too_few_values_are_no_background(tmp_path: Path) -> None:
    """A strip that decompresses to less than it should is refused, not padded with zeros."""
    import zlib

    path = tmp_path / "m.tif"
    tifffile.imwrite(path, masks(1)[0], compression="zlib", metadata=None)
    with tifffile.TiffFile(path) as file:
        start, count = file.pages[0].dataoffsets[0], file.pages[0].databytecounts[0]
    short = zlib.compress(masks(1)[0][:10].tobytes(), 9)
    assert len(short) <= count
    content = bytearray(path.read_bytes())
    content[start : start + count] = short.ljust(count, b"\0")
    path.write_bytes(bytes(content))
    refused(path, "cannot be decoded")


@pytest.mark.parametrize("big", [False, True])
def test_hostile_size_is_refused_before_allocation(tmp_path: Path, big: bool) -> None:
    path = tmp_path / "m.tif"
    tifffile.imwrite(path, masks(1)[0], compression="zlib", bigtiff=big, metadata=None)
    set_tags(path, {256: 1_000_000, 257: 1_000_000, 278: 1_000_000})
    tracemalloc.start()
    refused(path, r"promises 1000000 x 1000000 pixels; frames of more than 268435456")
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_size_that_no_data_can_stand_behind(tmp_path: Path) -> None:
    path = tmp_path / "m.tif"
    tifffile.imwrite(path, np.zeros((8, 8), np.uint16), compression="zlib", metadata=None)
    set_tags(path, {256: 16_000, 257: 16_000, 278: 16_000})
    refused(path, "promises 512000000 bytes of values from")


def test_hostile_tiles(tmp_path: Path) -> None:
    path = tmp_path / "m.tif"
    tifffile.imwrite(path, masks(1, 16, 16)[0], tile=(16, 16), compression="zlib", metadata=None)
    set_tags(path, {322: 2**30, 323: 2**30})
    refused(path, "are not read")


def set_tags(path: Path, values: dict[int, int]) -> None:
    """Overwrite tags in place, as 32-bit values."""
    with tifffile.TiffFile(path) as file:
        page, order, big = file.pages[0], file.byteorder, file.is_bigtiff
        places = {code: page.tags[code].offset for code in values if code in page.tags}
    content = bytearray(path.read_bytes())
    for code, place in places.items():
        content[place + 2 : place + 4] = struct.pack(order + "H", 4)
        where = place + (12 if big else 8)
        content[where : where + 4] = struct.pack(order + "I", values[code])
    path.write_bytes(bytes(content))


def test_rgb(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", np.zeros((4, 9, 9, 3), np.uint8), photometric="rgb")
    refused(tmp_path / "m.tif", "RGB")


def test_planar_rgb(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", np.zeros((3, 9, 9), np.uint8), photometric="rgb",
                     planarconfig="separate", metadata=None)  # fmt: skip
    refused(tmp_path / "m.tif", "RGB")


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("n", [3, 4])
def test_short_movies_stored_as_colour_planes(
    tmp_path: Path, n: int, compression: str | None
) -> None:
    tifffile.imwrite(tmp_path / "m.tif", masks(n, dtype=np.uint8), photometric="rgb",
                     planarconfig="separate", compression=compression)  # fmt: skip
    stack = read_labels(tmp_path / "m.tif")
    assert_frames(stack, masks(n))
    assert any("colour planes" in note for note in stack.notes)


@pytest.mark.parametrize("kind", ["imagej", "ome", "tifffile"])
def test_several_channels(tmp_path: Path, kind: str) -> None:
    options = {**KINDS[kind], "metadata": {"axes": "TCYX"}}
    array = np.zeros((4, 2, 9, 9), np.uint16)
    tifffile.imwrite(tmp_path / "m.tif", array, photometric="minisblack", **options)
    refused(tmp_path / "m.tif", "several channels")


@pytest.mark.parametrize("kind", ["imagej", "ome", "tifffile"])
def test_planes_as_well_as_time(tmp_path: Path, kind: str) -> None:
    options = {**KINDS[kind], "metadata": {"axes": "TZYX"}}
    array = np.zeros((4, 3, 9, 9), np.uint16)
    tifffile.imwrite(tmp_path / "m.tif", array, photometric="minisblack", **options)
    refused(tmp_path / "m.tif", "more than a time series")


def test_axes_that_end_in_time(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", np.zeros((9, 9, 5), np.uint16), metadata={"axes": "YXT"})
    refused(tmp_path / "m.tif", "save it with time first")


def test_fractions_and_nan(tmp_path: Path) -> None:
    array = masks(dtype=np.float32)
    array[2, 5, 6] = 0.25
    tifffile.imwrite(tmp_path / "m.tif", array)
    refused(tmp_path / "m.tif", "frame 2 holds 0.25 at row 5, column 6")
    array[2, 5, 6] = np.nan
    tifffile.imwrite(tmp_path / "m.tif", array)
    refused(tmp_path / "m.tif", "frame 2 holds nan")


@pytest.mark.parametrize("dtype", ["i1", "i2", "i4", "i8", "f4"])
def test_negative_labels(tmp_path: Path, dtype: str) -> None:
    array = (masks() % 100).astype(dtype)
    array[3, 7, 8] = -2
    tifffile.imwrite(tmp_path / "m.tif", array)
    refused(tmp_path / "m.tif", "frame 3 holds the negative label -2 at row 7, column 8")


def test_frames_of_different_size(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "m.tif") as writer:
        writer.write(np.zeros((9, 9), np.uint16))
        writer.write(np.zeros((9, 9), np.uint16))
        writer.write(np.zeros((8, 9), np.uint16))
    refused(tmp_path / "m.tif", "frame 2 is 8 x 9 uint16, frame 0 is 9 x 9 uint16")


def test_two_series_in_one_file(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "m.tif") as writer:
        writer.write(masks(), metadata={"axes": "TYX"})
        writer.write(masks(), metadata={"axes": "TYX"})
    refused(tmp_path / "m.tif", "several image series")


def test_compression_that_loses_values(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", masks(dtype=np.uint8), compression="jpeg")
    refused(tmp_path / "m.tif", "compression 7")


def test_complex_values(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", masks(dtype=np.complex64))
    refused(tmp_path / "m.tif", "sample format 6")


def test_vanished_while_open(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", masks())
    stack = read_labels(tmp_path / "m.tif")
    (tmp_path / "m.tif").unlink()
    with pytest.raises(InputError, match="vanished"):
        stack[0]


@pytest.mark.parametrize("shape", [(0, 4, 4), (4, 0, 4), (4,), (1, 2, 3, 4)])
def test_arrays_that_are_no_movie(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="shape"):
        LabelStack.from_array(np.zeros(shape, np.int32))


# Writing.


@pytest.mark.parametrize(("largest", "dtype"), [(65535, np.uint16), (65536, np.uint32)])
def test_written_labels_come_back(tmp_path: Path, largest: int, dtype: Any) -> None:
    array = masks(dtype=np.int64)
    array[2, 4, 4] = largest
    write_labels(tmp_path / "m.tif", array, pixel_size=0.65, frame_interval=10)
    stack = read_labels(tmp_path / "m.tif")
    assert_frames(stack, array)
    assert stack.dtype == dtype
    assert stack.calibration.pixel_size == pytest.approx(0.65, rel=1e-12)
    assert stack.calibration.frame_interval == pytest.approx(10, rel=1e-12)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "m.tif"), array)
    write_labels(tmp_path / "again.tif", stack, pixel_size=0.65, frame_interval=10)
    assert (tmp_path / "again.tif").read_bytes() == (tmp_path / "m.tif").read_bytes()


def test_failed_writing_leaves_nothing(tmp_path: Path) -> None:
    array = masks(dtype=np.int64)
    array[3, 1, 1] = -1
    with pytest.raises(InputError, match="frame 3 holds the negative label"):
        write_labels(tmp_path / "m.tif", array)
    array[3, 1, 1] = 2**40
    with pytest.raises(InputError, match="32 bits"):
        write_labels(tmp_path / "m.tif", array)
    with pytest.raises(InputError, match="frame 1 has the shape"):
        write_labels(tmp_path / "m.tif", [np.zeros((3, 3), int), np.zeros((3, 4), int)])
    with pytest.raises(InputError, match="no frame"):
        write_labels(tmp_path / "m.tif", [])
    assert list(tmp_path.iterdir()) == []
