"""Linking: closed forms, invariances, broken input."""

import numpy as np
import pytest

import cellquant as cq
from cellquant.errors import InputError
from cellquant.io import LabelStack
from cellquant.tables import TRACK_COLUMNS


def discs(paths: np.ndarray, *, size: int = 120, radius: float = 3.2) -> np.ndarray:
    """Label masks of discs that follow paths (T, n, 2) as x, y; NaN where absent."""
    y, x = np.mgrid[:size, :size]
    stack = np.zeros((len(paths), size, size), dtype=np.int32)
    for frame, points in enumerate(paths):
        for label, (px, py) in enumerate(points, start=1):
            if np.isfinite(px):
                stack[frame][(x - px) ** 2 + (y - py) ** 2 <= radius**2] = label
    return stack


def stack_of(array: np.ndarray) -> LabelStack:
    return LabelStack.from_array(array, units="pixel")


def lattice(n: int = 5, spacing: float = 14.0, corner: float = 20.0) -> np.ndarray:
    grid = corner + spacing * np.arange(n)
    return np.array([(x, y) for y in grid for x in grid])


def test_uniform_drift_gives_one_track_per_cell() -> None:
    start = lattice()
    paths = start[None] + np.arange(8)[:, None, None] * np.array([3.0, -1.0])
    tracks = cq.track(stack_of(discs(paths)))
    table = tracks.table
    assert list(table.columns[: len(TRACK_COLUMNS)]) == list(TRACK_COLUMNS)
    assert tracks.n_tracks == len(start)
    assert (table.groupby("track_id")["label"].nunique() == 1).all()
    assert (table["parent_track_id"] == 0).all()


def test_single_frame_is_refused() -> None:
    with pytest.raises(InputError, match="at least two frames"):
        cq.track(stack_of(discs(lattice()[None])))


def test_background_movie_is_refused() -> None:
    with pytest.raises(InputError, match="holds a cell"):
        cq.track(stack_of(np.zeros((4, 20, 20), dtype=np.int32)))
