"""What a parquet file promises, checked against its size before anything is decoded.

A footer may claim 10^12 rows, and a page of some bytes may claim to hold gigabytes. The headers of
all pages are read here with nothing but Python; only then is the file given to Arrow.

Reference: the Parquet format (parquet.thrift, structs PageHeader and ColumnMetaData) and the
compact protocol of Apache Thrift.
"""

from collections.abc import Iterator
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
_KINDS = {"BOOLEAN", "INT32", "INT64", "FLOAT", "DOUBLE", "BYTE_ARRAY"}


class _Damaged(ValueError):
    """The reason why a file cannot be what it claims to be."""


def check_promises(path: Path) -> pa.Schema:
    """Return the schema of a parquet file whose promises its bytes can stand behind.

    Raises
    ------
    InputError
        If the file promises more rows or larger pages than it can hold, or has columns that are
        no plain numbers, truth values or texts.
    pyarrow.ArrowException, OSError, ValueError
        If its footer cannot be read.
    """
    size = path.stat().st_size
    with pq.ParquetFile(path) as file:
        metadata, schema = file.metadata, file.schema_arrow
    rows = metadata.num_rows
    if not 0 <= rows <= MAX_ROWS_PER_BYTE * size:
        raise InputError(
            f"{path} promises {rows} rows in {size} bytes, more than any table of that size holds; "
            "make it again from its source."
        )
    try:
        if metadata.num_columns != len(schema.names):
            raise _Damaged("it has nested columns")
        total = 0
        with path.open("rb") as stream:
            for number in range(metadata.num_row_groups):
                group = metadata.row_group(number)
                total += group.num_rows
                if group.num_rows < 0 or total > rows:
                    raise _Damaged(f"its row groups hold more than its {rows} rows")
                for index in range(group.num_columns):
                    _check_column(stream, size, group.column(index), group.num_rows)
    except _Damaged as error:
        raise InputError(
            f"{path} is damaged or no table of cellquant: {error}; make it again from its source."
        ) from error
    return schema


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


def _check_column(stream: BinaryIO, size: int, column: Any, rows: int) -> None:
    name = column.path_in_schema
    if column.physical_type not in _KINDS:
        raise _Damaged(f"column {name[:40]!r} has the type {column.physical_type}")
    starts = [column.data_page_offset]
    if column.has_dictionary_page and column.dictionary_page_offset:
        starts.append(column.dictionary_page_offset)
    start = min(starts)
    stop = start + column.total_compressed_size
    if not 4 <= start <= stop <= size:
        raise _Damaged(f"column {name[:40]!r} lies outside its {size} bytes")
    if column.num_values > rows:
        raise _Damaged(f"column {name[:40]!r} has more values than rows")
    while start < stop:
        stream.seek(start)
        header = stream.read(min(_MAX_HEADER, stop - start))
        unpacked, packed, length = _page_sizes(header)
        if not 0 <= unpacked <= MAX_PAGE:
            raise _Damaged(f"a page of column {name[:40]!r} promises {unpacked} bytes")
        if packed < 0 or start + length + packed > stop:
            raise _Damaged(f"a page of column {name[:40]!r} lies outside its column")
        start += length + packed


def _page_sizes(header: bytes) -> tuple[int, int, int]:
    """Size of a page before and after compression, and length of its header."""
    fields: dict[int, int] = {}
    try:
        position = _read_struct(header, 0, fields, 0)
        return fields[2], fields[3], position
    except (IndexError, KeyError) as error:
        raise _Damaged("a page header is incomplete") from error


def _read_struct(data: bytes, position: int, fields: dict[int, int] | None, depth: int) -> int:
    """Skip a struct of the compact protocol; keeps its integers by field number."""
    if depth > 8:
        raise _Damaged("a page header is nested too deeply")
    number = 0
    while True:
        head = data[position]
        position += 1
        if head == 0:
            return position
        kind, step = head & 0x0F, head >> 4
        if step:
            number += step
        else:
            value, position = _varint(data, position)
            number = (value >> 1) ^ -(value & 1)
        if kind in (4, 5, 6):
            value, position = _varint(data, position)
            if fields is not None:
                fields[number] = (value >> 1) ^ -(value & 1)
        else:
            position = _skip(data, position, kind, depth)


def _skip(data: bytes, position: int, kind: int, depth: int) -> int:
    if kind in (1, 2):  # true, false: in the field's head
        return position
    if kind == 3:
        return position + 1
    if kind in (4, 5, 6):
        return _varint(data, position)[1]
    if kind == 7:
        return position + 8
    if kind == 8:  # bytes, e.g. the bounds in the statistics
        length, position = _varint(data, position)
        return position + length
    if kind in (9, 10):
        for item in _items(data, position):
            position = item
        return position
    if kind == 12:
        return _read_struct(data, position, None, depth + 1)
    raise _Damaged("a page header has an unknown field")


def _items(data: bytes, position: int) -> Iterator[int]:
    """Positions behind the head and behind each item of a list."""
    head = data[position]
    position += 1
    kind, count = head & 0x0F, head >> 4
    if count == 15:
        count, position = _varint(data, position)
    yield position
    for _ in range(count):
        position = position + 1 if kind in (1, 2) else _skip(data, position, kind, 8)
        if position > len(data):
            raise _Damaged("a page header is incomplete")
        yield position


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
