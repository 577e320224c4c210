"""Exported tracks, each read back by a reader that is not ours."""

import csv
import json
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cellquant.errors import InputError
from cellquant.io import FORMATS, LabelStack, export_tracks, read_ctc_lineage
from cellquant.tables import PHYSICAL, TRACK_COLUMNS, Tracks

# track_id, parent, frames: a division, a track with a gap, a cell of a single frame, and a
# track whose mother is not in the table.
FAMILY = {
    1: (0, (0, 1, 2)),
    2: (1, (3, 4, 5)),
    3: (1, (3, 4)),
    4: (0, (0, 1, 4, 5)),
    6: (0, (2,)),
    7: (99, (4, 5)),
}
LINKS = {
    ((1, 0), (1, 1)), ((1, 1), (1, 2)), ((1, 2), (2, 3)), ((1, 2), (3, 3)), ((2, 3), (2, 4)),
    ((2, 4), (2, 5)), ((3, 3), (3, 4)), ((4, 0), (4, 1)), ((4, 1), (4, 4)), ((4, 4), (4, 5)),
    ((7, 4), (7, 5)),
}  # fmt: skip


@pytest.fixture
def tracks() -> Tracks:
    rng = np.random.default_rng(11)
    rows = []
    for track, (parent, frames) in FAMILY.items():
        for frame in frames:
            row = dict.fromkeys(TRACK_COLUMNS, 0.0)
            row |= {"frame": frame, "label": 10 * track, "track_id": track}
            row |= {"parent_track_id": parent, "time": 10.0 * frame, "area": 25 * 0.65**2}
            row |= {"x": rng.uniform(0, 30), "y": rng.uniform(0, 30), "shape_index": 3.9}
            rows.append(row)
    table = pd.DataFrame(rows).astype(dict(TRACK_COLUMNS))
    table.loc[3, "perimeter"] = np.nan
    return Tracks(table, PHYSICAL, 10.0, 900.0, provenance={"pixel_size": 0.65})


@pytest.fixture
def masks(tracks: Tracks) -> LabelStack:
    array = np.zeros((6, 40, 80), np.int32)
    for frame, label in tracks.table[["frame", "label"]].to_numpy():
        array[frame, 10:15, label : label + 5] = label
    return LabelStack.from_array(array)


def key(tracks: Tracks, row: int) -> tuple[int, int]:
    return tuple(int(v) for v in tracks.table.loc[row, ["track_id", "frame"]])  # type: ignore[return-value]


def test_csv(tmp_path: Path, tracks: Tracks) -> None:
    export_tracks(tracks, "csv", tmp_path / "t.csv")
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "t.csv"), tracks.table)
    described = json.loads((tmp_path / "t.json").read_text())
    assert (described["length_unit"], described["time_unit"]) == ("um", "min")
    assert described["frame_interval"] == 10


def test_napari(tmp_path: Path, tracks: Tracks) -> None:
    export_tracks(tracks, "napari", tmp_path / "t.csv")
    with (tmp_path / "t.csv").open() as file:
        header, *rows = list(csv.reader(file))
    assert header == ["track_id", "t", "y", "x"]
    data = np.array(rows, dtype=float)
    np.testing.assert_array_equal(data, tracks.table[["track_id", "frame", "y", "x"]])
    # What the tracks layer of napari demands: integers, sorted by track then time.
    assert (data[:, :2] == data[:, :2].astype(int)).all()
    assert (np.lexsort((data[:, 1], data[:, 0])) == np.arange(len(data))).all()
    graph = json.loads((tmp_path / "t.json").read_text())["graph"]
    assert graph == {"2": [1], "3": [1]}


def test_geff(tmp_path: Path, tracks: Tracks) -> None:
    geff = pytest.importorskip("geff")
    export_tracks(tracks, "geff", tmp_path / "t.geff")
    geff.validate_structure(tmp_path / "t.geff")
    graph, metadata = geff.read(tmp_path / "t.geff", backend="networkx")
    nodes = graph.nodes
    assert {(key(tracks, a), key(tracks, b)) for a, b in graph.edges} == LINKS
    for row, values in tracks.table.iterrows():
        assert nodes[row]["t"] == values["frame"]
        assert (nodes[row]["x"], nodes[row]["y"]) == (values["x"], values["y"])
        assert nodes[row]["label"] == values["label"]
    assert "perimeter" not in nodes[3]
    assert len({nodes[row]["lineage_id"] for row in nodes}) == 4
    axes = {axis.name: axis for axis in metadata.axes}
    assert (axes["x"].unit, axes["t"].unit) == ("micrometer", "frame")
    assert (axes["t"].scale, axes["t"].scaled_unit) == (10, "minute")


def test_geff_missing(tmp_path: Path, tracks: Tracks, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "geff.core_io", None)
    with pytest.raises(InputError, match=r"pip install 'cellquant\[geff\]'"):
        export_tracks(tracks, "geff", tmp_path / "t.geff")


