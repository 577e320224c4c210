"""Compiled kernels of the deformable-cell layer: neighbour list, contacts, generalised velocities.

Conventions shared by all kernels:

- A state row holds x, y, theta, a_2 .. a_M, b_2 .. b_M of one cell; positions are unwrapped.
- In the frame of the laboratory a contour is rho(phi) = A0 + Re sum_n C_n exp(i n phi), with
  C_n = R0 (a_n - i b_n) exp(-i n theta). A record row holds x, y, A0, the largest rho, then the
  real parts and the imaginary parts of C_2 .. C_M.
- `modes`, `tension` and `torque` are tuples whose *lengths* are compile-time constants: the number
  of modes M - 1, and whether the scene has these terms. What is absent is not compiled.
- An overlap region is bounded by arcs of both contours. Every integral over the arcs is a signed
  sum over the crossings (+1 where the contour of i leaves j, -1 where it enters), so neither the
  number of crossings nor their order matters. On the contour of j the signs are opposite.
- Everything is computed cell by cell or block by block; a block has a fixed number of cells, so
  that results do not depend on the number of threads.
"""

import math
from typing import Any

import numpy as np
from numba import njit, prange

FLAGS = {"contract", "nsz", "arcp"}
REDUCE = {"contract", "nsz", "arcp", "reassoc"}
BLOCK = 32  # cells whose contacts are searched together
LANES = 8  # samples evaluated together
CHUNK = 64  # crossings polished together
ROW = np.uint64(CHUNK)  # unsigned, as every index of a vector loop: a sign would need a branch
HEAD = 4  # entries of a record before the modes
ROOT = 6  # entries of a root: unit vector on i, unit vector on j, rho on i, rho on j
HULL_MARGIN = 1e-4  # of the cubic through two samples, relative to A0
SMOOTH = 3.5  # sum n^2 |C_n| / A0 above which a contour's length takes twice the points
MOST_LOOKS = 400  # closer looks at one pair; only nearly coincident contours need more
OVERFLOW = 1  # more crossings than the buffer holds


@njit(cache=True)
def find_pairs(
    position: Any, reach: Any, box: Any, skin: float, capacity: int
) -> tuple[Any, Any, Any, Any]:
    """List pairs (i, image of j) whose circles of radius `reach` come closer than `skin`.

    Every pair stands once, with i < j, or i == j and a positive image. Images are enumerated, so
    boxes smaller than a cell are right as well.

    Returns
    -------
    first : (N + 1,) start of the pairs of each cell
    other : (pairs,) the cell j
    shift : (pairs, 2) displacement to be added to the unwrapped position of j
    needed : (1,) number of pairs found; larger than `capacity` where the list did not fit
    """
    n_cells = position.shape[0]
    lx, ly = box[0], box[1]
    largest = 0.0
    for i in range(n_cells):
        largest = max(largest, reach[i])
    cutoff = 2.0 * largest + skin
    nx = max(1, min(int(lx / cutoff), 4096))
    ny = max(1, min(int(ly / cutoff), 4096))
    rx = math.ceil(cutoff / (lx / nx))
    ry = math.ceil(cutoff / (ly / ny))
    head = np.full(nx * ny, -1, np.int64)
    link = np.empty(n_cells, np.int64)
    wrap = np.empty((n_cells, 2), np.float64)
    bin_x = np.empty(n_cells, np.int64)
    bin_y = np.empty(n_cells, np.int64)
    for i in range(n_cells - 1, -1, -1):
        wrap[i, 0] = lx * math.floor(position[i, 0] / lx)
        wrap[i, 1] = ly * math.floor(position[i, 1] / ly)
        bin_x[i] = min(nx - 1, int((position[i, 0] - wrap[i, 0]) / lx * nx))
        bin_y[i] = min(ny - 1, int((position[i, 1] - wrap[i, 1]) / ly * ny))
        bin_index = bin_x[i] * ny + bin_y[i]
        link[i] = head[bin_index]
        head[bin_index] = i
    first = np.zeros(n_cells + 1, np.int64)
    other = np.empty(capacity, np.int64)
    shift = np.empty((capacity, 2), np.float64)
    count = 0
    for i in range(n_cells):
        for ox in range(bin_x[i] - rx, bin_x[i] + rx + 1):
            image_x = math.floor(ox / nx)
            for oy in range(bin_y[i] - ry, bin_y[i] + ry + 1):
                image_y = math.floor(oy / ny)
                j = head[int(ox - image_x * nx) * ny + int(oy - image_y * ny)]
                while j >= 0:
                    itself = j == i and (image_x > 0 or (image_x == 0 and image_y > 0))
                    if j > i or itself:
                        sx = image_x * lx + wrap[i, 0] - wrap[j, 0]
                        sy = image_y * ly + wrap[i, 1] - wrap[j, 1]
                        dx = position[j, 0] + sx - position[i, 0]
                        dy = position[j, 1] + sy - position[i, 1]
                        limit = reach[i] + reach[j] + skin
                        if dx * dx + dy * dy < limit * limit:
                            if count < capacity:
                                other[count] = j
                                shift[count, 0] = sx
                                shift[count, 1] = sy
                            count += 1
                    j = link[j]
        first[i + 1] = count
    kept = min(count, capacity)
    needed = np.empty(1, np.int64)
    needed[0] = count
    return first, other[:kept], shift[:kept], needed


