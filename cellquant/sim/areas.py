r"""Pinched cells keep their area: their mean radius, and the forces that follow from it.

The model keeps the area by a0 = sqrt(1 - sum(a_n^2 + b_n^2) / 2), for which the integral of
R^2 / 2 is pi R0^2. Where R < 0 somewhere that counts area the cell does not have, and a cell under
pressure hides ever more of it there until a0^2 <= 0. The area of the set r < R(phi) is kept by

.. math:: \frac12 \oint \max(R, 0)^2 d\phi = \pi R_0^2, \qquad
   \frac{\partial A_0}{\partial \mathrm{Re}\, C_n}
   = -\frac{\oint \max(R, 0) \cos n\phi\, d\phi}{\oint \max(R, 0)\, d\phi},

which is the closed form wherever R > 0 and joins it continuously, with its first derivatives. The
left side grows from zero without bound with A0, so that every shape has one mean radius.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from cellquant.sim.pinches import (
    MOST_PANELS,
    MOST_ZEROS,
    NODES,
    WEIGHTS,
    gaps,
    graded_panels,
    radius_towards,
)
from cellquant.sim.records import HEAD

ROUND_OFF = 1e-15  # of A0 over R0
MOST_STEPS = 100  # of Newton's method, whose steps from the second on all go the same way
LEAST_MEAN = 1e-6  # |A0| over R0 below which the closed form of the forces is not evaluated


@njit(cache=True, error_model="numpy")
def moments_of_gaps(record: Any, i: int, n_modes: int, ends: Any, n_ends: int, out: Any) -> float:
    """Integrals over gaps: of R^2 / 2, returned, and in `out` of R, R cos n phi and R sin n phi."""
    out[:] = 0.0
    area = 0.0
    for e in range(0, n_ends, 2):
        n_panels = math.ceil((ends[e + 1] - ends[e]) * (n_modes + 1) / 1.5)
        width = (ends[e + 1] - ends[e]) / n_panels
        for panel in range(n_panels):
            for g in range(NODES.shape[0]):
                angle = ends[e] + width * (panel + 0.5 * (1.0 + NODES[g]))
                rho, _ = radius_towards(record, i, angle, n_modes)
                share = 0.5 * width * WEIGHTS[g] * rho
                area += 0.5 * share * rho
                out[0] += share
                for m in range(n_modes):
                    out[1 + m] += share * math.cos((m + 2) * angle)
                    out[1 + n_modes + m] += share * math.sin((m + 2) * angle)
    return area


@njit(cache=True, error_model="numpy")
def keep_area(record: Any, i: int, radius: float, n_modes: int, weights: Any) -> bool:
    """Write the mean radius of contour i to `record`; whether the contour has gaps.

    Then `weights` (2 n_modes) holds what the derivatives of A0 differ by from those of the closed
    form: the integrals of max(R, 0) cos n phi and max(R, 0) sin n phi over that of max(R, 0), less
    Re C_n / 2 A0 and -Im C_n / 2 A0.
    """
    ends = np.empty(MOST_ZEROS)
    moments = np.empty(1 + 2 * n_modes)
    power = 0.0
    for m in range(2 * n_modes):
        power += record[i, HEAD + m] * record[i, HEAD + m]
    closed = radius * radius - 0.5 * power
    mean = math.sqrt(max(closed, 0.0))
    around = 0.0
    for step in range(MOST_STEPS):
        record[i, 2] = mean
        n_ends = gaps(record, i, n_modes, ends)
        if step == 0 and n_ends == 0 and closed > 0.0:
            return False
        excess = math.pi * (mean * mean - closed)
        excess -= moments_of_gaps(record, i, n_modes, ends, n_ends, moments)
        around = 2.0 * math.pi * mean - moments[0]
        change = excess / around
        mean -= change
        if abs(change) <= ROUND_OFF * radius:
            break
    mean = math.copysign(max(abs(mean), LEAST_MEAN * radius), mean)
    record[i, 2] = mean
    record[i, HEAD + 2 * n_modes] = mean
    for m in range(n_modes):
        re = record[i, HEAD + m]
        im = record[i, HEAD + n_modes + m]
        weights[m] = (math.pi * re - moments[1 + m]) / around - 0.5 * re / mean
        weights[n_modes + m] = 0.5 * im / mean - (math.pi * im + moments[1 + n_modes + m]) / around
    return True


@njit(cache=True, error_model="numpy")
def keep_areas(record: Any, radius: Any, n_modes: int, cells: Any, weights: Any) -> Any:
    """Keep the areas of some cells; which of them have gaps. `weights`: a row for each of them."""
    parted = np.zeros(cells.shape[0], np.bool_)
    for count in range(cells.shape[0]):
        i = cells[count]
        finite = math.isfinite(record[i, 0] + record[i, 1] + record[i, 5])
        for m in range(2 * n_modes):
            finite = finite and math.isfinite(record[i, HEAD + m])
        parted[count] = finite and keep_area(record, i, radius[i], n_modes, weights[count])
    return parted


@njit(cache=True, error_model="numpy")
def resample(
    record: Any, i: int, radius: float, n_modes: int, rho: Any, slope: Any, spacing: float
) -> None:
    """Sample a contour at directions `spacing` apart; renew its largest and least radius."""
    bend = 0.0
    for m in range(n_modes):
        bend += (m + 2.0) ** 2 * math.hypot(record[i, HEAD + m], record[i, HEAD + n_modes + m])
    high = -math.inf
    low = math.inf
    for s in range(rho.shape[0]):
        r, dr = radius_towards(record, i, s * spacing, n_modes)
        rho[s] = r
        slope[s] = dr
        high = max(high, r)
        low = min(low, r)
    record[i, 3] = high + 1e-6 * radius + 0.125 * spacing * spacing * bend
    record[i, 4] = low - 1e-6 * radius


@njit(cache=True, error_model="numpy")
def correct_velocity(
    record: Any, cells: Any, weights: Any, radius: Any, growth: Any, mobility: float,
    n_modes: int, velocity: Any,
) -> None:  # fmt: skip
    """Turn the shape velocities of cells with gaps into those at constant area of the set.

    `growth` holds dH/dA0 of every cell, `mobility` is mu_ab.
    """
    for count in range(cells.shape[0]):
        i = cells[count]
        scale = mobility * radius[i] * growth[i]
        cos_1 = record[i, 5]
        sin_1 = record[i, 6]
        cos_n = cos_1
        sin_n = sin_1
        for m in range(n_modes):
            cos_n, sin_n = cos_n * cos_1 - sin_n * sin_1, sin_n * cos_1 + cos_n * sin_1
            even = weights[count, m]
            odd = weights[count, n_modes + m]
            velocity[i, 3 + m] += scale * (even * cos_n + odd * sin_n)
            velocity[i, 3 + n_modes + m] += scale * (odd * cos_n - even * sin_n)


@njit(cache=True, error_model="numpy")
def measure_lobes(record: Any, i: int, n_modes: int, ends: Any, n_ends: int, out: Any) -> None:
    """Add what `measure` finds, on graded panels between the gaps."""
    panels = np.empty((MOST_PANELS, 2))
    bend = abs(record[i, 2])
    for m in range(n_modes):
        bend += (m + 3.0) ** 2 * math.hypot(record[i, HEAD + m], record[i, HEAD + n_modes + m])
    for e in range(1, n_ends, 2):
        whole = (ends[(e + 1) % n_ends] - ends[e]) % (2.0 * math.pi)
        n_panels = math.ceil(whole * 8.0 / math.pi)
        count = graded_panels(record, i, ends[e], whole, n_panels, bend, n_modes, panels)
        for panel in range(count):
            low = panels[panel, 0]
            width = panels[panel, 1]
            for g in range(NODES.shape[0]):
                angle = low + 0.5 * width * (1.0 + NODES[g])
                share = 0.5 * width * WEIGHTS[g]
                rho, slope = radius_towards(record, i, angle, n_modes)
                x = math.cos(angle)
                y = math.sin(angle)
                out[0] += share * math.hypot(rho, slope)
                second = share * rho * rho
                out[1] += 0.5 * second
                out[2] += second * rho * x / 3.0
                out[3] += second * rho * y / 3.0
                out[4] += 0.25 * second * rho * rho * x * x
                out[5] += 0.25 * second * rho * rho * x * y
                out[6] += 0.25 * second * rho * rho * y * y


@njit(cache=True, error_model="numpy")
def measure(record: Any, cells: Any, n_modes: int) -> Any:
    """Perimeter of the set r < R of some cells, and its moments 1, x, y, xx, xy, yy: (n, 7)."""
    found = np.zeros((cells.shape[0], 7))
    ends = np.empty(MOST_ZEROS)
    for count in range(cells.shape[0]):
        n_ends = gaps(record, cells[count], n_modes, ends)
        measure_lobes(record, cells[count], n_modes, ends, n_ends, found[count])
    return found
