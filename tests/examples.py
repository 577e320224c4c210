"""Named toy movies that the tests share."""

import numpy as np


def drifting_discs(
    n_frames: int = 6,
    *,
    side: int = 2,
    radius: float = 7.0,
    step: tuple[float, float] = (1.5, 0.5),
    dtype: type = np.uint16,
) -> np.ndarray:
    """`side` x `side` discs that keep their label and move by `step` px (x, y) per frame."""
    size = 40 * side + 16
    rows, columns = np.mgrid[:size, :size]
    movie = np.zeros((n_frames, size, size), dtype)
    for frame in range(n_frames):
        for label in range(1, side * side + 1):
            y = 24 + 40 * ((label - 1) // side) + frame * step[1]
            x = 24 + 40 * ((label - 1) % side) + frame * step[0]
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