@njit(cache=True)
def transpose_pairs(first: Any, other: Any) -> tuple[Any, Any, Any]:
    """Index the pairs by their second cell: start per cell, pair numbers, and first cells."""
    n_cells = first.shape[0] - 1
    start = np.zeros(n_cells + 1, np.int64)
    for p in range(other.shape[0]):
        start[other[p] + 1] += 1
    for i in range(n_cells):
        start[i + 1] += start[i]
    fill = start[:-1].copy()
    pairs = np.empty(other.shape[0], np.int64)
    cells = np.empty(other.shape[0], np.int64)
    for i in range(n_cells):
        for p in range(first[i], first[i + 1]):
            pairs[fill[other[p]]] = p
            cells[fill[other[p]]] = i
            fill[other[p]] += 1
    return start, pairs, cells


@njit(cache=True, parallel=True, fastmath=REDUCE, error_model="numpy")
def contours(
    state: Any,
    radius: Any,
    table: Any,
    modes: Any,
    tension: Any,
    record: Any,
    rho: Any,
    slope: Any,
    tangent: Any,
    lowest: Any,
) -> None:
    """Sample every contour; with tension also project the gradient of its length.

    `table` holds cos(n phi_s) in row 2(n - 1) and sin(n phi_s) in row 2(n - 1) + 1, n = 1 .. M.
    Writes `record`, the samples `rho` and `slope` = d rho / d phi, the smallest sample `lowest`
    (NaN where a0^2 <= 0) and in `tangent` the length, L_0, then Re and Im of
    L_n = integral (u + i n v) exp(i n phi), u = rho / |t|, v = slope / |t|.
    """
    n_cells = state.shape[0]
    size = table.shape[1]
    half = size // 2
    spacing = 2.0 * math.pi / size
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    for block in prange(n_blocks):
        even = np.zeros(half)
        odd = np.zeros(half)
        even_slope = np.zeros(half)
        odd_slope = np.zeros(half)
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
            lowest[i] = low if power < 2.0 else math.nan
            if len(tension) > 0:
                tangent[i, :] = 0.0
                # The length needs more points: those of one or three turned grids as well.
                n_grids = 2 if bend < SMOOTH * mean else 4
                share = spacing / n_grids
                for grid in range(n_grids):
                    turn_c = math.cos(grid * share)
                    turn_s = math.sin(grid * share)
                    length = 0.0
                    constant = 0.0
                    if grid > 0:
                        c_n = turn_c
                        s_n = turn_s
                        for s in range(half):
                            even[s] = 0.0
                            odd[s] = 0.0
                            even_slope[s] = 0.0
                            odd_slope[s] = 0.0
                        for m in range(len(modes)):
                            n = m + 2
                            re = record[i, HEAD + m]
                            im = record[i, HEAD + len(modes) + m]
                            c_n, s_n = c_n * turn_c - s_n * turn_s, s_n * turn_c + c_n * turn_s
                            re, im = re * c_n - im * s_n, re * s_n + im * c_n
                            if n % 2 == 0:
                                for s in range(half):
                                    c = table[2 * m + 2, s]
                                    d = table[2 * m + 3, s]
                                    even[s] += re * c - im * d
                                    even_slope[s] -= n * (re * d + im * c)
                            else:
                                for s in range(half):
                                    c = table[2 * m + 2, s]
                                    d = table[2 * m + 3, s]
                                    odd[s] += re * c - im * d
                                    odd_slope[s] -= n * (re * d + im * c)
                    for s in range(half):
                        r = mean + even[s] + odd[s]
                        dr = even_slope[s] + odd_slope[s]
                        stretch = math.sqrt(r * r + dr * dr)
                        length += stretch
                        u = r / stretch
                        v = dr / stretch
                        r = mean + even[s] - odd[s]
                        dr = even_slope[s] - odd_slope[s]
                        stretch = math.sqrt(r * r + dr * dr)
                        length += stretch
                        u_half = r / stretch
                        v_half = dr / stretch
                        constant += u + u_half
                        # Even modes see the sum of opposite points, odd modes the difference.
                        even[s] = u + u_half
                        odd[s] = u - u_half
                        even_slope[s] = v + v_half
                        odd_slope[s] = v - v_half
                    tangent[i, 0] += share * length
                    tangent[i, 1] += share * constant
                    c_n = turn_c
                    s_n = turn_s
                    for m in range(len(modes)):
                        n = m + 2
                        re = 0.0
                        im = 0.0
                        if n % 2 == 0:
                            for s in range(half):
                                c = table[2 * m + 2, s]
                                d = table[2 * m + 3, s]
                                re += even[s] * c - n * even_slope[s] * d
                                im += even[s] * d + n * even_slope[s] * c
                        else:
                            for s in range(half):
                                c = table[2 * m + 2, s]
                                d = table[2 * m + 3, s]
                                re += odd[s] * c - n * odd_slope[s] * d
                                im += odd[s] * d + n * odd_slope[s] * c
                        c_n, s_n = c_n * turn_c - s_n * turn_s, s_n * turn_c + c_n * turn_s
                        tangent[i, 2 + m] += share * (re * c_n - im * s_n)
                        tangent[i, 2 + len(modes) + m] += share * (re * s_n + im * c_n)


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def acos_bound(x: float) -> float:
    """Arc cosine to 7e-5 (Abramowitz & Stegun 4.4.45); pi below -1, 0 above 1."""
    if x >= 1.0:
        return 0.0
    if x <= -1.0:
        return math.pi
    y = abs(x)
    root = math.sqrt(1.0 - y) * (1.5707288 + y * (-0.2121144 + y * (0.0742610 - 0.0187293 * y)))
    return root if x >= 0.0 else math.pi - root


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def gap(
    record: Any, i: int, j: int, dx: float, dy: float, cosine: float, sine: float, modes: Any
) -> tuple[float, float, float, float, float, float, float]:
    """Depth g of the contour point of i at direction (cosine, sine) inside j, and dg/dphi.

    Also rho and d rho/d phi of i, the distance to the centre of j, and the direction from it.
    """
    top = len(modes) - 1
    pr = record[i, HEAD + top]
    pi = record[i, HEAD + len(modes) + top]
    qr = (top + 2) * pr
    qi = (top + 2) * pi
    for k in range(len(modes) - 1):
        m = top - 1 - k
        cr = record[i, HEAD + m]
        ci = record[i, HEAD + len(modes) + m]
        pr, pi = pr * cosine - pi * sine + cr, pr * sine + pi * cosine + ci
        qr, qi = qr * cosine - qi * sine + (m + 2) * cr, qr * sine + qi * cosine + (m + 2) * ci
    zr = cosine * cosine - sine * sine
    zi = 2.0 * cosine * sine
    rho = record[i, 2] + pr * zr - pi * zi
    slope = -(qr * zi + qi * zr)
    x = rho * cosine - dx
    y = rho * sine - dy
    tx = slope * cosine - rho * sine
    ty = slope * sine + rho * cosine
    inverse = 1.0 / math.sqrt(x * x + y * y)
    ux = x * inverse
    uy = y * inverse
    pr = record[j, HEAD + top]
    pi = record[j, HEAD + len(modes) + top]
    qr = (top + 2) * pr
    qi = (top + 2) * pi
    for k in range(len(modes) - 1):
        m = top - 1 - k
        cr = record[j, HEAD + m]
        ci = record[j, HEAD + len(modes) + m]
        pr, pi = pr * ux - pi * uy + cr, pr * uy + pi * ux + ci
        qr, qi = qr * ux - qi * uy + (m + 2) * cr, qr * uy + qi * ux + (m + 2) * ci
    zr = ux * ux - uy * uy
    zi = 2.0 * ux * uy
    rho_j = record[j, 2] + pr * zr - pi * zi
    slope_j = -(qr * zi + qi * zr)
    distance = (x * x + y * y) * inverse
    depth = rho_j - distance
    change = slope_j * (ux * ty - uy * tx) * inverse - (ux * tx + uy * ty)
    return depth, change, rho, slope, distance, ux, uy


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def turn(cosine: float, sine: float, angle: float) -> tuple[float, float]:
    """Rotate a unit vector by a small angle (|angle| < 0.2), to round-off."""
    q = angle * angle
    s = angle * (
        1.0 + q * (-1 / 6 + q * (1 / 120 + q * (-1 / 5040 + q * (1 / 362880 - q / 39916800))))
    )
    c = 1.0 + q * (
        -0.5 + q * (1 / 24 + q * (-1 / 720 + q * (1 / 40320 + q * (-1 / 3628800 + q / 479001600))))
    )
    return cosine * c - sine * s, sine * c + cosine * s


