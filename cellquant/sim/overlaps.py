"""Forces of the exact contact rule from the crossings of the contours.

With the end points of an arc: translation needs the chord only, rotation the two radii only, and
shape W_k = integral over the arcs of exp(i k phi), which is known from the end angles. The shape
forces are a convolution of W, summed over all neighbours, with the modes of the cell.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from cellquant.sim.gathers import gather
from cellquant.sim.grazes import gap
from cellquant.sim.lanes import (
    QUAD,
    doubles,
    fetch,
    load,
    peek,
    poke,
    root,
    store,
)
from cellquant.sim.lenses import LENS, ROOT
from cellquant.sim.outlines import BLOCK
from cellquant.sim.parts import features_of, shared, taken
from cellquant.sim.records import HEAD

FLAGS = {"contract", "nsz", "arcp", "reassoc"}
ATAN = (  # of arctan(t) / t in powers of t^2, t < tan(pi / 8), to 4e-17
    0.999999999999999965, -0.333333333333284341, 0.199999999988541675, -0.142857141809006454,
    0.111111061773752269, -0.0909077300324082779, 0.0768995248823301616, -0.0664022517353950076,
    0.0568830340363324983, -0.0434791983904653699, 0.0211337520337483632,
)  # fmt: skip
SLOTS = 32  # crossings of a cell whose powers are summed at once; even


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def add_powers(roots: Any, places: Any, used: int, modes: Any, tile: Any) -> None:
    """Add sign exp(i n phi) / i of every crossing to the sums of n = 1 .. 2M; empty the slots.

    `places` says where the numbers of the crossings begin, those of one cell QUAD apart; slots that
    are empty point to the last row of `roots`. Row n of `tile`, QUAD apart, takes the real parts,
    row 2M + 1 + n the imaginary ones.
    """
    n_powers = 2 * len(modes) + 3
    half = n_powers * QUAD
    for slot in range(0, used, 2):
        c_0, s_0, before_c0, _ = gather(roots, places, slot * QUAD, 0)
        c_1, s_1, before_c1, _ = gather(roots, places, (slot + 1) * QUAD, 0)
        twice_0 = 2.0 * c_0
        twice_1 = 2.0 * c_1
        before_s0 = doubles(0.0)
        before_s1 = doubles(0.0)
        c_0, s_0 = before_c0 * c_0, before_c0 * s_0
        c_1, s_1 = before_c1 * c_1, before_c1 * s_1
        for n in range(1, n_powers, 2):
            at = n * QUAD
            store(tile, at, load(tile, at) + (s_0 + s_1))
            store(tile, half + at, load(tile, half + at) - (c_0 + c_1))
            before_c0 = twice_0 * c_0 - before_c0
            before_s0 = twice_0 * s_0 - before_s0
            before_c1 = twice_1 * c_1 - before_c1
            before_s1 = twice_1 * s_1 - before_s1
            at += QUAD
            store(tile, at, load(tile, at) + (before_s0 + before_s1))
            store(tile, half + at, load(tile, half + at) - (before_c0 + before_c1))
            c_0 = twice_0 * before_c0 - c_0
            s_0 = twice_0 * before_s0 - s_0
            c_1 = twice_1 * before_c1 - c_1
            s_1 = twice_1 * before_s1 - s_1
    for slot in range((used + 1) // 2 * 2 * QUAD):
        poke(places, slot, ROOT * (roots.shape[0] - 1))


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def angle_of(cosine: Any, sine: Any) -> Any:
    """Angle of unit vectors in the first quadrant, to round-off: four times that of a quarter."""
    t = sine / (1.0 + cosine)
    t = t / (1.0 + root(1.0 + t * t))
    q = t * t
    total = q * ATAN[10] + ATAN[9]
    for n in range(8, -1, -1):
        total = total * q + ATAN[n]
    return 4.0 * t * total


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def fill_lanes(record: Any, tangent: Any, rows: Any, modes: Any, tension: Any, lane: Any) -> None:
    """Put what the shape forces of a tile of cells need side by side.

    Rows of `lane`, QUAD apart: A0, cos theta, sin theta, one that is free, Re C, Im C, padding to a
    multiple of 4, and a row of `tangent`. `rows` says where those of the cells begin.
    """
    n_modes = len(modes)
    _, _, mean, _ = gather(record, rows, 0, 0)
    _, cosine, sine, _ = gather(record, rows, 0, 4)
    store(lane, 0, mean)
    store(lane, QUAD, cosine)
    store(lane, 2 * QUAD, sine)
    for m in range(0, 2 * n_modes, 4):
        v0, v1, v2, v3 = gather(record, rows, 0, HEAD + m)
        at = (4 + m) * QUAD
        store(lane, at, v0)
        store(lane, at + QUAD, v1)
        store(lane, at + 2 * QUAD, v2)
        store(lane, at + 3 * QUAD, v3)
    if len(tension) > 0:
        length = (4 + (2 * n_modes + 3) // 4 * 4) * QUAD
        for m in range(0, 2 * n_modes + 2, 4):
            v0, v1, v2, v3 = gather(tangent, rows, QUAD, m)
            at = length + m * QUAD
            store(lane, at, v0)
            store(lane, at + QUAD, v1)
            store(lane, at + 2 * QUAD, v2)
            store(lane, at + 3 * QUAD, v3)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def shape_forces(
    tile: Any,
    wave: Any,
    lane: Any,
    inverse: Any,
    k: float,
    eta: float,
    modes: Any,
    tension: Any,
    out: Any,
) -> None:
    """Convolve W with the modes, for a tile of cells.

    `tile` holds n W_n (and W_0), `wave` takes W_n for n = 1 - M .. 2M; both real parts first.
    Rows of `lane`: see `fill_lanes`. Rows of `out`: the overlap integral, dH/da_n and dH/db_n over
    R0, then dH/dA0. `inverse` holds 1 and 1 / n.
    """
    n_modes = len(modes)
    n_powers = 2 * n_modes + 3
    half = (n_modes + n_powers) * QUAD
    zero = n_modes * QUAD
    for n in range(n_powers):
        re = load(tile, n * QUAD) * inverse[n]
        im = load(tile, (n_powers + n) * QUAD) * inverse[n]
        store(wave, zero + n * QUAD, re)
        store(wave, half + zero + n * QUAD, im)
        if 0 < n < n_modes:
            store(wave, zero - n * QUAD, re)
            store(wave, half + zero - n * QUAD, -im)
    mean = load(lane, 0)
    cos_1 = load(lane, QUAD)
    sin_1 = load(lane, 2 * QUAD)
    real = 4 * QUAD
    imaginary = (4 + n_modes) * QUAD
    length = (4 + (2 * n_modes + 3) // 4 * 4) * QUAD
    j0 = mean * load(wave, zero)
    for m in range(n_modes):
        j0 += load(lane, real + m * QUAD) * load(wave, zero + (m + 2) * QUAD)
        j0 -= load(lane, imaginary + m * QUAD) * load(wave, half + zero + (m + 2) * QUAD)
    area = mean * j0
    constant = k * j0
    if len(tension) > 0:
        constant += eta * load(lane, length + QUAD)
    pull = 0.5 * constant / mean
    cos_n = cos_1
    sin_n = sin_1
    for m in range(n_modes):
        n = m + 2
        cos_n, sin_n = cos_n * cos_1 - sin_n * sin_1, sin_n * cos_1 + cos_n * sin_1
        # Sums of products in four chains, so that they seldom wait for each other.
        jr = doubles(0.0)
        ji = doubles(0.0)
        kr = doubles(0.0)
        ki = doubles(0.0)
        for q in range(n_modes):
            cr = load(lane, real + q * QUAD)
            ci = load(lane, imaginary + q * QUAD)
            up = zero + (n + q + 2) * QUAD
            ur = load(wave, up)
            ui = load(wave, half + up)
            jr += cr * ur
            kr -= ci * ui
            ji += cr * ui
            ki += ci * ur
            low = zero + (m - q) * QUAD
            lr = load(wave, low)
            li = load(wave, half + low)
            jr += cr * lr
            kr += ci * li
            ji += cr * li
            ki -= ci * lr
        jr = mean * load(wave, zero + n * QUAD) + 0.5 * (jr + kr)
        ji = mean * load(wave, half + zero + n * QUAD) + 0.5 * (ji + ki)
        area += load(lane, real + m * QUAD) * jr - load(lane, imaginary + m * QUAD) * ji
        jr *= k
        ji *= k
        if len(tension) > 0:
            jr += eta * load(lane, length + (2 + m) * QUAD)
            ji += eta * load(lane, length + (2 + n_modes + m) * QUAD)
        # The constant area pulls with a_n and b_n, which are the mode turned back.
        jr -= pull * load(lane, real + m * QUAD)
        ji += pull * load(lane, imaginary + m * QUAD)
        store(out, (1 + m) * QUAD, jr * cos_n + ji * sin_n)
        store(out, (1 + n_modes + m) * QUAD, ji * cos_n - jr * sin_n)
    store(out, 0, area)
    store(out, (1 + 2 * n_modes) * QUAD, constant)


@shared(FLAGS)
def exact_velocity(part: int, n_parts: int, kept: Any, state: Any, velocity: Any) -> None:
    """Generalised velocity, energy and dH/dA0 of every cell from the crossings of its contour.

    The energy lacks the areas of the lenses, see `energies`.

    `numbers` holds v0, k, eta, mu_r, mu_theta, mu_ab.
    """
    (
        radius, record, tangent, first, second, back_first, back_pair, back_cell, roots,
        root_first, root_last, lenses, inside, numbers, energy, growth,
    ) = taken(kept)  # fmt: skip
    modes, tension, torque = features_of(kept)
    v0, k, eta = numbers[0], numbers[1], numbers[2]
    mu_r, mu_theta, mu_ab = numbers[3], numbers[4], numbers[5]
    n_cells = state.shape[0]
    n_modes = len(modes)
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    n_powers = 2 * len(modes) + 3
    inverse = 1.0 / np.maximum(np.arange(n_powers), 1)
    tile = np.empty(2 * n_powers * QUAD)
    wave = np.zeros(2 * (n_modes + n_powers) * QUAD)
    lane = np.empty((12 + 4 * n_modes) * QUAD)
    rows = np.empty(2 * QUAD, np.int64)
    out = np.empty((2 + 2 * n_modes) * QUAD)
    rest = np.zeros(2 * QUAD)
    places = np.full(SLOTS * QUAD, ROOT * (roots.shape[0] - 1))
    for block in range(n_blocks):
        if not part * n_blocks <= block * n_parts < (part + 1) * n_blocks:
            continue
        end = min(n_cells, (block + 1) * BLOCK)
        for begin in range(block * BLOCK, end, QUAD):
            tile[:] = 0.0
            used: Any = np.int64(0)
            for column in range(QUAD):
                i = min(begin + column, end - 1)
                rows[column] = i * record.shape[1]
                rows[QUAD + column] = i * tangent.shape[1]
            fill_lanes(record, tangent, rows, modes, tension, lane)
            # Lenses that others list, which the next tile needs.
            for b in range(
                back_first[min(begin + QUAD, end)], back_first[min(begin + 2 * QUAD, end)]
            ):
                fetch(lenses, LENS * peek(back_pair, b))
            for column in range(min(QUAD, end - begin)):
                i = begin + column
                fx = 0.0
                fy = 0.0
                spin = 0.0
                whole = 0.0
                filled: Any = np.int64(0)
                arcs_r = 1.0
                arcs_i = 0.0
                n_own = first[i + 1] - first[i]
                n_all = n_own + back_first[i + 1] - back_first[i]
                for entry in range(n_all):
                    own = entry < n_own
                    if own:
                        p = first[i] + entry
                    else:
                        p = peek(back_pair, back_first[i] + entry - n_own)
                    if peek(inside, p) == (1 if own else 2):
                        whole += 2.0 * math.pi
                    begin_of_it = peek(root_first, p)
                    end_of_it = peek(root_last, p)
                    if begin_of_it == end_of_it:
                        continue
                    turn = 1.0 if own else -1.0
                    side = 0 if own else 1
                    at = LENS * p
                    fx += turn * peek(lenses, at)
                    fy += turn * peek(lenses, at + 1)
                    spin += peek(lenses, at + 2 + side)
                    arc_r = peek(lenses, at + 4 + 2 * side)
                    arc_i = peek(lenses, at + 5 + 2 * side)
                    for r in range(begin_of_it, end_of_it):
                        if filled == SLOTS:
                            add_powers(roots, places, filled, modes, tile)
                            filled = 0
                            used = 0
                        poke(places, filled * QUAD + column, ROOT * r + 4 * side)
                        fetch(roots, ROOT * r)
                        filled += 1
                    if arc_r > 0.0 and arc_i >= 0.0:
                        # Short arcs are added by turning one by the other, quarter turns apart.
                        arcs_r, arcs_i = (
                            arcs_r * arc_r - arcs_i * arc_i,
                            arcs_r * arc_i + arcs_i * arc_r,
                        )
                        over = arcs_r <= 0.0
                        whole += 0.5 * math.pi if over else 0.0
                        arcs_r, arcs_i = (
                            (arcs_i if over else arcs_r),
                            (-arcs_r if over else arcs_i),
                        )
                        continue
                    angle = math.atan2(arc_i, arc_r)
                    if angle < 0.0:
                        angle += 2.0 * math.pi
                        if angle > 2.0 * math.pi - 1e-6:
                            # Round-off, or a cell inside but for a sliver: ask its far side.
                            r = begin_of_it
                            dx = roots[r, 3] * roots[r, 0] - roots[r, 7] * roots[r, 4]
                            dy = roots[r, 3] * roots[r, 1] - roots[r, 7] * roots[r, 5]
                            # The pair is the same seen from either cell but for its sign.
                            c1 = -roots[r, 4 * side]
                            s1 = -roots[r, 4 * side + 1]
                            j = second[p]
                            if not own:
                                j = back_cell[back_first[i] + entry - n_own]
                            g, _, _, _, _, _, _ = gap(
                                record, i, j, turn * dx, turn * dy, c1, s1, modes
                            )
                            if g <= 0.0:
                                angle = 0.0
                    whole += angle
                tile[column] = whole
                rest[column] = arcs_r
                rest[QUAD + column] = arcs_i
                used = max(used, filled)
                velocity[i, 0] = v0 * record[i, 5] - mu_r * k * fx
                velocity[i, 1] = v0 * record[i, 6] - mu_r * k * fy
                velocity[i, 2] = mu_theta * k * spin if len(torque) > 0 else 0.0
            store(tile, 0, load(tile, 0) + angle_of(load(rest, 0), load(rest, QUAD)))
            if used > 0:
                add_powers(roots, places, used, modes, tile)
            shape_forces(tile, wave, lane, inverse, k, eta, modes, tension, out)
            for column in range(min(QUAD, end - begin)):
                i = begin + column
                scale = mu_ab * radius[i]
                for m in range(2 * n_modes):
                    velocity[i, 3 + m] = -scale * out[(1 + m) * QUAD + column]
                bound = eta * tangent[i, 0] if len(tension) > 0 else 0.0
                energy[i] = bound + 0.5 * k * out[column]
                growth[i] = out[(1 + 2 * n_modes) * QUAD + column]
