"""Cells and tracks: the tables in which the movie side and the simulation side meet.

Every table is a tidy DataFrame with one row per cell and frame. Units are not part of a column's
name: they travel beside the table and, on disk, in the parquet schema metadata.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from cellquant.errors import InputError
from cellquant.parquet import check_promises, decode_texts, text_columns

CELL_COLUMNS: Mapping[str, str] = {
    "frame": "int64",
    "label": "int64",
    "x": "float64",
    "y": "float64",
    "area": "float64",
    "perimeter": "float64",
    "shape_index": "float64",
    "aspect_ratio": "float64",
    "orientation": "float64",
    "touches_border": "bool",
    "n_neighbours": "int64",
}
TRACK_COLUMNS: Mapping[str, str] = {
    **CELL_COLUMNS,
    "track_id": "int64",
    "parent_track_id": "int64",
    "time": "float64",
}


@dataclass(frozen=True)
class Units:
    """Names of the length and time unit of a table, e.g. ``um`` and ``min``, ``L0`` and ``t0``."""

    length: str
    time: str


PHYSICAL = Units("um", "min")
PIXEL = Units("px", "frame")
REDUCED = Units("L0", "t0")


@dataclass(frozen=True)
class Cells:
    """Every cell of every frame, measured.

    Attributes
    ----------
    table
        One row per cell and frame, columns `CELL_COLUMNS`; x, y, perimeter in ``units.length``,
        area in its square, orientation in radians in (-pi/2, pi/2] against the x axis.
    units
        Unit names of the table.
    pixel_size
        Edge of a pixel in ``units.length``.
    frame_interval
        Time between consecutive frame numbers in ``units.time``.
    field_of_view
        Width and height of the image in ``units.length``.
    n_frames
        Number of frames read, those without a cell included.
    occupied_area
        (n_frames,) area that cells can occupy in each frame, in ``units.length`` squared.
    faults
        Counts of what was found and repaired in the masks, by name of the fault.
    """

    table: pd.DataFrame
    units: Units
    pixel_size: float
    frame_interval: float
    field_of_view: tuple[float, float]
    n_frames: int
    occupied_area: np.ndarray[Any, np.dtype[np.float64]]
    faults: Mapping[str, int] = field(default_factory=dict)

    def write(self, path: str | Path) -> None:
        """Write the cells as parquet, with units, calibration and faults in the metadata."""
        metadata = {
            "pixel_size": self.pixel_size,
            "frame_interval": self.frame_interval,
            "field_of_view": list(self.field_of_view),
            "n_frames": self.n_frames,
            "occupied_area": [float(area) for area in self.occupied_area],
            "faults": dict(self.faults),
        }
        write_table(self.table, path, units=self.units, metadata=metadata)


@dataclass(frozen=True)
class Tracks:
    """Trajectories of cells, from a movie or from a simulated run.

    Attributes
    ----------
    table
        One row per cell and frame, columns `TRACK_COLUMNS`, sorted by track_id then frame.
        x, y are unwrapped positions; (frame, label) finds the cell in the input again;
        parent_track_id is 0 where a track has no known mother.
    units
        Unit names of the table.
    frame_interval
        Time between consecutive frame numbers in ``units.time``.
    area
        Area that cells can occupy, averaged over frames, in ``units.length`` squared; the
        denominator of every number density. For a simulated run the area of the box.
    box
        Edges (Lx, Ly) of a periodic box in ``units.length``; None for an open field of view.
    smoothing
        Points of the moving average that the positions have already been through; 1 for none.
    provenance
        How the table was made: settings, versions, counts. JSON-serialisable.
    """

    table: pd.DataFrame
    units: Units
    frame_interval: float
    area: float
    box: tuple[float, float] | None = None
    smoothing: int = 1
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def n_tracks(self) -> int:
        """Number of distinct tracks."""
        return int(self.table["track_id"].nunique())

    def write(self, path: str | Path) -> None:
        """Write the tracks as parquet, with units and provenance in the schema metadata."""
        metadata = {
            "frame_interval": self.frame_interval,
            "area": self.area,
            "box": self.box,
            "smoothing": self.smoothing,
            "provenance": dict(self.provenance),
        }
        write_table(self.table, path, units=self.units, metadata=metadata)


def read_cells(
    path: str | Path, *, columns: Sequence[str] | None = None, rows: bool = True
) -> Cells:
    """Read cells written by `Cells.write`.

    Parameters
    ----------
    path
        A parquet file, or a folder that holds ``cells.parquet``.
    columns
        Names out of `CELL_COLUMNS`: only these are read; all of them when None.
    rows
        Whether rows are read; without them the table is empty.

    Raises
    ------
    InputError
        If the file is missing, is not a cells table, or lacks a column.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "cells.parquet"
    table, units, metadata = read_table(
        path, kind="cells", columns=columns or list(CELL_COLUMNS), rows=rows
    )
    try:
        width, height = metadata["field_of_view"]
        return Cells(
            table=table,
            units=units,
            pixel_size=float(metadata["pixel_size"]),
            frame_interval=float(metadata["frame_interval"]),
            field_of_view=(float(width), float(height)),
            n_frames=int(metadata["n_frames"]),
            occupied_area=np.asarray(metadata["occupied_area"], dtype=np.float64),
            faults=metadata["faults"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} has no usable calibration in its metadata ({error}); "
            "make it again with 'cellquant track MASKS -o DIR'."
        ) from error