@njit(cache=True, error_model="numpy")
def variations(g0: float, g1: float, d0: float, d1: float, width: float, margin: float) -> int:
    """Possible zeros of the cubic through two samples with slopes: 0, 1, or 2 for "look closer".

    The zeros of a polynomial are at most the sign changes of its Bernstein coefficients.
    """
    b1 = g0 + d0 * width * (1 / 3)
    b2 = g1 - d1 * width * (1 / 3)
    if (g0 > 0.0) != (g1 > 0.0):
        if abs(b1) < margin and abs(b2) < margin:
            return 2
        up = g0 <= 0.0
        return 2 if ((b1 > 0.0) == up) and ((b2 > 0.0) != up) else 1
    if g0 > 0.0:
        return 2 if min(b1, b2) < margin else 0
    return 2 if max(b1, b2) > -margin else 0


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
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


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def polish(lane: Any, result: Any, count: int, modes: Any) -> None:
    """Two Newton steps on every crossing of a chunk, then its data.

    Row k of `lane` starts at k CHUNK: sample direction (2), displacement to j (2), bracket (2),
    depth at its start (then the angle from the sample), A0 of i and j, depth at its end, slopes
    times width (2), modes of i and j (real, imaginary). Rows of `result`:
    direction on i (2), on j (2), rho on i, on j, size of the next Newton step. One buffer each,
    with constant distances between the rows, is what lets the compiler use vector instructions.
    """
    top = len(modes) - 1
    re_i = np.uint64(12 * CHUNK)
    im_i = np.uint64((12 + len(modes)) * CHUNK)
    re_j = np.uint64((12 + 2 * len(modes)) * CHUNK)
    im_j = np.uint64((12 + 3 * len(modes)) * CHUNK)
    two, three, four, five = (
        np.uint64(2 * CHUNK),
        np.uint64(3 * CHUNK),
        np.uint64(4 * CHUNK),
        np.uint64(5 * CHUNK),
    )
    six, seven, eight = np.uint64(6 * CHUNK), np.uint64(7 * CHUNK), np.uint64(8 * CHUNK)
    nine, ten, eleven = np.uint64(9 * CHUNK), np.uint64(10 * CHUNK), np.uint64(11 * CHUNK)
    for r in range(np.uint64(count)):
        # Zero of the cubic through the samples by Newton steps: from the chord, or, where an
        # extremum lies between the samples, from the end beyond which there is none.
        g0 = lane[six + r]
        e0 = lane[ten + r]
        difference = g0 - lane[nine + r]
        c2 = -3.0 * difference - 2.0 * e0 - lane[eleven + r]
        c3 = 2.0 * difference + e0 + lane[eleven + r]
        t = g0 / difference
        t = 1.0 if e0 * difference > 0.0 else t
        t = 0.0 if lane[eleven + r] * difference > 0.0 else t
        for _ in range(6):
            value = g0 + t * (e0 + t * (c2 + t * c3))
            rate = e0 + t * (2.0 * c2 + 3.0 * t * c3)
            t = t - value / (rate if abs(rate) > 1e-300 else 1e-300)
            t = 1.0 if t > 1.0 else t
            t = 0.0 if t < 0.0 else t
        lane[six + r] = lane[four + r] + t * (lane[five + r] - lane[four + r])
    for step in range(3):
        for r in range(np.uint64(count)):
            angle = lane[six + r]
            q = angle * angle
            sine = angle * (
                1.0
                + q * (-1 / 6 + q * (1 / 120 + q * (-1 / 5040 + q * (1 / 362880 - q / 39916800))))
            )
            cosine = 1.0 + q * (
                -0.5
                + q
                * (1 / 24 + q * (-1 / 720 + q * (1 / 40320 + q * (-1 / 3628800 + q / 479001600))))
            )
            c = lane[r] * cosine - lane[ROW + r] * sine
            s = lane[ROW + r] * cosine + lane[r] * sine
            pr = lane[re_i + np.uint64(top * CHUNK) + r]
            pi = lane[im_i + np.uint64(top * CHUNK) + r]
            qr = (top + 2) * pr
            qi = (top + 2) * pi
            for k in range(len(modes) - 1):
                m = top - 1 - k
                cr = lane[re_i + np.uint64(m * CHUNK) + r]
                ci = lane[im_i + np.uint64(m * CHUNK) + r]
                pr, pi = pr * c - pi * s + cr, pr * s + pi * c + ci
                qr, qi = qr * c - qi * s + (m + 2) * cr, qr * s + qi * c + (m + 2) * ci
            zr = c * c - s * s
            zi = 2.0 * c * s
            rho = lane[seven + r] + pr * zr - pi * zi
            slope = -(qr * zi + qi * zr)
            x = rho * c - lane[two + r]
            y = rho * s - lane[three + r]
            tx = slope * c - rho * s
            ty = slope * s + rho * c
            square = x * x + y * y
            inverse = 1.0 / math.sqrt(square)
            ux = x * inverse
            uy = y * inverse
            pr = lane[re_j + np.uint64(top * CHUNK) + r]
            pi = lane[im_j + np.uint64(top * CHUNK) + r]
            qr = (top + 2) * pr
            qi = (top + 2) * pi
            for k in range(len(modes) - 1):
                m = top - 1 - k
                cr = lane[re_j + np.uint64(m * CHUNK) + r]
                ci = lane[im_j + np.uint64(m * CHUNK) + r]
                pr, pi = pr * ux - pi * uy + cr, pr * uy + pi * ux + ci
                qr, qi = qr * ux - qi * uy + (m + 2) * cr, qr * uy + qi * ux + (m + 2) * ci
            zr = ux * ux - uy * uy
            zi = 2.0 * ux * uy
            distance = square * inverse
            depth = lane[eight + r] + pr * zr - pi * zi - distance
            change = -(qr * zi + qi * zr) * (ux * ty - uy * tx) * inverse - (ux * tx + uy * ty)
            newton = depth / change
            result[r] = c
            result[ROW + r] = s
            result[two + r] = ux
            result[three + r] = uy
            result[four + r] = rho
            result[five + r] = distance
            result[six + r] = abs(newton)
            moved = angle - newton
            high = lane[five + r]
            low = lane[four + r]
            moved = high if moved > high else moved
            moved = low if moved < low else moved
            lane[six + r] = moved if step < 2 else angle


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def finish(
    lane: Any, result: Any, count: int, cells: Any, record: Any, modes: Any,
    sign: Any, roots: Any, base: int,
) -> None:  # fmt: skip
    """Polish a chunk and store it; what these did not settle is bisected."""
    padded = (count + LANES - 1) // LANES * LANES
    for r in range(count, padded):
        for row in range(12 + 4 * len(modes)):
            lane[row * CHUNK + r] = lane[row * CHUNK + count - 1]
    polish(lane, result, padded, modes)
    for r in range(count):
        if not result[6 * CHUNK + r] < 1e-10:
            i = cells[2 * r]
            j = cells[2 * r + 1]
            dx = lane[2 * CHUNK + r]
            dy = lane[3 * CHUNK + r]
            low = lane[4 * CHUNK + r]
            high = lane[5 * CHUNK + r]
            angle = min(high, max(low, lane[6 * CHUNK + r]))
            for _ in range(80):
                ca, sa = turn(lane[r], lane[CHUNK + r], angle)
                g, rate, _, _, _, _, _ = gap(record, i, j, dx, dy, ca, sa, modes)
                if (g > 0.0) == (sign[base + r] > 0.0):
                    low = angle
                else:
                    high = angle
                moved = angle - g / rate if rate != 0.0 else low - 1.0
                if not low < moved < high:
                    moved = 0.5 * (low + high)
                step = abs(moved - angle)
                angle = moved
                if step < 1e-13 or high - low < 1e-15:
                    break
            ca, sa = turn(lane[r], lane[CHUNK + r], angle)
            _, _, rho, _, distance, ux, uy = gap(record, i, j, dx, dy, ca, sa, modes)
            result[r] = ca
            result[CHUNK + r] = sa
            result[2 * CHUNK + r] = ux
            result[3 * CHUNK + r] = uy
            result[4 * CHUNK + r] = rho
            result[5 * CHUNK + r] = distance
        for column in range(ROOT):
            roots[base + r, column] = result[column * CHUNK + r]


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def sample_depth(
    grid: Any, start: int, count: int, record: Any, j: int, dx: float, dy: float, modes: Any,
    sampled: Any,
) -> None:  # fmt: skip
    """Depth inside j, and its derivative, at `count` samples of a contour from `start` on.

    `grid` holds x, y, dx/dphi and dy/dphi of twice round the contour; `sampled` takes the depths
    and the derivatives.
    """
    twice = np.uint64(16 * max(6, len(modes) + 1))
    at_y = np.uint64(start) + twice
    at_tx = at_y + twice
    at_ty = at_tx + twice
    at_x = np.uint64(start)
    top = len(modes) - 1
    for s in range(np.uint64(count)):
        x = grid[at_x + s] - dx
        y = grid[at_y + s] - dy
        tx = grid[at_tx + s]
        ty = grid[at_ty + s]
        q = x * x + y * y
        q = q if q > 1e-300 else 1e-300
        inverse = 1.0 / math.sqrt(q)
        ux = x * inverse
        uy = y * inverse
        pr = record[j, HEAD + top]
        pi = record[j, HEAD + len(modes) + top]
        qr = (top + 2) * pr
        qi = (top + 2) * pi
        for k in range(len(modes) - 1):
            m = top - 1 - k
            cr = record[j, HEAD + m]
            ci = record[j, HEAD + len(modes) + m]
            pr, pi = pr * ux - pi * uy + cr, pr * uy + pi * ux + ci
            qr, qi = qr * ux - qi * uy + (m + 2) * cr, qr * uy + qi * ux + (m + 2) * ci
        zr = ux * ux - uy * uy
        zi = 2.0 * ux * uy
        sampled[s] = record[j, 2] + pr * zr - pi * zi - q * inverse
        sampled[twice + s] = -(qr * zi + qi * zr) * (ux * ty - uy * tx) * inverse - (
            ux * tx + uy * ty
        )


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def find_suspects(sampled: Any, count: int, twice: int, spacing: float, margin: float) -> None:
    """Mark the gaps between samples in which `variations` is not zero, in the third row."""
    slopes = np.uint64(twice)
    marks = np.uint64(2 * twice)
    third = spacing * (1 / 3)
    one = np.uint64(1)
    for s in range(np.uint64(count)):
        g0 = sampled[s]
        g1 = sampled[s + one]
        b1 = g0 + sampled[slopes + s] * third
        b2 = g1 - sampled[slopes + s + one] * third
        low = g0 if g0 < g1 else g1
        high = g0 if g0 > g1 else g1
        inner_low = b1 if b1 < b2 else b2
        inner_high = b1 if b1 > b2 else b2
        inner_low = inner_low - margin
        inner_high = inner_high + margin
        low = low if low < inner_low else inner_low
        high = high if high > inner_high else inner_high
        # All four coefficients on one side of zero, the inner ones by the margin: no crossing.
        sampled[marks + s] = 1.0 if low <= 0.0 and high > 0.0 else 0.0


