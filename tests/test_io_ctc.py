"""Folders of the Cell Tracking Challenge: what is written is read back, also by other readers."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile

from cellquant.errors import InputError
from cellquant.io import (
    LabelStack,
    compare_lineage,
    read_ctc_lineage,
    read_labels,
    write_ctc,
    write_labels,
)
from cellquant.io.lineage import cut_at_gaps, families, links


def family() -> tuple[np.ndarray, pd.DataFrame]:
    """A mother that divides, a cell with a gap, and one that is no track; labels shift in time."""
    masks = np.zeros((6, 24, 40), np.int32)
    rows: list[tuple[int, int, int, int]] = []

    def cell(frame: int, label: int, row: int, column: int, track: int, parent: int = 0) -> None:
        masks[frame, row : row + 5, column : column + 5] = label
        if track:
            rows.append((frame, label, track, parent))

    for t in range(3):
        cell(t, 10 + t, 2, 2 + t, 1)
    for t in range(3, 6):
        cell(t, 20 + t, 2, 2, 2, 1)
        cell(t, 30 + t, 2, 12, 3, 1)
    for t in (0, 1, 3, 4, 5):
        cell(t, 70_000 + t, 14, 20 + t, 4)
    cell(2, 5, 14, 2, 0)
    columns = ["frame", "label", "track_id", "parent_track_id"]
    return masks, pd.DataFrame(rows, columns=columns).sort_values(["track_id", "frame"])


LINEAGE = [(1, 0, 2, 0), (2, 3, 5, 1), (3, 3, 5, 1), (4, 0, 1, 0), (5, 3, 5, 4)]


def as_tuples(lineage: pd.DataFrame) -> list[tuple[int, ...]]:
    return [tuple(int(v) for v in row) for row in lineage.itertuples(index=False)]


@pytest.mark.parametrize("result", [False, True])
def test_written_folder_comes_back(tmp_path: Path, result: bool) -> None:
    masks, table = family()
    stack = LabelStack.from_array(masks)
    write_ctc(tmp_path / "out", stack, table, result=result)
    assert as_tuples(read_ctc_lineage(tmp_path / "out")) == LINEAGE
    again = read_labels(tmp_path / "out")
    assert again.frame_numbers == (0, 1, 2, 3, 4, 5)
    assert again.dtype == np.uint16
    assert compare_lineage(read_ctc_lineage(tmp_path / "out"), again) == ()
    for frame, label, track, _ in table.itertuples(index=False):
        number = 5 if track == 4 and frame >= 3 else track
        np.testing.assert_array_equal(again[frame] == number, masks[frame] == label)
    assert set(np.unique(again[2])) == {0, 1}
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names[0] == ("mask000.tif" if result else "man_track.txt")


def test_equal_input_gives_equal_bytes(tmp_path: Path) -> None:
    masks, table = family()
    for name in ("a", "b"):
        write_ctc(tmp_path / name, LabelStack.from_array(masks), table)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_traccuracy_reads_it(tmp_path: Path) -> None:
    loaders = pytest.importorskip("traccuracy.loaders")
    masks, table = family()
    write_ctc(tmp_path / "out", LabelStack.from_array(masks), table)
    graph = loaders.load_ctc_data(str(tmp_path / "out")).graph
    assert graph.number_of_nodes() == len(table)
    steps = sorted(
        (graph.nodes[a]["t"], graph.nodes[a]["segmentation_id"], graph.nodes[b]["segmentation_id"])
        for a, b in graph.edges
    )
    assert [step for step in steps if step[1] != step[2]] == [(1, 4, 5), (2, 1, 2), (2, 1, 3)]
    assert len(steps) == 2 + 3 + 2 * 2 + 1 + 2


def test_ctcmetrics_finds_it_valid(tmp_path: Path) -> None:
    pytest.importorskip("ctc_metrics")
    from ctc_metrics.scripts.validate import validate_sequence

    masks, table = family()
    write_ctc(tmp_path / "01_RES", LabelStack.from_array(masks), table, result=True)
    assert validate_sequence(str(tmp_path / "01_RES"))["Valid"]


def test_missing_frames_are_written_as_background(tmp_path: Path) -> None:
    masks, table = family()
    keep = [0, 1, 3, 4, 5]
    for index in keep:
        (tmp_path / "in").mkdir(exist_ok=True)
        tifffile.imwrite(tmp_path / "in" / f"t{index}.tif", masks[index])
    table = table[table["frame"] != 2]
    write_ctc(tmp_path / "out", read_labels(tmp_path / "in"), table)
    again = read_labels(tmp_path / "out")
    assert again.frame_numbers == (0, 1, 2, 3, 4, 5)
    assert not again[2].any()
    assert as_tuples(read_ctc_lineage(tmp_path / "out")) == [(1, 0, 1, 0), *LINEAGE[1:]]


def test_many_tracks_need_32_bits(tmp_path: Path) -> None:
    masks = np.ones((1, 4, 4), np.int32)
    table = pd.DataFrame({"frame": [0], "label": [1], "track_id": [70_000], "parent_track_id": 0})
    write_ctc(tmp_path / "out", LabelStack.from_array(masks), table)
    assert read_labels(tmp_path / "out").dtype == np.uint32
    assert (read_labels(tmp_path / "out")[0] == 70_000).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frame": 9, "parent_track_id": 0}, "cells in frame 9, which the array does not hold"),
        ({"label": 999}, "frame 5 does not hold label 999"),
        ({"track_id": 0}, "track_id 0"),
    ],
)
def test_tracks_of_other_masks(tmp_path: Path, change: dict[str, int], words: str) -> None:
    masks, table = family()
    table = table.reset_index(drop=True)
    for column, value in change.items():
        table.loc[len(table) - 1, column] = value
    with pytest.raises(InputError, match=words):
        write_ctc(tmp_path / "out", LabelStack.from_array(masks), table)
    assert list(tmp_path.iterdir()) == []


def test_recording_survives_the_round_trip(tmp_path: Path, recordings: Path) -> None:
    stack = read_labels(recordings / "epidermis_area1")
    lineage = read_ctc_lineage(recordings / "epidermis_area1")
    assert len(lineage) == 1070
    assert lineage["parent"][lineage["parent"] > 0].value_counts().eq(2).sum() == 335
    mothers = dict(zip(lineage["track_id"], lineage["parent"], strict=True))
    rows = [
        (frame, label, label, mothers[label])
        for frame, labels in enumerate(stack)
        for label in np.unique(labels[labels > 0]).tolist()
    ]
    table = pd.DataFrame(rows, columns=["frame", "label", "track_id", "parent_track_id"])
    write_ctc(tmp_path / "out", stack, table)
    written = read_ctc_lineage(tmp_path / "out")
    assert compare_lineage(written, read_labels(tmp_path / "out")) == ()
    assert compare_lineage(lineage, stack) == ()
    pd.testing.assert_frame_equal(written, lineage)


def test_cell_migration_table(recordings: Path) -> None:
    lineage = read_ctc_lineage(recordings / "cell_migration")
    assert len(lineage) == 571
    assert lineage["parent"][lineage["parent"] > 0].nunique() == 101


# The table alone.


def table_file(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "man_track.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize(
    "text",
    ["2 3 5 1\n1 0 2 0\n", "\ufeff1 0 2 0\r\n\r\n  2\t3 5 1", "2 3 5 1\n1 0 2 0\n\n\n"],
)
def test_spellings_of_a_table(tmp_path: Path, text: str) -> None:
    assert as_tuples(read_ctc_lineage(table_file(tmp_path, text))) == [(1, 0, 2, 0), (2, 3, 5, 1)]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 0 2\n", "line 1, is '1 0 2' instead of four integers"),
        ("1 0 2 0\nL B E P\n", "line 2, is 'L B E P'"),
        ("1 0 2.5 0\n", "four integers"),
        ("0 0 2 0\n", "is no track"),
        ("1 3 2 0\n", "is no track"),
        ("1 -1 2 0\n", "is no track"),
        ("1 0 2 -1\n", "is no track"),
        ("1 0 2 0\n1 3 4 0\n", "lists track 1 twice"),
        ("1 0 2 7\n", "mother 7, which the table does not list"),
        ("1 0 2 0\n2 2 4 1\n", "mother 1 ends at frame 2"),
        ("1 0 2 2\n2 0 2 1\n", "a daughter starts after its mother has ended"),
        ("1 0 99999999999999999999999 0\n", "is no track"),
        (b"\xff\xfe1 0 2 0", "not a text file"),
    ],
)
def test_lines_that_are_no_track(tmp_path: Path, text: str | bytes, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_ctc_lineage(table_file(tmp_path, text))


def test_folders_without_one_table(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds neither of"):
        read_ctc_lineage(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        read_ctc_lineage(tmp_path / "man_track.txt")
    (tmp_path / "man_track.txt").write_text("1 0 0 0\n")
    (tmp_path / "res_track.txt").write_text("1 0 0 0\n")
    with pytest.raises(InputError, match="holds both of"):
        read_ctc_lineage(tmp_path)


def test_labels_that_do_not_match_the_table(tmp_path: Path) -> None:
    masks, _ = family()
    write_labels(tmp_path / "m.tif", np.where(masks > 0, 1, 0))
    lineage = read_ctc_lineage(table_file(tmp_path, "1 0 3 0\n2 0 8 0\n"))
    assert compare_lineage(lineage, read_labels(tmp_path / "m.tif")) == (
        "2 labels are in the masks but not in the table at that time, first label 1 in frame 4",
        "6 labels are in the table but not in the masks at that time, first label 2 in frame 0",
        "the table goes on to frame 8, the masks end with 5",
    )


# The graph.


def test_pieces_links_and_families() -> None:
    _, table = family()
    shuffled = table.sample(frac=1, random_state=1).reset_index(drop=True)
    pieces = cut_at_gaps(shuffled)
    assert as_tuples(pieces.lineage) == LINEAGE
    late = (shuffled["track_id"] == 4) & (shuffled["frame"] >= 3)
    assert (pieces.label == np.where(late, 5, shuffled["track_id"])).all()
    found = {
        (
            tuple(shuffled.loc[a, ["track_id", "frame"]]),
            tuple(shuffled.loc[b, ["track_id", "frame"]]),
        )
        for a, b in links(shuffled).tolist()
    }
    assert found == {
        ((1, 0), (1, 1)), ((1, 1), (1, 2)), ((1, 2), (2, 3)), ((1, 2), (3, 3)),
        ((2, 3), (2, 4)), ((2, 4), (2, 5)), ((3, 3), (3, 4)), ((3, 4), (3, 5)),
        ((4, 0), (4, 1)), ((4, 1), (4, 3)), ((4, 3), (4, 4)), ((4, 4), (4, 5)),
    }  # fmt: skip
    assert families(pieces.lineage) == {1: 1, 2: 1, 3: 1, 4: 4, 5: 4}


def test_empty_table() -> None:
    _, table = family()
    empty = table.iloc[:0]
    assert len(cut_at_gaps(empty).lineage) == 0
    assert links(empty).shape == (0, 2)


def test_two_cells_of_one_track_in_a_frame() -> None:
    _, table = family()
    with pytest.raises(InputError, match="track 1 twice in frame 0"):
        cut_at_gaps(pd.concat([table, table.iloc[:1]]))
