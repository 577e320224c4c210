"""Tracks as a TrackMate XML file.

A track of TrackMate is a whole family, divisions included; cells of one frame without any link
are spots without a track.

References: Ershov et al., Nature Methods 19, 829 (2022); the writer and reader of TrackMate 7.
"""

from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pandas as pd

from cellquant.io.lineage import Ints, cut_at_gaps, families, links
from cellquant.io.stack import LabelStack
from cellquant.tables import Tracks

_VERSION = "7.11.1"
_UNITS = {"um": "micron", "px": "pixel"}
# Feature of TrackMate, column of the tracks table, short name, dimension.
_SPOT_FEATURES = (
    ("AREA", "area", "Area", "AREA"),
    ("PERIMETER", "perimeter", "Perim.", "LENGTH"),
    ("SHAPE_INDEX", "shape_index", "SI", "NONE"),
    ("ELLIPSE_ASPECTRATIO", "aspect_ratio", "El. a.r.", "NONE"),
    ("ELLIPSE_THETA", "orientation", "El. angle", "ANGLE"),
)
_PLAIN_FEATURES = (
    ("QUALITY", "Quality", "QUALITY", False),
    ("POSITION_X", "X", "POSITION", False),
    ("POSITION_Y", "Y", "POSITION", False),
    ("POSITION_Z", "Z", "POSITION", False),
    ("POSITION_T", "T", "TIME", False),
    ("FRAME", "Frame", "NONE", True),
    ("RADIUS", "R", "LENGTH", False),
    ("VISIBILITY", "Visibility", "NONE", True),
    ("LABEL", "Label", "NONE", True),
    ("CELLQUANT_TRACK", "Track", "NONE", True),
)
_EDGE_FEATURES = (
    ("SPOT_SOURCE_ID", "Source spot ID", "NONE", True),
    ("SPOT_TARGET_ID", "Target spot ID", "NONE", True),
    ("LINK_COST", "Edge cost", "COST", False),
    ("EDGE_TIME", "Edge time", "TIME", False),
    ("DISPLACEMENT", "Displacement", "LENGTH", False),
)
_TRACK_FEATURES = (
    ("TRACK_INDEX", "Index", "NONE", True),
    ("TRACK_ID", "ID", "NONE", True),
    ("NUMBER_SPOTS", "N spots", "NONE", True),
    ("NUMBER_GAPS", "N gaps", "NONE", True),
    ("NUMBER_SPLITS", "N splits", "NONE", True),
    ("TRACK_DURATION", "Duration", "TIME", False),
    ("TRACK_START", "Start", "TIME", False),
    ("TRACK_STOP", "Stop", "TIME", False),
)


def write_trackmate(tracks: Tracks, path: Path, masks: LabelStack | None) -> None:
    """Write a TrackMate file; see `cellquant.io.export_tracks`."""
    table = tracks.table
    pairs = links(table)
    owner = families(cut_at_gaps(table).lineage)
    family = np.array([owner[track] for track in table["track_id"].tolist()], dtype=np.int64)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        space = _UNITS.get(tracks.units.length, tracks.units.length)
        file.write('<?xml version="1.0" encoding="UTF-8"?>\n')
        file.write(f'<TrackMate version="{_VERSION}">\n  <Log>Written by cellquant.</Log>\n')
        file.write(_open("Model", 1, spatialunits=space, timeunits=tracks.units.time))
        file.writelines(_declarations())
        file.writelines(_spots(table))
        file.writelines(_families(tracks, pairs, family))
        file.write("  </Model>\n")
        file.writelines(_settings(tracks, masks))
        file.write('  <GUIState state="ConfigureViews" />\n</TrackMate>\n')


def _attributes(values: dict[str, object]) -> str:
    return "".join(f" {name}={_quoted(value)}" for name, value in values.items())


def _quoted(value: object) -> str:
    if isinstance(value, str):
        return quoteattr(value)
    return '"NaN"' if value != value else f'"{value}"'


def _open(tag: str, depth: int, **values: object) -> str:
    return f"{'  ' * depth}<{tag}{_attributes(values)}>\n"


def _empty(tag: str, depth: int, **values: object) -> str:
    return f"{'  ' * depth}<{tag}{_attributes(values)} />\n"


def _declarations() -> Iterator[str]:
    spots = [*_PLAIN_FEATURES, *((key, name, dim, False) for key, _, name, dim in _SPOT_FEATURES)]
    yield _open("FeatureDeclarations", 2)
    for tag, features in (
        ("SpotFeatures", spots),
        ("EdgeFeatures", _EDGE_FEATURES),
        ("TrackFeatures", _TRACK_FEATURES),
    ):
        yield _open(tag, 3)
        for key, name, dimension, integer in features:
            yield _empty(
                "Feature",
                4,
                feature=key,
                name=name,
                shortname=name,
                dimension=dimension,
                isint=str(integer).lower(),
            )
        yield f"      </{tag}>\n"
    yield "    </FeatureDeclarations>\n"


