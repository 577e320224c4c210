"""Cells of known perimeter and area, drawn as label masks at any size.

Lengths are in units of the mean cell radius, sqrt(area / pi). A layer is drawn at a radius in
pixels, at a random sub-pixel offset and rotation; a pixel belongs to the cell that holds its
centre.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import Voronoi, cKDTree
from shapely.geometry import Polygon
from skimage.measure import find_contours

SHAPES = ("disc", "ellipse 1.5", "ellipse 2.5", "hexagon", "pentagon", "lobed")
CORNERS = {"hexagon": 6, "pentagon": 5, "square": 4}
# Standard deviations of the modes n = 2..6 of a Fourier contour.
_MODES = 0.05 * np.array([1.2, 1.0, 0.7, 0.5, 0.35])

Radius = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Scene:
    """A label mask with, for the cells that are judged, the true P / sqrt(A)."""

    labels: np.ndarray
    judged: np.ndarray
    shape_index: np.ndarray


def shape(kind: str, rng: np.random.Generator) -> Radius:
    """Contour R(theta) of a shape, of any size."""
    if kind == "disc":
        return np.ones_like
    if kind.startswith("ellipse"):
        ratio = float(kind.split()[1])
        return lambda t: 1 / np.hypot(np.cos(t), ratio * np.sin(t))
    if kind in CORNERS:
        sector = 2 * np.pi / CORNERS[kind]
        return lambda t: 1 / np.cos(t % sector - sector / 2)
    if kind == "lobed":
        return lambda t: 1 + 0.15 * np.cos(3 * t)
    a, b = rng.normal(size=(2, 5)) * _MODES[:, np.newaxis].T
    a0 = np.sqrt(1 - (a @ a + b @ b) / 2)
    n = np.arange(2, 7)
    return lambda t: a0 + np.cos(np.multiply.outer(t, n)) @ a + np.sin(np.multiply.outer(t, n)) @ b


def polygon_measures(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Perimeter and area of a closed polygon."""
    next_x, next_y = np.roll(x, -1), np.roll(y, -1)
    area = 0.5 * abs(np.sum(x * next_y - next_x * y))
    return float(np.hypot(next_x - x, next_y - y).sum()), float(area)


def isolated(kind: str, radius: float, n_cells: int, rng: np.random.Generator) -> Scene:
    """Cells of one kind far apart, each at its own offset and rotation."""
    tile = int(np.ceil(4.4 * radius)) + 4
    columns = int(np.ceil(np.sqrt(n_cells)))
    labels = np.zeros((columns * tile, columns * tile), np.int32)
    y, x = np.mgrid[:tile, :tile]
    angle = np.arange(20000) * 2 * np.pi / 20000
    truth = []
    for k in range(n_cells):
        contour = shape(kind, rng)
        r = contour(angle)
        perimeter, area = polygon_measures(r * np.cos(angle), r * np.sin(angle))
        truth.append(perimeter / np.sqrt(area))
        centre_x, centre_y = tile / 2 + rng.random(2)
        turn = rng.random() * 2 * np.pi
        across, down = x - centre_x, y - centre_y
        edge = contour((np.arctan2(down, across) - turn) % (2 * np.pi))
        inside = np.hypot(across, down) < radius * np.sqrt(np.pi / area) * edge
        row, column = divmod(k, columns)
        labels[row * tile : (row + 1) * tile, column * tile : (column + 1) * tile][inside] = k + 1
    return Scene(labels, np.arange(1, n_cells + 1), np.array(truth))


@dataclass(frozen=True)
class Tissue:
    """A confluent tissue: Voronoi cells of ``seeds``; ``cells`` are those far from its edge."""

    seeds: np.ndarray
    cells: np.ndarray
    polygons: list[np.ndarray]


def tissue(n_cells: int, relaxations: int, rng: np.random.Generator) -> Tissue:
    """Voronoi tissue of random seeds after some steps towards the centroids of their cells."""
    size = np.sqrt(n_cells * np.pi)
    seeds = rng.random((n_cells, 2)) * size
    shifts = np.array([[i, j] for i in (0, -1, 1) for j in (0, -1, 1)]) * size
    for _ in range(relaxations):
        diagram = Voronoi(np.concatenate([seeds + shift for shift in shifts]))
        corners = [diagram.vertices[diagram.regions[r]] for r in diagram.point_region[:n_cells]]
        seeds = np.array([np.array(Polygon(_in_order(c)).centroid.coords[0]) for c in corners])
        seeds %= size
    everywhere = np.concatenate([seeds + shift for shift in shifts])
    diagram = Voronoi(everywhere)
    cells, polygons = [], []
    for index in range(n_cells):
        corners = diagram.vertices[diagram.regions[diagram.point_region[index]]]
        if np.hypot(*(corners - size / 2).T).max() < size / 2:
            cells.append(index)
            polygons.append(_in_order(corners) - size / 2)
    return Tissue(everywhere - size / 2, np.array(cells), polygons)


def _in_order(corners: np.ndarray) -> np.ndarray:
    x, y = (corners - corners.mean(axis=0)).T
    return corners[np.argsort(np.arctan2(y, x))]


