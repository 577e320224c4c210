"""Damaged and hostile files: a reader may only say what is wrong, soon and within memory.

The quick profile runs with the suite; the slow one is the campaign of 10 000 cases per reader.
"""

import contextlib
import resource
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cellquant.errors import InputError
from cellquant.io import compare_lineage, read_ctc_lineage, read_images, read_labels

QUICK, CAMPAIGN, PARTS = 200, 10_000, 10
COMMON: dict[str, Any] = {
    "deadline": None,  # `only_input_errors` counts processor time instead
    "suppress_health_check": [HealthCheck.too_slow, HealthCheck.data_too_large],
    "database": None,
    "derandomize": True,
}
GIGABYTE = 2**30

SEEDS: tuple[dict[str, Any], ...] = (
    {"metadata": None},
    {"metadata": {"axes": "TYX"}},
    {"imagej": True, "metadata": {"axes": "TYX"}, "resolution": (2, 2)},
    {"ome": True, "metadata": {"axes": "TYX", "PhysicalSizeX": 0.5, "TimeIncrement": 3}},
    {"bigtiff": True, "compression": "zlib"},
    {"byteorder": ">", "compression": "lzw", "predictor": True},
    {"compression": "zstd", "tile": (16, 16)},
    {"compression": "lzma", "rowsperstrip": 3},
    {"compression": "packbits"},
    {"truncate": True},
    {"photometric": "rgb", "planarconfig": "separate", "compression": "zlib"},
    {"dtype": "f4", "compression": "deflate", "predictor": 3},
    {"dtype": "u8", "metadata": None, "byteorder": ">"},
    {"dtype": "?"},
)
# Numbers that readers trip over.
HOSTILE = (0, 1, 2, 3, 5, 7, 8, 16, 255, 256, 1000, 32773, 50000, 65535, 10**6, 2**28, 2**31 - 1,
           2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)  # fmt: skip


@cache
def seed(index: int) -> bytes:
    """A small valid file."""
    options = {"photometric": "minisblack", **SEEDS[index]}
    array = np.random.default_rng(index).integers(0, 9, (3, 12, 17))
    array = array.astype(options.pop("dtype", "u2"))
    with tempfile.TemporaryDirectory() as folder:
        tifffile.imwrite(Path(folder) / "m.tif", array, **options)
        return (Path(folder) / "m.tif").read_bytes()


@cache
def entries(index: int) -> tuple[tuple[int, bool, str], ...]:
    """Places of all directory entries of a valid file, whether BigTIFF, byte order."""
    content = seed(index)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.tif"
        path.write_bytes(content)
        with tifffile.TiffFile(path) as file:
            pages = [page.aspage() for page in file.pages]
            return tuple(
                (tag.offset, file.is_bigtiff, file.byteorder) for page in pages for tag in page.tags
            )


@st.composite
def edited_bytes(draw: st.DrawFn, content: bytes, most: int = 4) -> bytes:
    """Content after a few random edits: flips, numbers, cuts, copies, insertions."""
    data = bytearray(content)
    for _ in range(draw(st.integers(1, most))):
        place = draw(st.integers(0, max(0, len(data) - 1)))
        kind = draw(st.sampled_from(["flip", "number", "cut", "copy", "insert", "delete"]))
        if kind == "flip" and data:
            data[place] ^= 1 << draw(st.integers(0, 7))
        elif kind == "number":
            width = draw(st.sampled_from((1, 2, 4, 8)))
            value = draw(st.sampled_from(HOSTILE)) % 256**width
            order = draw(st.sampled_from(("little", "big")))
            data[place : place + width] = value.to_bytes(width, order)
        elif kind == "cut":
            del data[place:]
        elif kind == "copy":
            start = draw(st.integers(0, max(0, len(data) - 1)))
            length = draw(st.integers(1, 64))
            data[place : place + length] = data[start : start + length]
        elif kind == "insert":
            data[place:place] = draw(st.binary(min_size=1, max_size=16))
        else:
            del data[place : place + draw(st.integers(1, 32))]
    return bytes(data)


@st.composite
def edited_tags(draw: st.DrawFn, index: int) -> bytes:
    """A valid file in which one to three fields of directory entries carry hostile numbers."""
    data = bytearray(seed(index))
    places = entries(index)
    for _ in range(draw(st.integers(1, 3))):
        place, big, order = draw(st.sampled_from(places))
        field, code = draw(
            st.sampled_from(
                [(0, "H"), (2, "H"), (4, "Q"), (12, "Q"), (12, "I"), (12, "H")]
                if big
                else [(0, "H"), (2, "H"), (4, "I"), (8, "I"), (8, "H")]
            )
        )
        width = struct.calcsize(code)
        value = draw(st.sampled_from(HOSTILE) | st.integers(0, 400)) % 256**width
        data[place + field : place + field + width] = struct.pack(order + code, value)
    return bytes(data)


