"""Contours of all cells: what every contact rule reads, and the gradient of their lengths.

In the frame of the laboratory a contour is rho(phi) = A0 + Re sum_n C_n exp(i n phi), with
C_n = R0 (a_n - i b_n) exp(-i n theta). A record row holds x, y, A0, an upper bound of rho, a lower
estimate of rho, cos theta, sin theta, a free entry, then the real and the imaginary parts of
C_2 .. C_M.

Cells are worked on in tiles of `LANES`, one cell per lane of a vector instruction. The trapezoid
rule of the length takes four points at once, phi, -phi, pi + phi and pi - phi, which share their
sines and cosines. It starts with 16 max(6, M) points; the alternating sum over these estimates what
aliasing costs, and cells that need more get the points between, as often as it takes.
"""

import math
from typing import Any

import numpy as np
from numba import njit, prange
from numba.np.numpy_support import carray

from cellquant.sim.lanes import (
    LANES,
    bits_of_double,
    bits_of_single,
    double_of_bits,
    doubles,
    integers,
    single_of_bits,
    singles,
)

HEAD = 8  # entries of a record before the modes
BLOCK = 32  # cells worked on together
FLAGS = {"contract", "nsz", "arcp", "reassoc"}
ROUGH = 2e-5  # alternating sum above which the trapezoid rule takes twice the points
LEVELS = 5  # 16 max(6, M) points, doubled at most four times
GUESS = np.uint64(0x5FE6EB50C7B537A9)  # bits from which those of 1 / sqrt follow, to 3 %
SLACK = 1e-6  # rounding of single-precision samples, relative to A0


def samples_of(modes: int) -> int:
    """Samples of a contour from which the exact rule starts its search, a multiple of 8."""
    return 8 * max(6, modes)


def compass(modes: int, size: int) -> tuple[Any, Any]:
    """cos(n phi_s), sin(n phi_s) in rows 2(n - 1), 2(n - 1) + 1, in double and in single."""
    angle = 2.0 * math.pi * np.arange(size) / size
    rows = [f(n * angle) for n in range(1, max(modes, 1) + 1) for f in (np.cos, np.sin)]
    table = np.ascontiguousarray(rows)
    return table, table.astype(np.float32)


