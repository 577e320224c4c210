"""A synthetic dense layer: Voronoi cells of points that move persistently, as label masks."""

from pathlib import Path

import numba
import numpy as np
import tifffile


@numba.njit(cache=True)
def _paint(x, y, order, starts, n_bins, size, reach, out):  # type: ignore[no-untyped-def]
    """Give each pixel the label of the nearest centre within `reach`, through a grid of bins."""
    width = size / n_bins
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            bin_x = int(column / width)
            bin_y = int(row / width)
            best = reach * reach
            label = 0
            for by in range(max(0, bin_y - 1), min(n_bins, bin_y + 2)):
                for bx in range(max(0, bin_x - 1), min(n_bins, bin_x + 2)):
                    for k in range(starts[by * n_bins + bx], starts[by * n_bins + bx + 1]):
                        i = order[k]
                        distance = (x[i] - column) ** 2 + (y[i] - row) ** 2
                        if distance < best:
                            best = distance
                            label = i + 1
            out[row, column] = label


def paint(x: np.ndarray, y: np.ndarray, size: int, reach: float) -> np.ndarray:
    """Label image of the Voronoi cells of (x, y), cut at a distance `reach` from each centre."""
    n_bins = max(1, int(size / reach))
    column = np.clip((x * n_bins / size).astype(int), 0, n_bins - 1)
    row = np.clip((y * n_bins / size).astype(int), 0, n_bins - 1)
    index = row * n_bins + column
    order = np.argsort(index, kind="stable")
    starts = np.searchsorted(index[order], np.arange(n_bins * n_bins + 1))
    out = np.zeros((size, size), np.int32)
    _paint(x, y, order, starts, n_bins, float(size), reach, out)
    return out


def make_movie(
    path: Path, *, n_frames: int, n_cells: int, size: int, seed: int, step: float = 0.08
) -> None:
    """Write a movie of a dense layer whose cells move `step` diameters per frame.

    Labels are shuffled in every frame. Cells leave at one edge and enter at the other as new ones
    would: the field is open.
    """
    rng = np.random.default_rng(seed)
    spacing = size / np.sqrt(n_cells)
    side = int(np.ceil(np.sqrt(n_cells)))
    grid = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2) + 0.5)[
        :n_cells
    ]
    position = grid * spacing + rng.normal(0, 0.2 * spacing, (n_cells, 2))
    angle = rng.uniform(0, 2 * np.pi, n_cells)
    with tifffile.TiffWriter(path, bigtiff=True) as writer:
        for _ in range(n_frames):
            position += step * spacing * np.stack([np.cos(angle), np.sin(angle)], -1)
            position %= size
            angle += rng.normal(0, 0.3, n_cells)
            # Push apart cells that have come closer than 0.7 of the spacing.
            delta = position[:, None] - position[None]
            distance = np.hypot(*np.moveaxis(delta, -1, 0)) + 1e-9
            push = np.clip(0.7 * spacing - distance, 0, None) / distance
            np.fill_diagonal(push, 0)
            position += 0.3 * (push[..., None] * delta).sum(1)
            labels = paint(position[:, 0], position[:, 1], size, 0.75 * spacing)
            names = np.concatenate([[0], rng.permutation(n_cells) + 1]).astype(np.uint16)
            writer.write(names[labels], compression="zlib", metadata=None)