def test_ctc(tmp_path: Path, tracks: Tracks, masks: LabelStack) -> None:
    loaders = pytest.importorskip("traccuracy.loaders")
    export_tracks(tracks, "ctc", tmp_path / "out", masks=masks)
    graph = loaders.load_ctc_data(str(tmp_path / "out")).graph
    assert graph.number_of_nodes() == len(tracks.table)
    assert graph.number_of_edges() == len(LINKS)
    assert len(read_ctc_lineage(tmp_path / "out")) == len(FAMILY) + 1
    with pytest.raises(InputError, match="--masks"):
        export_tracks(tracks, "ctc", tmp_path / "other")


@pytest.mark.filterwarnings("ignore::UserWarning")  # what the file leaves out: image, display
def test_trackmate_through_geff(tmp_path: Path, tracks: Tracks) -> None:
    """The converter of GEFF is an independent reader of TrackMate files."""
    geff = pytest.importorskip("geff")
    convert = pytest.importorskip("geff.convert")
    export_tracks(tracks, "trackmate", tmp_path / "t.xml")
    convert.from_trackmate_xml_to_geff(tmp_path / "t.xml", tmp_path / "t.geff")
    graph, _ = geff.read(tmp_path / "t.geff", backend="networkx")
    assert graph.number_of_nodes() == len(tracks.table)
    assert {(key(tracks, a), key(tracks, b)) for a, b in graph.edges} == LINKS
    for row, values in tracks.table.iterrows():
        node = graph.nodes[row]
        assert (node["POSITION_X"], node["POSITION_Y"]) == (values["x"], values["y"])
        assert (node["FRAME"], node["POSITION_T"]) == (values["frame"], values["time"])
        assert node["LABEL"] == values["label"]
        assert node["SHAPE_INDEX"] == values["shape_index"]


def test_trackmate_structure(tmp_path: Path, tracks: Tracks, masks: LabelStack) -> None:
    """What the reader of TrackMate 7 looks for, by its own names."""
    export_tracks(tracks, "trackmate", tmp_path / "t.xml", masks=masks)
    root = ElementTree.parse(tmp_path / "t.xml").getroot()
    assert root.tag == "TrackMate"
    model = root.find("Model")
    assert model is not None
    assert (model.get("spatialunits"), model.get("timeunits")) == ("micron", "min")
    spots = {spot.get("ID"): spot for spot in model.iter("Spot")}
    assert model.find("AllSpots").get("nspots") == str(len(spots)) == str(len(tracks.table))
    declared = {
        f.get("feature") for f in model.iterfind("FeatureDeclarations/SpotFeatures/Feature")
    }
    assert set(spots["0"].attrib) - {"ID", "name"} == declared
    assert spots["3"].get("PERIMETER") == "NaN"  # as Java spells it
    for frame in model.iter("SpotsInFrame"):
        assert {spot.get("FRAME") for spot in frame} == {frame.get("frame")}
    families = {track.get("TRACK_ID"): track for track in model.iterfind("AllTracks/Track")}
    filtered = {track.get("TRACK_ID") for track in model.iterfind("FilteredTracks/TrackID")}
    assert set(families) == filtered == {"1", "4", "7"}
    first = families["1"]
    assert (first.get("NUMBER_SPOTS"), first.get("NUMBER_SPLITS")) == ("8", "1")
    assert families["4"].get("NUMBER_GAPS") == "1"
    for edge in model.iter("Edge"):
        ends = [spots[edge.get(f"SPOT_{end}_ID")] for end in ("SOURCE", "TARGET")]
        assert int(ends[0].get("FRAME")) < int(ends[1].get("FRAME"))
    image = root.find("Settings/ImageData")
    assert (image.get("width"), image.get("height"), image.get("nframes")) == ("80", "40", "6")
    assert (image.get("pixelwidth"), image.get("timeinterval")) == ("0.65", "10.0")


def test_equal_input_gives_equal_bytes(tmp_path: Path, tracks: Tracks) -> None:
    for to in ("csv", "napari", "trackmate"):
        for name in ("a", "b"):
            export_tracks(tracks, to, tmp_path / to / name)
        assert (tmp_path / to / "a").read_bytes() == (tmp_path / to / "b").read_bytes()


@pytest.mark.parametrize("to", [to for to in FORMATS if to != "ctc"])
def test_no_tracks_at_all(tmp_path: Path, tracks: Tracks, to: str) -> None:
    empty = Tracks(tracks.table.iloc[:0], PHYSICAL, 10.0, 900.0)
    export_tracks(empty, to, tmp_path / "t.x")
    assert (tmp_path / "t.x").exists()


@pytest.mark.parametrize("to", FORMATS)
def test_nothing_half_written_is_left(
    tmp_path: Path, tracks: Tracks, masks: LabelStack, to: str
) -> None:
    broken = Tracks(pd.concat([tracks.table, tracks.table.iloc[:1]]), PHYSICAL, 10.0, 900.0)
    with pytest.raises(InputError, match="twice in frame 0"):
        export_tracks(broken, to, tmp_path / "out", masks=masks)
    assert list(tmp_path.iterdir()) == []


def test_refusals(tmp_path: Path, tracks: Tracks) -> None:
    with pytest.raises(InputError, match="choose one of ctc, trackmate, napari, geff, csv"):
        export_tracks(tracks, "matlab", tmp_path / "t.mat")
    with pytest.raises(InputError, match="is a folder"):
        export_tracks(tracks, "csv", tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(InputError):
        export_tracks(tracks, "csv", tmp_path / "file" / "t.csv")
