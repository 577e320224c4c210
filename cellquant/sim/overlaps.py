"""Forces of the exact contact rule from the crossings of the contours.

With the end points of an arc: translation needs the chord only, rotation the two radii only, and
shape W_k = integral over the arcs of exp(i k phi), which is known from the end angles. The shape
forces are a convolution of W, summed over all neighbours, with the modes of the cell.
"""

import math
from typing import Any

import numpy as np
from numba import njit, prange
from numba.np.numpy_support import carray

from cellquant.sim.crossings import gap
from cellquant.sim.lanes import LANES, doubles
from cellquant.sim.outlines import BLOCK, HEAD

FLAGS = {"contract", "nsz", "arcp", "reassoc"}
SLOTS = 32  # crossings of a cell whose powers are summed together with those of its tile


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def add_powers(side: Any, used: int, modes: Any, tile: Any) -> None:
    """Add sign exp(i n phi) / i of every crossing to the sums of n = 1 .. 2M; empty the slots.

    Rows of `side`, SLOTS LANES apart: sign, cosine and sine of phi, one lane per cell. Row n of
    `tile`, LANES apart, takes the real parts, row 2M + 1 + n the imaginary ones.
    """
    n_powers = 2 * len(modes) + 3
    sums = carray(doubles(modes, 6, 4), ((4 * len(modes) + 6) * LANES,))
    half = np.uint64((2 * len(modes) + 3) * LANES)
    one = np.uint64(SLOTS * LANES)
    two = np.uint64(2 * SLOTS * LANES)
    for row in range(2 * n_powers * LANES):
        sums[row] = tile[row]
    for begin in range(np.uint64(0), np.uint64(used * LANES), np.uint64(2 * LANES)):
        for r in range(np.uint64(LANES)):
            p = begin + r
            q = p + np.uint64(LANES)
            sign = side[p]
            sign_q = side[q]
            twice = 2.0 * side[one + p]
            twice_q = 2.0 * side[one + q]
            c = sign * side[one + p]
            s = sign * side[two + p]
            c_q = sign_q * side[one + q]
            s_q = sign_q * side[two + q]
            c_before = sign
            s_before = 0.0
            c_before_q = sign_q
            s_before_q = 0.0
            for n in range(1, n_powers):
                sums[np.uint64(n * LANES) + r] += s + s_q
                sums[half + np.uint64(n * LANES) + r] -= c + c_q
                c, c_before = twice * c - c_before, c
                s, s_before = twice * s - s_before, s
                c_q, c_before_q = twice_q * c_q - c_before_q, c_q
                s_q, s_before_q = twice_q * s_q - s_before_q, s_q
    for row in range(2 * n_powers * LANES):
        tile[row] = sums[row]
    for row in range((used + 1) // 2 * 2 * LANES):
        side[row] = 0.0


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def shape_forces(
    tile: Any, lane: Any, k: float, eta: float, modes: Any, tension: Any, out: Any
) -> None:
    """Convolve W with the modes, for a tile of cells.

    Rows of `lane`, LANES apart: A0, R0, cos theta, sin theta, L, L_0, a_n and b_n, Re C, Im C,
    Re L_n, Im L_n. Rows of `out`: the overlap integral, then dH/da_n and dH/db_n over R0.
    """
    n_modes = len(modes)
    forces = carray(doubles(modes, 1, 2), ((2 * len(modes) + 1) * LANES,))
    im_w = np.uint64((2 * len(modes) + 3) * LANES)
    for r in range(np.uint64(LANES)):
        mean = lane[r]
        r0 = lane[np.uint64(LANES) + r]
        cos_1 = lane[np.uint64(2 * LANES) + r]
        sin_1 = lane[np.uint64(3 * LANES) + r]
        j0 = mean * tile[r]
        for m in range(n_modes):
            j0 += lane[np.uint64((6 + 2 * n_modes + m) * LANES) + r] * (
                tile[np.uint64((m + 2) * LANES) + r] / (m + 2)
            )
            j0 -= lane[np.uint64((6 + 3 * n_modes + m) * LANES) + r] * (
                tile[im_w + np.uint64((m + 2) * LANES) + r] / (m + 2)
            )
        area = mean * j0
        constant = k * j0
        if len(tension) > 0:
            constant += eta * lane[np.uint64(5 * LANES) + r]
        pull = 0.5 * constant * r0 / mean
        cos_n = cos_1
        sin_n = sin_1
        for m in range(n_modes):
            n = m + 2
            cos_n, sin_n = cos_n * cos_1 - sin_n * sin_1, sin_n * cos_1 + cos_n * sin_1
            jr = mean * (tile[np.uint64(n * LANES) + r] / n)
            ji = mean * (tile[im_w + np.uint64(n * LANES) + r] / n)
            for q in range(n_modes):
                cr = 0.5 * lane[np.uint64((6 + 2 * n_modes + q) * LANES) + r]
                ci = 0.5 * lane[np.uint64((6 + 3 * n_modes + q) * LANES) + r]
                up = n + q + 2
                ur = tile[np.uint64(up * LANES) + r] / up
                ui = tile[im_w + np.uint64(up * LANES) + r] / up
                jr += cr * ur - ci * ui
                ji += cr * ui + ci * ur
                low = m - q if m > q else q - m
                scale = 1.0 / low if low > 0 else 1.0
                lr = scale * tile[np.uint64(low * LANES) + r]
                li = scale * tile[im_w + np.uint64(low * LANES) + r]
                if q <= m:
                    jr += cr * lr + ci * li
                    ji += cr * li - ci * lr
                else:
                    jr += cr * lr - ci * li
                    ji -= cr * li + ci * lr
            area += lane[np.uint64((6 + 2 * n_modes + m) * LANES) + r] * jr
            area -= lane[np.uint64((6 + 3 * n_modes + m) * LANES) + r] * ji
            jr *= k
            ji *= k
            if len(tension) > 0:
                jr += eta * lane[np.uint64((6 + 4 * n_modes + m) * LANES) + r]
                ji += eta * lane[np.uint64((6 + 5 * n_modes + m) * LANES) + r]
            a = lane[np.uint64((6 + m) * LANES) + r]
            b = lane[np.uint64((6 + n_modes + m) * LANES) + r]
            forces[np.uint64((1 + m) * LANES) + r] = jr * cos_n + ji * sin_n - a * pull
            forces[np.uint64((1 + n_modes + m) * LANES) + r] = ji * cos_n - jr * sin_n - b * pull
        forces[r] = area
    for row in range((1 + 2 * n_modes) * LANES):
        out[row] = forces[row]


@njit(cache=True, parallel=True, fastmath=FLAGS, error_model="numpy")
def exact_velocity(
    state: Any,
    radius: Any,
    record: Any,
    tangent: Any,
    first: Any,
    second: Any,
    back_first: Any,
    back_pair: Any,
    back_cell: Any,
    roots: Any,
    root_first: Any,
    root_last: Any,
    sign: Any,
    inside: Any,
    numbers: Any,
    modes: Any,
    tension: Any,
    torque: Any,
    velocity: Any,
    energy: Any,
) -> None:
    """Generalised velocity and energy of every cell from the crossings of its contour.

    `numbers` holds v0, k, eta, mu_r, mu_theta, mu_ab.
    """
    v0, k, eta = numbers[0], numbers[1], numbers[2]
    mu_r, mu_theta, mu_ab = numbers[3], numbers[4], numbers[5]
    n_cells = state.shape[0]
    n_modes = len(modes)
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    n_powers = 2 * len(modes) + 3
    for block in prange(n_blocks):
        tile = np.empty(2 * n_powers * LANES)
        lane = np.empty((6 + 6 * n_modes) * LANES)
        out = np.empty((1 + 2 * n_modes) * LANES)
        lens = np.empty(LANES)
        side = np.zeros(3 * SLOTS * LANES)
        end = min(n_cells, (block + 1) * BLOCK)
        for begin in range(block * BLOCK, end, LANES):
            tile[:] = 0.0
            used = 0
            for column in range(LANES):
                i = min(begin + column, end - 1)
                lane[column] = record[i, 2]
                lane[LANES + column] = radius[i]
                lane[2 * LANES + column] = record[i, 5]
                lane[3 * LANES + column] = record[i, 6]
                for m in range(2 * n_modes):
                    lane[(6 + m) * LANES + column] = state[i, 3 + m]
                    lane[(6 + 2 * n_modes + m) * LANES + column] = record[i, HEAD + m]
                if len(tension) > 0:
                    for m in range(2):
                        lane[(4 + m) * LANES + column] = tangent[i, m]
                    for m in range(2 * n_modes):
                        lane[(6 + 4 * n_modes + m) * LANES + column] = tangent[i, 2 + m]
            for column in range(min(LANES, end - begin)):
                i = begin + column
                fx = 0.0
                fy = 0.0
                spin = 0.0
                shared = 0.0
                whole = 0.0
                filled = 0
                arcs_r = 1.0
                arcs_i = 0.0
                n_own = first[i + 1] - first[i]
                n_all = n_own + back_first[i + 1] - back_first[i]
                for entry in range(n_all):
                    own = entry < n_own
                    if own:
                        p = first[i] + entry
                    else:
                        p = back_pair[back_first[i] + entry - n_own]
                    if inside[p] == (1 if own else 2):
                        whole += 2.0 * math.pi
                    if root_first[p] == root_last[p]:
                        continue
                    arc_r = 1.0
                    arc_i = 0.0
                    for r in range(root_first[p], root_last[p]):
                        if own:
                            s = sign[r]
                            c1 = roots[r, 0]
                            s1 = roots[r, 1]
                            distance = roots[r, 4]
                            turned = c1 * roots[r, 3] - s1 * roots[r, 2]
                            shared -= 0.5 * s * distance * roots[r, 5] * turned
                        else:
                            s = -sign[r]
                            c1 = roots[r, 2]
                            s1 = roots[r, 3]
                            distance = roots[r, 5]
                        fx += s * distance * s1
                        fy -= s * distance * c1
                        spin += 0.5 * s * distance * distance
                        arc_r, arc_i = arc_r * c1 - s * arc_i * s1, arc_i * c1 + s * arc_r * s1
                        if filled == SLOTS:
                            add_powers(side, SLOTS, modes, tile)
                            filled = 0
                            used = 0
                        side[filled * LANES + column] = s
                        side[(SLOTS + filled) * LANES + column] = c1
                        side[(2 * SLOTS + filled) * LANES + column] = s1
                        filled += 1
                    if arc_r > 0.0 and arc_i >= 0.0:
                        # Short arcs are turned together; their sum is below pi until it is taken.
                        arcs_r, arcs_i = (
                            arcs_r * arc_r - arcs_i * arc_i,
                            arcs_r * arc_i + arcs_i * arc_r,
                        )
                        if arcs_r <= 0.0:
                            whole += math.atan2(arcs_i, arcs_r)
                            arcs_r = 1.0
                            arcs_i = 0.0
                        continue
                    angle = math.atan2(arc_i, arc_r)
                    if angle < 0.0:
                        angle += 2.0 * math.pi
                        if angle > 2.0 * math.pi - 1e-6:
                            # Round-off, or a cell inside but for a sliver: ask its far side.
                            r = root_first[p]
                            dx = roots[r, 4] * roots[r, 0] - roots[r, 5] * roots[r, 2]
                            dy = roots[r, 4] * roots[r, 1] - roots[r, 5] * roots[r, 3]
                            # The pair is the same seen from either cell but for its sign.
                            turn = 1.0 if own else -1.0
                            c1 = -(roots[r, 0] if own else roots[r, 2])
                            s1 = -(roots[r, 1] if own else roots[r, 3])
                            j = second[p]
                            if not own:
                                j = back_cell[back_first[i] + entry - n_own]
                            g, _, _, _, _, _ = gap(
                                record, i, j, turn * dx, turn * dy, c1, s1, modes
                            )
                            if g <= 0.0:
                                angle = 0.0
                    whole += angle
                tile[column] = whole + math.atan2(arcs_i, arcs_r)
                used = max(used, filled)
                velocity[i, 0] = v0 * record[i, 5] - mu_r * k * fx
                velocity[i, 1] = v0 * record[i, 6] - mu_r * k * fy
                velocity[i, 2] = mu_theta * k * spin if len(torque) > 0 else 0.0
                lens[column] = shared
            if used > 0:
                add_powers(side, used, modes, tile)
            shape_forces(tile, lane, k, eta, modes, tension, out)
            for column in range(min(LANES, end - begin)):
                i = begin + column
                scale = mu_ab * radius[i]
                for m in range(2 * n_modes):
                    velocity[i, 3 + m] = -scale * out[(1 + m) * LANES + column]
                bound = eta * tangent[i, 0] if len(tension) > 0 else 0.0
                energy[i] = bound + k * (0.5 * out[column] + lens[column])
