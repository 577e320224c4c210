"""What a parquet file promises, checked against its size before anything is decoded.

A footer may claim 10^12 rows, and a page of some bytes may claim to hold gigabytes. Footer and
page headers are read here with nothing but Python; only then is the file given to Arrow.

Reference: the Parquet format (parquet.thrift, structs FileMetaData and PageHeader) and the
compact protocol of Apache Thrift.
"""

from pathlib import Path
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from cellquant.errors import InputError

#: Most rows that one byte of a file may stand for; a layer at rest compresses to about 20.
MAX_ROWS_PER_BYTE = 256
#: Largest page once it is decompressed; writers make pages of about 1 MB.
MAX_PAGE = 2**24
#: Largest page header.
_MAX_HEADER = 2**16
#: Largest text column once it is decoded.
MAX_TEXT = 2**28
_KINDS = {0, 1, 2, 4, 5, 6}  # boolean, int32, int64, float, double, byte array
_CODECS = {0, 1, 2, 6}  # none, snappy, gzip, zstd


class _Damaged(ValueError):
    """The reason why a file cannot be what it claims to be."""


def check_promises(path: Path) -> pa.Schema:
    """Return the schema of a parquet file whose promises its bytes can stand behind.

    Raises
    ------
    InputError
        If the file is damaged, promises more rows or larger pages than it can hold, or has columns
        that are no plain numbers, truth values or texts.
    pyarrow.ArrowException, OSError, ValueError
        If its schema cannot be read.
    """
    size = path.stat().st_size
    try:
        with path.open("rb") as stream:
            content = _footer(stream, size)
            rows = _whole(content, 3)
            if not 0 <= rows <= MAX_ROWS_PER_BYTE * size:
                raise InputError(
                    f"{path} promises {rows} rows in {size} bytes, more than any table of that "
                    "size holds; make it again from its source."
                )
            leaves = _leaves(content)
            total = 0
            for group in _structs(content, 4):
                number, columns = _whole(group, 3), _structs(group, 1)
                total += number
                if number < 0 or total > rows:
                    raise _Damaged(f"its row groups hold more than its {rows} rows")
                if len(columns) != len(leaves):
                    raise _Damaged("a row group lacks columns")
                for column, leaf in zip(columns, leaves, strict=True):
                    _check_column(stream, size, column, leaf, number)
            if total != rows:
                raise _Damaged(f"its row groups hold {total} of its {rows} rows")
    except _Damaged as error:
        raise InputError(
            f"{path} is no readable parquet table of cellquant: {error}; "
            "make it again from its source."
        ) from error
    # Arrow ends the process where parts of a footer contradict each other: only now may it look.
    return pq.read_schema(path)


def _footer(stream: BinaryIO, size: int) -> dict[int, Any]:
    stream.seek(max(0, size - 8))
    tail = stream.read(8)
    length = int.from_bytes(tail[:4], "little")
    if size < 12 or tail[4:] != b"PAR1" or not 0 < length <= size - 12:
        raise _Damaged("it does not end as a parquet file does")
    stream.seek(size - 8 - length)
    return _parse(stream.read(length))[0]


def _leaves(content: dict[int, Any]) -> list[tuple[bytes, int]]:
    """Name and physical type of every column of a flat schema."""
    elements = _structs(content, 2)
    if not elements or _whole(elements[0], 5) != len(elements) - 1:
        raise _Damaged("its columns are nested or not complete")
    leaves = []
    for element in elements[1:]:
        name, kind = element.get(4), element.get(1)
        if not isinstance(name, bytes) or 5 in element or kind not in _KINDS:
            raise _Damaged("a column is nested or of a type that no table here has")
        if element.get(3, 0) not in (0, 1):
            raise _Damaged("a column holds lists")
        leaves.append((name, kind))
    return leaves


