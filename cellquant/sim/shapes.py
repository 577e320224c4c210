"""Contours of simulated cells, measured without error: area, perimeter, axes, orientation."""

import math

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cellquant.sim import areas
from cellquant.sim.records import HEAD, record_length

Floats = NDArray[np.float64]
_BATCH = 256  # contours at a time: their points stay in the cache


def contour_radii(
    modes: Floats, polarity: Floats, radius: Floats, points: int
) -> tuple[Floats, Floats]:
    """Radius and its derivative at directions 2 pi s / points, each (N, points).

    Parameters
    ----------
    modes
        (N, 2, M - 1) coefficients a_n and b_n, n = 2 .. M.
    polarity, radius
        (N,) theta_i and R0_i.
    """
    n = np.arange(2, modes.shape[2] + 2)
    turned = (modes[:, 0] - 1j * modes[:, 1]) * np.exp(-1j * np.outer(polarity, n))
    phase = np.exp(2j * math.pi * np.outer(n, np.arange(points)) / points)
    rho = mean_radii(modes)[:, None] + (turned @ phase).real
    slope = ((turned * (1j * n)) @ phase).real
    return rho * radius[:, None], slope * radius[:, None]


def mean_radii(modes: Floats) -> Floats:
    """(N,) mean radius a0 over R0 that keeps the area of the set r < R: see `areas`."""
    mean, cells, record = _keep_areas(modes)
    mean[cells] = record[:, 2]
    return mean


def pinched(modes: Floats) -> NDArray[np.bool_]:
    """(N,) whether R(phi) < 0 somewhere: the cell has parted into lobes."""
    found = np.zeros(len(modes), bool)
    found[_keep_areas(modes)[1]] = True
    return found


def _keep_areas(modes: Floats) -> tuple[Floats, NDArray[np.int64], Floats]:
    """(N,) a0 of the closed form; pinched cells, and their records with R0 = 1 and theta = 0."""
    mean: Floats = np.sqrt(np.maximum(1.0 - 0.5 * np.sum(modes**2, axis=(1, 2)), 0.0))
    near = np.flatnonzero(np.sqrt(np.sum(modes**2, axis=1)).sum(axis=1) >= mean)
    n_modes = modes.shape[2]
    record = np.zeros((len(near), record_length(n_modes)))
    if len(near) == 0:  # as nearly always: then nothing need be compiled
        return mean, near, record
    record[:, HEAD : HEAD + n_modes] = modes[near, 0]
    record[:, HEAD + n_modes : HEAD + 2 * n_modes] = -modes[near, 1]
    weights = np.empty((len(near), 2 * n_modes))
    one, all_of_them = np.ones(len(near)), np.arange(len(near))
    parted = areas.keep_areas(record, one, n_modes, all_of_them, weights)
    return mean, near[parted], record[parted]


def contours(
    position: Floats, modes: Floats, polarity: Floats, radius: Floats, points: int = 128
) -> Floats:
    """Contour points of every cell, (N, points, 2), counter-clockwise.

    A pinched cell has no extent where R <= 0: its points stand at the centre there.
    """
    rho, _ = contour_radii(modes, polarity, radius, points)
    rho = np.maximum(rho, 0.0)
    angle = 2.0 * math.pi * np.arange(points) / points
    around = np.stack([rho * np.cos(angle), rho * np.sin(angle)], axis=2)
    return around + position[:, None, :]


def shape_indices(modes: Floats) -> Floats:
    """(N,) shape index P / sqrt(A) of contours with modes (N, 2, M - 1), as `measure_shapes`."""
    n, waves = _directions(modes.shape[2])
    found = []
    for start in range(0, len(modes), _BATCH):
        rho, slope = _terms(modes[start : start + _BATCH], n, waves)
        length = np.sqrt(rho * rho + slope * slope).sum(axis=1)
        found.append(length * (2.0 * math.pi / rho.shape[1] / math.sqrt(math.pi)))
    index = np.concatenate(found or [np.empty(0)])
    cells, lobes = _lobes(modes)
    index[cells] = lobes[:, 0] / np.sqrt(lobes[:, 1])
    return index