def _spots(table: pd.DataFrame) -> Iterator[str]:
    yield _open("AllSpots", 2, nspots=len(table))
    numbered = table.assign(spot=np.arange(len(table)), radius=np.sqrt(table["area"] / np.pi))
    for frame, cells in numbered.groupby("frame", sort=True):
        yield _open("SpotsInFrame", 3, frame=frame)
        columns = {name: cells[name].tolist() for name in cells.columns}
        for row, spot in enumerate(columns["spot"]):
            measured = {key: columns[column][row] for key, column, _, _ in _SPOT_FEATURES}
            yield _empty(
                "Spot",
                4,
                ID=spot,
                name=f"ID{spot}",
                QUALITY=1.0,
                POSITION_X=columns["x"][row],
                POSITION_Y=columns["y"][row],
                POSITION_Z=0.0,
                POSITION_T=columns["time"][row],
                FRAME=columns["frame"][row],
                RADIUS=columns["radius"][row],
                VISIBILITY=1,
                LABEL=columns["label"][row],
                CELLQUANT_TRACK=columns["track_id"][row],
                **measured,
            )
        yield "      </SpotsInFrame>\n"
    yield "    </AllSpots>\n"


def _families(tracks: Tracks, pairs: Ints, family: Ints) -> Iterator[str]:
    table = tracks.table
    time, frame = table["time"].to_numpy(), table["frame"].to_numpy()
    x, y = table["x"].to_numpy(), table["y"].to_numpy()
    of_pair = family[pairs[:, 1]]
    order = np.argsort(of_pair, kind="stable")
    numbers, starts = np.unique(of_pair[order], return_index=True)
    stops = np.append(starts, len(order))[1:]
    yield _open("AllTracks", 2)
    for index, (number, start, stop) in enumerate(
        zip(numbers.tolist(), starts.tolist(), stops.tolist(), strict=True)
    ):
        edges = pairs[order[start:stop]]
        spots = np.unique(edges)
        begin, end = float(time[spots].min()), float(time[spots].max())
        _, daughters = np.unique(edges[:, 0], return_counts=True)
        yield _open(
            "Track",
            3,
            name=f"Track_{number}",
            TRACK_INDEX=index,
            TRACK_ID=number,
            NUMBER_SPOTS=len(spots),
            NUMBER_GAPS=int(np.count_nonzero(np.diff(frame[edges], axis=1) > 1)),
            NUMBER_SPLITS=int(np.count_nonzero(daughters > 1)),
            TRACK_DURATION=end - begin,
            TRACK_START=begin,
            TRACK_STOP=end,
        )
        for source, target in edges.tolist():
            yield _empty(
                "Edge",
                4,
                SPOT_SOURCE_ID=source,
                SPOT_TARGET_ID=target,
                LINK_COST=-1.0,
                EDGE_TIME=float(time[source] + time[target]) / 2,
                DISPLACEMENT=float(np.hypot(x[target] - x[source], y[target] - y[source])),
            )
        yield "      </Track>\n"
    yield "    </AllTracks>\n"
    yield _open("FilteredTracks", 2)
    for number in numbers.tolist():
        yield _empty("TrackID", 3, TRACK_ID=number)
    yield "    </FilteredTracks>\n"


def _settings(tracks: Tracks, masks: LabelStack | None) -> Iterator[str]:
    path = None if masks is None else masks.path
    pixel = 1.0 if tracks.units.length == "px" else tracks.provenance.get("pixel_size", 1.0)
    rows, columns = (0, 0) if masks is None else masks.shape
    last = 0 if tracks.table.empty else int(tracks.table["frame"].max())
    n_frames = last + 1 if masks is None else masks.frame_numbers[-1] + 1
    yield _open("Settings", 1)
    yield _empty(
        "ImageData",
        2,
        filename="" if path is None else path.name,
        folder="" if path is None else str(path.resolve().parent),
        width=columns,
        height=rows,
        nslices=1,
        nframes=n_frames,
        pixelwidth=float(pixel),
        pixelheight=float(pixel),
        voxeldepth=1.0,
        timeinterval=tracks.frame_interval,
    )
    yield _empty("InitialSpotFilter", 2, feature="QUALITY", value=0.0, isabove="true")
    yield "    <SpotFilterCollection />\n    <TrackFilterCollection />\n"
    yield "    <AnalyzerCollection />\n  </Settings>\n"
