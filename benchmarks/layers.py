"""Crowded layers that move, made for the tracking benchmarks: cells as a Voronoi tessellation."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class Layer:
    """A movie of label masks with one label per cell through time, and its true positions.

    ``masks`` (T, H, W); ``position`` (T, n, 2) x, y of the cells' generating points in px.
    """

    masks: np.ndarray
    position: np.ndarray
    diameter: float


def moving_points(
    n_cells: int,
    n_frames: int,
    *,
    step: float,
    diameter: float = 20.0,
    memory: float = 0.7,
    collective: float = 0.7,
    seed: int = 0,
) -> tuple[np.ndarray, float]:
    """Points of a repelling, partly collective, persistent random walk in a periodic box.

    Parameters
    ----------
    step
        Root mean square displacement per frame in units of the diameter.
    memory
        Correlation of a cell's velocity between frames.
    collective
        Share of the velocity variance that is a smooth flow field.

    Returns
    -------
    position : numpy.ndarray
        (T, n, 2) wrapped into the box.
    box : float
    """
    rng = np.random.default_rng(seed)
    box = diameter * float(np.sqrt(n_cells * np.pi / 4))
    points = rng.random((n_cells, 2)) * box
    for _ in range(60):
        points = _relax(points, box, diameter, 0.5)
    waves = 2 * np.pi / box * rng.integers(-3, 4, size=(12, 2))
    phase, strength = rng.random(12) * 2 * np.pi, rng.normal(size=(12, 2)) / np.sqrt(6)
    own = rng.normal(size=(n_cells, 2)) / np.sqrt(2)
    frames = [points]
    for _ in range(n_frames - 1):
        own = memory * own + np.sqrt(1 - memory**2) * rng.normal(size=own.shape) / np.sqrt(2)
        phase = phase + 0.15 * rng.normal(size=12)
        field = np.cos(points @ waves.T + phase) @ strength
        field /= max(float(np.sqrt(np.mean(np.sum(field**2, axis=1)))), 1e-9)
        push = np.sqrt(collective) * field + np.sqrt(1 - collective) * own
        before = points
        points = (points + step * diameter * push) % box
        for _ in range(3):
            points = _relax(points, box, diameter, 0.3)
        moved = (points - before + box / 2) % box - box / 2
        size = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
        points = (before + moved * (step * diameter / max(size, 1e-9))) % box
        frames.append(points)
    return np.array(frames), box


def _relax(points: np.ndarray, box: float, diameter: float, rate: float) -> np.ndarray:
    tree = cKDTree(points, boxsize=box)
    pairs = tree.query_pairs(diameter, output_type="ndarray")
    apart = (points[pairs[:, 0]] - points[pairs[:, 1]] + box / 2) % box - box / 2
    distance = np.maximum(np.hypot(*apart.T), 1e-9)
    push = rate * 0.5 * (diameter - distance)[:, None] * apart / distance[:, None]
    moved = points.copy()
    np.add.at(moved, pairs[:, 0], push)
    np.add.at(moved, pairs[:, 1], -push)
    return moved % box


def voronoi_layer(
    n_cells: int, n_frames: int, *, step: float, diameter: float = 20.0, seed: int = 0
) -> Layer:
    """Label masks of a confluent layer; cells leave and enter through the edge of the view."""
    position, box = moving_points(n_cells, n_frames, step=step, diameter=diameter, seed=seed)
    view = int(box * 0.85)
    grid = np.stack(np.meshgrid(np.arange(view), np.arange(view)), axis=-1).reshape(-1, 2)
    masks = np.empty((n_frames, view, view), dtype=np.int32)
    for frame, points in enumerate(position):
        distance, nearest = cKDTree(points, boxsize=box).query(grid % box)
        labels = np.where(distance < 0.75 * diameter, nearest + 1, 0)
        masks[frame] = labels.reshape(view, view)
    return Layer(masks, position, diameter)


def shuffled(masks: np.ndarray, seed: int = 0) -> tuple[np.ndarray, list[np.ndarray]]:
    """Masks with the labels of every frame permuted, and the true label of each new one."""
    rng = np.random.default_rng(seed)
    new, truth = np.zeros_like(masks), []
    for frame, image in enumerate(masks):
        labels = np.unique(image)
        labels = labels[labels > 0]
        names = rng.permutation(len(labels)) + 1
        table = np.zeros(int(image.max()) + 1, dtype=masks.dtype)
        table[labels] = names
        new[frame] = table[image]
        back = np.zeros(len(labels) + 1, dtype=np.int64)
        back[names] = labels
        truth.append(back)
    return new, truth


def data_folder() -> Path:
    """Real recordings: CELLQUANT_DATA, or shared/data beside the project."""
    import os

    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(os.environ.get("CELLQUANT_DATA", beside))
