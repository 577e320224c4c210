"""Where the contours of neighbouring cells cross: the root search of the exact contact rule.

The depth g of i's contour inside j is sampled in single precision on the part of the contour that
faces j. The cubic through two neighbouring samples and their slopes shows how often the contours
cross between them, and where, to about 1e-5. One evaluation in double precision then gives the
crossing to round-off. What single precision or the cubic cannot settle (an extremum of g closer to
zero than the cubic is exact, contours that nearly coincide) is searched in double precision by
halving.

An overlap region is bounded by arcs of both contours. Every integral over the arcs is a signed sum
over the crossings (+1 where the contour of i leaves j, -1 where it enters), so neither the number
of crossings nor their order matters.
"""

import math
from typing import Any

import numpy as np
from numba import njit, prange
from numba.np.numpy_support import carray

from cellquant.sim.lanes import (
    LANES,
    bytes_of,
    doubles,
    integers,
    singles,
    trailing_zeros,
    words,
)
from cellquant.sim.outlines import BLOCK, HEAD

FLAGS = {"contract", "nsz", "arcp"}
FAST = FLAGS | {"afn", "reassoc"}  # where single precision is enough
ROOT = 6  # entries of a root: unit vector on i, unit vector on j, rho on i, rho on j
PAIRS = 64  # pairs whose contours are sampled before the gaps between samples are judged
MANY = 12  # gaps of one pair that may hold a crossing; with more it is searched in double precision
GAPS = MANY * PAIRS
CHUNK = 64  # crossings polished together
HULL_MARGIN = 1e-4  # of the cubic through two samples, relative to A0
FINE_MARGIN = 1e-5  # of the interpolation through four samples, single precision included
MOST_LOOKS = 400  # closer looks at one pair; only nearly coincident contours need more
NARROW = 0.1  # smallest radius over A0 for which single precision is trusted
SETTLED = 2e-9  # error of an angle that needs no further steps
OVERFLOW = 1  # more crossings than the buffer holds
NONE, ONE, TWO, UNSURE = 0, 1, 2, 3  # crossings in a gap

