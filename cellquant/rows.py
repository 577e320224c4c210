"""Rows of cells and tracks in pieces, from memory or from a file, one column at a time.

A movie may be longer than the memory. What is measured in passes over its rows takes a piece after
the other; of tracks a piece holds whole tracks, in the order of track and frame.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cellquant.errors import InputError
from cellquant.tables import TRACK_COLUMNS, Cells, Tracks, read_cells, read_tracks

PIECE = 2**15  # rows
Piece = dict[str, np.ndarray[Any, Any]]


@dataclass(frozen=True)
class Scan:
    """A table of cells or tracks that stays on disk.

    Attributes
    ----------
    head
        The table without its rows: units, intervals, areas.
    path
        The parquet file.
    """

    head: Tracks | Cells
    path: Path

    @property
    def rows(self) -> "Rows":
        """Its rows, read when they are asked for."""
        return FileRows(self.path, isinstance(self.head, Tracks))


def scan_tracks(path: str | Path, *, columns: Sequence[str] | None = None) -> Scan:
    """Open tracks written by `Tracks.write` without reading them; see `read_tracks`."""
    return _scan(Path(path), "tracks.parquet", read_tracks, columns)


def scan_cells(path: str | Path, *, columns: Sequence[str] | None = None) -> Scan:
    """Open cells written by `Cells.write` without reading them; see `read_cells`."""
    return _scan(Path(path), "cells.parquet", read_cells, columns)


def _scan(path: Path, name: str, read: Any, columns: Sequence[str] | None) -> Scan:
    path = path / name if path.is_dir() else path
    return Scan(read(path, columns=columns, rows=False), path)


class Rows:
    """The rows of a table, in pieces.

    Attributes
    ----------
    linked
        Whether they are rows of tracks.
    """

    linked: bool

    @property
    def size(self) -> int:
        """Number of rows."""
        raise NotImplementedError

    def _stretches(self, names: list[str]) -> Iterator[Piece]:
        """Rows of the source as they lie there, by column."""
        raise NotImplementedError

    @cached_property
    def _in_order(self) -> bool:
        """Whether the rows lie in the order of track and frame."""
        last_track, last_frame = -1, -1
        for piece in self._stretches(["track_id", "frame"]):
            track, frame = piece["track_id"], piece["frame"]
            if not track.size:
                continue
            same = track[1:] == track[:-1]
            if (track[1:] < track[:-1]).any() or (same & (frame[1:] < frame[:-1])).any():
                return False
            if (track[0], frame[0]) < (last_track, last_frame):
                return False
            last_track, last_frame = int(track[-1]), int(frame[-1])
        return True

    @cached_property
    def _order(self) -> Any:
        parts = list(self._stretches(["track_id", "frame"]))
        frame, track = (np.concatenate([p[k] for p in parts]) for k in ("frame", "track_id"))
        return np.lexsort((frame, track))

    def pieces(self, *names: str) -> Iterator[Piece]:
        """Yield the rows by column, of tracks whole tracks in the order of track and frame.

        Rows out of that order are gathered and sorted first, which holds the columns asked for.
        """
        if not self.linked:
            yield from self._stretches(list(names))
            return
        wanted = list(dict.fromkeys(("track_id", *names)))
        yield from _whole_tracks(
            self._stretches(wanted) if self._in_order else self._sorted(wanted)
        )

    def _sorted(self, names: list[str]) -> Iterator[Piece]:
        parts = list(self._stretches(names))
        columns = {name: np.concatenate([part.pop(name) for part in parts]) for name in names}
        for start in range(0, self._order.size, PIECE):
            rows = self._order[start : start + PIECE]
            yield {name: column[rows] for name, column in columns.items()}


def _whole_tracks(stretches: Iterator[Piece]) -> Iterator[Piece]:
    """Cut stretches of rows between tracks instead of within them."""
    held: Piece = {}
    for piece in stretches:
        if held:
            piece = {name: np.concatenate([held[name], piece[name]]) for name in piece}
        track = piece["track_id"]
        if not track.size:
            continue
        cut = int(np.searchsorted(track, track[-1]))
        if cut:
            yield {name: column[:cut] for name, column in piece.items()}
        held = {name: column[cut:].copy() for name, column in piece.items()}
    if held:
        yield held


class TableRows(Rows):
    """Rows of a table in memory."""

    def __init__(self, source: Tracks | Cells) -> None:
        self._table = source.table
        self.linked = isinstance(source, Tracks)

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self._table)

    def _stretches(self, names: list[str]) -> Iterator[Piece]:
        columns = {name: self._table[name] for name in names}
        for start in range(0, len(self._table), PIECE):
            yield {
                name: column.iloc[start : start + PIECE].to_numpy(dtype=TRACK_COLUMNS[name])
                for name, column in columns.items()
            }


class FileRows(Rows):
    """Rows of a parquet file whose promises have been checked."""

    def __init__(self, path: Path, linked: bool) -> None:
        self._path, self.linked = path, linked

    @property
    def size(self) -> int:
        """Number of rows."""
        with self._readable(), pq.ParquetFile(self._path) as file:
            return int(file.metadata.num_rows)

    @contextmanager
    def _readable(self) -> Iterator[None]:
        try:
            yield
        except (pa.ArrowException, OSError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0][:300]
            raise InputError(
                f"{self._path} is not a readable parquet table ({reason}); make it again from its "
                "source."
            ) from error

    def _stretches(self, names: list[str]) -> Iterator[Piece]:
        # Without a buffer of its own each column of a row group would be held in its packed form
        # as a whole.
        with (
            self._readable(),
            pq.ParquetFile(self._path, buffer_size=2**16, pre_buffer=False) as file,
        ):
            for batch in file.iter_batches(PIECE, columns=names, use_threads=False):
                yield {name: self._array(name, batch.column(name)) for name in names}

    def _array(self, name: str, column: Any) -> Any:
        kind = TRACK_COLUMNS[name]
        if kind != "float64" and column.null_count:
            raise InputError(
                f"{self._path} has rows without a value of {name}; make it again from its source."
            )
        try:
            if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
                raise ValueError("text")
            return column.cast(pa.type_for_alias(kind)).to_numpy(zero_copy_only=False)
        except (pa.ArrowException, ValueError) as error:
            raise InputError(
                f"{self._path}: the column {name} holds {column.type}, not numbers of the kind "
                f"{kind}; make it again from its source."
            ) from error


def rows_of(source: "Tracks | Cells | Scan") -> Rows:
    """The rows of a table in memory or on disk."""
    return source.rows if isinstance(source, Scan) else TableRows(source)