@st.composite
def tiffs(draw: st.DrawFn) -> bytes:
    """A damaged TIFF file of any kind."""
    index = draw(st.integers(0, len(SEEDS) - 1))
    if draw(st.booleans()):
        return draw(edited_tags(index))
    return draw(edited_bytes(seed(index)))


LINEAGE = b"1 0 1 0\n2 2 2 1\n3 2 2 1\n10 0 2 0\n"
NAMES = st.sampled_from(
    ("man_track000.tif", "man_track001.tif", "man_track2.tif", "mask1.tif", "man_track.tif",
     "man_track99999999999999999999.tif", "x.tif", "man_track-1.tif", "\u00b25.tif")
)  # fmt: skip


@st.composite
def ctc_folders(draw: st.DrawFn) -> dict[str, bytes]:
    """Names and contents of a tracking folder in which table, masks or names are damaged."""
    table = LINEAGE
    if draw(st.booleans()):
        table = draw(
            edited_bytes(LINEAGE)
            | st.binary(max_size=40)
            | st.lists(
                st.tuples(*[st.sampled_from(HOSTILE) | st.integers(-2, 12)] * 4), max_size=6
            ).map(lambda rows: "\n".join(" ".join(map(str, row)) for row in rows).encode())
        )
    files = {draw(st.sampled_from(("man_track.txt", "res_track.txt"))): table}
    for number in range(3):
        index = draw(st.integers(0, 8))
        content = page(index)
        if draw(st.integers(0, 3)) == 0:
            content = draw(edited_bytes(content))
        name = f"man_track{number:03d}.tif" if draw(st.integers(0, 4)) else draw(NAMES)
        files[name] = content
    return files


@cache
def page(index: int) -> bytes:
    """A valid file of a single frame."""
    frame = np.random.default_rng(index).integers(0, 4, (12, 17)).astype("u2")
    options = {key: value for key, value in SEEDS[index].items() if key not in ("metadata",)}
    with tempfile.TemporaryDirectory() as folder:
        tifffile.imwrite(Path(folder) / "m.tif", frame, **{"metadata": None, **options})
        return (Path(folder) / "m.tif").read_bytes()


SECONDS = 5.0


def only_input_errors(act: Callable[[], object]) -> None:
    """Run within 5 s of processor time; a refusal must be one sentence.

    One that waits without working is ended by the time limit of the test.
    """
    message = ""
    started = time.process_time()
    try:
        act()
    except InputError as error:
        message = str(error)
    assert time.process_time() - started < SECONDS
    assert "\n" not in message
    assert len(message) < 1000


@contextlib.contextmanager
def bounded_memory() -> Iterator[None]:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < GIGABYTE


def read_all(path: Path) -> None:
    labels = read_labels(path)
    for frame in labels:
        assert frame.shape == labels.shape
        assert frame.dtype in (np.int32, np.int64)
        assert frame.min() >= 0
    for units in (None, "pixel"):
        with contextlib.suppress(InputError):
            calibration = read_labels(path, units=units).calibration
            assert 0 < calibration.pixel_size < np.inf
            assert 0 < calibration.frame_interval < np.inf


def check_tiff(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.tif"
        path.write_bytes(content)
        only_input_errors(lambda: read_all(path))
        only_input_errors(lambda: [frame.shape for frame in read_images(path)])


def check_ctc(files: dict[str, bytes]) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, content in files.items():
            (folder / file).write_bytes(content)
        only_input_errors(lambda: read_all(folder))
        only_input_errors(lambda: compare_lineage(read_ctc_lineage(folder), read_labels(folder)))


@settings(max_examples=QUICK, **COMMON)
@given(tiffs())
def test_damaged_tiff(content: bytes) -> None:
    check_tiff(content)


@settings(max_examples=QUICK, **COMMON)
@given(ctc_folders())
def test_damaged_tracking_folder(files: dict[str, bytes]) -> None:
    check_ctc(files)


def campaign(cases: st.SearchStrategy[Any], check: Callable[[Any], None], part: int) -> None:
    """Run the check on one part of `CAMPAIGN` cases."""
    count = 0

    def counted(case: Any) -> None:
        nonlocal count
        count += 1
        check(case)

    options = {**COMMON, "derandomize": False, "max_examples": CAMPAIGN // PARTS}
    with bounded_memory():
        hypothesis.seed(part)(settings(**options)(given(cases)(counted)))()
    assert count >= CAMPAIGN // PARTS


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize(
    ("cases", "check"), [(tiffs(), check_tiff), (ctc_folders(), check_ctc)], ids=["tiff", "ctc"]
)
def test_campaign(cases: st.SearchStrategy[Any], check: Callable[[Any], None], part: int) -> None:
    campaign(cases, check, part)


def test_seeds_are_valid() -> None:
    for index in range(len(SEEDS)):
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "m.tif").write_bytes(seed(index))
            assert read_labels(Path(folder) / "m.tif").n_frames == 3
            assert len(entries(index)) > 5