F = np.float32
ZERO, HALF, ONE_, TWO_, THREE = F(0.0), F(0.5), F(1.0), F(2.0), F(3.0)
THIRD, QUARTER, NINTH, TINY, PI = F(1 / 3), F(1 / 4), F(1 / 9), F(1e-30), F(math.pi)
A0, A1, A2, A3 = F(1.5707288), F(-0.2121144), F(0.0742610), F(-0.0187293)
SLACK = F(0.05)  # of a gap: an extremum just beyond its end counts as within
ROW = np.uint64(CHUNK)
LINES = 8  # rows of a chunk


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def gap(
    record: Any, i: int, j: int, dx: float, dy: float, cosine: float, sine: float, modes: Any
) -> tuple[float, float, float, float, float, float]:
    """Depth g of the contour point of i at direction (cosine, sine) inside j, and dg/dphi.

    Also rho of i, the distance to the centre of j, and the direction from it.
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
    inverse = 1.0 / math.sqrt(max(x * x + y * y, 1e-300))
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
    slope_j = -(qr * zi + qi * zr)
    distance = (x * x + y * y) * inverse
    depth = record[j, 2] + pr * zr - pi * zi - distance
    change = slope_j * (ux * ty - uy * tx) * inverse - (ux * tx + uy * ty)
    return depth, change, rho, distance, ux, uy


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
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


@njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def find_windows(near: Any, start: Any, count: Any, filled: int, modes: Any) -> None:
    """Samples of i's contour that can lie within the reach of j, for many pairs.

    Rows of `near`, PAIRS apart: displacement to j (2), low and high of i, high of j.
    """
    size = 8 * max(6, len(modes) + 1)
    per_radian = F(size / (2.0 * math.pi))
    whole = F(size // 2)
    first = carray(integers(modes, 8, 0), (PAIRS,))
    number = carray(integers(modes, 8, 0), (PAIRS,))
    one = np.uint64(1 * PAIRS)
    two = np.uint64(2 * PAIRS)
    three = np.uint64(3 * PAIRS)
    four = np.uint64(4 * PAIRS)
    for begin in range(np.uint64(0), np.uint64(filled), np.uint64(LANES)):
        for r in range(np.uint64(LANES)):
            p = begin + r
            dx = near[p]
            dy = near[one + p]
            low = near[two + p]
            high = near[three + p]
            reach = near[four + p]
            square = dx * dx + dy * dy
            distance = math.sqrt(square)
            away = square - reach * reach
            tangent = math.sqrt(away if away > ZERO else ZERO)
            nearest = tangent if tangent > low else low
            nearest = nearest if nearest < high else high
            # A pinched contour comes as near as its centre.
            nearest = nearest if nearest > F(1e-6) * high else F(1e-6) * high
            inverse = ONE_ / (distance if distance > TINY else TINY)
            # Angles by Abramowitz & Stegun 4.4.45, to 7e-5.
            x = HALF * (away + nearest * nearest) * inverse / nearest
            x = x if x < ONE_ else ONE_
            x = x if x > -ONE_ else -ONE_
            y = abs(x)
            half = math.sqrt(ONE_ - y) * (A0 + y * (A1 + y * (A2 + y * A3)))
            half = half if x >= ZERO else PI - half
            x = dx * inverse
            x = x if x < ONE_ else ONE_
            x = x if x > -ONE_ else -ONE_
            y = abs(x)
            middle = math.sqrt(ONE_ - y) * (A0 + y * (A1 + y * (A2 + y * A3)))
            middle = middle if x >= ZERO else PI - middle
            middle = middle if dy >= ZERO else -middle
            width = TWO_ * half * per_radian + F(2.5)
            eighths = math.ceil(width * F(0.125))
            samples = F(8.0) * eighths
            begin_at = math.floor(middle * per_radian - HALF * samples + ONE_)
            begin_at = begin_at if begin_at >= ZERO else begin_at + F(size)
            all_of_it = samples > whole or distance < F(1e-6) * high
            apart = distance > (high + reach) * F(1.000001)
            samples = F(size + 1) if all_of_it else samples
            begin_at = ZERO if all_of_it else begin_at
            number[p] = np.int32(ZERO if apart else samples)
            first[p] = np.int32(begin_at)
    for p in range(filled):
        start[p] = first[p]
        count[p] = number[p]


@njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def sample_pairs(
    grid: Any, pattern: Any, owner: Any, other: Any, near: Any, starts: Any, counts: Any,
    filled: int, modes: Any, gaps: Any, marks: Any, codes: Any,
) -> int:  # fmt: skip
    """Sample the depth of i in j for many pairs; store the gaps that may hold a crossing.

    Rows of `gaps`, GAPS apart: depths at the sample before the gap, at its two ends, and after it,
    the same of the slopes times the width, 1 where there is none before or after, and A0. `marks`
    takes the number of the first sample of each gap, `codes` the number of gaps of each pair, or -1
    where it must be searched in double precision (also where it is given), -2 where no sample lies
    in j and -3 where all do.
    Returns the number of gaps.
    """
    top = len(modes) - 1
    size = 8 * max(6, len(modes) + 1)
    width = F(2.0 * math.pi / size)
    depth = carray(singles(modes, 10, 1), (8 * max(10, len(modes) + 4),))
    change = carray(singles(modes, 10, 1), (8 * max(10, len(modes) + 4),))
    flag_place = words(modes, 2, 1)
    flags = carray(flag_place, (8,))
    flag = carray(bytes_of(flag_place), (64,))
    base = 0
    for pair in range(filled):
        count = counts[pair]
        if count == 0 or codes[pair] == -1:
            continue
        i = np.uint64(owner[pair])
        j = np.uint64(other[pair])
        start = starts[pair]
        x_j = near[pair]
        y_j = near[PAIRS + pair]
        mean = pattern[j, 0]
        at = np.uint64(start)
        begin = np.uint64(0)
        while begin < np.uint64(count):
            for r in range(np.uint64(2 * LANES)):
                gx = grid[i, 0, at + begin + r]
                gy = grid[i, 1, at + begin + r]
                ratio = grid[i, 2, at + begin + r]
                x = gx - x_j
                y = gy - y_j
                tx = ratio * gx - gy
                ty = ratio * gy + gx
                q = x * x + y * y
                q = q if q > TINY else TINY
                inverse = ONE_ / math.sqrt(q)
                ux = x * inverse
                uy = y * inverse
                pr = pattern[j, 1 + top]
                pi = pattern[j, 1 + len(modes) + top]
                qr = F(top + 2) * pr
                qi = F(top + 2) * pi
                for k in range(len(modes) - 1):
                    m = top - 1 - k
                    cr = pattern[j, 1 + m]
                    ci = pattern[j, 1 + len(modes) + m]
                    n = F(m + 2)
                    pr, pi = pr * ux - pi * uy + cr, pr * uy + pi * ux + ci
                    qr, qi = qr * ux - qi * uy + n * cr, qr * uy + qi * ux + n * ci
                zr = ux * ux - uy * uy
                zi = TWO_ * ux * uy
                depth[begin + r] = mean + pr * zr - pi * zi - q * inverse
                slope = -(qr * zi + qi * zr) * inverse
                change[begin + r] = width * (slope * (ux * ty - uy * tx) - (ux * tx + uy * ty))
            begin += np.uint64(2 * LANES)
        margin = F(HULL_MARGIN) * mean
        begin = np.uint64(0)
        found = 0
        last = count - 1
        whole = count > size
        while begin < np.uint64(last):
            for r in range(np.uint64(LANES)):
                s = begin + r
                g0 = depth[s]
                g1 = depth[s + np.uint64(1)]
                b1 = g0 + change[s] * THIRD
                b2 = g1 - change[s + np.uint64(1)] * THIRD
                low = g0 if g0 < g1 else g1
                high = g0 if g0 > g1 else g1
                inner_low = (b1 if b1 < b2 else b2) - margin
                inner_high = (b1 if b1 > b2 else b2) + margin
                low = low if low < inner_low else inner_low
                high = high if high > inner_high else inner_high
                # All four coefficients on one side of zero, the inner ones by the margin: none.
                flag[r] = np.uint8(1) if (low <= ZERO) & (high > ZERO) else np.uint8(0)
            word = flags[0]
            while word != np.uint64(0):
                s = begin + (trailing_zeros(word) >> np.uint64(3))
                word &= word - np.uint64(1)
                if s < np.uint64(last):
                    if found == MANY:
                        found = MANY + 1
                        break
                    slot = np.uint64(base + found)
                    one = np.uint64(1)
                    before = s - one if s > np.uint64(0) else np.uint64(size - 1 if whole else 0)
                    after = s + one + one
                    for k in range(4):
                        t = before if k == 0 else s + np.uint64(k - 1)
                        gaps[slot + np.uint64(k * GAPS)] = depth[t]
                        gaps[slot + np.uint64((4 + k) * GAPS)] = change[t]
                    outside = (not whole) & ((s == np.uint64(0)) | (after >= np.uint64(count)))
                    gaps[slot + np.uint64(8 * GAPS)] = ONE_ if outside else ZERO
                    gaps[slot + np.uint64(9 * GAPS)] = mean
                    marks[slot] = np.int32(s)
                    found += 1
            if found > MANY:
                break
            begin += np.uint64(LANES)
        if found > MANY:
            codes[pair] = -1
        elif found == 0:
            codes[pair] = -3 if depth[0] > ZERO else -2
        else:
            codes[pair] = found
            base += found
    return base


@njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def start_in_piece(
    low: Any, high: Any, t2: Any, p1: Any, p2: Any, g0: Any, difference: Any, c2: Any, c3: Any
) -> Any:
    """First guess of the crossing of a cubic between two extrema or ends.

    From an extremum, of height p2 at t2 and else p1, the parabola through it leads close.
    """
    chord = g0 / (-difference if abs(difference) > TINY else TINY)
    turning = low if low > ZERO else high
    value = p2 if turning == t2 else p1
    bent = c2 + THREE * c3 * turning
    away = -value / (bent if abs(bent) > TINY else TINY)
    away = math.sqrt(away if away > ZERO else ZERO)
    before = turning - away if high < ONE_ else chord
    return turning + away if low > ZERO else before


@njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def cubic_step(t: Any, low: Any, high: Any, g0: Any, e0: Any, c2: Any, c3: Any) -> Any:
    """One Newton step on the cubic, from within the piece."""
    t = t if t < high else high
    t = t if t > low else low
    value = g0 + t * (e0 + t * (c2 + t * c3))
    rate = e0 + t * (TWO_ * c2 + THREE * t * c3)
    return t - value / (rate if abs(rate) > TINY else TINY)


@njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def full_step(
    t: Any, low: Any, high: Any, g0: Any, e0: Any, c2: Any, c3: Any,
    q0: Any, q1: Any, q2: Any, q3: Any,
) -> Any:  # fmt: skip
    """One Newton step on the polynomial of degree 7, from within the piece."""
    t = t if t < high else high
    t = t if t > low else low
    u = t + ONE_
    w = t * (t - ONE_)
    q = q0 + u * (q1 + u * (q2 + u * q3))
    value = g0 + t * (e0 + t * (c2 + t * c3)) + w * w * q
    rate = e0 + t * (TWO_ * c2 + THREE * t * c3)
    rate += w * ((F(4.0) * t - TWO_) * q + w * (q1 + u * (TWO_ * q2 + THREE * u * q3)))
    return t - value / (rate if abs(rate) > TINY else TINY)


@njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def judge_gaps(gaps: Any, filled: int, modes: Any, kind: Any, guess: Any, curve: Any) -> None:
    """How often the depth crosses zero in every gap, and where.

    With the samples beyond both ends the interpolation is of degree 7: the cubic p(t) through the
    ends plus t^2 (t - 1)^2 q(t), q cubic. `guess` takes the positions of the first and the second
    crossing and of an extremum between them in units of the width, in rows GAPS apart, and `curve`
    the second derivatives at the crossings.
    """
    kinds = carray(integers(modes, 1, 0), (LANES,))
    places = carray(singles(modes, 5, 0), (5 * LANES,))
    row = np.uint64(GAPS)
    for begin in range(np.uint64(0), np.uint64(filled), np.uint64(LANES)):
        for r in range(np.uint64(LANES)):
            p = begin + r
            before = gaps[p]
            g0 = gaps[row + p]
            g1 = gaps[row + row + p]
            after = gaps[np.uint64(3) * row + p]
            e_before = gaps[np.uint64(4) * row + p]
            e0 = gaps[np.uint64(5) * row + p]
            e1 = gaps[np.uint64(6) * row + p]
            e_after = gaps[np.uint64(7) * row + p]
            edge = gaps[np.uint64(8) * row + p]
            mean = gaps[np.uint64(9) * row + p]
            difference = g1 - g0
            c2 = THREE * difference - TWO_ * e0 - e1
            c3 = e0 + e1 - TWO_ * difference
            # What the cubic misses before and after gives q and q' at -1 and 2; q at u = t + 1.
            miss = before - (g0 - e0 + c2 - c3)
            tilt = e_before - (e0 - TWO_ * c2 + THREE * c3)
            miss_2 = after - (g0 + TWO_ * e0 + F(4.0) * c2 + F(8.0) * c3)
            tilt_2 = e_after - (e0 + F(4.0) * c2 + F(12.0) * c3)
            weight = ZERO if edge > ZERO else QUARTER
            q0 = weight * miss
            q1 = weight * (tilt + THREE * miss)
            rise = (weight * miss_2 - q0) * THIRD
            end = weight * (tilt_2 - THREE * miss_2)
            q2 = (THREE * rise - TWO_ * q1 - end) * THIRD
            q3 = (q1 + end - TWO_ * rise) * NINTH
            margin = mean * (F(HULL_MARGIN) if edge > ZERO else F(FINE_MARGIN))
            # Extrema of the cubic, put on the ends where they lie outside.
            square = c2 * c2 - THREE * c3 * e0
            root = math.sqrt(square if square > ZERO else ZERO)
            total = -(c2 + (root if c2 > ZERO else -root))
            safe = total if abs(total) > TINY else TINY
            safe_3 = THREE * c3
            safe_3 = safe_3 if abs(safe_3) > TINY else TINY
            ta = total / safe_3
            tb = e0 / safe
            ta = ta if square > ZERO else -ONE_
            tb = tb if square > ZERO else -ONE_
            t1 = ta if ta < tb else tb
            t2 = ta if ta > tb else tb
            near_1 = (t1 > -SLACK) & (t1 < ONE_ + SLACK)
            near_2 = (t2 > -SLACK) & (t2 < ONE_ + SLACK)
            t1 = t1 if t1 > ZERO else ZERO
            t1 = t1 if t1 < ONE_ else ONE_
            t2 = t2 if t2 > ZERO else ZERO
            t2 = t2 if t2 < ONE_ else ONE_
            u = t1 + ONE_
            w = t1 * (t1 - ONE_)
            p1 = g0 + t1 * (e0 + t1 * (c2 + t1 * c3)) + w * w * (q0 + u * (q1 + u * (q2 + u * q3)))
            u = t2 + ONE_
            w = t2 * (t2 - ONE_)
            p2 = g0 + t2 * (e0 + t2 * (c2 + t2 * c3)) + w * w * (q0 + u * (q1 + u * (q2 + u * q3)))
            p1 = p1 if t1 > ZERO else g0
            p1 = p1 if t1 < ONE_ else g1
            p2 = p2 if t2 > ZERO else g0
            p2 = p2 if t2 < ONE_ else g1
            close = (near_1 & (abs(p1) < margin)) | (near_2 & (abs(p2) < margin))
            b1 = g0 + e0 * THIRD
            b2 = g1 - e1 * THIRD
            change_1 = (g0 > ZERO) != (p1 > ZERO)
            change_2 = (p1 > ZERO) != (p2 > ZERO)
            change_3 = (p2 > ZERO) != (g1 > ZERO)
            flat = F(HULL_MARGIN) * mean
            unsure = (abs(b1) < flat) & (abs(b2) < flat)
            unsure = unsure | close | (change_1 & change_2 & change_3)
            number = (ONE_ if change_1 else ZERO) + (ONE_ if change_2 else ZERO)
            number += ONE_ if change_3 else ZERO
            number = THREE if unsure else number
            kinds[r] = np.int32(number)
            # The first and the last piece between extrema that crosses zero.
            low = t1 if change_2 else t2
            low = ZERO if change_1 else low
            high = t2 if change_2 else ONE_
            high = t1 if change_1 else high
            t = start_in_piece(low, high, t2, p1, p2, g0, difference, c2, c3)
            t = cubic_step(t, low, high, g0, e0, c2, c3)
            t = full_step(t, low, high, g0, e0, c2, c3, q0, q1, q2, q3)
            t = full_step(t, low, high, g0, e0, c2, c3, q0, q1, q2, q3)
            t = full_step(t, low, high, g0, e0, c2, c3, q0, q1, q2, q3)
            t = t if t < high else high
            t = t if t > low else low
            places[r] = t
            places[np.uint64(4 * LANES) + r] = t1 if change_1 else t2
            places[np.uint64(2 * LANES) + r] = TWO_ * c2 + F(6.0) * c3 * t
            low = t1 if change_2 else ZERO
            low = t2 if change_3 else low
            high = t2 if change_2 else t1
            high = ONE_ if change_3 else high
            t = start_in_piece(low, high, t2, p1, p2, g0, difference, c2, c3)
            t = cubic_step(t, low, high, g0, e0, c2, c3)
            t = full_step(t, low, high, g0, e0, c2, c3, q0, q1, q2, q3)
            t = full_step(t, low, high, g0, e0, c2, c3, q0, q1, q2, q3)
            t = full_step(t, low, high, g0, e0, c2, c3, q0, q1, q2, q3)
            t = t if t < high else high
            t = t if t > low else low
            places[np.uint64(LANES) + r] = t
            places[np.uint64(3 * LANES) + r] = TWO_ * c2 + F(6.0) * c3 * t
        for r in range(LANES):
            at = begin + np.uint64(r)
            kind[at] = kinds[r]
            guess[at] = places[r]
            guess[row + at] = places[LANES + r]
            guess[row + row + at] = places[4 * LANES + r]
            curve[at] = places[2 * LANES + r]
            curve[row + at] = places[3 * LANES + r]


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def polish(lane: Any, cells: Any, record: Any, result: Any, count: int, modes: Any) -> None:
    """Step of order three on every crossing of a chunk, then its data.

    Row k of `lane` starts at k CHUNK: sample direction (2), displacement to j (2), bracket (2),
    angle from the sample, second derivative of the depth; `cells` holds i, then j. Rows of
    `result`: direction on i (2), on j (2), rho on i, on j, estimated error, corrected angle.
    """
    top = len(modes) - 1
    out = carray(doubles(modes, 8, 0), (8 * LANES,))
    two = np.uint64(2 * CHUNK)
    three = np.uint64(3 * CHUNK)
    five = np.uint64(5 * CHUNK)
    six = np.uint64(6 * CHUNK)
    seven = np.uint64(7 * CHUNK)
    for begin in range(np.uint64(0), np.uint64(count), np.uint64(LANES)):
        for k in range(np.uint64(LANES)):
            r = begin + k
            i = cells[r]
            j = cells[ROW + r]
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
            pr = record[i, HEAD + top]
            pi = record[i, HEAD + len(modes) + top]
            qr = (top + 2) * pr
            qi = (top + 2) * pi
            for down in range(len(modes) - 1):
                m = top - 1 - down
                cr = record[i, HEAD + m]
                ci = record[i, HEAD + len(modes) + m]
                pr, pi = pr * c - pi * s + cr, pr * s + pi * c + ci
                qr, qi = qr * c - qi * s + (m + 2) * cr, qr * s + qi * c + (m + 2) * ci
            zr = c * c - s * s
            zi = 2.0 * c * s
            rho = record[i, 2] + pr * zr - pi * zi
            slope = -(qr * zi + qi * zr)
            dx = lane[two + r]
            dy = lane[three + r]
            x = rho * c - dx
            y = rho * s - dy
            tx = slope * c - rho * s
            ty = slope * s + rho * c
            square = x * x + y * y
            inverse = 1.0 / math.sqrt(square)
            ux = x * inverse
            uy = y * inverse
            pr = record[j, HEAD + top]
            pi = record[j, HEAD + len(modes) + top]
            qr = (top + 2) * pr
            qi = (top + 2) * pi
            for down in range(len(modes) - 1):
                m = top - 1 - down
                cr = record[j, HEAD + m]
                ci = record[j, HEAD + len(modes) + m]
                pr, pi = pr * ux - pi * uy + cr, pr * uy + pi * ux + ci
                qr, qi = qr * ux - qi * uy + (m + 2) * cr, qr * uy + qi * ux + (m + 2) * ci
            zr = ux * ux - uy * uy
            zi = 2.0 * ux * uy
            depth = record[j, 2] + pr * zr - pi * zi - square * inverse
            change = -(qr * zi + qi * zr) * (ux * ty - uy * tx) * inverse - (ux * tx + uy * ty)
            newton = -depth / change
            # Half the second derivative over the first bends the step; see the estimated error.
            second = -0.5 * lane[seven + r] / change * newton
            step = newton * (1.0 + second)
            q = step * step
            sine = step * (1.0 - q * (1 / 6))
            cosine = 1.0 - 0.5 * q
            rho += step * slope
            new_c = c * cosine - s * sine
            new_s = s * cosine + c * sine
            x = rho * new_c - dx
            y = rho * new_s - dy
            square = x * x + y * y
            inverse = 1.0 / math.sqrt(square)
            out[k] = new_c
            out[np.uint64(LANES) + k] = new_s
            out[np.uint64(2 * LANES) + k] = x * inverse
            out[np.uint64(3 * LANES) + k] = y * inverse
            out[np.uint64(4 * LANES) + k] = rho
            out[np.uint64(5 * LANES) + k] = square * inverse
            error = newton * newton + 0.02 * abs(newton * second)
            moved = angle + step
            inside = (moved > lane[np.uint64(4 * CHUNK) + r]) & (moved < lane[five + r])
            out[np.uint64(6 * LANES) + k] = error if inside else 1.0
            out[np.uint64(7 * LANES) + k] = moved
        for row in range(8):
            for column in range(LANES):
                result[row * CHUNK + begin + column] = out[row * LANES + column]


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def finish(
    lane: Any, result: Any, count: int, cells: Any, record: Any, modes: Any,
    sign: Any, roots: Any, base: int, rest: Any, names: Any, places: Any, second: Any,
) -> None:  # fmt: skip
    """Polish a chunk and store it; what one step did not settle takes safeguarded ones."""
    padded = (count + LANES - 1) // LANES * LANES
    for r in range(count, padded):
        for row in range(LINES):
            lane[row * CHUNK + r] = lane[row * CHUNK + count - 1]
        cells[r] = cells[count - 1]
        cells[CHUNK + r] = cells[CHUNK + count - 1]
    polish(lane, cells, record, result, padded, modes)
    again = 0
    for r in range(count):
        if not result[6 * CHUNK + r] < SETTLED:
            for row in range(LINES):
                rest[row * CHUNK + again] = lane[row * CHUNK + r]
            angle = result[7 * CHUNK + r]
            if lane[4 * CHUNK + r] < angle < lane[5 * CHUNK + r]:
                rest[6 * CHUNK + again] = angle
            names[again] = cells[r]
            names[CHUNK + again] = cells[CHUNK + r]
            places[again] = r
            again += 1
    if again > 0:
        padded = (again + LANES - 1) // LANES * LANES
        for r in range(again, padded):
            for row in range(LINES):
                rest[row * CHUNK + r] = rest[row * CHUNK + again - 1]
            names[r] = names[again - 1]
            names[CHUNK + r] = names[CHUNK + again - 1]
        polish(rest, names, record, second, padded, modes)
        for r in range(again):
            for row in range(8):
                result[row * CHUNK + places[r]] = second[row * CHUNK + r]
    for r in range(count):
        if not result[6 * CHUNK + r] < SETTLED:
            i: Any = np.int64(cells[r])
            j: Any = np.int64(cells[CHUNK + r])
            dx = lane[2 * CHUNK + r]
            dy = lane[3 * CHUNK + r]
            low = lane[4 * CHUNK + r]
            high = lane[5 * CHUNK + r]
            angle = result[7 * CHUNK + r]
            if not low < angle < high:
                angle = min(high, max(low, lane[6 * CHUNK + r]))
            for _ in range(80):
                ca, sa = turn(lane[r], lane[CHUNK + r], angle)
                g, rate, _, _, _, _ = gap(record, i, j, dx, dy, ca, sa, modes)
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
            _, _, rho, distance, ux, uy = gap(record, i, j, dx, dy, ca, sa, modes)
            result[r] = ca
            result[CHUNK + r] = sa
            result[2 * CHUNK + r] = ux
            result[3 * CHUNK + r] = uy
            result[4 * CHUNK + r] = rho
            result[5 * CHUNK + r] = distance
        for column in range(ROOT):
            roots[base + r, column] = result[column * CHUNK + r]


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def search_closely(
    record: Any, i: int, j: int, dx: float, dy: float, compass: Any, start: int, count: int,
    modes: Any, stack: Any, found: Any,
) -> int:  # fmt: skip
    """Bracket the crossings of one pair by halving, in double precision.

    Rows of `found`: number of the sample, bracket as angles from it, guess, no second derivative,
    and the sign of the depth at its start; without crossings the first row holds the sign
    everywhere. Returns their number, or -1 where the contours are the same.
    """
    size = compass.shape[1]
    spacing = 2.0 * math.pi / size
    whole = count > size
    mean_j = record[j, 2]
    margin = HULL_MARGIN * mean_j
    n_found = 0
    looks = 0
    largest = 0.0
    g1, d1, _, _, _, _ = gap(record, i, j, dx, dy, compass[0, start], compass[1, start], modes)
    g_first = g1
    d_first = d1
    for index in range(count - 1):
        s = (start + index) % size
        g0 = g1
        d0 = d1
        t = (s + 1) % size
        if whole and index == count - 2:
            g1 = g_first
            d1 = d_first
        else:
            g1, d1, _, _, _, _ = gap(record, i, j, dx, dy, compass[0, t], compass[1, t], modes)
        largest = max(largest, abs(g1))
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
            a = stack[height, 2]
            b = stack[height, 3]
            e = stack[height, 4]
            f = stack[height, 5]
            fraction = width / spacing
            finer = margin * fraction * fraction * fraction * fraction
            kind = variations(a, b, e, f, width, finer)
            if kind == 2 and width > 1e-9 and looks < MOST_LOOKS:
                looks += 1
                width *= 0.5
                ca, sa = turn(compass[0, s], compass[1, s], left + width)
                gm, dm, _, _, _, _ = gap(record, i, j, dx, dy, ca, sa, modes)
                # The left half lies on top, so that crossings come in order.
                stack[height, 0] = left + width
                stack[height, 1] = width
                stack[height, 2] = gm
                stack[height, 3] = b
                stack[height, 4] = dm
                stack[height, 5] = f
                height += 1
                stack[height, 0] = left
                stack[height, 1] = width
                stack[height, 2] = a
                stack[height, 3] = gm
                stack[height, 4] = e
                stack[height, 5] = dm
                height += 1
            elif (a > 0.0) != (b > 0.0):
                if n_found == found.shape[0]:
                    break
                found[n_found, 0] = s
                found[n_found, 1] = left
                found[n_found, 2] = left + width
                found[n_found, 3] = left + 0.5 * width
                found[n_found, 4] = math.nan
                found[n_found, 5] = 1.0 if a > 0.0 else -1.0
                n_found += 1
    if whole and largest < 1e-12 * mean_j:
        return -1
    if n_found == 0:
        found[0, 5] = 1.0 if g_first > 0.0 else -1.0
    return n_found


@njit(cache=True, parallel=True, fastmath=FLAGS, error_model="numpy")
def crossings(
    record: Any,
    grid: Any,
    pattern: Any,
    compass: Any,
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

    `roots` has the same room for every block of cells; the crossings of pair p are the rows
    root_first[p] to root_last[p]. `inside` is 1 where i lies in j, 2 where j lies in i.
    """
    n_cells = record.shape[0]
    size = compass.shape[1]
    spacing = 2.0 * math.pi / size
    n_blocks = (n_cells + BLOCK - 1) // BLOCK
    room = roots.shape[0] // n_blocks
    for block in prange(n_blocks):
        base = block * room
        near = np.empty(5 * PAIRS, np.float32)
        start = np.empty(PAIRS, np.int32)
        count = np.empty(PAIRS, np.int32)
        owner = np.empty(PAIRS, np.int32)
        code = np.empty(PAIRS, np.int32)
        gaps = np.empty(10 * GAPS, np.float32)
        marks = np.empty(GAPS, np.int32)
        kind = np.empty(GAPS, np.int32)
        guess = np.empty(3 * GAPS, np.float32)
        curve = np.empty(2 * GAPS, np.float32)
        lane = np.empty(LINES * CHUNK)
        result = np.empty(8 * CHUNK)
        cells = np.empty(2 * CHUNK, np.uint64)
        rest = np.empty(LINES * CHUNK)
        names = np.empty(2 * CHUNK, np.uint64)
        places = np.empty(CHUNK, np.int64)
        second = np.empty(8 * CHUNK)
        stack = np.empty((40, 6))
        found = np.empty((8 * size, 6))
        n_roots = 0
        done = 0
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
                near[k] = record[j, 0] + shift[p, 0] - record[i, 0]
                near[PAIRS + k] = record[j, 1] + shift[p, 1] - record[i, 1]
                near[2 * PAIRS + k] = record[i, 4]
                near[3 * PAIRS + k] = record[i, 3]
                near[4 * PAIRS + k] = record[j, 3]
                narrow = min(record[i, 4] / record[i, 2], record[j, 4] / record[j, 2])
                code[k] = -1 if narrow < NARROW else -2
            find_windows(near, start, count, filled, modes)
            n_gaps = sample_pairs(
                grid, pattern, owner, other[begin : begin + filled], near, start, count, filled,
                modes, gaps, marks, code,
            )  # fmt: skip
            judge_gaps(gaps, n_gaps, modes, kind, guess, curve)
            at = 0
            for k in range(filled):
                p = begin + k
                root_first[p] = base + n_roots
                inside[p] = 0
                if count[k] > 0:
                    c = owner[k]
                    j = other[p]
                    dx = record[j, 0] + shift[p, 0] - record[c, 0]
                    dy = record[j, 1] + shift[p, 1] - record[c, 1]
                    n_own = max(0, code[k])
                    closely = code[k] == -1
                    positive = code[k] == -3
                    if n_own > 0:
                        positive = gaps[GAPS + at] > ZERO
                        for q in range(at, at + n_own):
                            closely |= kind[q] == UNSURE
                    n_found = 0
                    if closely:
                        n_found = search_closely(
                            record, c, j, dx, dy, compass, start[k], count[k], modes, stack, found
                        )
                        if n_found == -1:
                            inside[p] = 1  # the same contour twice: i counts as inside j
                        positive = n_found < 0 or found[0, 5] > 0.0
                    else:
                        for q in range(at, at + n_own):
                            first_sign = 1.0 if gaps[GAPS + q] > ZERO else -1.0
                            for side in range(kind[q]):
                                place = side * GAPS + q
                                low = -1e-3
                                high = 1.001
                                if kind[q] == TWO:
                                    middle = guess[2 * GAPS + q]
                                    low = middle if side == 1 else low
                                    high = middle if side == 0 else high
                                s = start[k] + marks[q]
                                found[n_found, 0] = s - size if s >= size else s
                                found[n_found, 1] = low * spacing
                                found[n_found, 2] = high * spacing
                                found[n_found, 3] = guess[place] * spacing
                                found[n_found, 4] = curve[place] / (spacing * spacing)
                                found[n_found, 5] = first_sign if side == 0 else -first_sign
                                n_found += 1
                    for q in range(n_found):
                        if n_roots == room:
                            fault[block] = OVERFLOW
                            break
                        s = int(found[q, 0])
                        r = n_roots - done
                        lane[r] = compass[0, s]
                        lane[CHUNK + r] = compass[1, s]
                        lane[2 * CHUNK + r] = dx
                        lane[3 * CHUNK + r] = dy
                        for row in range(4):
                            lane[(4 + row) * CHUNK + r] = found[q, 1 + row]
                        cells[r] = np.uint64(c)
                        cells[CHUNK + r] = np.uint64(j)
                        sign[base + n_roots] = found[q, 5]
                        n_roots += 1
                        if r == CHUNK - 1:
                            finish(
                                lane, result, CHUNK, cells, record, modes, sign, roots,
                                base + done, rest, names, places, second,
                            )  # fmt: skip
                            done = n_roots
                    at += n_own
                    if base + n_roots == root_first[p] and inside[p] == 0:
                        if count[k] > size and positive:
                            inside[p] = 1
                        elif math.sqrt(dx * dx + dy * dy) + record[j, 4] < record[c, 3]:
                            g, _, _, _, _, _ = gap(record, j, c, -dx, -dy, 1.0, 0.0, modes)
                            if g > 0.0:
                                inside[p] = 2
                root_last[p] = base + n_roots
        if n_roots > done:
            finish(
                lane,
                result,
                n_roots - done,
                cells,
                record,
                modes,
                sign,
                roots,
                base + done,
                rest,
                names,
                places,
                second,
            )
