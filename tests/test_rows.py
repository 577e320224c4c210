"""Tables in pieces: from memory and from a file, in any order, the same numbers."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cellquant import rows as module
from cellquant.errors import InputError
from cellquant.observables import observe
from cellquant.rows import TableRows, rows_of, scan_cells, scan_tracks
from cellquant.tables import PHYSICAL, Cells, Tracks
from observables_examples import brownian, movie, with_gaps

NAMES = ("frame", "x", "touches_border")


@pytest.fixture
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PIECE", 100)


@pytest.mark.parametrize("order", ["as written", "shuffled"])
def test_pieces_hold_whole_tracks_in_order(order: str, small_pieces: None, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    tracks = with_gaps(brownian(rng, 30, 37), rng, 0.1)
    table = tracks.table if order == "as written" else tracks.table.sample(frac=1, random_state=1)
    source = Tracks(table, tracks.units, 1.0, tracks.area, None)
    source.write(tmp_path / "tracks.parquet")
    for rows in (TableRows(source), rows_of(scan_tracks(tmp_path))):
        pieces = list(rows.pieces(*NAMES))
        assert len(pieces) > 5
        seen = [set(piece["track_id"].tolist()) for piece in pieces]
        assert sum(map(len, seen)) == len(set().union(*seen)) == 30
        found = pd.concat([pd.DataFrame(piece) for piece in pieces], ignore_index=True)
        pd.testing.assert_frame_equal(found[list(NAMES)], tracks.table[list(NAMES)])


def test_a_track_longer_than_a_piece_stays_whole(small_pieces: None) -> None:
    pieces = list(rows_of(brownian(np.random.default_rng(1), 2, 450)).pieces("frame"))
    assert [piece["frame"].size for piece in pieces] == [450, 450]


def test_a_file_gives_the_bytes_that_memory_gives(tmp_path: Path) -> None:
    tracks = movie(np.random.default_rng(2))
    tracks.write(tmp_path / "tracks.parquet")
    observe(tracks).write(tmp_path / "memory")
    # Pieces of another size, too: nothing may depend on where they are cut.
    before = module.PIECE
    try:
        module.PIECE = 500
        observe(scan_tracks(tmp_path)).write(tmp_path / "file")
    finally:
        module.PIECE = before
    names = sorted(path.name for path in (tmp_path / "memory").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "file").iterdir())
    for name in names:
        one, other = ((tmp_path / k / name).read_bytes() for k in ("memory", "file"))
        assert one == other, name


def test_cells_on_disk_give_what_cells_in_memory_give(small_pieces: None, tmp_path: Path) -> None:
    table = movie(np.random.default_rng(3)).table
    columns = [name for name in table if name not in ("track_id", "parent_track_id", "time")]
    cells = Cells(table[columns], PHYSICAL, 1.0, 10.0, (283.0, 283.0), 60, np.full(60, 283.0**2))
    cells.write(tmp_path / "cells.parquet")
    names = ["shape_index", "density", "wave_number", "structure_factor", "neighbours"]
    one, other = observe(cells, only=names), observe(scan_cells(tmp_path), only=names)
    assert one.summary == other.summary


def test_rows_of_the_wrong_kind_are_named(tmp_path: Path) -> None:
    tracks = movie(np.random.default_rng(4))
    path = tmp_path / "tracks.parquet"
    tracks.write(path)
    whole = pq.read_table(path)
    for column, message in (
        (pa.array(["a"] * whole.num_rows), "the column x holds string"),
        (pa.array([None] * whole.num_rows, pa.int64()), "rows without a value of track_id"),
    ):
        name = "x" if "column x" in message else "track_id"
        place = whole.schema.get_field_index(name)
        pq.write_table(
            whole.set_column(place, name, column).replace_schema_metadata(whole.schema.metadata),
            path,
        )
        with pytest.raises(InputError, match=message):
            observe(scan_tracks(path), only=["msd"])


def test_a_file_cut_short_is_named(tmp_path: Path) -> None:
    path = tmp_path / "tracks.parquet"
    movie(np.random.default_rng(5)).write(path)
    source = scan_tracks(path)
    content = bytearray(path.read_bytes())
    content[200:3000] = bytes(2800)
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a readable parquet table"):
        observe(source, only=["msd"])
