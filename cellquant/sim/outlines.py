"""Contours of all cells: what every contact rule reads, and the gradient of their lengths.

In the frame of the laboratory a contour is rho(phi) = A0 + Re sum_n C_n exp(i n phi), with
C_n = R0 (a_n - i b_n) exp(-i n theta).

Cells are worked on in tiles, one cell per lane of a vector instruction. The trapezoid
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
    doubles_pair,
    greatest,
    halved_bits,
    least,
    load,
    load_pair,
    peek,
    poke,
    root,
    singles,
    store,
    zeros,
)
from cellquant.sim.parts import features_of, shared, taken
from cellquant.sim.records import HEAD, write_records

GUESS = 0x5FE6EB50C7B537A9  # bits from which those of 1 / sqrt follow, to 3 %
BLOCK = 32  # cells worked on together
FLAGS = {"contract", "nsz", "arcp", "reassoc"}
ROUGH = 6e-5  # alternating sum above which the trapezoid rule takes twice the points
POINTS = 32  # of the trapezoid rule, worked on together; even
LEVELS = 5  # 16 max(6, M) - 8 points, doubled at most four times
SLACK = 1e-6  # rounding of single-precision samples, relative to A0


def samples_of(modes: int) -> int:
    """Samples of a contour from which the exact rule starts its search, a multiple of 8."""
    return 8 * max(6, modes)


def row_of_samples(size: int) -> int:
    """Entries of a row of `grid`: the samples one and a half times round, and room to read on."""
    return 3 * (size // 2) + 2 * LANES


def compass(modes: int, size: int) -> tuple[Any, Any]:
    """cos(n phi_s), sin(n phi_s) in rows 2(n - 1), 2(n - 1) + 1, in double and in single."""
    angle = 2.0 * math.pi * np.arange(size) / size
    rows = [f(n * angle) for n in range(1, max(modes, 1) + 1) for f in (np.cos, np.sin)]
    table, single = zeros(len(rows), size), zeros(len(rows), size, kind=np.float32)
    table[:] = single[:] = rows
    return table, single


def rim(size: int) -> Any:
    """Cosine and sine of the directions of a row of `grid`, in single precision."""
    angle = 2.0 * math.pi * np.arange(row_of_samples(size)) / size
    return np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32)


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


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def add_points(
    lane: Any, sums: Any, quarter: Any, begin: int, end: int, modes: Any, rays: Any
) -> None:
    """Add at most `POINTS` points of one level, for a tile of eight cells.

    Rows of `lane`, LANES apart: A0, Re C, Im C. Rows of `sums`: length, L_0, Re L, Im L and two
    alternating sums. `rays` has room for 8 rows per point.

    Each pass is short, so that operations seldom wait for each other: 1.6 times as fast as one
    loop.
    """
    n_modes = len(modes)
    row = 8 * LANES
    long = quarter.shape[1]
    for point in range(end - begin):
        q = (begin + point) * long
        at = point * row
        even_c = load_pair(lane, 0)
        even_s = doubles_pair(0.0)
        odd_c = even_s
        odd_s = even_s
        for m in range(0, n_modes, 2):
            even_c += load_pair(lane, (1 + m) * LANES) * peek(quarter, q + 4 * m + 1)
            even_s += load_pair(lane, (1 + n_modes + m) * LANES) * peek(quarter, q + 4 * m + 2)
        for m in range(1, n_modes, 2):
            odd_c += load_pair(lane, (1 + m) * LANES) * peek(quarter, q + 4 * m + 1)
            odd_s += load_pair(lane, (1 + n_modes + m) * LANES) * peek(quarter, q + 4 * m + 2)
        # Radius at phi, -phi, pi + phi, pi - phi; then the slope there.
        store(rays, at, (even_c + odd_c) - (even_s + odd_s))
        store(rays, at + 2 * LANES, (even_c + odd_c) + (even_s + odd_s))
        store(rays, at + 4 * LANES, (even_c - odd_c) - (even_s - odd_s))
        store(rays, at + 6 * LANES, (even_c - odd_c) + (even_s - odd_s))
        even_b = doubles_pair(0.0)
        even_a = even_b
        odd_b = even_b
        odd_a = even_b
        for m in range(0, n_modes, 2):
            even_b += load_pair(lane, (1 + n_modes + m) * LANES) * peek(quarter, q + 4 * m + 3)
            even_a += load_pair(lane, (1 + m) * LANES) * peek(quarter, q + 4 * m + 4)
        for m in range(1, n_modes, 2):
            odd_b += load_pair(lane, (1 + n_modes + m) * LANES) * peek(quarter, q + 4 * m + 3)
            odd_a += load_pair(lane, (1 + m) * LANES) * peek(quarter, q + 4 * m + 4)
        store(rays, at + LANES, -(even_a + odd_a) - (even_b + odd_b))
        store(rays, at + 3 * LANES, (even_a + odd_a) - (even_b + odd_b))
        store(rays, at + 5 * LANES, (odd_a - even_a) - (even_b - odd_b))
        store(rays, at + 7 * LANES, (even_a - odd_a) - (even_b - odd_b))
    length = load_pair(sums, 0)
    for point in range(end - begin):
        weight = peek(quarter, (begin + point) * long)
        for ray in range(4):
            at = point * row + 2 * ray * LANES
            rho = load_pair(rays, at)
            slope = load_pair(rays, at + LANES)
            square = rho * rho + slope * slope
            if ray % 2 == 1:
                # The unit that divides would idle otherwise.
                inverse = weight / root(square)
            else:
                # 1 / sqrt: a guess to 3 %, then two steps of order three, to 3e-12.
                inverse = halved_bits(square, GUESS)
                for _ in range(2):
                    error = 1.0 - (square * inverse) * inverse
                    inverse += (inverse * error) * (0.5 + 0.375 * error)
                inverse *= weight
            length += square * inverse
            store(rays, at, rho * inverse)
            store(rays, at + LANES, slope * inverse)
    store(sums, 0, length)
    sign = 1.0
    constant = load_pair(sums, LANES)
    wave_u = load_pair(sums, (2 + 2 * n_modes) * LANES)
    wave_v = load_pair(sums, (3 + 2 * n_modes) * LANES)
    for point in range(end - begin):
        at = point * row
        sign = -sign
        # What even modes are projected on comes first, then odd ones.
        u0 = load_pair(rays, at)
        u1 = load_pair(rays, at + 2 * LANES)
        u2 = load_pair(rays, at + 4 * LANES)
        u3 = load_pair(rays, at + 6 * LANES)
        v0 = load_pair(rays, at + LANES)
        v1 = load_pair(rays, at + 3 * LANES)
        v2 = load_pair(rays, at + 5 * LANES)
        v3 = load_pair(rays, at + 7 * LANES)
        even = (u0 + u1) + (u2 + u3)
        skew = (u0 - u1) + (u2 - u3)
        constant += even
        wave_u += sign * skew
        store(rays, at, even)
        store(rays, at + 2 * LANES, skew)
        store(rays, at + 4 * LANES, (u0 + u1) - (u2 + u3))
        store(rays, at + 6 * LANES, (u0 - u1) - (u2 - u3))
        turn = (v0 - v1) + (v2 - v3)
        wave_v += sign * turn
        store(rays, at + LANES, turn)
        store(rays, at + 3 * LANES, (v0 + v1) + (v2 + v3))
        store(rays, at + 5 * LANES, (v0 - v1) - (v2 - v3))
        store(rays, at + 7 * LANES, (v0 + v1) - (v2 + v3))
    store(sums, LANES, constant)
    store(sums, (2 + 2 * n_modes) * LANES, wave_u)
    store(sums, (3 + 2 * n_modes) * LANES, wave_v)
    for m in range(n_modes):
        re = load_pair(sums, (2 + m) * LANES)
        im = load_pair(sums, (2 + n_modes + m) * LANES)
        less = doubles_pair(0.0)
        more = doubles_pair(0.0)
        parity = 4 * LANES * (m % 2)
        for point in range(end - begin):
            at = point * row + parity
            q = (begin + point) * long + 4 * m
            re += load_pair(rays, at) * peek(quarter, q + 1)
            less += load_pair(rays, at + LANES) * peek(quarter, q + 4)
            im += load_pair(rays, at + 2 * LANES) * peek(quarter, q + 2)
            more += load_pair(rays, at + 3 * LANES) * peek(quarter, q + 3)
        store(sums, (2 + m) * LANES, re - less)
        store(sums, (2 + n_modes + m) * LANES, im + more)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def fill_lanes(lane: Any, cells: Any, begin: int, count: int, record: Any, modes: Any) -> None:
    """Copy the contours of a tile of cells into lanes; empty lanes repeat the last cell."""
    stride = record.shape[1]
    for r in range(LANES):
        at = peek(cells, begin + min(r, count - 1)) * stride
        poke(lane, r, peek(record, at + 2))
        for m in range(2 * len(modes)):
            poke(lane, (1 + m) * LANES + r, peek(record, at + HEAD + m))


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def gradient_of_length(
    cells: Any, count: int, lane: Any, sums: Any, record: Any, quarter: Any, starts: Any,
    modes: Any, tangent: Any, rays: Any,
) -> None:  # fmt: skip
    """Length of the contours of some cells and its gradient; reorders `cells`."""
    n_modes = len(modes)
    wave = (2 + 2 * n_modes) * LANES
    stride = tangent.shape[1]
    share = 2.0 * math.pi / (4 * starts[1])
    for level in range(LEVELS):
        rough = 0
        for begin in range(0, count, LANES):
            filled = min(LANES, count - begin)
            fill_lanes(lane, cells, begin, filled, record, modes)
            sums[:] = 0.0
            for q in range(starts[level], starts[level + 1], POINTS):
                last = min(q + POINTS, starts[level + 1])
                add_points(lane, sums, quarter, q, last, modes, rays)
            for r in range(filled):
                i = peek(cells, begin + r)
                at = i * stride
                if level == 0:
                    a = peek(sums, wave + r) * share
                    b = peek(sums, wave + LANES + r) * share
                    for row in range(2 + 2 * n_modes):
                        poke(tangent, at + row, share * peek(sums, row * LANES + r))
                    off = a * a + b * b
                else:
                    off = 0.0
                    for row in range(2 + 2 * n_modes):
                        old = peek(tangent, at + row)
                        fresh = share * peek(sums, row * LANES + r)
                        poke(tangent, at + row, 0.5 * (old + fresh))
                        off = max(off, (old - fresh) * (old - fresh))
                if off > ROUGH * ROUGH:
                    cells[rough] = i
                    rough += 1
        count = rough
        if count == 0:
            break
        if level > 0:
            share *= 0.5


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def sample(
    i: int, record: Any, compass: Any, modes: Any, grid: Any, pattern: Any, work: Any
) -> tuple[float, float]:
    """Sample contour i in single precision; return the largest and the smallest radius."""
    n_modes = len(modes)
    size = 8 * max(6, n_modes + 1)
    half = size // 2
    long = 3 * (size // 2) + 2 * LANES
    for m in range(2 * n_modes):
        value = np.float32(record[i, HEAD + m])
        pattern[i, 1 + m] = value
        pattern[i, 1 + 2 * n_modes + m] = np.float32(m % n_modes + 2) * value
    pattern[i, 0] = np.float32(record[i, 2])
    highest = singles(0.0)
    lowest = singles(np.inf)
    base = i * 2 * long
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
        slope = even_slope + odd_slope
        store(grid, base + s, here)
        store(grid, base + size + s, here)
        store(grid, base + half + s, there)
        store(grid, base + long + s, slope)
        store(grid, base + long + size + s, slope)
        store(grid, base + long + half + s, even_slope - odd_slope)
    store(work, 0, highest)
    store(work, LANES, lowest)
    high = work[0]
    low = work[LANES]
    for r in range(1, LANES):
        high = max(high, work[r])
        low = min(low, work[LANES + r])
    return high, low


@shared(FLAGS)
def contours(part: int, n_parts: int, kept: Any, state: Any, velocity: Any) -> None:
    """Record every contour and its samples; with tension also the gradient of its length.

    Writes `record`, samples of rho and its slope in `grid` (N, 2, see `row_of_samples`) and in
    `pattern` A0, the modes and n times the modes, both in single precision, and in `tangent` the
    length, L_0, then Re and Im of
    L_n = integral (u + i n v) exp(i n phi), u = rho / |t|, v = slope / |t|. The lower estimate of
    rho is NaN where A0 is, see `areas`.
    """
    radius, compass, quarter, starts, record, grid, pattern, tangent = taken(kept)
    modes, tension, _ = features_of(kept)
    n_modes = len(modes)
    n_cells = state.shape[0]
    size = compass.shape[1]
    spacing = 2.0 * math.pi / size
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    lane = np.empty(LANES * (1 + 2 * n_modes))
    sums = np.empty(LANES * (4 + 2 * n_modes))
    rays = np.empty(8 * LANES * POINTS)
    extremes = np.empty(2 * LANES, np.float32)
    places = np.empty(QUAD, np.int64)
    columns = np.empty((8 + 4 * n_modes) * QUAD)
    cells = np.empty(n_cells if len(tension) > 0 else 0, np.int64)
    count = 0
    for block in range(n_blocks):
        if not part * n_blocks <= block * n_parts < (part + 1) * n_blocks:
            continue
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
            for i in range(block * BLOCK, end):
                if record[i, 4] > 0.0:
                    cells[count] = i
                    count += 1
    if len(tension) > 0:
        gradient_of_length(cells, count, lane, sums, record, quarter, starts, modes, tangent, rays)
