"""The graph behind a tracks table: pieces without gaps, links from row to row, families."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from cellquant.errors import InputError

Ints = np.ndarray[Any, np.dtype[np.int64]]


@dataclass(frozen=True)
class Segments:
    """Tracks cut at their gaps.

    Attributes
    ----------
    lineage
        Columns track_id, start, end, parent; sorted by track_id.
    label
        (n,) number of the piece that each row of the tracks table belongs to.
    """

    lineage: pd.DataFrame
    label: Ints


def cut_at_gaps(table: pd.DataFrame) -> Segments:
    """Cut tracks at missing frames, as formats without gaps need it.

    The first piece of a track keeps its track_id; later pieces get numbers after the largest
    one and the piece before as parent. A daughter hangs on the last piece of its mother; a mother
    that is not in the table counts as none.

    Parameters
    ----------
    table
        Columns frame, track_id, parent_track_id; any order.

    Returns
    -------
    Segments

    Raises
    ------
    InputError
        If a track_id is below 1, has two rows in one frame, or starts before its mother ends.
    """
    frame = table["frame"].to_numpy(dtype=np.int64)
    track = table["track_id"].to_numpy(dtype=np.int64)
    parent = table["parent_track_id"].to_numpy(dtype=np.int64)
    if len(track) and track.min() < 1:
        raise InputError(f"the tracks table holds track_id {track.min()}; number tracks from 1.")
    order = np.lexsort((frame, track))
    frames, tracks = frame[order], track[order]
    same = np.diff(tracks) == 0
    twice = np.flatnonzero(same & (np.diff(frames) == 0))
    if len(twice):
        raise InputError(
            f"the tracks table holds track {tracks[twice[0]]} twice in frame {frames[twice[0]]}; "
            "a track has one cell per frame."
        )
    begins = np.ones(len(tracks), dtype=bool)
    begins[1:] = ~same | (np.diff(frames) > 1)
    starts = np.flatnonzero(begins)
    stops = np.flatnonzero(np.roll(begins, -1))
    owner = tracks[starts]
    first = np.ones(len(starts), dtype=bool)
    first[1:] = owner[1:] != owner[:-1]
    number = owner.copy()
    number[~first] = (owner.max() if len(owner) else 0) + 1 + np.arange(np.count_nonzero(~first))
    mother = parent[order][starts]
    last_piece = dict(zip(owner.tolist(), number.tolist(), strict=True))  # later pieces win
    parents = np.array([last_piece.get(int(track), 0) for track in mother], dtype=np.int64)
    later = np.flatnonzero(~first)
    parents[later] = number[later - 1]
    lineage = pd.DataFrame(
        {"track_id": number, "start": frames[starts], "end": frames[stops], "parent": parents}
    )
    lineage = lineage.sort_values("track_id", ignore_index=True)
    check_order(lineage, "the tracks table")
    label = np.empty(len(tracks), dtype=np.int64)
    label[order] = np.repeat(number, stops - starts + 1)
    return Segments(lineage, label)


def links(table: pd.DataFrame) -> Ints:
    """Rows that follow each other: along each track, over its gaps, and from mother to daughter.

    Parameters
    ----------
    table
        Columns frame, track_id, parent_track_id; any order.

    Returns
    -------
    numpy.ndarray
        (n, 2) row numbers of source and target, by target's track, then frame.
    """
    frame = table["frame"].to_numpy(dtype=np.int64)
    track = table["track_id"].to_numpy(dtype=np.int64)
    parent = table["parent_track_id"].to_numpy(dtype=np.int64)
    order = np.lexsort((frame, track))
    starts = np.flatnonzero(np.diff(track[order], prepend=0))
    last_row = dict(
        zip(
            track[order][starts].tolist(),
            order[np.append(starts[1:], len(order)) - 1].tolist() if len(starts) else [],
            strict=True,
        )
    )
    source = np.empty(len(order), dtype=np.int64)
    source[1:] = order[:-1]
    source[starts] = [last_row.get(int(mother), -1) for mother in parent[order[starts]]]
    linked = source >= 0
    return np.column_stack((source[linked], order[linked]))


def families(lineage: pd.DataFrame) -> dict[int, int]:
    """The oldest known ancestor of every track.

    Parameters
    ----------
    lineage
        Columns track_id, start, parent, as `cut_at_gaps` returns them.

    Returns
    -------
    dict
        track_id of each track to that of its ancestor; a track without a mother is its own.
    """
    ancestor: dict[int, int] = {}
    by_age = lineage.sort_values(["start", "track_id"])
    for track, parent in by_age[["track_id", "parent"]].to_numpy().tolist():
        ancestor[track] = ancestor.get(parent, track)
    return ancestor


def check_order(lineage: pd.DataFrame, where: str) -> None:
    """Refuse a daughter that starts before its mother has ended; that also rules out circles.

    Parameters
    ----------
    lineage
        Columns track_id, start, end, parent; every parent other than 0 is listed.
    where
        Name of the table for the message.

    Raises
    ------
    InputError
        Naming both tracks and their frames.
    """
    ends = dict(zip(lineage["track_id"], lineage["end"], strict=True))
    for row in lineage[lineage["parent"] != 0].itertuples(index=False):
        if ends[row.parent] >= row.start:
            raise InputError(
                f"{where}: track {row.track_id} starts at frame {row.start}, but its mother "
                f"{row.parent} ends at frame {ends[row.parent]}; a daughter starts after its "
                "mother has ended."
            )
