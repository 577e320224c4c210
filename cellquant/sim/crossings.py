"""Where the contours of neighbouring cells cross: the root search of the exact contact rule.

The depth g of i's contour inside j is sampled in single precision on the part of the contour that
faces j. The cubic through two neighbouring samples and their slopes shows how often the contours
cross between them, and where, to about 1e-5. One evaluation in double precision then gives the
crossing to round-off. What single precision or the cubic cannot settle is left to `grazes`.

An overlap region is bounded by arcs of both contours. Every integral over the arcs is a signed sum
over the crossings (+1 where the contour of i leaves j, -1 where it enters), so neither the number
of crossings nor their order matters.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from cellquant.sim.grazes import FLAGS, HULL_MARGIN, gap, search_closely, settle
from cellquant.sim.lanes import (
    LANES,
    absolute,
    bits,
    ceiling,
    choose,
    floor,
    gather_pair,
    greatest,
    least,
    load,
    load_pair,
    root,
    rough_root,
    scatter,
    singles,
    singles_pair,
    store,
    trailing_zeros,
    widen_pair,
)
from cellquant.sim.outlines import BLOCK, HEAD
from cellquant.sim.parts import shared

ROOT = 8  # columns of a root: unit vectors on i and on j, rho on i and on j, error, angle
PAIRS = 32  # pairs whose contours are sampled before the gaps between samples are judged
MANY = 12  # gaps of one pair that may hold a crossing; with more it is searched in double precision
LISTED = PAIRS * 4 * MANY + 4 * LANES  # gaps, second crossings, and what to polish again
FINE_MARGIN = 1e-5  # of the interpolation through four samples, single precision included
NARROW = 0.1  # smallest radius over A0 for which single precision is trusted
SETTLED = 2e-9  # error of an angle that needs no further steps
OVERFLOW = 1  # more crossings than the buffer holds
TWO, UNSURE = 2, 3  # crossings in a gap
TINY = 1e-30
SLACK = 0.05  # of a gap: an extremum just beyond its end counts as within
BEYOND = 1e-3  # of a gap: how far from it a crossing may be found
CLOSELY, OUTSIDE, INSIDE = -1, -2, -3  # what a pair without gaps is


def work(n_parts: int) -> tuple[Any, Any, Any]:
    """Work arrays too large to be made anew at every call."""
    return (
        np.zeros((n_parts, 4, LISTED), np.int64),
        np.zeros((n_parts, 4, LISTED), np.float32),
        np.zeros((n_parts, LISTED, ROOT)),
    )


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def arc_cosine(x: Any) -> Any:
    """Arc cosine to 7e-5 (Abramowitz & Stegun 4.4.45); of numbers outside of [-1, 1] its ends."""
    y = least(absolute(x), 1.0)
    half = root(1.0 - y) * (1.5707288 + y * (-0.2121144 + y * (0.0742610 + y * -0.0187293)))
    return choose(x >= 0.0, half, math.pi - half)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
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


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def sample_pairs(
    grid: Any, pattern: Any, owner: Any, other: Any, near: Any, starts: Any, counts: Any,
    filled: int, modes: Any, depth: Any, change: Any,
) -> None:  # fmt: skip
    """Sample the depth of i in j for many pairs.

    Row k of `depth`, and of `change` for its slope times the width of a gap, belongs to pair k and
    holds its first sample in column LANES.
    """
    n_modes = len(modes)
    top = n_modes - 1
    size = 8 * max(6, n_modes + 1)
    long = grid.shape[2]
    room = size + 5 * LANES
    width = np.float32(2.0 * math.pi / size)
    for pair in range(filled):
        count = int(counts[pair])
        j = other[pair]
        at = owner[pair] * 3 * long + int(starts[pair])
        row = pair * room + LANES
        x_j = near[pair]
        y_j = near[PAIRS + pair]
        for s in range(0, count, 2 * LANES):
            gx = load_pair(grid, at + s)
            gy = load_pair(grid, at + long + s)
            x = gx - x_j
            y = gy - y_j
            square = greatest(x * x + y * y, TINY)
            inverse = rough_root(square)
            ux = x * inverse
            uy = y * inverse
            pr = singles_pair(pattern[j, 1 + top])
            pi = singles_pair(pattern[j, 1 + n_modes + top])
            qr = singles_pair(pattern[j, 1 + 2 * n_modes + top])
            qi = singles_pair(pattern[j, 1 + 3 * n_modes + top])
            for k in range(1, n_modes):
                m = 1 + top - k
                pr, pi = (
                    pr * ux - pi * uy + pattern[j, m],
                    pr * uy + pi * ux + pattern[j, n_modes + m],
                )
                qr, qi = (
                    qr * ux - qi * uy + pattern[j, 2 * n_modes + m],
                    qr * uy + qi * ux + pattern[j, 3 * n_modes + m],
                )
            zr = ux * ux - uy * uy
            zi = 2.0 * ux * uy
            store(depth, row + s, pattern[j, 0] + pr * zr - pi * zi - square * inverse)
            slope = (qr * zi + qi * zr) * inverse
            ratio = load_pair(grid, at + 2 * long + s)
            tx = ratio * gx - gy
            ty = ratio * gy + gx
            along = slope * (uy * tx - ux * ty) - (ux * tx + uy * ty)
            store(change, row + s, width * along)
        if count > size:
            depth[row - 1] = depth[row + size - 1]
            change[row - 1] = change[row + size - 1]


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def list_gaps(
    pattern: Any, owner: Any, other: Any, starts: Any, counts: Any, filled: int, size: int,
    stride: int, depth: Any, change: Any, place: Any, weight: Any, mean: Any, rows: Any,
    codes: Any,
) -> int:  # fmt: skip
    """List the gaps between samples that may hold a crossing; return their number.

    Of each gap `place` takes the index of the sample before it, `weight` 0 where there is no
    sample before or after the gap (else 1/4), and `mean` the A0 of j; for `rows` see `polish`.
    `codes` takes CLOSELY where a pair must be searched in double precision (also where that is
    given), or else OUTSIDE where the first sample lies outside of j and INSIDE where it does not.
    """
    room = size + 5 * LANES
    base = 0
    for pair in range(filled):
        count = int(counts[pair])
        if count == 0 or codes[pair] == CLOSELY:
            continue
        row = pair * room + LANES
        a0 = pattern[other[pair], 0]
        margin = np.float32(HULL_MARGIN) * a0
        codes[pair] = INSIDE if depth[row] > 0.0 else OUTSIDE
        whole = count > size
        last = count - 1
        first = base
        begin = int(starts[pair])
        own = stride * owner[pair]
        facing = stride * other[pair]
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
            while word != np.uint64(0):
                t = s + trailing_zeros(word)
                word &= word - np.uint64(1)
                if base - first == MANY:
                    codes[pair] = CLOSELY
                    base = first
                    break
                edge = not whole and (t == 0 or t + 2 >= count)
                place[base] = row + t
                weight[base] = 0.0 if edge else 0.25
                mean[base] = a0
                at = begin + t
                rows[0, base] = 4 * (at - size if at >= size else at)
                rows[1, base] = 4 * pair
                rows[2, base] = own
                rows[3, base] = facing
                base += 1
            if codes[pair] == CLOSELY:
                break
    return base


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def full_step(
    t: Any, low: Any, high: Any, g0: Any, e0: Any, c2: Any, c3: Any,
    q0: Any, q1: Any, q2: Any, q3: Any,
) -> Any:  # fmt: skip
    """One Newton step on the polynomial of degree 7, from within the piece."""
    t = greatest(least(t, high), low)
    u = t + 1.0
    w = t * (t - 1.0)
    q = q0 + u * (q1 + u * (q2 + u * q3))
    value = g0 + t * (e0 + t * (c2 + t * c3)) + w * w * q
    rate = e0 + t * (2.0 * c2 + 3.0 * t * c3)
    rate += w * ((4.0 * t - 2.0) * q + w * (q1 + u * (2.0 * q2 + 3.0 * u * q3)))
    return t - value / nonzero(rate)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def nonzero(x: Any) -> Any:
    """What a division survives."""
    return choose(absolute(x) > TINY, x, TINY)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def judge_gaps(
    depth: Any, change: Any, place: Any, weight: Any, mean: Any, begin: int, end: int,
    second: bool, spacing: float, kind: Any, hints: Any,
) -> None:  # fmt: skip
    """How often the depth crosses zero in every gap, and where (see `polish` for `hints`).

    With the samples beyond both ends the interpolation is of degree 7: the cubic p(t) through the
    ends plus t^2 (t - 1)^2 q(t), q cubic. The crossing is the first one in the gap, or the second
    one where that is asked for.
    """
    room = hints.shape[1]
    for g in range(begin, end, 2 * LANES):
        before, g0, g1, after = gather_pair(depth, place, g, -1)
        e_before, e0, e1, e_after = gather_pair(change, place, g, -1)
        share = load_pair(weight, g)
        a0 = load_pair(mean, g)
        difference = g1 - g0
        c2 = 3.0 * difference - 2.0 * e0 - e1
        c3 = e0 + e1 - 2.0 * difference
        # What the cubic misses before and after gives q and q' at -1 and 2; q at u = t + 1.
        miss = before - (g0 - e0 + c2 - c3)
        tilt = e_before - (e0 - 2.0 * c2 + 3.0 * c3)
        miss_2 = after - (g0 + 2.0 * e0 + 4.0 * c2 + 8.0 * c3)
        tilt_2 = e_after - (e0 + 4.0 * c2 + 12.0 * c3)
        q0 = share * miss
        q1 = share * (tilt + 3.0 * miss)
        rise = (share * miss_2 - q0) * (1.0 / 3.0)
        end = share * (tilt_2 - 3.0 * miss_2)
        q2 = (3.0 * rise - 2.0 * q1 - end) * (1.0 / 3.0)
        q3 = (q1 + end - 2.0 * rise) * (1.0 / 9.0)
        flat = HULL_MARGIN * a0
        margin = choose(share > 0.0, FINE_MARGIN * a0, flat)
        # Extrema of the cubic, put on the ends where they lie outside.
        square = c2 * c2 - 3.0 * c3 * e0
        spread = root(greatest(square, 0.0))
        total = -(c2 + choose(c2 > 0.0, spread, -spread))
        ta = choose(square > 0.0, total / nonzero(3.0 * c3), singles_pair(-1.0))
        tb = choose(square > 0.0, e0 / nonzero(total), singles_pair(-1.0))
        t1 = least(ta, tb)
        t2 = greatest(ta, tb)
        near_1 = (t1 > -SLACK) & (t1 < 1.0 + SLACK)
        near_2 = (t2 > -SLACK) & (t2 < 1.0 + SLACK)
        t1 = least(greatest(t1, 0.0), 1.0)
        t2 = least(greatest(t2, 0.0), 1.0)
        u = t1 + 1.0
        w = t1 * (t1 - 1.0)
        p1 = g0 + t1 * (e0 + t1 * (c2 + t1 * c3)) + w * w * (q0 + u * (q1 + u * (q2 + u * q3)))
        u = t2 + 1.0
        w = t2 * (t2 - 1.0)
        p2 = g0 + t2 * (e0 + t2 * (c2 + t2 * c3)) + w * w * (q0 + u * (q1 + u * (q2 + u * q3)))
        p1 = choose(t1 > 0.0, choose(t1 < 1.0, p1, g1), g0)
        p2 = choose(t2 > 0.0, choose(t2 < 1.0, p2, g1), g0)
        change_1 = (g0 > 0.0) != (p1 > 0.0)
        change_2 = (p1 > 0.0) != (p2 > 0.0)
        change_3 = (p2 > 0.0) != (g1 > 0.0)
        if not second:
            close = (near_1 & (absolute(p1) < margin)) | (near_2 & (absolute(p2) < margin))
            b1 = absolute(g0 + e0 * (1.0 / 3.0))
            b2 = absolute(g1 - e1 * (1.0 / 3.0))
            unsure = close | ((b1 < flat) & (b2 < flat)) | (change_1 & change_2 & change_3)
            number = choose(change_1, singles_pair(1.0), singles_pair(0.0))
            number += choose(change_2, singles_pair(1.0), singles_pair(0.0))
            number += choose(change_3, singles_pair(1.0), singles_pair(0.0))
            number = choose(unsure, singles_pair(UNSURE), number)
            store(kind, g, number)
            # The first piece between extrema that crosses zero, or else the last one.
            low = choose(change_1, singles_pair(0.0), choose(change_2, t1, t2))
            high = choose(change_1, t1, choose(change_2, t2, singles_pair(1.0)))
            end_of_it = choose(number == TWO, choose(change_1, t1, t2), singles_pair(1.0 + BEYOND))
            store(hints, 2 * room + g, singles_pair(-BEYOND * spacing))
            store(hints, 3 * room + g, end_of_it * spacing)
        else:
            low = choose(change_3, t2, choose(change_2, t1, singles_pair(0.0)))
            high = choose(change_3, singles_pair(1.0), choose(change_2, t2, t1))
            store(hints, 2 * room + g, choose(change_1, t1, t2) * spacing)
            store(hints, 3 * room + g, singles_pair((1.0 + BEYOND) * spacing))
        # From an extremum, of height p2 at t2 and else p1, the parabola through it leads close.
        turning = choose(low > 0.0, low, high)
        value = choose(turning == t2, p2, p1)
        away = root(greatest(-value / nonzero(c2 + 3.0 * c3 * turning), 0.0))
        chord = -g0 / nonzero(difference)
        t = choose(low > 0.0, turning + away, choose(high < 1.0, turning - away, chord))
        t = greatest(least(t, high), low)
        value = g0 + t * (e0 + t * (c2 + t * c3))
        t -= value / nonzero(e0 + t * (2.0 * c2 + 3.0 * t * c3))
        for _ in range(3):
            t = full_step(t, low, high, g0, e0, c2, c3, q0, q1, q2, q3)
        t = greatest(least(t, high), low)
        store(hints, g, t * spacing)
        store(hints, room + g, (2.0 * c2 + 6.0 * c3 * t) / (spacing * spacing))


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def polish(
    begin: int, end: int, circle: Any, apart: Any, record: Any, rows: Any, hints: Any,
    modes: Any, scratch: Any, result: Any,
) -> None:  # fmt: skip
    """Step of order three on the crossing in every listed gap, then its data.

    Rows of `rows`: where the numbers of its sample, its pair, i and j begin. Rows of `hints`: angle
    from the sample, second derivative of the depth, and the bracket. A row of `result` takes what
    a root has (see ROOT).
    """
    n_modes = len(modes)
    top = n_modes - 1
    room = rows.shape[1]
    imaginary = n_modes * LANES
    for r in range(begin, end, LANES):
        c, s, _, _ = gather_pair(circle, rows, r, 0)
        dx, dy, _, _ = gather_pair(apart, rows, room + r, 0)
        angle = widen_pair(hints, r)
        q = angle * angle
        sine = angle * (
            1.0
            + q
            * (-1 / 6 + q * (1 / 120 + q * (-1 / 5040 + q * (1 / 362880 + q * (-1 / 39916800)))))
        )
        cosine = 1.0 + q * (
            -0.5
            + q * (1 / 24 + q * (-1 / 720 + q * (1 / 40320 + q * (-1 / 3628800 + q / 479001600))))
        )
        c, s = c * cosine - s * sine, s * cosine + c * sine
        mean, _, _, _ = gather_pair(record, rows, 2 * room + r, 2)
        for m in range(0, 2 * n_modes, 4):
            c0, c1, c2, c3 = gather_pair(record, rows, 2 * room + r, HEAD + m)
            store(scratch, m * LANES, c0)
            store(scratch, m * LANES + LANES, c1)
            store(scratch, m * LANES + 2 * LANES, c2)
            store(scratch, m * LANES + 3 * LANES, c3)
        pr = load_pair(scratch, top * LANES)
        pi = load_pair(scratch, imaginary + top * LANES)
        qr = (top + 2.0) * pr
        qi = (top + 2.0) * pi
        for k in range(1, n_modes):
            m = top - k
            cr = load_pair(scratch, m * LANES)
            ci = load_pair(scratch, imaginary + m * LANES)
            pr, pi = pr * c - pi * s + cr, pr * s + pi * c + ci
            qr, qi = qr * c - qi * s + (m + 2.0) * cr, qr * s + qi * c + (m + 2.0) * ci
        zr = c * c - s * s
        zi = 2.0 * c * s
        rho = mean + pr * zr - pi * zi
        slope = -(qr * zi + qi * zr)
        x = rho * c - dx
        y = rho * s - dy
        tx = slope * c - rho * s
        ty = slope * s + rho * c
        square = x * x + y * y
        inverse = 1.0 / root(square)
        ux = x * inverse
        uy = y * inverse
        mean, _, _, _ = gather_pair(record, rows, 3 * room + r, 2)
        for m in range(0, 2 * n_modes, 4):
            c0, c1, c2, c3 = gather_pair(record, rows, 3 * room + r, HEAD + m)
            store(scratch, m * LANES, c0)
            store(scratch, m * LANES + LANES, c1)
            store(scratch, m * LANES + 2 * LANES, c2)
            store(scratch, m * LANES + 3 * LANES, c3)
        pr = load_pair(scratch, top * LANES)
        pi = load_pair(scratch, imaginary + top * LANES)
        qr = (top + 2.0) * pr
        qi = (top + 2.0) * pi
        for k in range(1, n_modes):
            m = top - k
            cr = load_pair(scratch, m * LANES)
            ci = load_pair(scratch, imaginary + m * LANES)
            pr, pi = pr * ux - pi * uy + cr, pr * uy + pi * ux + ci
            qr, qi = qr * ux - qi * uy + (m + 2.0) * cr, qr * uy + qi * ux + (m + 2.0) * ci
        zr = ux * ux - uy * uy
        zi = 2.0 * ux * uy
        depth = mean + pr * zr - pi * zi - square * inverse
        change = -(qr * zi + qi * zr) * (ux * ty - uy * tx) * inverse - (ux * tx + uy * ty)
        newton = -depth / change
        # Half the second derivative over the first bends the step; see the estimated error.
        second = -0.5 * widen_pair(hints, room + r) / change * newton
        step = newton * (1.0 + second)
        q = step * step
        sine = step * (1.0 - q * (1 / 6))
        cosine = 1.0 - 0.5 * q
        rho += step * slope
        c, s = c * cosine - s * sine, s * cosine + c * sine
        x = rho * c - dx
        y = rho * s - dy
        square = x * x + y * y
        inverse = 1.0 / root(square)
        moved = angle + step
        inside = (moved > widen_pair(hints, 2 * room + r)) & (
            moved < widen_pair(hints, 3 * room + r)
        )
        error = newton * newton + 0.02 * absolute(newton * second)
        error = choose(inside, error, 1.0)
        scatter(result, r * ROOT, ROOT, c, s, x * inverse, y * inverse)
        scatter(result, r * ROOT + 4, ROOT, rho, square * inverse, error, moved)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def copy_gap(
    source: int, to: int, place: Any, weight: Any, mean: Any, rows: Any, hints: Any
) -> None:
    """List a gap once more."""
    place[to] = place[source]
    weight[to] = weight[source]
    mean[to] = mean[source]
    for row in range(4):
        rows[row, to] = rows[row, source]
        hints[row, to] = hints[row, source]


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def put(roots: Any, r: int, result: Any, g: int, sign: Any, value: float) -> None:
    """Store a crossing."""
    store(roots, ROOT * r, load_pair(result, ROOT * g))
    sign[r] = value


@shared(FLAGS)
def crossings(part: int, n_parts: int, arrays: Any, modes: Any, tension: Any, torque: Any) -> None:
    """Find where the contours of every listed pair cross.

    `roots` has the same room for every block of cells; the crossings of pair p are the rows
    root_first[p] to root_last[p]. `inside` is 1 where i lies in j, 2 where j lies in i. Every part
    has its own work arrays (see `work`).
    """
    (
        record, grid, pattern, circle, compass, first, other, shift, roots, root_first, root_last,
        sign, inside, fault, work_rows, work_hints, work_result,
    ) = arrays  # fmt: skip
    n_cells = record.shape[0]
    stride = record.shape[1]
    size = compass.shape[1]
    spacing: Any = np.float32(2.0 * math.pi / size)
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    room = roots.shape[0] // n_blocks
    near = np.zeros(5 * PAIRS, np.float32)
    apart = np.zeros((PAIRS, 4))
    start = np.empty(PAIRS, np.float32)
    count = np.empty(PAIRS, np.float32)
    owner = np.empty(PAIRS, np.int64)
    code = np.empty(PAIRS, np.int64)
    total = np.empty(PAIRS, np.int64)
    cursor = np.empty(PAIRS, np.int64)
    depth = np.zeros(PAIRS * (size + 5 * LANES), np.float32)
    change = np.zeros(PAIRS * (size + 5 * LANES), np.float32)
    place = np.full(LISTED, LANES)
    weight = np.zeros(LISTED, np.float32)
    mean = np.ones(LISTED, np.float32)
    kind = np.empty(LISTED, np.float32)
    rows = work_rows[part]
    hints = work_hints[part]
    target = np.empty(LISTED, np.int64)
    result = work_result[part]
    scratch = np.empty((2 * len(modes) + 4) * LANES)
    stack = np.empty((40, 6))
    found = np.empty((8 * size, 4))
    for block in range(part * n_blocks // n_parts, (part + 1) * n_blocks // n_parts):
        n_roots = block * room
        full = n_roots + room
        i = block * BLOCK
        last_pair = first[min(n_cells, (block + 1) * BLOCK)]
        for begin in range(first[i], last_pair, PAIRS):
            filled = min(PAIRS, last_pair - begin)
            for k in range(filled):
                p = begin + k
                while first[i + 1] <= p:
                    i += 1
                j = other[p]
                owner[k] = i
                apart[k, 0] = record[j, 0] + shift[p, 0] - record[i, 0]
                apart[k, 1] = record[j, 1] + shift[p, 1] - record[i, 1]
                near[k] = apart[k, 0]
                near[PAIRS + k] = apart[k, 1]
                near[2 * PAIRS + k] = record[i, 4]
                near[3 * PAIRS + k] = record[i, 3]
                near[4 * PAIRS + k] = record[j, 3]
                narrow = record[i, 4] < NARROW * record[i, 2]
                narrow |= record[j, 4] < NARROW * record[j, 2]
                code[k] = CLOSELY if narrow else OUTSIDE
                total[k] = 0
            listed = other[begin : begin + filled]
            find_windows(near, start, count, filled, modes)
            sample_pairs(
                grid, pattern, owner, listed, near, start, count, filled, modes, depth, change
            )
            n_gaps = list_gaps(
                pattern, owner, listed, start, count, filled, size, stride, depth, change,
                place, weight, mean, rows, code,
            )  # fmt: skip
            # First the first crossing of every gap; those with two are then listed once more.
            n_listed = n_gaps
            for second in range(2):
                judge_gaps(
                    depth, change, place, weight, mean, second * n_gaps,
                    n_listed if second else n_gaps, second == 1, spacing, kind, hints,
                )  # fmt: skip
                if second:
                    break
                for g in range(n_gaps):
                    number = int(kind[g])
                    k = rows[1, g] // 4
                    total[k] += number
                    if number == UNSURE:
                        code[k] = CLOSELY
                    elif number == TWO:
                        copy_gap(g, n_listed, place, weight, mean, rows, hints)
                        n_listed += 1
            for k in range(filled):
                p = begin + k
                n_samples = int(count[k])
                root_first[p] = n_roots
                inside[p] = 0
                empty = total[k] == 0
                within = code[k] == INSIDE
                if n_samples > 0 and code[k] == CLOSELY:
                    n_found = search_closely(
                        record, owner[k], other[p], apart[k, 0], apart[k, 1], compass,
                        int(start[k]), n_samples, modes, stack, found,
                    )  # fmt: skip
                    if n_found == -1:
                        inside[p] = 1  # the same contour twice: i counts as inside j
                    empty = n_found == 0
                    within = empty and found[0, 3] > 0.0
                    if n_roots + n_found > full:
                        fault[block] = OVERFLOW
                        n_found = 0
                    for q in range(n_found):
                        s = int(found[q, 0])
                        settle(
                            record, owner[k], other[p], apart[k, 0], apart[k, 1],
                            compass[0, s], compass[1, s], found[q, 1], found[q, 2], math.nan,
                            found[q, 3], modes, roots, n_roots,
                        )  # fmt: skip
                        sign[n_roots] = found[q, 3]
                        n_roots += 1
                elif n_roots + total[k] > full:
                    fault[block] = OVERFLOW
                    code[k] = CLOSELY
                else:
                    cursor[k] = n_roots
                    n_roots += total[k]
                root_last[p] = n_roots
                if empty and n_samples > 0:
                    reach = math.sqrt(apart[k, 0] ** 2 + apart[k, 1] ** 2) + record[other[p], 4]
                    if n_samples > size and within:
                        inside[p] = 1
                    elif reach < record[owner[k], 3]:
                        inner, _, _, _, _, _ = gap(
                            record, other[p], owner[k], -apart[k, 0], -apart[k, 1], 1.0, 0.0,
                            modes,
                        )  # fmt: skip
                        if inner > 0.0:
                            inside[p] = 2
            # What one step does not settle takes a second one, then safeguarded ones.
            again = n_listed
            for attempt in range(2):
                ending = again if attempt else n_listed
                for g in range(ending, ending + (attempt * n_listed - ending) % LANES):
                    copy_gap(ending - 1, g, place, weight, mean, rows, hints)
                polish(
                    attempt * n_listed, ending, circle, apart, record, rows, hints, modes,
                    scratch, result,
                )  # fmt: skip
                if attempt == 1:
                    break
                partner = n_gaps
                for g in range(n_gaps):
                    number = int(kind[g])
                    k = rows[1, g] // 4
                    if code[k] == CLOSELY or number == 0:
                        partner += number == TWO
                        continue
                    value = 1.0 if depth[place[g]] > 0.0 else -1.0
                    source = g
                    for side in range(number):
                        if side == 1:
                            source = partner
                            value = -value
                            partner += 1
                        r = cursor[k]
                        cursor[k] = r + 1
                        put(roots, r, result, source, sign, value)
                        if not result[source, 6] < SETTLED:
                            copy_gap(source, again, place, weight, mean, rows, hints)
                            if hints[2, source] < result[source, 7] < hints[3, source]:
                                hints[0, again] = result[source, 7]
                            target[again] = r
                            again += 1
            for g in range(n_listed, again):
                r = target[g]
                if result[g, 6] < SETTLED:
                    put(roots, r, result, g, sign, sign[r])
                    continue
                k = rows[1, g] // 4
                s = rows[0, g] // 4
                settle(
                    record, owner[k], other[begin + k], apart[k, 0], apart[k, 1],
                    compass[0, s], compass[1, s], hints[2, g], hints[3, g], result[g, 7],
                    sign[r], modes, roots, r,
                )  # fmt: skip
