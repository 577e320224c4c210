"""What the overlap of two cells gives to both, from the crossings of their contours.

A row of `roots` belongs to a crossing: cosine and sine of its direction, its sign (+1 where the
contour leaves the other cell) and its distance to the centre, as seen from i and then from j. A row
of `lenses` belongs to a listed pair, with the sums over its crossings that are not about shapes:

    fx, fy          force on i per k: the chord, turned; that on j is its opposite
    ti, tj          torques on i and on j per k: half of sign rho^2
    pi, qi, pj, qj  product of exp(i sign phi): cosine and sine of the length of the arcs in angle
"""

from typing import Any

from numba import njit

from cellquant.sim.gathers import gather_pair, scatter_rows
from cellquant.sim.lanes import (
    LANES,
)

ROOT = 8  # columns of a root
LENS = 8  # columns of a lens
FLAGS = {"contract", "nsz", "arcp"}


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def sum_lens(roots: Any, begin: int, end: int, lenses: Any, p: int) -> None:
    """Sum up pair p, whose crossings are the rows from begin to end."""
    fx = 0.0
    fy = 0.0
    ti = 0.0
    tj = 0.0
    pi = 1.0
    qi = 0.0
    pj = 1.0
    qj = 0.0
    for r in range(begin, end):
        sign = roots[r, 2]
        push = sign * roots[r, 3]
        fx += push * roots[r, 1]
        fy -= push * roots[r, 0]
        ti += 0.5 * push * roots[r, 3]
        tj -= 0.5 * sign * roots[r, 7] * roots[r, 7]
        c = roots[r, 0]
        s = sign * roots[r, 1]
        pi, qi = pi * c - qi * s, pi * s + qi * c
        c = roots[r, 4]
        s = -sign * roots[r, 5]
        pj, qj = pj * c - qj * s, pj * s + qj * c
    lenses[p, 0] = fx
    lenses[p, 1] = fy
    lenses[p, 2] = ti
    lenses[p, 3] = tj
    lenses[p, 4] = pi
    lenses[p, 5] = qi
    lenses[p, 6] = pj
    lenses[p, 7] = qj


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def sum_lenses(roots: Any, rows: Any, count: int, seconds: int, lenses: Any, targets: int) -> None:
    """Sum up `count` pairs of two crossings each, of opposite signs.

    `rows` says where the first crossing of each begins, `seconds` further on where the second does,
    and `targets` further on where its lens does; filled up to whole vectors.
    """
    for k in range(0, count, LANES):
        c_a, s_a, sign, rho_a = gather_pair(roots, rows, k, 0)
        c_b, s_b, _, rho_b = gather_pair(roots, rows, seconds + k, 0)
        fx = sign * (rho_a * s_a - rho_b * s_b)
        fy = sign * (rho_b * c_b - rho_a * c_a)
        ti = (0.5 * sign) * (rho_a * rho_a - rho_b * rho_b)
        pi = c_a * c_b + s_a * s_b
        qi = sign * (s_a * c_b - c_a * s_b)
        c_a, s_a, sign, rho_a = gather_pair(roots, rows, k, 4)
        c_b, s_b, _, rho_b = gather_pair(roots, rows, seconds + k, 4)
        tj = (0.5 * sign) * (rho_a * rho_a - rho_b * rho_b)
        scatter_rows(lenses, rows, targets + k, 0, fx, fy, ti, tj)
        pj = c_a * c_b + s_a * s_b
        qj = sign * (s_a * c_b - c_a * s_b)
        scatter_rows(lenses, rows, targets + k, 4, pi, qi, pj, qj)
