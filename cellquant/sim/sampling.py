"""How deep the contour of a cell lies in its neighbours: samples, and gaps that may hide crossings.

Only the part of a contour that can reach the neighbour is sampled, in single precision. A gap
between two samples is listed if the cubic through them and their slopes may cross zero.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from cellquant.sim.gathers import gather_pair, scatter
from cellquant.sim.grazes import FLAGS, HULL_MARGIN
from cellquant.sim.lanes import (
    LANES,
    absolute,
    bits,
    ceiling,
    choose,
    count_ones,
    doubles_pair,
    floor,
    greatest,
    least,
    load,
    load_pair,
    peek,
    poke,
    root,
    rough_root,
    singles,
    store,
    trailing_zeros,
)

PAIRS = 112  # pairs whose contours are sampled before the gaps between samples are judged
MANY = 12  # gaps of one pair that may hold a crossing; with more it is searched in double precision
FULL = 4 * PAIRS  # gaps of all of them; pairs for which there is no room are searched in it too
LISTED = 2 * FULL + 4 * LANES  # gaps and second crossings, and room to read on
# What is known of gaps is kept in two tables whose widths are known when kernels are compiled: one
# address leads to all rows. In whole numbers: where the numbers of its sample, its pair, i and j
# begin, the place of its sample, and where its crossing goes.
SAMPLE, PAIR, OWNER, OTHER, PLACE, TARGET = range(0, 6 * LISTED, LISTED)
# In single precision, after 13 rows of `judge_gaps`: angle from the sample, bracket and sign; then
# 0 where there is no sample before or after the gap (else 1), A0 of j, and how many crossings.
ANGLE, LOW, HIGH, SIGN, INNER, MEAN, KIND = range(13 * LISTED, 20 * LISTED, LISTED)
CLOSELY, OUTSIDE, INSIDE = -1, -2, -3  # what a pair without gaps is
NARROW = 0.1  # smallest radius over A0 for which single precision is trusted
FAST = 3.0  # turns round the centre of j per turn of i, above which modes of j are undersampled
END = np.uint64(1 << 63)
TINY = 1e-30


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def arc_cosine(x: Any) -> Any:
    """Arc cosine to 7e-5 (Abramowitz & Stegun 4.4.45); of numbers outside of [-1, 1] its ends."""
    y = least(absolute(x), 1.0)
    half = root(1.0 - y) * (1.5707288 + y * (-0.2121144 + y * (0.0742610 + y * -0.0187293)))
    return choose(x >= 0.0, half, math.pi - half)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def place_pairs(
    record: Any, shift: Any, begin: int, filled: int, rows: Any, near: Any, apart: Any,
    codes: Any,
) -> None:  # fmt: skip
    """Where the cells of many pairs lie: `near` (see `find_windows`), and in `apart` as doubles.

    Rows of `rows`: where the records of i and of j begin, and the numbers of the pairs' shifts.
    `codes` takes CLOSELY where a contour is narrow.
    """
    room = PAIRS
    nothing = doubles_pair(0.0)
    for k in range(filled):
        codes[k] = OUTSIDE
    for k in range(0, filled, LANES):
        x_i, y_i, mean_i, high_i = gather_pair(record, rows, k, 0)
        low_i, _, _, _ = gather_pair(record, rows, k, 4)
        x_j, y_j, mean_j, high_j = gather_pair(record, rows, room + k, 0)
        low_j, _, _, _ = gather_pair(record, rows, room + k, 4)
        shift_x, shift_y, _, _ = gather_pair(shift, rows, 2 * room + k, 0)
        dx = (x_j + shift_x) - x_i
        dy = (y_j + shift_y) - y_i
        scatter(apart, 4 * k, 4, dx, dy, nothing, nothing)
        store(near, k, dx)
        store(near, PAIRS + k, dy)
        store(near, 2 * PAIRS + k, low_i)
        store(near, 3 * PAIRS + k, high_i)
        store(near, 4 * PAIRS + k, high_j)
        word = bits((low_i < NARROW * mean_i) | (low_j < NARROW * mean_j))
        if word != np.uint64(0):
            for lane in range(LANES):
                if (word >> np.uint64(lane)) & np.uint64(1) and k + lane < filled:
                    codes[k + lane] = CLOSELY


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def find_windows(near: Any, start: Any, count: Any, filled: int, modes: Any) -> None:
    """Samples of i's contour that can lie within the reach of j, for many pairs.

    Rows of `near`, PAIRS apart: displacement to j (2), low and high of i, high of j.
    """
    size = 8 * max(6, len(modes) + 1)
    per_radian = size / (2.0 * math.pi)
    for p in range(0, filled, LANES):
        dx = load(near, p)
        dy = load(near, PAIRS + p)
        low = load(near, 2 * PAIRS + p)
        high = load(near, 3 * PAIRS + p)
        reach = load(near, 4 * PAIRS + p)
        square = dx * dx + dy * dy
        distance = root(square)
        away = square - reach * reach
        nearest = least(greatest(root(greatest(away, 0.0)), low), high)
        # A pinched contour comes as near as its centre.
        nearest = greatest(nearest, 1e-6 * high)
        inverse = 1.0 / greatest(distance, TINY)
        half = arc_cosine(0.5 * (away + nearest * nearest) * inverse / nearest)
        middle = arc_cosine(dx * inverse)
        middle = choose(dy >= 0.0, middle, -middle)
        samples = 8.0 * ceiling((2.0 * half * per_radian + 2.5) * 0.125)
        begin = floor(middle * per_radian - 0.5 * samples + 1.0)
        begin = choose(begin >= 0.0, begin, begin + size)
        all_of_it = (samples > size // 2) | (distance < 1e-6 * high)
        samples = choose(all_of_it, singles(size + 1), samples)
        store(start, p, choose(all_of_it, singles(0.0), begin))
        apart = distance > (high + reach) * 1.000001
        store(count, p, choose(apart, singles(0.0), samples))


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def sample_pairs(
    grid: Any, rim: Any, pattern: Any, owner: Any, other: Any, near: Any, starts: Any, counts: Any,
    filled: int, modes: Any, depth: Any, change: Any, codes: Any,
) -> None:  # fmt: skip
    """Sample the depth of i in j for many pairs.

    Where i passes j so fast that the samples lie too far apart, `codes` takes CLOSELY.

    Row k of `depth`, and of `change` for its slope times the width of a gap, belongs to pair k and
    holds its first sample in column LANES.
    """
    n_modes = len(modes)
    top = n_modes - 1
    size = 8 * max(6, n_modes + 1)
    long = 3 * (size // 2) + 2 * LANES
    room = size + 5 * LANES
    width = np.float32(2.0 * math.pi / size)
    for pair in range(filled):
        count = int(peek(counts, pair))
        j = peek(other, pair) * (1 + 4 * n_modes)
        begin = int(peek(starts, pair))
        at = peek(owner, pair) * 2 * long + begin
        row = pair * room + LANES
        x_j = peek(near, pair)
        y_j = peek(near, PAIRS + pair)
        fastest = singles(0.0)
        for s in range(0, count, LANES):
            rho = load(grid, at + s)
            slope_i = load(grid, at + long + s)
            c = load(rim, begin + s)
            d = load(rim, long + begin + s)
            x = rho * c - x_j
            y = rho * d - y_j
            square = greatest(x * x + y * y, TINY)
            inverse = rough_root(square)
            ux = x * inverse
            uy = y * inverse
            pr = singles(peek(pattern, j + 1 + top))
            pi = singles(peek(pattern, j + 1 + n_modes + top))
            qr = singles(0.0)
            qi = singles(0.0)
            for k in range(1, n_modes):
                m = 1 + top - k
                qr, qi = qr * ux + (pr - qi * uy), qr * uy + (pi + qi * ux)
                pr, pi = (
                    pr * ux + (peek(pattern, j + m) - pi * uy),
                    pr * uy + (peek(pattern, j + n_modes + m) + pi * ux),
                )
            zr = ux * ux - uy * uy
            zi = 2.0 * ux * uy
            store(depth, row + s, pr * zr + (peek(pattern, j) - pi * zi) - square * inverse)
            qr, qi = qr * ux + (2.0 * pr - qi * uy), qr * uy + (2.0 * pi + qi * ux)
            tx = slope_i * c - rho * d
            ty = slope_i * d + rho * c
            passing = (uy * tx - ux * ty) * inverse
            fastest = greatest(fastest, absolute(passing))
            along = (qr * zi + qi * zr) * passing - (ux * tx + uy * ty)
            store(change, row + s, width * along)
        if bits(fastest > FAST) != np.uint64(0):
            poke(codes, pair, CLOSELY)
        if count > size:
            depth[row - 1] = depth[row + size - 1]
            change[row - 1] = change[row + size - 1]


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def list_gaps(
    pattern: Any, owner: Any, other: Any, starts: Any, counts: Any, filled: int, size: int,
    stride: int, depth: Any, change: Any, rows: Any, piece: Any, codes: Any, numbers: Any,
) -> int:  # fmt: skip
    """List the gaps between samples that may hold a crossing; return their number.

    `rows` and `piece` take what is known of each so far: all of the first but TARGET, and INNER and
    MEAN. `numbers` takes how many there are of every pair, and `codes` takes CLOSELY where a pair
    must be searched in double precision (also where that is given), or else OUTSIDE where the first
    sample lies outside of j and INSIDE where it does not.
    """
    room = size + 5 * LANES
    base: Any = np.int64(0)  # a plain 0 would have callers compiled twice
    long = pattern.shape[1]
    for pair in range(filled):
        count = int(peek(counts, pair))
        poke(numbers, pair, 0)
        if count == 0 or peek(codes, pair) == CLOSELY:
            continue
        row = pair * room + LANES
        margin = np.float32(HULL_MARGIN) * peek(pattern, long * peek(other, pair))
        poke(codes, pair, INSIDE if math.copysign(1.0, peek(depth, row)) > 0.0 else OUTSIDE)
        last = count - 1
        first = base
        for s in range(0, last, 2 * LANES):
            g0 = load_pair(depth, row + s)
            g1 = load_pair(depth, row + s + 1)
            b1 = g0 + load_pair(change, row + s) * (1.0 / 3.0)
            b2 = g1 - load_pair(change, row + s + 1) * (1.0 / 3.0)
            low = least(least(g0, g1), least(b1, b2) - margin)
            high = greatest(greatest(g0, g1), greatest(b1, b2) + margin)
            # All four coefficients on one side of zero, the inner ones by the margin: none.
            word = bits((low <= 0.0) & (high > 0.0))
            if s + 2 * LANES > last:
                word &= (np.uint64(1) << np.uint64(last - s)) - np.uint64(1)
            number = count_ones(word)
            if base - first + number > MANY or base + number > FULL:
                codes[pair] = CLOSELY
                base = first
                break
            # Four at a time, whether there are as many or not, to spare the branches.
            for g in range(base, base + number, 4):
                for q in range(4):
                    poke(rows, PLACE + g + q, (pair << 16) + s + trailing_zeros(word | END))
                    word &= word - np.uint64(1)
            base += number
        poke(numbers, pair, base - first)
    for g in range(base):
        code = peek(rows, PLACE + g)
        pair = code >> 16
        t = code & 65535
        count = int(peek(counts, pair))
        edge = (count <= size) & ((t == 0) | (t + 2 >= count))
        at = int(peek(starts, pair)) + t
        at -= size if at >= size else 0
        j = peek(other, pair)
        poke(rows, PLACE + g, pair * room + LANES + t)
        poke(piece, INNER + g, 0.0 if edge else 1.0)
        poke(piece, MEAN + g, peek(pattern, long * j))
        poke(rows, SAMPLE + g, 4 * at)
        poke(rows, PAIR + g, 4 * pair)
        poke(rows, OWNER + g, stride * peek(owner, pair))
        poke(rows, OTHER + g, stride * j)
    for g in range(base, base + 2 * LANES):
        poke(rows, PLACE + g, LANES)  # what fills up the last vector
    return int(base)
