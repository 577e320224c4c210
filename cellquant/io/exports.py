"""Tracks for other programs."""

from pathlib import Path
from typing import Any

import numpy as np

from cellquant.errors import InputError
from cellquant.io.ctc import write_ctc
from cellquant.io.lineage import cut_at_gaps, families, links
from cellquant.io.stack import LabelStack
from cellquant.io.trackmate import write_trackmate
from cellquant.storage import atomic_path, write_json
from cellquant.tables import Tracks

FORMATS = ("ctc", "trackmate", "napari", "geff", "csv")
# Units as GEFF spells them; others are left out.
_GEFF_UNITS = {"um": "micrometer", "px": "pixel", "min": "minute", "frame": "frame"}


def export_tracks(
    tracks: Tracks, to: str, path: str | Path, *, masks: LabelStack | None = None
) -> None:
    """Write tracks for another program; the output is there complete or not at all.

    - ``ctc``: a folder of relabelled masks and ``man_track.txt``; a track with gaps becomes
      several, see `cellquant.io.write_ctc`.
    - ``trackmate``: a TrackMate XML file; a family of cells is one track there.
    - ``napari``: a CSV with the columns track_id, t, y, x of a napari tracks layer, and beside it
      a JSON with its graph (daughter to mothers) and the units.
    - ``geff``: a folder in the Graph Exchange File Format.
    - ``csv``: the whole table, and beside it a JSON with units and settings.

    Positions are in the units of the tracks; t is the frame number.

    Parameters
    ----------
    tracks
        What to write.
    to
        One of `FORMATS`.
    path
        File, or folder for ctc and geff; replaced when it exists.
    masks
        The label masks that were tracked; needed for ctc, named in trackmate.

    Raises
    ------
    InputError
        If the format is unknown, needs masks or the geff extra, the tracks contradict
        themselves, or the path cannot be written.
    """
    if to not in FORMATS:
        raise InputError(
            f"tracks cannot be exported to {to!r}; choose one of {', '.join(FORMATS)}."
        )
    path = Path(path)
    cut_at_gaps(tracks.table)  # refuses tables that are no set of tracks
    if to == "ctc":
        if masks is None:
            raise InputError("the ctc format holds masks; give the label masks (--masks PATH).")
        write_ctc(path, masks, tracks.table)
    elif to == "geff":
        _write_geff(tracks, path)
    else:
        if path.is_dir():
            raise InputError(f"{path} is a folder; give the path of a file for {to}.")
        with atomic_path(path) as temporary:
            if to == "trackmate":
                write_trackmate(tracks, temporary, masks)
            elif to == "napari":
                columns = tracks.table[["track_id", "frame", "y", "x"]]
                columns.rename(columns={"frame": "t"}).to_csv(temporary, index=False)
            else:
                tracks.table.to_csv(temporary, index=False)
        if to != "trackmate":
            graph = _graph(tracks) if to == "napari" else {}
            write_json(path.with_suffix(".json"), {**_description(tracks), **graph})


def _description(tracks: Tracks) -> dict[str, Any]:
    return {
        "length_unit": tracks.units.length,
        "time_unit": tracks.units.time,
        "frame_interval": tracks.frame_interval,
        "area": tracks.area,
        "box": tracks.box,
        "smoothing": tracks.smoothing,
        "provenance": dict(tracks.provenance),
    }


def _graph(tracks: Tracks) -> dict[str, Any]:
    known = set(tracks.table["track_id"].tolist())
    mothers = tracks.table[["track_id", "parent_track_id"]].drop_duplicates("track_id")
    graph = {
        str(track): [parent] for track, parent in mothers.to_numpy().tolist() if parent in known
    }
    return {"graph": graph}


def _write_geff(tracks: Tracks, path: Path) -> None:
    try:
        from geff import GeffMetadata
        from geff.core_io import write_arrays
    except ImportError as error:
        raise InputError(
            "the geff format needs the geff package; install it with pip install 'cellquant[geff]'."
        ) from error
    table = tracks.table
    owner = families(cut_at_gaps(table).lineage)
    props = {"t": table["frame"].to_numpy()}
    props |= {name: table[name].to_numpy() for name in table.columns if name != "frame"}
    props["lineage_id"] = np.array([owner[t] for t in table["track_id"].tolist()], dtype=np.int64)
    length = _GEFF_UNITS.get(tracks.units.length)
    time = _GEFF_UNITS.get(tracks.units.time)
    frames = {"name": "t", "type": "time", "unit": "frame"}
    axes = [
        {**frames, "scale": tracks.frame_interval, "scaled_unit": time},
        {"name": "y", "type": "space", "unit": length},
        {"name": "x", "type": "space", "unit": length},
    ]
    metadata = GeffMetadata(
        directed=True,
        axes=axes,
        node_props_metadata={},
        edge_props_metadata={},
        track_node_props={"lineage": "lineage_id"},
        extra={"cellquant": _description(tracks)},
    )
    with atomic_path(path) as temporary:
        write_arrays(
            temporary,
            node_ids=np.arange(len(table), dtype=np.uint64),
            node_props={
                name: {"values": values, "missing": _missing(values)}
                for name, values in props.items()
            },
            edge_ids=links(table).astype(np.uint64),
            edge_props={},
            metadata=metadata,
        )


def _missing(values: "np.ndarray[Any, Any]") -> "np.ndarray[Any, Any] | None":
    missing = np.isnan(values) if values.dtype.kind == "f" else np.zeros(0, dtype=bool)
    return missing if missing.any() else None
