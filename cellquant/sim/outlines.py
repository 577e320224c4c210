"""Contours of all cells: what every contact rule reads, and the gradient of their lengths.

In the frame of the laboratory a contour is rho(phi) = A0 + Re sum_n C_n exp(i n phi), with
C_n = R0 (a_n - i b_n) exp(-i n theta). A record row holds x, y, A0, an upper bound of rho, a lower
estimate of rho, cos theta, sin theta, R0, then the real and the imaginary parts of
C_2 .. C_M.

Cells are worked on in tiles of `QUAD`, one cell per lane of a vector instruction. The trapezoid
rule of the length takes four points at once, phi, -phi, pi + phi and pi - phi, which share their
sines and cosines. It starts with 16 max(6, M) - 8 points; the alternating sum over these estimates
what aliasing costs, and cells that need more get the points between, as often as it takes.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from cellquant.sim.lanes import (
    LANES,
    QUAD,
    choose,
    doubles,
    floor,
    gather,
    greatest,
    halved_bits,
    least,
    load,
    root,
    scatter,
    singles,
    store,
)
from cellquant.sim.parts import shared

QUARTER_TURN, REST_OF_IT = 0.5 * math.pi, 6.123233995736766e-17
GUESS = 0x5FE6EB50C7B537A9  # bits from which those of 1 / sqrt follow, to 3 %
HEAD = 8  # entries of a record before the modes
BLOCK = 32  # cells worked on together
FLAGS = {"contract", "nsz", "arcp", "reassoc"}
ROUGH = 4e-5  # alternating sum above which the trapezoid rule takes twice the points
POINTS = 32  # of the trapezoid rule, worked on together; even
LEVELS = 5  # 16 max(6, M) - 8 points, doubled at most four times
SLACK = 1e-6  # rounding of single-precision samples, relative to A0


def samples_of(modes: int) -> int:
    """Samples of a contour from which the exact rule starts its search, a multiple of 8."""
    return 8 * max(6, modes)


def record_length(n_modes: int) -> int:
    """Entries of a record, padded so that the modes are read four at a time."""
    return HEAD + (2 * n_modes + QUAD - 1) // QUAD * QUAD


def row_of_samples(size: int) -> int:
    """Entries of a row of `grid`: the samples one and a half times round, and room to read on."""
    return 3 * (size // 2) + 2 * LANES


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
    base = 16 * max(6, modes) - 8
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
def add_points(
    lane: Any, sums: Any, quarter: Any, begin: int, end: int, modes: Any, rays: Any
) -> None:
    """Add at most `POINTS` points of one level, for a tile of cells.

    Rows of `lane`, QUAD apart: A0, Re C, Im C. Rows of `sums`: length, L_0, Re L, Im L and two
    alternating sums. `rays` has room for 8 rows per point.

    Each pass is short, so that operations seldom wait for each other: 1.6 times as fast as one
    loop.
    """
    n_modes = len(modes)
    row = 8 * QUAD
    mean = load(lane, 0)
    for point in range(end - begin):
        q = begin + point
        even_c = mean
        even_s = doubles(0.0)
        even_b = doubles(0.0)
        even_a = doubles(0.0)
        for m in range(0, n_modes, 2):
            re = load(lane, (1 + m) * QUAD)
            im = load(lane, (1 + n_modes + m) * QUAD)
            even_c += re * quarter[q, 4 * m + 1]
            even_s += im * quarter[q, 4 * m + 2]
            even_b += im * quarter[q, 4 * m + 3]
            even_a += re * quarter[q, 4 * m + 4]
        odd_c = doubles(0.0)
        odd_s = doubles(0.0)
        odd_b = doubles(0.0)
        odd_a = doubles(0.0)
        for m in range(1, n_modes, 2):
            re = load(lane, (1 + m) * QUAD)
            im = load(lane, (1 + n_modes + m) * QUAD)
            odd_c += re * quarter[q, 4 * m + 1]
            odd_s += im * quarter[q, 4 * m + 2]
            odd_b += im * quarter[q, 4 * m + 3]
            odd_a += re * quarter[q, 4 * m + 4]
        # Radius, then slope, at phi, -phi, pi + phi, pi - phi.
        at = point * row
        store(rays, at, (even_c + odd_c) - (even_s + odd_s))
        store(rays, at + 2 * QUAD, (even_c + odd_c) + (even_s + odd_s))
        store(rays, at + 4 * QUAD, (even_c - odd_c) - (even_s - odd_s))
        store(rays, at + 6 * QUAD, (even_c - odd_c) + (even_s - odd_s))
        store(rays, at + QUAD, -(even_a + odd_a) - (even_b + odd_b))
        store(rays, at + 3 * QUAD, (even_a + odd_a) - (even_b + odd_b))
        store(rays, at + 5 * QUAD, (odd_a - even_a) - (even_b - odd_b))
        store(rays, at + 7 * QUAD, (even_a - odd_a) - (even_b - odd_b))
    length = load(sums, 0)
    for ray in range(4 * (end - begin)):
        at = 2 * ray * QUAD
        rho = load(rays, at)
        slope = load(rays, at + QUAD)
        square = rho * rho + slope * slope
        # 1 / sqrt: a guess to 3 %, then two steps of order three, to 3e-12.
        inverse = halved_bits(square, GUESS)
        for _ in range(2):
            error = 1.0 - (square * inverse) * inverse
            inverse += (inverse * error) * (0.5 + 0.375 * error)
        inverse *= quarter[begin + ray // 4, 0]
        length += square * inverse
        store(rays, at, rho * inverse)
        store(rays, at + QUAD, slope * inverse)
    store(sums, 0, length)
    sign = 1.0
    constant = load(sums, QUAD)
    wave_u = load(sums, (2 + 2 * n_modes) * QUAD)
    wave_v = load(sums, (3 + 2 * n_modes) * QUAD)
    for point in range(end - begin):
        at = point * row
        u0 = load(rays, at)
        u1 = load(rays, at + 2 * QUAD)
        u2 = load(rays, at + 4 * QUAD)
        u3 = load(rays, at + 6 * QUAD)
        v0 = load(rays, at + QUAD)
        v1 = load(rays, at + 3 * QUAD)
        v2 = load(rays, at + 5 * QUAD)
        v3 = load(rays, at + 7 * QUAD)
        sign = -sign
        even = (u0 + u1) + (u2 + u3)
        skew = (u0 - u1) + (u2 - u3)
        turn = (v0 - v1) + (v2 - v3)
        constant += even
        wave_u += sign * skew
        wave_v += sign * turn
        # What even modes are projected on comes first, then odd ones.
        store(rays, at, even)
        store(rays, at + QUAD, turn)
        store(rays, at + 2 * QUAD, skew)
        store(rays, at + 3 * QUAD, (v0 + v1) + (v2 + v3))
        store(rays, at + 4 * QUAD, (u0 + u1) - (u2 + u3))
        store(rays, at + 5 * QUAD, (v0 - v1) - (v2 - v3))
        store(rays, at + 6 * QUAD, (u0 - u1) - (u2 - u3))
        store(rays, at + 7 * QUAD, (v0 + v1) - (v2 + v3))
    store(sums, QUAD, constant)
    store(sums, (2 + 2 * n_modes) * QUAD, wave_u)
    store(sums, (3 + 2 * n_modes) * QUAD, wave_v)
    for m in range(n_modes):
        re = load(sums, (2 + m) * QUAD)
        im = load(sums, (2 + n_modes + m) * QUAD)
        less = doubles(0.0)
        more = doubles(0.0)
        parity = 4 * QUAD * (m % 2)
        for point in range(end - begin):
            at = point * row + parity
            q = begin + point
            re += load(rays, at) * quarter[q, 4 * m + 1]
            less += load(rays, at + QUAD) * quarter[q, 4 * m + 4]
            im += load(rays, at + 2 * QUAD) * quarter[q, 4 * m + 2]
            more += load(rays, at + 3 * QUAD) * quarter[q, 4 * m + 3]
        store(sums, (2 + m) * QUAD, re - less)
        store(sums, (2 + n_modes + m) * QUAD, im + more)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def fill_lanes(lane: Any, cells: Any, begin: int, count: int, record: Any, modes: Any) -> None:
    """Copy the contours of a tile of cells into lanes; empty lanes repeat the last cell."""
    for r in range(QUAD):
        i = cells[begin + min(r, count - 1)]
        lane[r] = record[i, 2]
        for m in range(2 * len(modes)):
            lane[(1 + m) * QUAD + r] = record[i, HEAD + m]


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def gradient_of_length(
    cells: Any, count: int, lane: Any, sums: Any, record: Any, quarter: Any, starts: Any,
    modes: Any, tangent: Any, rays: Any,
) -> None:  # fmt: skip
    """Length of the contours of some cells and its gradient; reorders `cells`."""
    n_modes = len(modes)
    wave = (2 + 2 * n_modes) * QUAD
    share = 2.0 * math.pi / (4 * starts[1])
    for level in range(LEVELS):
        rough = 0
        for begin in range(0, count, QUAD):
            filled = min(QUAD, count - begin)
            fill_lanes(lane, cells, begin, filled, record, modes)
            sums[:] = 0.0
            for q in range(starts[level], starts[level + 1], POINTS):
                last = min(q + POINTS, starts[level + 1])
                add_points(lane, sums, quarter, q, last, modes, rays)
            for r in range(filled):
                i = cells[begin + r]
                if level == 0:
                    a = sums[wave + r] * share
                    b = sums[wave + QUAD + r] * share
                    for row in range(2 + 2 * n_modes):
                        tangent[i, row] = share * sums[row * QUAD + r]
                    off = a * a + b * b
                else:
                    off = 0.0
                    for row in range(2 + 2 * n_modes):
                        old = tangent[i, row]
                        fresh = share * sums[row * QUAD + r]
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


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def sample(
    i: int, record: Any, compass: Any, modes: Any, grid: Any, pattern: Any, work: Any
) -> tuple[float, float]:
    """Sample contour i in single precision; return the largest and the smallest radius."""
    n_modes = len(modes)
    size = 8 * max(6, n_modes + 1)
    half = size // 2
    long = grid.shape[2]
    for m in range(2 * n_modes):
        value = np.float32(record[i, HEAD + m])
        pattern[i, 1 + m] = value
        pattern[i, 1 + 2 * n_modes + m] = np.float32(m % n_modes + 2) * value
    pattern[i, 0] = np.float32(record[i, 2])
    highest = singles(0.0)
    lowest = singles(np.inf)
    base = i * 3 * long
    for s in range(0, half, LANES):
        even = singles(pattern[i, 0])
        odd = singles(0.0)
        even_slope = singles(0.0)
        odd_slope = singles(0.0)
        for m in range(0, n_modes, 2):
            c = load(compass, (2 * m + 2) * size + s)
            d = load(compass, (2 * m + 3) * size + s)
            even += pattern[i, 1 + m] * c - pattern[i, 1 + n_modes + m] * d
            m_n = 1 + 2 * n_modes + m
            even_slope -= pattern[i, m_n] * d + pattern[i, m_n + n_modes] * c
        for m in range(1, n_modes, 2):
            c = load(compass, (2 * m + 2) * size + s)
            d = load(compass, (2 * m + 3) * size + s)
            odd += pattern[i, 1 + m] * c - pattern[i, 1 + n_modes + m] * d
            m_n = 1 + 2 * n_modes + m
            odd_slope -= pattern[i, m_n] * d + pattern[i, m_n + n_modes] * c
        here = even + odd
        there = even - odd
        highest = greatest(highest, greatest(here, there))
        lowest = least(lowest, least(here, there))
        c = load(compass, s)
        d = load(compass, size + s)
        x = here * c
        y = here * d
        ratio = (even_slope + odd_slope) / here
        store(grid, base + s, x)
        store(grid, base + size + s, x)
        store(grid, base + long + s, y)
        store(grid, base + long + size + s, y)
        store(grid, base + 2 * long + s, ratio)
        store(grid, base + 2 * long + size + s, ratio)
        store(grid, base + half + s, -there * c)
        store(grid, base + long + half + s, -there * d)
        store(grid, base + 2 * long + half + s, (even_slope - odd_slope) / there)
    store(work, 0, highest)
    store(work, LANES, lowest)
    high = work[0]
    low = work[LANES]
    for r in range(1, LANES):
        high = max(high, work[r])
        low = min(low, work[LANES + r])
    return high, low


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def cosine_and_sine(angle: Any) -> tuple[Any, Any]:
    """Cosine and sine of a vector to round-off; NaN where it is not finite."""
    quarter = floor(angle * (2.0 / math.pi) + 0.5)
    x = (angle - quarter * QUARTER_TURN) - quarter * REST_OF_IT
    q = x * x
    s = 1 / 362880 + q * (-1 / 39916800 + q * (1 / 6227020800 + q * (-1 / 1307674368000)))
    s = x + x * q * (-1 / 6 + q * (1 / 120 + q * (-1 / 5040 + q * s)))
    c = 1 / 479001600 + q * (-1 / 87178291200 + q * (1 / 20922789888000))
    c = -1 / 720 + q * (1 / 40320 + q * (-1 / 3628800 + q * c))
    c = 1.0 + q * (-0.5 + q * (1 / 24 + q * c))
    place = quarter - 4.0 * floor(0.25 * quarter)
    odd = (place == 1.0) | (place == 3.0)
    cosine = choose(odd, s, c)
    sine = choose(odd, c, s)
    cosine = choose((place == 1.0) | (place == 2.0), -cosine, cosine)
    return cosine, choose(place >= 2.0, -sine, sine)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def write_records(
    state: Any, radius: Any, begin: int, end: int, modes: Any, record: Any, places: Any,
    columns: Any,
) -> None:  # fmt: skip
    """Records of a tile of cells, with R0 sum n^2 |C_n| / R0 in place of the largest radius.

    A0 is NaN where it is not a number, and so is the lower estimate of rho everywhere.
    """
    n_modes = len(modes)
    n_columns = state.shape[1]
    stride = record.shape[1]
    for r in range(QUAD):
        places[r] = n_columns * min(begin + r, end - 1)
    x, y, theta, _ = gather(state, places, 0, 0)
    raw = (4 + 2 * n_modes) * QUAD
    for m in range(0, 2 * n_modes, 4):
        first = min(3 + m, n_columns - 4)
        v0, v1, v2, v3 = gather(state, places, 0, first)
        at = raw + (first + 1) * QUAD
        store(columns, at, v0)
        store(columns, at + QUAD, v1)
        store(columns, at + 2 * QUAD, v2)
        store(columns, at + 3 * QUAD, v3)
    for r in range(QUAD):
        columns[r] = radius[min(begin + r, end - 1)]
    r0 = load(columns, 0)
    cos_1, sin_1 = cosine_and_sine(theta)
    for m in range(2 * n_modes, 2 * n_modes + 3):
        store(columns, m * QUAD, doubles(0.0))  # the padding of a record
    cos_n = cos_1
    sin_n = sin_1
    power = doubles(0.0)
    bend = doubles(0.0)
    for m in range(n_modes):
        cos_n, sin_n = cos_n * cos_1 - sin_n * sin_1, sin_n * cos_1 + cos_n * sin_1
        a = load(columns, raw + (4 + m) * QUAD)
        b = load(columns, raw + (4 + n_modes + m) * QUAD)
        square = a * a + b * b
        power += square
        bend += (m + 2.0) * (m + 2.0) * root(square)
        store(columns, m * QUAD, r0 * (a * cos_n - b * sin_n))
        store(columns, (n_modes + m) * QUAD, -r0 * (b * cos_n + a * sin_n))
    none = doubles(math.nan)
    fine = (power < 2.0) & (cos_1 * cos_1 < 2.0)
    mean = choose(fine, r0 * root(1.0 - 0.5 * power), none)
    # Lanes beyond the last cell write to the spare rows of the record.
    scatter(record, begin * stride, stride, x, y, mean, r0 * bend)
    scatter(record, begin * stride + 4, stride, none, cos_1, sin_1, r0)
    for m in range(0, 2 * n_modes, 4):
        scatter(
            record, begin * stride + HEAD + m, stride, load(columns, m * QUAD),
            load(columns, (m + 1) * QUAD), load(columns, (m + 2) * QUAD),
            load(columns, (m + 3) * QUAD),
        )  # fmt: skip


@shared(FLAGS)
def contours(part: int, n_parts: int, arrays: Any, modes: Any, tension: Any, torque: Any) -> None:
    """Record every contour and its samples; with tension also the gradient of its length.

    Writes `record`, the samples x, y and slope / rho of `grid` (N, 3, see
    `row_of_samples`) in single precision, relative to the centre, in `pattern` A0, the modes and
    n times the modes in single precision, and in `tangent` the length, L_0, then Re and Im of
    L_n = integral (u + i n v) exp(i n phi), u = rho / |t|, v = slope / |t|. The lower estimate of
    rho is NaN where a0^2 <= 0.
    """
    state, radius, compass, quarter, starts, record, grid, pattern, tangent = arrays
    n_modes = len(modes)
    n_cells = state.shape[0]
    size = compass.shape[1]
    spacing = 2.0 * math.pi / size
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    lane = np.empty(QUAD * (1 + 2 * n_modes))
    sums = np.empty(QUAD * (4 + 2 * n_modes))
    rays = np.empty(8 * QUAD * POINTS)
    extremes = np.empty(2 * LANES, np.float32)
    places = np.empty(QUAD, np.int64)
    columns = np.empty((8 + 4 * n_modes) * QUAD)
    cells = np.empty(BLOCK, np.int64)
    for block in range(part * n_blocks // n_parts, (part + 1) * n_blocks // n_parts):
        end = min(n_cells, (block + 1) * BLOCK)
        for begin in range(block * BLOCK, end, QUAD):
            write_records(state, radius, begin, end, modes, record, places, columns)
        for i in range(block * BLOCK, end):
            mean = record[i, 2]
            bend = record[i, 3]
            if not mean > 0.0:
                continue
            high, low = sample(i, record, compass, modes, grid, pattern, extremes)
            # Between two samples the radius exceeds them by at most spacing^2/8 |rho''|.
            record[i, 3] = high + SLACK * mean + 0.125 * spacing * spacing * bend
            record[i, 4] = low - SLACK * mean
        if len(tension) > 0:
            count = 0
            for i in range(block * BLOCK, min(n_cells, (block + 1) * BLOCK)):
                if record[i, 4] > 0.0:
                    cells[count] = i
                    count += 1
            gradient_of_length(
                cells, count, lane, sums, record, quarter, starts, modes, tangent, rays
            )