def read_tracks(
    path: str | Path, *, columns: Sequence[str] | None = None, rows: bool = True
) -> Tracks:
    """Read tracks written by `Tracks.write`.

    Parameters
    ----------
    path
        A parquet file, or a folder that holds ``tracks.parquet``.
    columns
        Names out of `TRACK_COLUMNS`: only these are read; all of them when None.
    rows
        Whether rows are read; without them the table is empty.

    Returns
    -------
    Tracks

    Raises
    ------
    InputError
        If the file is missing, is not a tracks table, or lacks a column.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "tracks.parquet"
    table, units, metadata = read_table(
        path, kind="tracks", columns=columns or list(TRACK_COLUMNS), rows=rows
    )
    try:
        box = metadata["box"]
        return Tracks(
            table=table,
            units=units,
            frame_interval=float(metadata["frame_interval"]),
            area=float(metadata["area"]),
            box=None if box is None else (float(box[0]), float(box[1])),
            smoothing=int(metadata["smoothing"]),
            provenance=metadata["provenance"],
        )
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(
            f"{path} has no usable units, frame interval and area in its metadata ({error}); "
            "make it again with 'cellquant track MASKS -o DIR'."
        ) from error


def write_table(
    table: pd.DataFrame,
    path: str | Path,
    *,
    units: Units,
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Write a table as parquet, byte-equal for equal content.

    Parameters
    ----------
    table
        Any DataFrame; its index is not kept.
    path
        The file to write.
    units
        Stored as ``length_unit`` and ``time_unit`` in the schema metadata.
    metadata
        Further JSON-serialisable entries, stored under ``cellquant``.
    """
    arrow = pa.Table.from_pandas(table, preserve_index=False)
    schema = {
        b"length_unit": units.length.encode(),
        b"time_unit": units.time.encode(),
        b"cellquant": json.dumps(metadata or {}, sort_keys=True).encode(),
    }
    pq.write_table(arrow.replace_schema_metadata(schema), path, compression="zstd")


def read_table(
    path: str | Path,
    *,
    kind: str = "",
    columns: Sequence[str] | None = None,
    rows: bool = True,
) -> tuple[pd.DataFrame, Units, dict[str, Any]]:
    """Read a table written by `write_table`.

    Parameters
    ----------
    path
        The file to read.
    kind
        What the table holds, for the message when a column is missing.
    columns
        The columns to read, all of which must be there; whatever there is when None.
    rows
        Whether rows are read; without them the table is empty.

    Returns
    -------
    table : pandas.DataFrame
    units : Units
    metadata : dict
        The further entries given to `write_table`.

    Raises
    ------
    InputError
        If the file is missing, is not parquet, lacks a column, or carries no units.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist; give the path of a parquet table.")
    try:
        schema = check_promises(path)
        raw = schema.metadata or {}
        units = Units(raw[b"length_unit"].decode(), raw[b"time_unit"].decode())
        metadata = json.loads(raw[b"cellquant"])
        missing = [name for name in columns or () if name not in schema.names]
        if missing:
            raise InputError(
                f"{path} is not a {kind} table: it lacks the columns {', '.join(missing)}; "
                "make one with 'cellquant track MASKS -o DIR'."
            )
        wanted = list(schema.names if columns is None else columns)
        if not rows:
            return pd.DataFrame({name: np.empty(0) for name in wanted}), units, metadata
        texts = [name for name in text_columns(schema) if name in wanted]
        arrow = decode_texts(path, pq.read_table(path, columns=wanted, read_dictionary=texts))
        # Each column is freed as soon as it is converted, or the table would be held twice.
        table = arrow.to_pandas(split_blocks=True, self_destruct=True)
    except KeyError as error:
        raise InputError(
            f"{path} carries no {error} in its schema metadata, so its numbers have no unit; "
            "use a table written by cellquant."
        ) from error
    except InputError:
        raise
    except (pa.ArrowException, OSError, ValueError, TypeError, AttributeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:300]
        raise InputError(
            f"{path} is not a readable parquet table ({reason}); make it again from its source."
        ) from error
    return table, units, metadata