@njit(cache=True, parallel=True, fastmath=FLAGS, error_model="numpy")
def crossings(
    record: Any,
    lowest: Any,
    rho: Any,
    slope: Any,
    table: Any,
    first: Any,
    other: Any,
    shift: Any,
    modes: Any,
    roots: Any,
    root_first: Any,
    root_last: Any,
    sign: Any,
    inside: Any,
    fault: Any,
) -> None:
    """Find where the contours of every listed pair cross.

    The depth of i's contour inside j is sampled on the facing part only. The cubic through two
    neighbouring samples shows whether there is no crossing between them, one, or a reason to look
    closer (a grazing contact); crossings are then polished by Newton steps, many at once.
    """
    n_cells = record.shape[0]
    size = 8 * max(6, len(modes) + 1)
    twice = 2 * size
    spacing = 2.0 * math.pi / size
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    room = roots.shape[0] // n_blocks
    for block in prange(n_blocks):
        base = block * room
        grid = np.empty(4 * twice)
        sampled = np.empty(3 * twice)
        stack = np.empty((40, 6))
        lane = np.empty((12 + 4 * len(modes)) * CHUNK)
        result = np.empty(7 * CHUNK)
        cells = np.empty(2 * CHUNK, np.int64)
        count = 0
        done = 0
        for i in range(block * BLOCK, min(n_cells, (block + 1) * BLOCK)):
            at_y, at_tx, at_ty = np.uint64(twice), np.uint64(2 * twice), np.uint64(3 * twice)
            for s in range(np.uint64(size)):
                c = table[0, s]
                d = table[1, s]
                r = rho[i, s]
                dr = slope[i, s]
                grid[s] = r * c
                grid[at_y + s] = r * d
                grid[at_tx + s] = dr * c - r * d
                grid[at_ty + s] = dr * d + r * c
            for row in range(4):
                begin = row * twice
                grid[begin + size : begin + twice] = grid[begin : begin + size]
            x_i = record[i, 0]
            y_i = record[i, 1]
            high_i = record[i, 3]
            for p in range(first[i], first[i + 1]):
                root_first[p] = base + count
                root_last[p] = base + count
                inside[p] = 0
                j = other[p]
                dx = record[j, 0] + shift[p, 0] - x_i
                dy = record[j, 1] + shift[p, 1] - y_i
                square = dx * dx + dy * dy
                high_j = record[j, 3]
                if square >= (high_i + high_j) * (high_i + high_j):
                    continue
                distance = math.sqrt(square)
                centre, width = facing(dx, dy, distance, lowest[i], high_i, high_j, spacing)
                n_samples = int((width + 2.5 + LANES) / LANES) * LANES
                start = 0
                whole = n_samples >= size
                if whole:
                    n_samples = size
                else:
                    start = math.floor(centre - 0.5 * (n_samples - 1) + 0.5)
                    start = (start + 2 * size) % size
                sample_depth(grid, start, n_samples, record, j, dx, dy, modes, sampled)
                mean_j = record[j, 2]
                if whole:
                    sampled[size] = sampled[0]
                    sampled[twice + size] = sampled[twice]
                    n_samples = size + 1
                    largest = 0.0
                    for s in range(size):
                        largest = max(largest, abs(sampled[s]))
                    if largest < 1e-12 * mean_j:
                        inside[p] = 1  # the same contour twice: i counts as inside j
                        continue
                margin = HULL_MARGIN * mean_j
                looks = 0
                find_suspects(sampled, n_samples - 1, twice, spacing, margin)
                for index in range(n_samples - 1):
                    if sampled[2 * twice + index] == 0.0:
                        continue
                    g0 = sampled[index]
                    g1 = sampled[index + 1]
                    d0 = sampled[twice + index]
                    d1 = sampled[twice + index + 1]
                    s = start + index
                    s = s - size if s >= size else s
                    stack[0, 0] = 0.0
                    stack[0, 1] = spacing
                    stack[0, 2] = g0
                    stack[0, 3] = g1
                    stack[0, 4] = d0
                    stack[0, 5] = d1
                    height = 1
                    while height > 0:
                        height -= 1
                        left = stack[height, 0]
                        width = stack[height, 1]
                        g0 = stack[height, 2]
                        g1 = stack[height, 3]
                        d0 = stack[height, 4]
                        d1 = stack[height, 5]
                        fraction = width / spacing
                        finer = margin * fraction * fraction * fraction * fraction
                        kind = variations(g0, g1, d0, d1, width, finer)
                        if kind == 2 and width > 1e-9 and looks < MOST_LOOKS:
                            looks += 1
                            width *= 0.5
                            ca, sa = turn(table[0, s], table[1, s], left + width)
                            gm, dm, _, _, _, _, _ = gap(record, i, j, dx, dy, ca, sa, modes)
                            # The left half lies on top, so that crossings come in order.
                            stack[height, 0] = left + width
                            stack[height, 1] = width
                            stack[height, 2] = gm
                            stack[height, 3] = g1
                            stack[height, 4] = dm
                            stack[height, 5] = d1
                            height += 1
                            stack[height, 0] = left
                            stack[height, 1] = width
                            stack[height, 2] = g0
                            stack[height, 3] = gm
                            stack[height, 4] = d0
                            stack[height, 5] = dm
                            height += 1
                        elif (g0 > 0.0) != (g1 > 0.0):
                            if count == room:
                                fault[block] = OVERFLOW
                                break
                            r = count - done
                            lane[r] = table[0, s]
                            lane[CHUNK + r] = table[1, s]
                            lane[2 * CHUNK + r] = dx
                            lane[3 * CHUNK + r] = dy
                            lane[4 * CHUNK + r] = left
                            lane[5 * CHUNK + r] = left + width
                            lane[6 * CHUNK + r] = g0
                            lane[7 * CHUNK + r] = record[i, 2]
                            lane[8 * CHUNK + r] = mean_j
                            lane[9 * CHUNK + r] = g1
                            lane[10 * CHUNK + r] = d0 * width
                            lane[11 * CHUNK + r] = d1 * width
                            for m in range(2 * len(modes)):
                                lane[(12 + m) * CHUNK + r] = record[i, HEAD + m]
                                lane[(12 + 2 * len(modes) + m) * CHUNK + r] = record[j, HEAD + m]
                            cells[2 * r] = i
                            cells[2 * r + 1] = j
                            sign[base + count] = 1.0 if g0 > 0.0 else -1.0
                            count += 1
                            if count - done == CHUNK:
                                finish(
                                    lane, result, CHUNK, cells, record, modes, sign, roots,
                                    base + done,
                                )  # fmt: skip
                                done = count
                if count == root_first[p] - base:
                    if whole and sampled[0] > 0.0:
                        inside[p] = 1
                    elif distance + lowest[j] < high_i:
                        g, _, _, _, _, _, _ = gap(record, j, i, -dx, -dy, 1.0, 0.0, modes)
                        if g > 0.0:
                            inside[p] = 2
                root_last[p] = base + count
        if count > done:
            finish(lane, result, count - done, cells, record, modes, sign, roots, base + done)


