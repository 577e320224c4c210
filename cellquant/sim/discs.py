"""Rigid discs: scenes without shape modes."""

import math
from typing import Any

from cellquant.sim.parts import shared, taken

FLAGS = {"contract", "nsz", "arcp", "reassoc"}


@shared(FLAGS)
def rigid_velocity(part: int, n_parts: int, kept: Any, state: Any, velocity: Any) -> None:
    """Velocity of rigid discs: the chord of two circles is known in closed form."""
    radius, first, other, shift, back_first, back_pair, back_cell, numbers = taken(kept)
    n_cells = state.shape[0]
    v0, k, mu_r = numbers[0], numbers[1], numbers[3]
    for i in range(part * n_cells // n_parts, (part + 1) * n_cells // n_parts):
        fx = 0.0
        fy = 0.0
        n_own = first[i + 1] - first[i]
        n_all = n_own + back_first[i + 1] - back_first[i]
        for entry in range(n_all):
            if entry < n_own:
                p = first[i] + entry
                j = other[p]
                side = 1.0
            else:
                p = back_pair[back_first[i] + entry - n_own]
                j = back_cell[back_first[i] + entry - n_own]
                side = -1.0
            dx = state[j, 0] + side * shift[p, 0] - state[i, 0]
            dy = state[j, 1] + side * shift[p, 1] - state[i, 1]
            square = dx * dx + dy * dy
            ri = radius[i]
            rj = radius[j]
            if square >= (ri + rj) * (ri + rj) or square <= (ri - rj) * (ri - rj):
                continue
            distance = math.sqrt(square)
            along = 0.5 * (square + ri * ri - rj * rj) / distance
            chord = 2.0 * math.sqrt(max(0.0, ri * ri - along * along))
            fx += chord * dx / distance
            fy += chord * dy / distance
        velocity[i, 0] = v0 * math.cos(state[i, 2]) - mu_r * k * fx
        velocity[i, 1] = v0 * math.sin(state[i, 2]) - mu_r * k * fy
        velocity[i, 2] = 0.0
