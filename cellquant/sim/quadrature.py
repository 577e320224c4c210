"""The published contact rule: sums over the contour points that lie inside a neighbour."""

import math
from typing import Any

import numpy as np
from numba import njit

from cellquant.sim.lanes import LANES
from cellquant.sim.outlines import BLOCK
from cellquant.sim.parts import features_of, shared, taken
from cellquant.sim.records import HEAD

FLAGS = {"contract", "nsz", "arcp", "reassoc"}


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def acos_bound(x: float) -> float:
    """Arc cosine to 7e-5 (Abramowitz & Stegun 4.4.45); pi below -1, 0 above 1."""
    if x >= 1.0:
        return 0.0
    if x <= -1.0:
        return math.pi
    y = abs(x)
    root = math.sqrt(1.0 - y) * (1.5707288 + y * (-0.2121144 + y * (0.0742610 - 0.0187293 * y)))
    return root if x >= 0.0 else math.pi - root


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def facing(
    dx: float, dy: float, distance: float, low_i: float, high_i: float, high_j: float,
    spacing: float,
) -> tuple[float, float]:  # fmt: skip
    """Samples of i's contour that can lie within the reach of j: their middle and their number.

    Both are real numbers, exact to 1e-3 of a sample.
    """
    away = distance * distance - high_j * high_j
    nearest = min(high_i, max(low_i, math.sqrt(max(away, 0.0))))
    if distance <= 1e-9 * nearest:
        return 0.0, 2.0 * math.pi / spacing
    inverse = 1.0 / distance
    nearest = max(nearest, 1e-6 * high_i)  # a pinched contour comes as near as its centre
    angle = acos_bound(0.5 * (away + nearest * nearest) * inverse / nearest)
    middle = acos_bound(dx * inverse)
    return (middle if dy >= 0.0 else -middle) / spacing, 2.0 * angle / spacing


@shared(FLAGS)
def sample_contours(part: int, n_parts: int, kept: Any, state: Any, velocity: Any) -> None:
    """Record every contour and its samples.

    `table` holds cos(n phi_s) in row 2(n - 1) and sin(n phi_s) in row 2(n - 1) + 1, n = 1 .. M.
    Writes `record` (see `outlines`), the samples `rho` and `slope` = d rho / d phi.
    """
    radius, table, record, rho, slope = taken(kept)
    modes, _, _ = features_of(kept)
    n_cells = state.shape[0]
    size = table.shape[1]
    half = size // 2
    spacing = 2.0 * math.pi / size
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    even = np.zeros(half)
    odd = np.zeros(half)
    even_slope = np.zeros(half)
    odd_slope = np.zeros(half)
    for block in range(n_blocks):
        if not part * n_blocks <= block * n_parts < (part + 1) * n_blocks:
            continue
        for i in range(block * BLOCK, min(n_cells, (block + 1) * BLOCK)):
            r0 = radius[i]
            power = 0.0
            bend = 0.0
            cos_1 = math.cos(state[i, 2])
            sin_1 = math.sin(state[i, 2])
            cos_n = cos_1
            sin_n = sin_1
            for s in range(half):
                even[s] = 0.0
                odd[s] = 0.0
                even_slope[s] = 0.0
                odd_slope[s] = 0.0
            for m in range(len(modes)):
                n = m + 2
                cos_n, sin_n = cos_n * cos_1 - sin_n * sin_1, sin_n * cos_1 + cos_n * sin_1
                a = state[i, 3 + m]
                b = state[i, 3 + len(modes) + m]
                power += a * a + b * b
                re = r0 * (a * cos_n - b * sin_n)
                im = -r0 * (b * cos_n + a * sin_n)
                record[i, HEAD + m] = re
                record[i, HEAD + len(modes) + m] = im
                bend += n * n * math.sqrt(re * re + im * im)
                if n % 2 == 0:
                    for s in range(half):
                        even[s] += re * table[2 * m + 2, s] - im * table[2 * m + 3, s]
                        even_slope[s] -= n * (re * table[2 * m + 3, s] + im * table[2 * m + 2, s])
                else:
                    for s in range(half):
                        odd[s] += re * table[2 * m + 2, s] - im * table[2 * m + 3, s]
                        odd_slope[s] -= n * (re * table[2 * m + 3, s] + im * table[2 * m + 2, s])
            mean = r0 * math.sqrt(1.0 - 0.5 * power) if power < 2.0 else math.nan
            record[i, 0] = state[i, 0]
            record[i, 1] = state[i, 1]
            record[i, 2] = mean
            record[i, 5] = cos_1
            record[i, 6] = sin_1
            for s in range(half):
                rho[i, s] = mean + even[s] + odd[s]
                rho[i, s + half] = mean + even[s] - odd[s]
                slope[i, s] = even_slope[s] + odd_slope[s]
                slope[i, s + half] = even_slope[s] - odd_slope[s]
            high = rho[i, 0]
            low = rho[i, 0]
            for s in range(size):
                high = max(high, rho[i, s])
                low = min(low, rho[i, s])
            # Between two samples the radius exceeds them by at most spacing^2/8 |rho''|.
            record[i, 3] = high + 0.125 * spacing * spacing * bend
            record[i, 4] = low if power < 2.0 else math.nan