def _check_column(
    stream: BinaryIO, size: int, column: dict[int, Any], leaf: tuple[bytes, int], rows: int
) -> None:
    name = leaf[0][:40]
    inner = column.get(3)
    if not isinstance(inner, dict) or 1 in column or inner.get(1) != leaf[1]:
        raise _Damaged(f"column {name!r} is not described")
    if inner.get(3) != [leaf[0]] or inner.get(4) not in _CODECS:
        raise _Damaged(f"column {name!r} has another name or compression")
    if not 0 <= _whole(inner, 5) <= rows:
        raise _Damaged(f"column {name!r} has more values than rows")
    if rows == 0:  # nothing is read of a group without rows
        return
    start = _whole(inner, 9)
    if 11 in inner and _whole(inner, 11) > 0:
        start = min(start, _whole(inner, 11))
    stop = start + _whole(inner, 7)
    if not 4 <= start < stop <= size:
        raise _Damaged(f"column {name!r} lies outside its {size} bytes")
    while start < stop:
        stream.seek(start)
        header, length = _parse(stream.read(min(_MAX_HEADER, stop - start)))
        unpacked, packed = _whole(header, 2), _whole(header, 3)
        if not 0 <= unpacked <= MAX_PAGE:
            raise _Damaged(f"a page of column {name!r} promises {unpacked} bytes")
        if packed < 0 or start + length + packed > stop:
            raise _Damaged(f"a page of column {name!r} lies outside its column")
        start += length + packed


def _whole(content: dict[int, Any], field: int) -> int:
    value = content.get(field)
    if not isinstance(value, int) or isinstance(value, bool):
        raise _Damaged(f"field {field} of a description is missing")
    return value


def _structs(content: dict[int, Any], field: int) -> list[dict[int, Any]]:
    value = content.get(field, [])
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise _Damaged(f"field {field} of a description is no list")
    return value


def decode_texts(path: Path, table: pa.Table) -> pa.Table:
    """Turn dictionary-encoded text columns into plain ones, where they stay small."""
    for index, field in enumerate(table.schema):
        if not pa.types.is_dictionary(field.type):
            continue
        column = table.column(index)
        longest = max(
            (len(text) for chunk in column.chunks for text in chunk.dictionary.to_pylist() if text),
            default=0,
        )
        if longest * len(column) > MAX_TEXT:
            raise InputError(
                f"{path}: the texts of column {field.name!r} would take more than {MAX_TEXT} "
                "bytes; make the table again from its source."
            )
        table = table.set_column(index, field.name, column.cast(field.type.value_type))
    return table


def text_columns(schema: pa.Schema) -> list[str]:
    """Names of the columns that hold text."""
    return [
        f.name for f in schema if pa.types.is_string(f.type) or pa.types.is_large_string(f.type)
    ]


def _parse(data: bytes) -> tuple[dict[int, Any], int]:
    """A struct of the compact protocol as a dictionary by field number, and its length."""
    try:
        return _struct(data, 0, 0)
    except IndexError as error:
        raise _Damaged("a description is incomplete") from error


def _struct(data: bytes, position: int, depth: int) -> tuple[dict[int, Any], int]:
    if depth > 10:
        raise _Damaged("a description is nested too deeply")
    fields: dict[int, Any] = {}
    number = 0
    while True:
        head = data[position]
        position += 1
        if head == 0:
            return fields, position
        kind, step = head & 0x0F, head >> 4
        if step:
            number += step
        else:
            value, position = _varint(data, position)
            number = (value >> 1) ^ -(value & 1)
        if kind in (1, 2):  # the truth value is in the head
            fields[number] = kind == 1
        else:
            fields[number], position = _value(data, position, kind, depth)


def _value(data: bytes, position: int, kind: int, depth: int) -> tuple[Any, int]:
    if kind in (1, 2, 3):
        return data[position], position + 1
    if kind in (4, 5, 6):
        value, position = _varint(data, position)
        return (value >> 1) ^ -(value & 1), position
    if kind == 7:
        return data[position : position + 8], position + 8
    if kind == 8:
        length, position = _varint(data, position)
        if position + length > len(data):
            raise _Damaged("a description is incomplete")
        return data[position : position + length], position + length
    if kind in (9, 10):
        head = data[position]
        position += 1
        inner, count = head & 0x0F, head >> 4
        if count == 15:
            count, position = _varint(data, position)
        if count > len(data) - position:
            raise _Damaged("a list is longer than its description")
        items = []
        for _ in range(count):
            item, position = _value(data, position, inner, depth + 1)
            items.append(item)
        return items, position
    if kind == 12:
        return _struct(data, position, depth + 1)
    raise _Damaged("a description has an unknown field")


def _varint(data: bytes, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
        if shift > 63:
            raise _Damaged("a page header has a number that is too large")
