"""Named toy movies that the tests share."""

import numpy as np


def drifting_discs(
    n_frames: int = 6,
    *,
    size: int = 96,
    radius: float = 7.0,
    step: tuple[float, float] = (1.5, 0.5),
    dtype: type = np.uint16,
) -> np.ndarray:
    """Four discs that keep their label and move by `step` px (x, y) per frame."""
    rows, columns = np.mgrid[:size, :size]
    movie = np.zeros((n_frames, size, size), dtype)
    centres = [(24, 24), (24, 64), (64, 24), (64, 64)]
    for frame in range(n_frames):
        for label, (row, column) in enumerate(centres, start=1):
            y, x = row + frame * step[1], column + frame * step[0]
            movie[frame][(rows - y) ** 2 + (columns - x) ** 2 <= radius**2] = label
    return movie


def shuffled(movie: np.ndarray, seed: int = 0) -> np.ndarray:
    """Same masks with the labels of every frame permuted at random."""
    rng = np.random.default_rng(seed)
    out = np.zeros_like(movie)
    for frame, labels in enumerate(movie):
        names = np.unique(labels[labels > 0])
        table = np.zeros(int(labels.max()) + 1, movie.dtype)
        table[names] = rng.permutation(names)
        out[frame] = table[labels]
    return out