@njit(cache=True, fastmath=REDUCE, error_model="numpy")
def add_powers(side: Any, filled: int, wr: Any, wi: Any) -> None:
    """Add sign exp(i n phi) / i of every crossing to the sums of n = 1, 2, ...

    Rows of `side`, CHUNK apart: sign, cosine and sine of phi, then room for the powers.
    """
    padded = (filled + LANES - 1) // LANES * LANES
    for r in range(filled, padded):
        side[r] = 0.0
        side[CHUNK + r] = 1.0
        side[2 * CHUNK + r] = 0.0
    two, three, four = np.uint64(2 * CHUNK), np.uint64(3 * CHUNK), np.uint64(4 * CHUNK)
    for r in range(np.uint64(padded)):
        side[three + r] = side[r] * side[ROW + r]
        side[four + r] = side[r] * side[two + r]
    for n in range(1, wr.shape[0]):
        re = 0.0
        im = 0.0
        for r in range(np.uint64(padded)):
            c = side[three + r]
            s = side[four + r]
            re += s
            im -= c
            side[three + r] = c * side[ROW + r] - s * side[two + r]
            side[four + r] = s * side[ROW + r] + c * side[two + r]
        wr[n] += re
        wi[n] += im


@njit(cache=True, parallel=True, fastmath=REDUCE, error_model="numpy")
def exact_velocity(
    state: Any,
    radius: Any,
    record: Any,
    tangent: Any,
    first: Any,
    other: Any,
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

    `numbers` holds v0, k, eta, mu_r, mu_theta, mu_ab. With W_k = integral over the arcs of
    exp(i k phi), the shape forces are a convolution of W with the modes.
    """
    v0, k, eta = numbers[0], numbers[1], numbers[2]
    mu_r, mu_theta, mu_ab = numbers[3], numbers[4], numbers[5]
    n_cells = state.shape[0]
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    n_powers = 2 * len(modes) + 3
    for block in prange(n_blocks):
        wr = np.empty(n_powers)
        wi = np.empty(n_powers)
        side = np.empty(5 * CHUNK)
        for i in range(block * BLOCK, min(n_cells, (block + 1) * BLOCK)):
            for m in range(n_powers):
                wr[m] = 0.0
                wi[m] = 0.0
            fx = 0.0
            fy = 0.0
            spin = 0.0
            lens = 0.0
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
                    wr[0] += 2.0 * math.pi
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
                        lens -= (
                            0.5 * s * distance * roots[r, 5] * (c1 * roots[r, 3] - s1 * roots[r, 2])
                        )
                    else:
                        s = -sign[r]
                        c1 = roots[r, 2]
                        s1 = roots[r, 3]
                        distance = roots[r, 5]
                    fx += s * distance * s1
                    fy -= s * distance * c1
                    spin += 0.5 * s * distance * distance
                    arc_r, arc_i = arc_r * c1 - s * arc_i * s1, arc_i * c1 + s * arc_r * s1
                    side[filled] = s
                    side[CHUNK + filled] = c1
                    side[2 * CHUNK + filled] = s1
                    filled += 1
                    if filled == CHUNK:
                        add_powers(side, filled, wr, wi)
                        filled = 0
                if arc_r > 0.0 and arc_i >= 0.0:
                    # Short arcs are turned together; their sum is below pi until it is taken.
                    arcs_r, arcs_i = (
                        arcs_r * arc_r - arcs_i * arc_i,
                        arcs_r * arc_i + arcs_i * arc_r,
                    )
                    if arcs_r <= 0.0:
                        wr[0] += math.atan2(arcs_i, arcs_r)
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
                        if own:
                            g, _, _, _, _, _, _ = gap(
                                record, i, other[p], dx, dy, -roots[r, 0], -roots[r, 1], modes
                            )
                        else:
                            j = back_cell[back_first[i] + entry - n_own]
                            g, _, _, _, _, _, _ = gap(
                                record, i, j, -dx, -dy, -roots[r, 2], -roots[r, 3], modes
                            )
                        if g <= 0.0:
                            angle = 0.0
                wr[0] += angle
            wr[0] += math.atan2(arcs_i, arcs_r)
            if filled > 0:
                add_powers(side, filled, wr, wi)
            # W_n = (exp(i n phi_out) - exp(i n phi_in)) / (i n), summed above without 1/n.
            for n in range(1, n_powers):
                wr[n] /= n
                wi[n] /= n
            mean = record[i, 2]
            j0 = mean * wr[0]
            for m in range(len(modes)):
                j0 += record[i, HEAD + m] * wr[m + 2] - record[i, HEAD + len(modes) + m] * wi[m + 2]
            area = mean * j0
            cos_1 = math.cos(state[i, 2])
            sin_1 = math.sin(state[i, 2])
            constant = k * j0
            bound = 0.0
            if len(tension) > 0:
                constant += eta * tangent[i, 1]
                bound = eta * tangent[i, 0]
            a0 = mean / radius[i]
            scale = mu_ab * radius[i]
            cos_n = cos_1
            sin_n = sin_1
            for m in range(len(modes)):
                n = m + 2
                cos_n, sin_n = cos_n * cos_1 - sin_n * sin_1, sin_n * cos_1 + cos_n * sin_1
                jr = mean * wr[n]
                ji = mean * wi[n]
                for q in range(len(modes)):
                    cr = 0.5 * record[i, HEAD + q]
                    ci = 0.5 * record[i, HEAD + len(modes) + q]
                    up = n + q + 2
                    jr += cr * wr[up] - ci * wi[up]
                    ji += cr * wi[up] + ci * wr[up]
                    if q <= m:
                        jr += cr * wr[m - q] + ci * wi[m - q]
                        ji += cr * wi[m - q] - ci * wr[m - q]
                    else:
                        jr += cr * wr[q - m] - ci * wi[q - m]
                        ji -= cr * wi[q - m] + ci * wr[q - m]
                area += record[i, HEAD + m] * jr - record[i, HEAD + len(modes) + m] * ji
                jr *= k
                ji *= k
                if len(tension) > 0:
                    jr += eta * tangent[i, 2 + m]
                    ji += eta * tangent[i, 2 + len(modes) + m]
                a = state[i, 3 + m]
                b = state[i, 3 + len(modes) + m]
                pull = 0.5 * constant / a0
                velocity[i, 3 + m] = -scale * (jr * cos_n + ji * sin_n - a * pull)
                velocity[i, 3 + len(modes) + m] = -scale * (ji * cos_n - jr * sin_n - b * pull)
            velocity[i, 0] = v0 * cos_1 - mu_r * k * fx
            velocity[i, 1] = v0 * sin_1 - mu_r * k * fy
            if len(torque) > 0:
                velocity[i, 2] = mu_theta * k * spin
            else:
                velocity[i, 2] = 0.0
            energy[i] = bound + k * (0.5 * area + lens)


@njit(cache=True, parallel=True, fastmath=REDUCE, error_model="numpy")
def quadrature_velocity(
    state: Any,
    radius: Any,
    record: Any,
    lowest: Any,
    rho: Any,
    slope: Any,
    table: Any,
    first: Any,
    other: Any,
    shift: Any,
    back_first: Any,
    back_pair: Any,
    back_cell: Any,
    numbers: Any,
    modes: Any,
    tension: Any,
    torque: Any,
    velocity: Any,
) -> None:
    """Generalised velocity by the published rule: sums over the contour points inside a neighbour.

    The points stand at fixed directions phi_s = 2 pi s / K. Only how many neighbours hold a point
    matters, so the neighbours are counted first and every sum is taken once.
    """
    v0, k, eta = numbers[0], numbers[1], numbers[2]
    mu_r, mu_theta, mu_ab = numbers[3], numbers[4], numbers[5]
    n_cells = state.shape[0]
    size = table.shape[1]
    spacing = 2.0 * math.pi / size
    half = size // 2
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    for block in prange(n_blocks):
        held = np.empty(2 * size)
        grid_x = np.empty(2 * size)
        grid_y = np.empty(2 * size)
        u = np.empty(size)
        v = np.empty(size)
        even = np.empty(half)
        odd = np.empty(half)
        even_slope = np.empty(half)
        odd_slope = np.empty(half)
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
                centre, width = facing(dx, dy, distance, lowest[i], high_i, high_j, spacing)
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
            cos_1 = math.cos(state[i, 2])
            sin_1 = math.sin(state[i, 2])
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


@njit(cache=True, parallel=True, fastmath=REDUCE, error_model="numpy")
def rigid_velocity(
    state: Any,
    radius: Any,
    first: Any,
    other: Any,
    shift: Any,
    back_first: Any,
    back_pair: Any,
    back_cell: Any,
    numbers: Any,
    velocity: Any,
    energy: Any,
) -> None:
    """Velocity and energy of rigid discs: the overlap of two circles is known in closed form."""
    v0, k, eta, mu_r = numbers[0], numbers[1], numbers[2], numbers[3]
    for i in prange(state.shape[0]):
        fx = 0.0
        fy = 0.0
        area = 0.0
        n_own = first[i + 1] - first[i]
        n_all = n_own + back_first[i + 1] - back_first[i]
        for entry in range(n_all):
            if entry < n_own:
                p = first[i] + entry
                j = other[p]
                side = 1.0
            else:
                p = back_pair[back_first[i] + entry - n_own]
                j = back_cell[back_first[i] + entry - n_own]
                side = -1.0
            dx = state[j, 0] + side * shift[p, 0] - state[i, 0]
            dy = state[j, 1] + side * shift[p, 1] - state[i, 1]
            square = dx * dx + dy * dy
            ri = radius[i]
            rj = radius[j]
            if square >= (ri + rj) * (ri + rj):
                continue
            if square <= (ri - rj) * (ri - rj):
                area += 0.5 * math.pi * min(ri, rj) ** 2
                continue
            distance = math.sqrt(square)
            along = 0.5 * (square + ri * ri - rj * rj) / distance
            chord = 2.0 * math.sqrt(max(0.0, ri * ri - along * along))
            fx += chord * dx / distance
            fy += chord * dy / distance
            angle_i = math.acos(max(-1.0, min(1.0, along / ri)))
            angle_j = math.acos(max(-1.0, min(1.0, (distance - along) / rj)))
            area += 0.5 * (ri * ri * angle_i + rj * rj * angle_j - 0.5 * distance * chord)
        velocity[i, 0] = v0 * math.cos(state[i, 2]) - mu_r * k * fx
        velocity[i, 1] = v0 * math.sin(state[i, 2]) - mu_r * k * fy
        velocity[i, 2] = 0.0
        energy[i] = k * area + 2.0 * math.pi * eta * radius[i]


@njit(cache=True)
def inspect(record: Any, lowest: Any, reference: Any) -> tuple[float, int, float]:
    """How far the neighbour list has aged, the first faulty cell, and the smallest radius.

    The age is the largest sum of displacement and growth of the reach since the list was made.
    The cell is -1 where every number is finite. The smallest radius is that of the sharpest waist
    in units of its A0.
    """
    age = 0.0
    fault = -1
    narrowest = 1.0
    for i in range(record.shape[0]):
        if not math.isfinite(lowest[i] + record[i, 0] + record[i, 1] + record[i, 3]):
            fault = i
            break
        dx = record[i, 0] - reference[i, 0]
        dy = record[i, 1] - reference[i, 1]
        age = max(age, math.sqrt(dx * dx + dy * dy) + record[i, 3] - reference[i, 2])
        narrowest = min(narrowest, lowest[i] / record[i, 2])
    return age, fault, narrowest