@shared(FLAGS)
def quadrature_velocity(part: int, n_parts: int, kept: Any, state: Any, velocity: Any) -> None:
    """Generalised velocity by the published rule: sums over the contour points inside a neighbour.

    The points stand at fixed directions phi_s = 2 pi s / K. Only how many neighbours hold a point
    matters, so the neighbours are counted first and every sum is taken once.
    """
    (
        radius, record, rho, slope, table, first, other, shift, back_first, back_pair, back_cell,
        numbers, growth,
    ) = taken(kept)  # fmt: skip
    modes, tension, torque = features_of(kept)
    v0, k, eta = numbers[0], numbers[1], numbers[2]
    mu_r, mu_theta, mu_ab = numbers[3], numbers[4], numbers[5]
    n_cells = state.shape[0]
    size = table.shape[1]
    spacing = 2.0 * math.pi / size
    half = size // 2
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    held = np.empty(2 * size)
    grid_x = np.empty(2 * size)
    grid_y = np.empty(2 * size)
    u = np.empty(size)
    v = np.empty(size)
    even = np.empty(half)
    odd = np.empty(half)
    even_slope = np.empty(half)
    odd_slope = np.empty(half)
    for block in range(n_blocks):
        if not part * n_blocks <= block * n_parts < (part + 1) * n_blocks:
            continue
        for i in range(block * BLOCK, min(n_cells, (block + 1) * BLOCK)):
            for s in range(size):
                held[s] = 0.0
                held[size + s] = 0.0
                grid_x[s] = rho[i, s] * table[0, s]
                grid_y[s] = rho[i, s] * table[1, s]
            for s in range(size):
                grid_x[size + s] = grid_x[s]
                grid_y[size + s] = grid_y[s]
            high_i = record[i, 3]
            n_own = first[i + 1] - first[i]
            n_all = n_own + back_first[i + 1] - back_first[i]
            for entry in range(n_all):
                if entry < n_own:
                    p = first[i] + entry
                    j = other[p]
                    dx = record[j, 0] + shift[p, 0] - record[i, 0]
                    dy = record[j, 1] + shift[p, 1] - record[i, 1]
                else:
                    p = back_pair[back_first[i] + entry - n_own]
                    j = back_cell[back_first[i] + entry - n_own]
                    dx = record[j, 0] - shift[p, 0] - record[i, 0]
                    dy = record[j, 1] - shift[p, 1] - record[i, 1]
                square = dx * dx + dy * dy
                high_j = record[j, 3]
                if square >= (high_i + high_j) * (high_i + high_j):
                    continue
                distance = math.sqrt(square)
                centre, width = facing(dx, dy, distance, record[i, 4], high_i, high_j, spacing)
                n_samples = int((width + 2.5 + LANES) / LANES) * LANES
                start = 0
                if n_samples >= size:
                    n_samples = size
                else:
                    start = math.floor(centre - 0.5 * (n_samples - 1) + 0.5)
                    start = (start + 2 * size) % size
                mean_j = record[j, 2]
                top = len(modes) - 1
                offset = np.uint64(start)
                for s in range(np.uint64(n_samples)):
                    x = grid_x[offset + s] - dx
                    y = grid_y[offset + s] - dy
                    q = x * x + y * y
                    q = q if q > 1e-300 else 1e-300
                    inverse = 1.0 / math.sqrt(q)
                    ux = x * inverse
                    uy = y * inverse
                    pr = record[j, HEAD + top]
                    pi = record[j, HEAD + len(modes) + top]
                    for lower in range(len(modes) - 1):
                        cr = record[j, HEAD + top - 1 - lower]
                        ci = record[j, HEAD + len(modes) + top - 1 - lower]
                        pr, pi = pr * ux - pi * uy + cr, pr * uy + pi * ux + ci
                    depth = mean_j + pr * (ux * ux - uy * uy) - pi * (2.0 * ux * uy)
                    held[offset + s] += 1.0 if depth > q * inverse else 0.0
            for s in range(size):
                # Directions in which the cell has no extent hold nothing: see `pinches`.
                held[s] = held[s] + held[size + s] if rho[i, s] > 0.0 else 0.0
            fx = 0.0
            fy = 0.0
            spin = 0.0
            constant = 0.0
            for s in range(size):
                r = rho[i, s]
                dr = slope[i, s]
                fx += held[s] * (dr * table[1, s] + r * table[0, s])
                fy += held[s] * (r * table[1, s] - dr * table[0, s])
                spin += held[s] * r * dr
                u[s] = k * held[s] * r
                if len(tension) > 0:
                    inverse = 1.0 / math.sqrt(r * r + dr * dr)
                    u[s] += eta * r * inverse
                    v[s] = eta * dr * inverse
                constant += u[s]
            for s in range(half):
                even[s] = u[s] + u[s + half]
                odd[s] = u[s] - u[s + half]
                if len(tension) > 0:
                    even_slope[s] = v[s] + v[s + half]
                    odd_slope[s] = v[s] - v[s + half]
            cos_1 = record[i, 5]
            sin_1 = record[i, 6]
            growth[i] = spacing * constant
            pull = 0.5 * constant * radius[i] / record[i, 2]
            scale = spacing * mu_ab * radius[i]
            cos_n = cos_1
            sin_n = sin_1
            for m in range(len(modes)):
                n = m + 2
                cos_n, sin_n = cos_n * cos_1 - sin_n * sin_1, sin_n * cos_1 + cos_n * sin_1
                re = 0.0
                im = 0.0
                if n % 2 == 0:
                    for s in range(half):
                        re += even[s] * table[2 * m + 2, s]
                        im += even[s] * table[2 * m + 3, s]
                    if len(tension) > 0:
                        for s in range(half):
                            re -= n * even_slope[s] * table[2 * m + 3, s]
                            im += n * even_slope[s] * table[2 * m + 2, s]
                else:
                    for s in range(half):
                        re += odd[s] * table[2 * m + 2, s]
                        im += odd[s] * table[2 * m + 3, s]
                    if len(tension) > 0:
                        for s in range(half):
                            re -= n * odd_slope[s] * table[2 * m + 3, s]
                            im += n * odd_slope[s] * table[2 * m + 2, s]
                a = state[i, 3 + m]
                b = state[i, 3 + len(modes) + m]
                velocity[i, 3 + m] = -scale * (re * cos_n + im * sin_n - a * pull)
                velocity[i, 3 + len(modes) + m] = -scale * (im * cos_n - re * sin_n - b * pull)
            velocity[i, 0] = v0 * cos_1 - mu_r * k * spacing * fx
            velocity[i, 1] = v0 * sin_1 - mu_r * k * spacing * fy
            if len(torque) > 0:
                velocity[i, 2] = mu_theta * k * spacing * spin
            else:
                velocity[i, 2] = 0.0