def draw_tissue(
    layer: Tissue, radius: float, rng: np.random.Generator, *, line: float = 0.0
) -> Scene:
    """Draw a tissue; ``line`` is the width in px of a background line between all cells."""
    extent = radius * max(np.hypot(*polygon.T).max() for polygon in layer.polygons)
    turn = rng.random() * 2 * np.pi
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    centre = extent + 3 + rng.random(2)
    size = int(2 * extent) + 8
    y, x = np.mgrid[:size, :size]
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    seeds = radius * layer.seeds @ rotation + centre
    distance, nearest = cKDTree(seeds).query(pixels, k=4 if line else 1)
    if line:
        own = seeds[nearest[:, 0]]
        gap = np.full(len(pixels), np.inf)
        for k in (1, 2, 3):  # distances to the edges shared with the next seeds
            other = np.hypot(*(seeds[nearest[:, k]] - own).T)
            gap = np.minimum(gap, (distance[:, k] ** 2 - distance[:, 0] ** 2) / (2 * other))
        labels = np.where(gap < line / 2, 0, nearest[:, 0] + 1)
    else:
        labels = nearest + 1
    truth = []
    for polygon in layer.polygons:
        if line:
            inner = Polygon(polygon * radius).buffer(-line / 2, join_style="mitre", mitre_limit=50)
            truth.append(inner.length / np.sqrt(inner.area))
        else:
            perimeter, area = polygon_measures(*polygon.T)
            truth.append(perimeter / np.sqrt(area))
    return Scene(labels.reshape(size, size).astype(np.int32), layer.cells + 1, np.array(truth))


@dataclass(frozen=True)
class Packing:
    """Overlapping Fourier contours: centres, radii, contours, and true P / sqrt(A) of ``cells``."""

    centres: np.ndarray
    radii: np.ndarray
    contours: list[Radius]
    cells: np.ndarray
    shape_index: np.ndarray


def packing(side: int, phi: float, rng: np.random.Generator) -> Packing:
    """Fourier contours on a disordered hexagonal lattice of area fraction ``phi``.

    Where contours overlap, a point belongs to the cell in which it lies deepest, R(theta) - r.
    """
    spacing = np.sqrt(np.pi / phi * 2 / np.sqrt(3))
    row, column = np.divmod(np.arange(side * side), side)
    centres = np.stack([column + 0.5 * (row % 2), row * np.sqrt(3) / 2], axis=-1) * spacing
    centres += rng.normal(size=centres.shape) * 0.06 * spacing
    centres -= centres.mean(axis=0)
    radii = 1 + 0.1 * rng.normal(size=len(centres))
    contours = [shape("fourier", rng) for _ in radii]
    cells = np.flatnonzero((row > 0) & (row < side - 1) & (column > 0) & (column < side - 1))
    layer = Packing(centres, radii, contours, cells, np.empty(0))
    tree = cKDTree(centres)
    truth = []
    axis = np.linspace(-1.8, 1.8, 400)
    across, down = np.meshgrid(axis, axis)
    for index in cells:
        x, y = centres[index, 0] + across, centres[index, 1] + down
        own = _depth(layer, index, x, y)
        inside = own.copy()
        for other in tree.query_ball_point(centres[index], 3.4):
            if other != index:
                inside = np.minimum(inside, own - _depth(layer, other, x, y))
        contour = max(find_contours(inside, 0.0), key=len)[:-1]
        perimeter, area = polygon_measures(*contour.T)
        truth.append(perimeter / np.sqrt(area))
    return Packing(centres, radii, contours, cells, np.array(truth))


def _depth(layer: Packing, index: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    across, down = x - layer.centres[index, 0], y - layer.centres[index, 1]
    edge = layer.contours[index](np.arctan2(down, across))
    return layer.radii[index] * edge - np.hypot(across, down)


def draw_packing(layer: Packing, radius: float, rng: np.random.Generator) -> Scene:
    """Draw a packing of Fourier contours."""
    turn = rng.random() * 2 * np.pi
    cos, sin = np.cos(turn), np.sin(turn)
    extent = np.hypot(*layer.centres.T).max() + 1.8
    offset = radius * extent + rng.random(2)
    size = int(2 * radius * extent) + 3
    deepest = np.zeros((size, size))
    labels = np.zeros((size, size), np.int32)
    reach = int(1.9 * radius) + 1
    for index, centre in enumerate(layer.centres):
        column = int(offset[0] + radius * (cos * centre[0] - sin * centre[1]))
        row = int(offset[1] + radius * (sin * centre[0] + cos * centre[1]))
        rows = slice(max(row - reach, 0), row + reach + 1)
        columns = slice(max(column - reach, 0), column + reach + 1)
        y, x = np.mgrid[rows, columns].astype(float)
        y, x = (
            y[: size - rows.start, : size - columns.start],
            x[: size - rows.start, : size - columns.start],
        )
        x, y = (x - offset[0]) / radius, (y - offset[1]) / radius
        depth = _depth(layer, index, cos * x + sin * y, cos * y - sin * x)
        deeper = depth > deepest[rows, columns]
        deepest[rows, columns][deeper] = depth[deeper]
        labels[rows, columns][deeper] = index + 1
    return Scene(labels, layer.cells + 1, layer.shape_index)
