"""Folders of the Cell Tracking Challenge: relabelled masks and a table of tracks.

The table has one line per track, ``L B E P``: label, first frame, last frame, label of the mother
or 0. A track of the challenge has no gap, so a track with gaps is written as several, each the
only daughter of the one before.

References: Maška et al., Nature Methods 20, 1010 (2023), and its description of formats.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tifffile

from cellquant.errors import InputError
from cellquant.io.folder import LINEAGES, ctc_folder
from cellquant.io.lineage import check_order, cut_at_gaps
from cellquant.io.stack import LabelStack
from cellquant.storage import atomic_path

_COLUMNS = ("track_id", "start", "end", "parent")
_MAX_TABLE_BYTES = 2**28


def write_ctc(
    folder: str | Path, stack: LabelStack, tracks: pd.DataFrame, *, result: bool = False
) -> None:
    """Write tracks as a folder of the Cell Tracking Challenge.

    Labels of the masks are replaced by track numbers; cells without a track become background.
    Frames are numbered from 0 to the last; one that is missing from the stack is written as
    background, so that file n is always frame n.

    Parameters
    ----------
    folder
        Folder to write; an existing one is replaced when everything has been written.
    stack
        The masks that were tracked.
    tracks
        Columns frame, label, track_id, parent_track_id, as in tracks.parquet.
    result
        Name the files ``mask*.tif`` and ``res_track.txt`` instead of ``man_track*.tif`` and
        ``man_track.txt``.

    Raises
    ------
    InputError
        If the tracks do not belong to the masks, or the folder cannot be written.
    """
    segments = cut_at_gaps(tracks)
    frames = tracks["frame"].to_numpy(dtype=np.int64)
    labels = tracks["label"].to_numpy(dtype=np.int64)
    unknown = np.setdiff1d(frames, np.array(stack.frame_numbers, dtype=np.int64))
    if len(unknown):
        raise InputError(
            f"the tracks have cells in frame {unknown[0]}, which {stack.name} does not hold; "
            "give the masks that were tracked."
        )
    largest = int(segments.label.max()) if len(segments.label) else 0
    dtype = np.dtype(np.uint16 if largest <= np.iinfo(np.uint16).max else np.uint32)
    mask_name, table_name = ("mask", "res_track.txt") if result else ("man_track", "man_track.txt")
    digits = max(3, len(str(stack.frame_numbers[-1])))
    order = np.argsort(frames, kind="stable")
    bounds = np.searchsorted(
        frames[order], np.arange(stack.frame_numbers[0], stack.frame_numbers[-1] + 2)
    )
    index_of = {number: index for index, number in enumerate(stack.frame_numbers)}
    with atomic_path(folder) as temporary:
        temporary.mkdir()
        for number in range(stack.frame_numbers[-1] + 1):
            relabelled = np.zeros(stack.shape, dtype)
            if number in index_of:
                place = number - stack.frame_numbers[0]
                rows = order[bounds[place] : bounds[place + 1]]
                relabelled = _relabel(
                    stack[index_of[number]], labels[rows], segments.label[rows], number, dtype
                )
            tifffile.imwrite(
                temporary / f"{mask_name}{number:0{digits}d}.tif",
                relabelled,
                compression="zlib",
                photometric="minisblack",
                metadata=None,
                maxworkers=1,
            )
        lines = [f"{a} {b} {c} {d}\n" for a, b, c, d in segments.lineage.itertuples(index=False)]
        (temporary / table_name).write_text("".join(lines), encoding="ascii")


def _relabel(
    frame: np.ndarray[Any, Any],
    labels: np.ndarray[Any, np.dtype[np.int64]],
    numbers: np.ndarray[Any, np.dtype[np.int64]],
    frame_number: int,
    dtype: np.dtype[Any],
) -> np.ndarray[Any, Any]:
    present, inverse = np.unique(frame, return_inverse=True)
    missing = np.setdiff1d(labels, present)
    if len(missing) or len(np.unique(labels)) < len(labels) or (labels == 0).any():
        what = f"label {missing[0]}" if len(missing) else "each label only once"
        raise InputError(
            f"the tracks do not belong to these masks: frame {frame_number} does not hold {what}; "
            "give the masks that were tracked."
        )
    lookup = np.zeros(len(present), dtype)
    lookup[np.searchsorted(present, labels)] = numbers
    return lookup[inverse.reshape(frame.shape)]


def read_ctc_lineage(path: str | Path) -> pd.DataFrame:
    """Read the table of tracks of a folder of the Cell Tracking Challenge.

    Parameters
    ----------
    path
        ``man_track.txt`` or ``res_track.txt``, the folder that holds it, or one above
        (``TRA``, ``*_GT/TRA``, ``*_RES``).

    Returns
    -------
    pandas.DataFrame
        Columns track_id, start, end, parent (0 for none), int64, sorted by track_id.

    Raises
    ------
    InputError
        If there is no table, or a line of it is no track: naming file, line and reason.
    """
    path = Path(path)
    if path.is_dir():
        path = _table_in(ctc_folder(path))
    rows = []
    for number, line in enumerate(_lines(path), start=1):
        if not line.strip():
            continue
        try:
            track_id, start, end, parent = (int(word) for word in line.split())
        except ValueError as error:
            raise InputError(
                f"{path}, line {number}, is {line.strip()[:60]!r} instead of four integers "
                "'L B E P' (label, first frame, last frame, mother); correct the line."
            ) from error
        if not (1 <= track_id < 2**62 and 0 <= start <= end < 2**62 and 0 <= parent < 2**62):
            raise InputError(
                f"{path}, line {number}: {line.strip()[:60]!r} is no track; a label is at least "
                "1, frames count from 0 and the last is not before the first."
            )
        rows.append((track_id, start, end, parent))
    table = pd.DataFrame(rows, columns=list(_COLUMNS), dtype=np.int64)
    table = table.sort_values("track_id", ignore_index=True)
    repeated = table["track_id"][table["track_id"].duplicated()]
    if len(repeated):
        raise InputError(f"{path} lists track {repeated.iloc[0]} twice; keep one line per track.")
    known = table["parent"].isin(table["track_id"]) | (table["parent"] == 0)
    if not known.all():
        row = table[~known].iloc[0]
        raise InputError(
            f"{path}: track {row['track_id']} has the mother {row['parent']}, which the table "
            "does not list; write 0 for no mother."
        )
    check_order(table, str(path))
    return table


def compare_lineage(lineage: pd.DataFrame, stack: LabelStack) -> tuple[str, ...]:
    """Say where a table of tracks and its masks disagree.

    Parameters
    ----------
    lineage
        As `read_ctc_lineage` returns it.
    stack
        The masks beside it; every frame is read once.

    Returns
    -------
    tuple of str
        One sentence per kind of disagreement, empty where all labels are where the table says.
    """
    ids = lineage["track_id"].to_numpy()
    start, end = lineage["start"].to_numpy(), lineage["end"].to_numpy()
    unlisted: list[tuple[int, int]] = []
    absent: list[tuple[int, int]] = []
    for index, number in enumerate(stack.frame_numbers):
        labels = np.unique(stack[index])
        labels = labels[labels != 0]
        promised = ids[(start <= number) & (number <= end)]
        unlisted += [(int(label), number) for label in np.setdiff1d(labels, promised)]
        absent += [(int(label), number) for label in np.setdiff1d(promised, labels)]
    notes = []
    if unlisted:
        notes.append(
            f"{len(unlisted)} labels are in the masks but not in the table at that time, first "
            f"label {unlisted[0][0]} in frame {unlisted[0][1]}"
        )
    if absent:
        notes.append(
            f"{len(absent)} labels are in the table but not in the masks at that time, first "
            f"label {absent[0][0]} in frame {absent[0][1]}"
        )
    last = int(end.max()) if len(end) else 0
    if last > stack.frame_numbers[-1]:
        notes.append(
            f"the table goes on to frame {last}, the masks end with {stack.frame_numbers[-1]}"
        )
    return tuple(notes)


def _table_in(folder: Path) -> Path:
    found = [folder / name for name in LINEAGES if (folder / name).is_file()]
    if len(found) != 1:
        what = "both" if found else "neither"
        raise InputError(
            f"{folder} holds {what} of {' and '.join(LINEAGES)}; give the path of the table."
        )
    return found[0]


def _lines(path: Path) -> list[str]:
    try:
        if path.stat().st_size > _MAX_TABLE_BYTES:
            raise InputError(
                f"{path} is larger than {_MAX_TABLE_BYTES} bytes, which no table of tracks is; "
                "give man_track.txt or res_track.txt."
            )
        return path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError as error:
        raise InputError(
            f"{path} does not exist; give a folder with man_track.txt or res_track.txt."
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file; give man_track.txt or res_track.txt.") from (
            error
        )
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error}).") from error