def quarter_points(modes: int) -> tuple[Any, Any]:
    """Points of the first quadrant for every level of the trapezoid rule, and where each starts.

    A row holds the weight of a point, then cos, sin, n cos and n sin of n phi for n = 2 .. M.
    """
    base = 16 * max(6, modes)
    spacing = 2.0 * math.pi / base
    angles, weights = [(np.arange(base // 4) + 0.5) * spacing], [np.ones(base // 4)]
    ends = np.ones(base // 4 + 1)
    ends[[0, -1]] = 0.5  # on an axis two of the four points coincide
    angles.append(np.arange(base // 4 + 1) * spacing)
    weights.append(ends)
    for level in range(2, LEVELS):
        number = base // 4 * 2 ** (level - 1)
        angles.append((np.arange(number) + 0.5) * 2.0 * math.pi / (4 * number))
        weights.append(np.ones(number))
    phi = np.concatenate(angles)
    columns = [np.concatenate(weights)]
    for n in range(2, modes + 1):
        c, s = np.cos(n * phi), np.sin(n * phi)
        columns += [c, s, n * c, n * s]
    starts = np.cumsum([0] + [len(a) for a in angles])
    return np.ascontiguousarray(np.column_stack(columns)), starts


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def add_points(lane: Any, sums: Any, quarter: Any, begin: int, end: int, modes: Any) -> None:
    """Sum over the points of one level for a tile of cells.

    Rows of `lane`, LANES apart: A0, Re C, Im C. Rows of `sums`: length, L_0, Re L, Im L and two
    alternating sums.
    """
    n_modes = len(modes)
    total = carray(doubles(modes, 4, 2), ((4 + 2 * len(modes)) * LANES,))
    re_sum = np.uint64(2 * LANES)
    im_sum = re_sum + np.uint64(n_modes * LANES)
    wave = im_sum + np.uint64(n_modes * LANES)
    one = np.uint64(LANES)
    for row in range((4 + 2 * n_modes) * LANES):
        total[row] = 0.0
    sign = 1.0
    for q in range(begin, end):
        weight = quarter[q, 0]
        sign = -sign
        for r in range(np.uint64(LANES)):
            mean = lane[r]
            even_c = 0.0
            even_s = 0.0
            odd_c = 0.0
            odd_s = 0.0
            even_a = 0.0
            even_b = 0.0
            odd_a = 0.0
            odd_b = 0.0
            for m in range(n_modes):
                re = lane[np.uint64((1 + m) * LANES) + r]
                im = lane[np.uint64((1 + n_modes + m) * LANES) + r]
                if m % 2 == 0:
                    even_c += re * quarter[q, 4 * m + 1]
                    even_s += im * quarter[q, 4 * m + 2]
                    even_b += im * quarter[q, 4 * m + 3]
                    even_a += re * quarter[q, 4 * m + 4]
                else:
                    odd_c += re * quarter[q, 4 * m + 1]
                    odd_s += im * quarter[q, 4 * m + 2]
                    odd_b += im * quarter[q, 4 * m + 3]
                    odd_a += re * quarter[q, 4 * m + 4]
            here = mean + even_c
            sum_c = here + odd_c
            dif_c = here - odd_c
            sum_s = even_s + odd_s
            dif_s = even_s - odd_s
            sum_a = even_a + odd_a
            dif_a = even_a - odd_a
            sum_b = even_b + odd_b
            dif_b = even_b - odd_b
            # Radius and slope at phi, -phi, pi + phi, pi - phi.
            r0 = sum_c - sum_s
            r1 = sum_c + sum_s
            r2 = dif_c - dif_s
            r3 = dif_c + dif_s
            d0 = -sum_a - sum_b
            d1 = sum_a - sum_b
            d2 = -dif_a - dif_b
            d3 = dif_a - dif_b
            q0 = r0 * r0 + d0 * d0
            q1 = r1 * r1 + d1 * d1
            q2 = r2 * r2 + d2 * d2
            q3 = r3 * r3 + d3 * d3
            # 1 / sqrt(q): bits of a guess to 3 %, then two steps of order three, to 3e-12.
            i0 = double_of_bits(GUESS - (bits_of_double(q0) >> np.uint64(1)))
            i1 = double_of_bits(GUESS - (bits_of_double(q1) >> np.uint64(1)))
            i2 = double_of_bits(GUESS - (bits_of_double(q2) >> np.uint64(1)))
            i3 = double_of_bits(GUESS - (bits_of_double(q3) >> np.uint64(1)))
            for _ in range(2):
                e0 = 1.0 - q0 * i0 * i0
                e1 = 1.0 - q1 * i1 * i1
                e2 = 1.0 - q2 * i2 * i2
                e3 = 1.0 - q3 * i3 * i3
                i0 += i0 * (e0 * (0.5 + 0.375 * e0))
                i1 += i1 * (e1 * (0.5 + 0.375 * e1))
                i2 += i2 * (e2 * (0.5 + 0.375 * e2))
                i3 += i3 * (e3 * (0.5 + 0.375 * e3))
            i0 *= weight
            i1 *= weight
            i2 *= weight
            i3 *= weight
            total[r] += (q0 * i0 + q1 * i1) + (q2 * i2 + q3 * i3)
            u0 = r0 * i0
            u1 = r1 * i1
            u2 = r2 * i2
            u3 = r3 * i3
            v0 = d0 * i0
            v1 = d1 * i1
            v2 = d2 * i2
            v3 = d3 * i3
            u_plus = u0 + u1
            u_minus = u0 - u1
            u_plus_2 = u2 + u3
            u_minus_2 = u2 - u3
            v_plus = v0 + v1
            v_minus = v0 - v1
            v_plus_2 = v2 + v3
            v_minus_2 = v2 - v3
            ue = u_plus + u_plus_2
            uo = u_plus - u_plus_2
            se = u_minus + u_minus_2
            so = u_minus - u_minus_2
            ve = v_plus + v_plus_2
            vo = v_plus - v_plus_2
            te = v_minus + v_minus_2
            to = v_minus - v_minus_2
            total[one + r] += ue
            total[wave + r] += sign * se
            total[wave + one + r] += sign * te
            for m in range(n_modes):
                c = quarter[q, 4 * m + 1]
                s = quarter[q, 4 * m + 2]
                nc = quarter[q, 4 * m + 3]
                ns = quarter[q, 4 * m + 4]
                at = np.uint64(m * LANES) + r
                if m % 2 == 0:
                    total[re_sum + at] += ue * c - te * ns
                    total[im_sum + at] += se * s + ve * nc
                else:
                    total[re_sum + at] += uo * c - to * ns
                    total[im_sum + at] += so * s + vo * nc
    for row in range((4 + 2 * n_modes) * LANES):
        sums[row] = total[row]


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def fill_lanes(
    lane: Any, cells: Any, begin: int, count: int, record: Any, scale: float, modes: Any
) -> None:
    """Copy the contours of a tile of cells into lanes; empty lanes are discs."""
    n_modes = len(modes)
    for r in range(LANES):
        if r < count:
            i = cells[begin + r]
            lane[r] = record[i, 2]
            for m in range(2 * n_modes):
                lane[(1 + m) * LANES + r] = record[i, HEAD + m]
        else:
            lane[r] = scale
            for m in range(2 * n_modes):
                lane[(1 + m) * LANES + r] = 0.0


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def gradient_of_length(
    cells: Any, count: int, lane: Any, sums: Any, record: Any, quarter: Any, starts: Any,
    modes: Any, tangent: Any,
) -> None:  # fmt: skip
    """Length of the contours of some cells and its gradient; reorders `cells`."""
    n_modes = len(modes)
    wave = (2 + 2 * n_modes) * LANES
    share = 2.0 * math.pi / (4 * starts[1])
    for level in range(LEVELS):
        rough = 0
        for begin in range(0, count, LANES):
            filled = min(LANES, count - begin)
            fill_lanes(lane, cells, begin, filled, record, 1.0, modes)
            add_points(lane, sums, quarter, starts[level], starts[level + 1], modes)
            for r in range(filled):
                i = cells[begin + r]
                if level == 0:
                    a = sums[wave + r] * share
                    b = sums[wave + LANES + r] * share
                    for row in range(2 + 2 * n_modes):
                        tangent[i, row] = share * sums[row * LANES + r]
                    off = a * a + b * b
                else:
                    off = 0.0
                    for row in range(2 + 2 * n_modes):
                        old = tangent[i, row]
                        fresh = share * sums[row * LANES + r]
                        tangent[i, row] = 0.5 * (old + fresh)
                        off = max(off, (old - fresh) * (old - fresh))
                if off > ROUGH * ROUGH:
                    cells[rough] = i
                    rough += 1
        count = rough
        if count == 0:
            break
        if level > 0:
            share *= 0.5


@njit(cache=True, fastmath=FLAGS | {"nnan"}, error_model="numpy", forceinline=True)
def sample(
    i: int, record: Any, compass: Any, modes: Any, grid: Any, pattern: Any
) -> tuple[float, float]:
    """Sample contour i in single precision; return the largest and the smallest radius."""
    n_modes = len(modes)
    size = np.uint64(8 * max(6, len(modes) + 1))
    half = np.uint64(4 * max(6, len(modes) + 1))
    # On the stack first: the compiler cannot know that `grid` and `compass` are apart.
    x_of = carray(singles(modes, 9, 2), (12 * max(6, len(modes) + 1),))
    y_of = carray(singles(modes, 9, 2), (12 * max(6, len(modes) + 1),))
    ratio_of = carray(singles(modes, 9, 2), (12 * max(6, len(modes) + 1),))
    coefficient = carray(singles(modes, 1, 1), (2 * len(modes) + 2,))
    for m in range(2 * n_modes):
        coefficient[m] = np.float32(record[i, HEAD + m])
        pattern[i, 1 + m] = coefficient[m]
    centre = np.float32(record[i, 2])
    pattern[i, 0] = centre
    # Bits order positive numbers as the numbers are; any negative one is below them.
    highest = carray(integers(modes, 1, 0), (LANES,))
    lowest = carray(integers(modes, 1, 0), (LANES,))
    for r in range(LANES):
        highest[r] = np.int32(0)
        lowest[r] = np.int32(0x7FFFFFFF)
    for start in range(np.uint64(0), half, np.uint64(LANES)):
        for r in range(np.uint64(LANES)):
            s = start + r
            even = centre
            odd = np.float32(0.0)
            even_slope = np.float32(0.0)
            odd_slope = np.float32(0.0)
            for m in range(n_modes):
                re = coefficient[m]
                im = coefficient[n_modes + m]
                c = compass[2 * m + 2, s]
                d = compass[2 * m + 3, s]
                n = np.float32(m + 2)
                if m % 2 == 0:
                    even += re * c - im * d
                    even_slope -= n * (re * d + im * c)
                else:
                    odd += re * c - im * d
                    odd_slope -= n * (re * d + im * c)
            here = even + odd
            there = even - odd
            bits = bits_of_single(here)
            other = bits_of_single(there)
            high = bits if bits > other else other
            low = bits if bits < other else other
            high = highest[r] if highest[r] > high else high
            low = lowest[r] if lowest[r] < low else low
            highest[r] = high
            lowest[r] = low
            c = compass[0, s]
            d = compass[1, s]
            x_of[s] = here * c
            y_of[s] = here * d
            ratio_of[s] = (even_slope + odd_slope) / here
            x_of[s + half] = -there * c
            y_of[s + half] = -there * d
            ratio_of[s + half] = (even_slope - odd_slope) / there
    for s in range(size):
        grid[i, 0, s] = x_of[s]
        grid[i, 1, s] = y_of[s]
        grid[i, 2, s] = ratio_of[s]
    high = highest[0]
    low = lowest[0]
    for r in range(1, LANES):
        high = max(high, highest[r])
        low = min(low, lowest[r])
    for s in range(half):
        grid[i, 0, s + size] = x_of[s]
        grid[i, 1, s + size] = y_of[s]
        grid[i, 2, s + size] = ratio_of[s]
    return single_of_bits(high), single_of_bits(low)


@njit(cache=True, parallel=True, fastmath=FLAGS, error_model="numpy")
def contours(
    state: Any,
    radius: Any,
    compass: Any,
    quarter: Any,
    starts: Any,
    modes: Any,
    tension: Any,
    record: Any,
    grid: Any,
    pattern: Any,
    tangent: Any,
) -> None:
    """Record every contour and its samples; with tension also the gradient of its length.

    Writes `record`, the samples x, y and slope / rho of `grid` (N, 3, 3 size / 2; one and a half
    times round) in single precision, relative to the centre, in `pattern` A0 and the modes in
    single precision, and in `tangent` the length, L_0, then Re and Im of
    L_n = integral (u + i n v) exp(i n phi), u = rho / |t|, v = slope / |t|. The lower estimate of
    rho is NaN where a0^2 <= 0.
    """
    n_modes = len(modes)
    n_cells = state.shape[0]
    size = compass.shape[1]
    spacing = 2.0 * math.pi / size
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    for block in prange(n_blocks):
        lane = np.empty(LANES * (1 + 2 * n_modes))
        sums = np.empty(LANES * (4 + 2 * n_modes))
        cells = np.empty(BLOCK, np.int64)
        for i in range(block * BLOCK, min(n_cells, (block + 1) * BLOCK)):
            r0 = radius[i]
            power = 0.0
            bend = 0.0
            cos_1 = math.cos(state[i, 2])
            sin_1 = math.sin(state[i, 2])
            cos_n = cos_1
            sin_n = sin_1
            for m in range(n_modes):
                n = m + 2
                cos_n, sin_n = cos_n * cos_1 - sin_n * sin_1, sin_n * cos_1 + cos_n * sin_1
                a = state[i, 3 + m]
                b = state[i, 3 + n_modes + m]
                square = a * a + b * b
                power += square
                record[i, HEAD + m] = r0 * (a * cos_n - b * sin_n)
                record[i, HEAD + n_modes + m] = -r0 * (b * cos_n + a * sin_n)
                bend += (n * n) * math.sqrt(square)
            mean = r0 * math.sqrt(1.0 - 0.5 * power) if power < 2.0 else math.nan
            record[i, 0] = state[i, 0]
            record[i, 1] = state[i, 1]
            record[i, 2] = mean
            record[i, 5] = cos_1
            record[i, 6] = sin_1
            if not (power < 2.0 and cos_1 * cos_1 < 2.0):
                record[i, 4] = math.nan
                continue
            high, low = sample(i, record, compass, modes, grid, pattern)
            # Between two samples the radius exceeds them by at most spacing^2/8 |rho''|.
            record[i, 3] = high + SLACK * mean + 0.125 * spacing * spacing * r0 * bend
            record[i, 4] = low - SLACK * mean
        if len(tension) > 0:
            count = 0
            for i in range(block * BLOCK, min(n_cells, (block + 1) * BLOCK)):
                if record[i, 4] > 0.0:
                    cells[count] = i
                    count += 1
            gradient_of_length(cells, count, lane, sums, record, quarter, starts, modes, tangent)
