r"""The stiff part of the contacts, and linear solves with it.

The Hessian of the overlap energy is dominated by the motion of the crossings. With u the normal
displacement of a contour per unit change of its coordinates, every crossing at which the contours
meet under the angle psi adds

.. math:: k\, w w^T / \sin\psi, \qquad w = (u_i, u_j),

which is positive and of rank one. Scaled by the square roots of the mobilities the operator
1 + h S H S is symmetric and positive, and conjugate gradients need a handful of products that cost
a few per cent of a force evaluation each.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from cellquant.sim.kernels import HEAD

LEAST_SINE = 0.1  # smaller angles, of grazing contacts, would only cost iterations


@njit(cache=True, error_model="numpy")
def normal_displacement(
    state: Any, radius: Any, record: Any, i: int, c: float, s: float, rho: float, scale: Any,
    row: Any,
) -> tuple[float, float, float]:  # fmt: skip
    """Fill `row` with u times `scale`; return the unit tangent and the unscaled turning part."""
    n_modes = (state.shape[1] - 3) // 2
    cos_1 = c * math.cos(state[i, 2]) + s * math.sin(state[i, 2])
    sin_1 = s * math.cos(state[i, 2]) - c * math.sin(state[i, 2])
    slope = 0.0
    zr = c
    zi = s
    for m in range(n_modes):
        zr, zi = zr * c - zi * s, zr * s + zi * c
        slope -= (m + 2) * (record[i, HEAD + m] * zi + record[i, HEAD + n_modes + m] * zr)
    tx = slope * c - rho * s
    ty = slope * s + rho * c
    inverse = 1.0 / math.sqrt(tx * tx + ty * ty)
    tx *= inverse
    ty *= inverse
    turning = -rho * slope * inverse
    row[0] = ty * scale[0]
    row[1] = -tx * scale[1]
    row[2] = turning * scale[2]
    radial = radius[i] * rho * inverse
    a0 = record[i, 2] / radius[i]
    cn = cos_1
    sn = sin_1
    for m in range(n_modes):
        cn, sn = cn * cos_1 - sn * sin_1, sn * cos_1 + cn * sin_1
        row[3 + m] = radial * (cn - 0.5 * state[i, 3 + m] / a0) * scale[3 + m]
        b = state[i, 3 + n_modes + m]
        row[3 + n_modes + m] = radial * (sn - 0.5 * b / a0) * scale[3 + n_modes + m]
    return tx, ty, turning


@njit(cache=True, error_model="numpy")
def gather(
    state: Any, radius: Any, record: Any, first: Any, other: Any, root_first: Any, root_last: Any,
    roots: Any, scale: Any, k: float, weight: Any, factor: Any, turning: Any, cells: Any,
) -> int:  # fmt: skip
    """Collect the vectors w of all crossings; return their number (larger than the room: none)."""
    room = weight.shape[0]
    width = weight.shape[1] // 2
    count = 0
    for i in range(state.shape[0]):
        for p in range(first[i], first[i + 1]):
            for r in range(root_first[p], root_last[p]):
                if roots[r, 4] == 0.0 or roots[r, 5] == 0.0:
                    continue  # an arc that ends at the centre of a pinched cell, no crossing
                if count < room:
                    j = other[p]
                    ax, ay, turn_i = normal_displacement(
                        state, radius, record, i, roots[r, 0], roots[r, 1], roots[r, 4], scale,
                        weight[count, :width],
                    )  # fmt: skip
                    bx, by, turn_j = normal_displacement(
                        state, radius, record, j, roots[r, 2], roots[r, 3], roots[r, 5], scale,
                        weight[count, width:],
                    )  # fmt: skip
                    factor[count] = k / max(abs(ax * by - ay * bx), LEAST_SINE)
                    turning[count, 0] = turn_i
                    turning[count, 1] = turn_j
                    cells[count, 0] = i
                    cells[count, 1] = j
                count += 1
    return count


@njit(cache=True, fastmath={"contract", "reassoc"}, error_model="numpy")
def add_turning(
    count: int, weight: Any, factor: Any, turning: Any, cells: Any, turned: Any, h: float, out: Any
) -> None:
    """Subtract h S H nu from `out`, where nu turns the polarity of cell i by turned[i]."""
    width = out.shape[1]
    for r in range(count):
        i = cells[r, 0]
        j = cells[r, 1]
        push = h * factor[r] * (turning[r, 0] * turned[i] + turning[r, 1] * turned[j])
        for d in range(width):
            out[i, d] -= push * weight[r, d]
            out[j, d] -= push * weight[r, width + d]


@njit(cache=True, fastmath={"contract", "reassoc"}, error_model="numpy")
def multiply(
    count: int, weight: Any, factor: Any, cells: Any, h: float, modes: Any, direction: Any,
    product: Any,
) -> None:  # fmt: skip
    """Add h S H direction to `product`; rows have a padded length known to the compiler."""
    width = 8 * ((10 + 2 * len(modes)) // 8)
    for r in range(count):
        i = cells[r, 0]
        j = cells[r, 1]
        dot = 0.0
        for d in range(width):
            dot += weight[r, d] * direction[i, d]
        for d in range(width):
            dot += weight[r, width + d] * direction[j, d]
        dot *= h * factor[r]
        for d in range(width):
            product[i, d] += dot * weight[r, d]
        for d in range(width):
            product[j, d] += dot * weight[r, width + d]


@njit(cache=True, fastmath={"contract", "reassoc"}, error_model="numpy")
def solve(
    count: int, weight: Any, factor: Any, cells: Any, diagonal: Any, h: float, modes: Any,
    right: Any, tolerance: float, most: int, out: Any, residual: Any, direction: Any, product: Any,
) -> int:  # fmt: skip
    """Solve (1 + h diag + h S H S) out = right by conjugate gradients; return the iterations.

    All arrays have rows padded with zeros to a multiple of 8.
    """
    x = out.reshape(-1)
    b = right.reshape(-1)
    rest = residual.reshape(-1)
    along = direction.reshape(-1)
    image = product.reshape(-1)
    stiff = diagonal.reshape(-1)
    square = 0.0
    for n in range(x.shape[0]):
        x[n] = 0.0
        rest[n] = b[n]
        along[n] = b[n]
        square += b[n] * b[n]
    limit = tolerance * tolerance * square
    for iteration in range(most):
        if not square > limit:
            return iteration
        for n in range(x.shape[0]):
            image[n] = along[n] * (1.0 + h * stiff[n])
        multiply(count, weight, factor, cells, h, modes, direction, product)
        curvature = 0.0
        for n in range(x.shape[0]):
            curvature += along[n] * image[n]
        alpha = square / curvature
        fresh = 0.0
        for n in range(x.shape[0]):
            x[n] += alpha * along[n]
            rest[n] -= alpha * image[n]
            fresh += rest[n] * rest[n]
        beta = fresh / square
        for n in range(x.shape[0]):
            along[n] = rest[n] + beta * along[n]
        square = fresh
    return most


def square_roots_of_mobilities(mu_r: float, mu_theta: float, mu_ab: float, modes: int) -> Any:
    """The scaling S as a row over the coordinates of a cell."""
    row = np.full(3 + 2 * (modes - 1), math.sqrt(mu_ab))
    row[:2] = math.sqrt(mu_r)
    row[2] = math.sqrt(mu_theta)
    return row
