"""Energies of cells: what no step needs, so it is not among what the kernels add up."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def lens_areas(roots: Any, root_first: Any, root_last: Any, first: Any) -> Floats:
    """Area between chords and centres of the lenses of every cell's listed pairs, L0^2.

    With the radii rho_i, rho_j to a crossing and the angle from one to the other, half the sum of
    sign rho_i rho_j sin(angle): what the area of a lens is beside both cells' sectors.
    """
    counts = root_last - root_first
    row = np.arange(counts.sum()) + np.repeat(root_first - (np.cumsum(counts) - counts), counts)
    cell = np.repeat(np.repeat(np.arange(len(first) - 1), np.diff(first)), counts)
    c, s, sign, rho_i, ux, uy, _, rho_j = roots[row].T
    area = -0.5 * sign * rho_i * rho_j * (c * uy - s * ux)
    total: Floats = np.bincount(cell, area, len(first) - 1).astype(np.float64, copy=False)
    return total


def disc_overlaps(state: Any, radius: Any, first: Any, other: Any, shift: Any) -> Floats:
    """Half the area that every rigid disc shares with its neighbours, L0^2."""
    n_cells = len(radius)
    cell = np.repeat(np.arange(n_cells), np.diff(first))
    distance = np.hypot(*(state[other, :2] + shift - state[cell, :2]).T)
    ri, rj = radius[cell], radius[other]
    within = distance <= np.abs(ri - rj)
    apart = np.where(within, ri + rj, np.minimum(distance, ri + rj))
    along = 0.5 * (apart**2 + ri**2 - rj**2) / apart
    angle_i = np.arccos(np.clip(along / ri, -1.0, 1.0))
    angle_j = np.arccos(np.clip((apart - along) / rj, -1.0, 1.0))
    chord = 2.0 * np.sqrt(np.maximum(ri**2 - along**2, 0.0))
    area = ri**2 * angle_i + rj**2 * angle_j - 0.5 * apart * chord
    area = np.where(distance < ri + rj, area, 0.0)
    area = np.where(within, np.pi * np.minimum(ri, rj) ** 2, area)
    both = np.bincount(cell, area, n_cells) + np.bincount(other, area, n_cells)
    return 0.5 * both.astype(np.float64, copy=False)