def measure_shapes(modes: Floats, polarity: Floats, radius: Floats) -> pd.DataFrame:
    r"""Area, perimeter and axes of every contour by the trapezoid rule, which is spectral here.

    A pinched cell (R < 0 somewhere, see `pinches`) is the set r < R: its lobes are measured.

    .. math:: P = \int \sqrt{\rho^2 + \rho'^2}\, d\phi, \qquad p = P / \sqrt{A}

    Parameters
    ----------
    modes, polarity, radius
        See `contour_radii`.

    Returns
    -------
    DataFrame
        area, perimeter, shape_index, aspect_ratio (square root of the ratio of the second
        moments), orientation (of the long axis, radians in (-pi/2, pi/2]), offset_x and offset_y
        of the centre of mass from the centre of the contour.
    """
    n, waves = _directions(modes.shape[2])
    parts = [
        _moments(modes[start : start + _BATCH], n, waves) for start in range(0, len(radius), _BATCH)
    ]
    moments = np.concatenate(parts or [np.empty((0, 7))])
    cells, lobes = _lobes(modes)
    moments[cells] = _central(*lobes.T)
    length, square, x, y, xx, yy, xy = moments.T
    # In the frame of the polarity and in units of R0 so far.
    area, perimeter = square * radius**2, length * radius
    c, s = np.cos(polarity), np.sin(polarity)
    spread = np.hypot(0.5 * (xx - yy), xy)
    orientation = polarity + 0.5 * np.arctan2(2.0 * xy, xx - yy)
    orientation -= math.pi * np.ceil(orientation / math.pi - 0.5)
    half = 0.5 * (xx + yy)
    return pd.DataFrame(
        {
            "area": area,
            "perimeter": perimeter,
            "shape_index": perimeter / np.sqrt(area),
            "aspect_ratio": np.sqrt((half + spread) / (half - spread)),
            "orientation": orientation,
            "offset_x": radius * (c * x - s * y),
            "offset_y": radius * (s * x + c * y),
        }
    )


def _directions(n_modes: int) -> tuple[Floats, tuple[Floats, Floats]]:
    """Orders of the modes, and their cosines and sines in every direction."""
    n, points = np.arange(2.0, n_modes + 2), 32 * max(6, n_modes + 1)
    angle = 2.0 * math.pi * np.outer(n, np.arange(points)) / points
    return n, (np.cos(angle), np.sin(angle))


def _terms(modes: Floats, n: Floats, waves: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """(N, points) radius and slope of contours with R0 = 1 in the frame of the polarity.

    Term by term: the last digits of a matrix product depend on threads and on the cells beside.
    """
    even, odd = waves
    a, b = modes[:, 0, :, None], modes[:, 1, :, None]
    rho = np.repeat(mean_radii(modes)[:, None], even.shape[1], 1)
    slope = np.zeros_like(rho)
    for k, order in enumerate(n):
        rho += a[:, k] * even[k] + b[:, k] * odd[k]
        slope += (order * b[:, k]) * even[k] - (order * a[:, k]) * odd[k]
    return rho, slope


def _moments(modes: Floats, n: Floats, waves: tuple[Floats, Floats]) -> Floats:
    """(N, 7) perimeter, area, centre of mass and second moments of contours with R0 = 1."""
    rho, slope = _terms(modes, n, waves)
    angle = 2.0 * math.pi * np.arange(rho.shape[1]) / rho.shape[1]
    c, s = np.cos(angle), np.sin(angle)
    d = angle[1]
    square = rho * rho
    area = 0.5 * d * square.sum(axis=1)
    length = d * np.sqrt(square + slope * slope).sum(axis=1)
    cube, fourth = rho * square, square * square
    x, y = (d / 3.0 * (cube * wave).sum(axis=1) for wave in (c, s))
    xx, yy, xy = (0.25 * d * (fourth * w).sum(axis=1) for w in (c * c, s * s, c * s))
    return _central(length, area, x, y, xx, xy, yy)


def _central(
    length: Floats, area: Floats, x: Floats, y: Floats, xx: Floats, xy: Floats, yy: Floats
) -> Floats:  # fmt: skip
    """(N, 7) perimeter, area, centre of mass and central moments from plain integrals."""
    x, y = x / area, y / area
    second = (xx / area - x * x, yy / area - y * y, xy / area - x * y)
    return np.column_stack([length, area, x, y, *second])


def _lobes(modes: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Pinched cells, and what `areas.measure` finds for them, with R0 = 1 and theta = 0."""
    _, cells, record = _keep_areas(modes)
    if len(cells) == 0:
        return cells, np.empty((0, 7))
    return cells, areas.measure(record, np.arange(len(cells)), modes.shape[2])
