"""What the folder of a simulated run promises, checked before anything is decoded.

The store is only as large as its description says; a hostile description may say anything, and a
chunk of some bytes may claim to hold gigabytes. Descriptions are read here as plain JSON and
compared with each other and with the chunks that are there.

References: Zarr core specification v3; Zstandard frame format (RFC 8878, section 3.1.1).
"""

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from cellquant.errors import InputError

_MAX_DESCRIPTION = 100_000_000
_MAX_RANK = 4
#: Memory that a run may take beside what its bytes can stand for: chunks that are hardly filled.
_FREE = 2**26
#: Most bytes that one compressed byte may stand for; saved states hardly compress.
_MAX_EXPANSION = 64
_GROWING = ("time", "position", "polarity", "modes")
_CONSTANT = ("radius", "box")
_ZSTD = b"\x28\xb5\x2f\xfd"


class _Damaged(ValueError):
    """The reason why a folder cannot be a run."""


def check_run_store(path: Path) -> None:
    """Make sure that a folder is a run whose arrays can be read within its own size.

    Raises
    ------
    InputError
        If a description is missing, damaged, or promises what the chunks cannot hold.
    """
    try:
        attributes = _described(path, "group").get("attributes", {})
        if not isinstance(attributes, dict) or attributes.get("format") != "cellquant run":
            raise _Damaged("it is a zarr group but no run of cellquant")
        for name in ("scene", "settings"):
            if not isinstance(attributes.get(name), dict):
                raise _Damaged(f"its attribute {name} is missing")
        shapes = {name: _check_array(path / name) for name in (*_GROWING, *_CONSTANT)}
        cells = shapes["radius"][0] if len(shapes["radius"]) == 1 else -1
        tails = {name: shape[1:] for name, shape in shapes.items()}
        good = (
            tails["time"] == ()
            and tails["position"] == (cells, 2)
            and tails["polarity"] == (cells,)
            and tails["modes"][:2] == (cells, 2)
            and len(tails["modes"]) == 3
            and shapes["box"] == (2,)
            and all(shapes[name][0] >= shapes["time"][0] for name in _GROWING)
        )
        if not good:
            raise _Damaged(f"its arrays do not belong together ({shapes})")
    except (_Damaged, OSError, ValueError, RecursionError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:300]
        raise InputError(
            f"{path} is not a readable run ({reason}); "
            "make one with 'cellquant simulate -o RUN.zarr'."
        ) from error


def _described(path: Path, kind: str) -> dict[str, Any]:
    file = path / "zarr.json"
    if file.stat().st_size > _MAX_DESCRIPTION:
        raise _Damaged(f"{file.name} is larger than {_MAX_DESCRIPTION} bytes")
    content = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise _Damaged("its description is no JSON object")
    if content.get("zarr_format") != 3 or content.get("node_type") != kind:
        raise _Damaged(f"{path.name} is no zarr {kind} of version 3")
    return content


def _check_array(path: Path) -> tuple[int, ...]:
    """Shape of an array, once everything it promises is found possible."""
    content = _described(path, "array")
    name = path.name
    shape = _integers(content.get("shape"), 0)
    grid = content.get("chunk_grid")
    chunk: tuple[int, ...] = ()
    if isinstance(grid, dict) and grid.get("name") == "regular":
        configuration = grid.get("configuration")
        if isinstance(configuration, dict):
            chunk = _integers(configuration.get("chunk_shape"), 1)
    if not 1 <= len(shape) <= _MAX_RANK or len(chunk) != len(shape):
        raise _Damaged(f"{name} has the shape {str(shape)[:60]} in chunks of {str(chunk)[:60]}")
    if content.get("data_type") != "float64" or content.get("storage_transformers"):
        raise _Damaged(f"{name} does not hold float64 numbers")
    if not _plain_codecs(content.get("codecs")):
        raise _Damaged(f"{name} is compressed in another way than zstd")
    key = content.get("chunk_key_encoding")
    if key not in ({"name": "default", "configuration": {"separator": "/"}}, {"name": "default"}):
        raise _Damaged(f"{name} names its chunks in another way")
    bytes_per_chunk = 8 * math.prod(chunk)
    chunks = [p for p in (path / "c").rglob("*") if p.is_file() and p.suffix != ".partial"]
    promised = max(bytes_per_chunk * len(chunks), 8 * math.prod(shape))
    there = sum(p.stat().st_size for p in chunks)
    if promised > _FREE + _MAX_EXPANSION * there:
        raise _Damaged(f"{name} promises {promised} bytes from {there}")
    for file in chunks:
        _check_chunk(file, bytes_per_chunk)
    return shape


def _integers(value: Any, least: int) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(
        isinstance(n, int) and not isinstance(n, bool) and n >= least for n in value
    ):
        raise _Damaged(f"a shape is {str(value)[:60]}")
    return tuple(value)


def _plain_codecs(codecs: Any) -> bool:
    if not isinstance(codecs, list) or not all(isinstance(codec, dict) for codec in codecs):
        return False
    return [codec.get("name") for codec in codecs] == ["bytes", "zstd"]


def _check_chunk(file: Path, size: int) -> None:
    """The frame of a chunk must say that it holds exactly one chunk."""
    with file.open("rb") as stream:
        head = stream.read(18)
    if head[:4] != _ZSTD or len(head) < 6:
        raise _Damaged(f"chunk {file.name} is no zstd frame")
    flags = head[4]
    single, width = bool(flags & 0x20), flags >> 6
    start = 5 + (0 if single else 1) + (0, 1, 2, 4)[flags & 3]
    length = (1 if single else 0, 2, 4, 8)[width]
    content = int.from_bytes(head[start : start + length], "little") + (256 if width == 1 else 0)
    if length == 0 or content != size:
        raise _Damaged(f"chunk {file.name} promises {content} bytes instead of {size}")


def read_arrays(path: Path) -> dict[str, Any]:
    """Read an ``npz`` file written without compression; nothing in it is ever executed.

    Raises
    ------
    InputError
        If the file is damaged, compressed, or an array promises more than is there.
    """
    arrays = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for item in archive.infolist():
                if item.compress_type != zipfile.ZIP_STORED or item.file_size > path.stat().st_size:
                    raise _Damaged("it is compressed")
                stream = io.BytesIO(archive.read(item))
                if np.lib.format.read_magic(stream) != (1, 0):
                    raise _Damaged("it has another version")
                shape, in_columns, dtype = np.lib.format.read_array_header_1_0(stream)
                values = stream.getbuffer()[stream.tell() :]
                if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(values):
                    raise _Damaged(f"{item.filename[:40]!r} promises more than is there")
                flat = np.frombuffer(values, dtype)
                name = item.filename.removesuffix(".npy")
                arrays[name] = flat.reshape(shape, order="F" if in_columns else "C").copy()
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, NotImplementedError, RuntimeError,
            TypeError, SyntaxError, RecursionError, MemoryError) as error:  # fmt: skip
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise InputError(f"{path} is damaged ({reason}); remove the run and simulate again.") from (
            error
        )
    return arrays
