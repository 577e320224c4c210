"""The depth of one contour in another, and crossings that single precision cannot settle.

Where an extremum of the depth comes too close to zero, contours nearly coincide or a waist is
narrow, or the highest modes are large, gaps between samples are halved in double precision until
the cubic through their ends decides how often it crosses zero.
"""

import math
from typing import Any

from numba import njit

from cellquant.sim.records import HEAD

FLAGS = {"contract", "nsz", "arcp"}
HULL_MARGIN = 1e-4  # of the cubic through two samples, relative to A0
MOST_LOOKS = 400  # closer looks at one pair; only nearly coincident contours need more
LEAST_STEP = 1e-13  # of an angle


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def gap(
    record: Any, i: int, j: int, dx: float, dy: float, cosine: float, sine: float, modes: Any
) -> tuple[float, float, float, float, float, float, float]:
    """Depth g of the contour point of i at direction (cosine, sine) inside j, and dg/dphi.

    Also rho of i, the distance to the centre of j, the direction from it, and the squared length of
    the tangent of i.
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
    return depth, change, rho, distance, ux, uy, tx * tx + ty * ty


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


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def settle(
    record: Any, i: int, j: int, dx: float, dy: float, cosine: float, sine: float,
    low: float, high: float, angle: float, sign: float, modes: Any, roots: Any, row: int,
) -> None:  # fmt: skip
    """Crossing between two angles from a direction, by safeguarded Newton steps.

    `sign` is that of the depth at the lower end. Stores a row of `roots` (see `lenses`).
    """
    if not low < angle < high:
        angle = 0.5 * (low + high)
    for _ in range(80):
        c, s = turn(cosine, sine, angle)
        g, rate, _, _, _, _, _ = gap(record, i, j, dx, dy, c, s, modes)
        if (g > 0.0) == (sign > 0.0):
            low = angle
        else:
            high = angle
        moved = angle - g / rate if rate != 0.0 else low - 1.0
        if not low < moved < high:
            moved = 0.5 * (low + high)
        step = abs(moved - angle)
        angle = moved
        if step < LEAST_STEP or high - low < 1e-15:
            break
    c, s = turn(cosine, sine, angle)
    _, _, rho, distance, ux, uy, _ = gap(record, i, j, dx, dy, c, s, modes)
    roots[row, 0] = c
    roots[row, 1] = s
    roots[row, 2] = sign
    roots[row, 3] = rho
    roots[row, 4] = ux
    roots[row, 5] = uy
    roots[row, 6] = -sign
    roots[row, 7] = distance


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


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def fourth_derivative(record: Any, i: int, modes: Any) -> float:
    """Bound sum (n + 1)^4 |C_n| of the fourth derivative of a contour by the direction."""
    total = 0.0
    for m in range(len(modes)):
        n = m + 3.0
        size = math.sqrt(record[i, HEAD + m] ** 2 + record[i, HEAD + len(modes) + m] ** 2)
        total += n * n * n * n * size
    return total


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def margin_of(
    bend_i: float, bend_j: float, spacing: float, v0: float, v1: float, r0: float, r1: float,
    mean_j: float,
) -> float:  # fmt: skip
    """What the depth may differ by from the cubic through both ends of a gap.

    spacing^4 / 384 times a bound of its fourth derivative: that of i's contour and that of j's, as
    fast as i passes it. At both ends v is the squared tangent, r the distance to the centre of j.
    """
    turning = max(v0, v1) / max(min(r0, r1), 1e-9) ** 2
    bound = spacing**4 / 384.0 * (bend_i + bend_j * turning * turning)
    return max(bound, HULL_MARGIN * mean_j)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def halve_gap(
    record: Any, i: int, j: int, dx: float, dy: float, cosine: float, sine: float,
    spacing: float, margin: float, g0: float, g1: float, d0: float, d1: float, modes: Any,
    stack: Any, found: Any, n_found: int, looks: int,
) -> tuple[int, int]:  # fmt: skip
    """Bracket the crossings in a gap, from row n_found on.

    g and d are the depth and its slope at both ends; `looks` are still allowed. Returns the number
    found in all, and the looks left.
    """
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
        if kind == 2 and width > 1e-9 and looks > 0:
            looks -= 1
            width *= 0.5
            ca, sa = turn(cosine, sine, left + width)
            gm, dm, _, _, _, _, _ = gap(record, i, j, dx, dy, ca, sa, modes)
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
            found[n_found, 1] = left
            found[n_found, 2] = left + width
            found[n_found, 3] = 1.0 if a > 0.0 else -1.0
            found[n_found, 4] = left + width * (a / (a - b))
            n_found += 1
    return n_found, looks


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def search_gap(
    record: Any, i: int, j: int, dx: float, dy: float, compass: Any, s: int, begin: float,
    end: float, modes: Any, stack: Any, found: Any, n_found: int,
) -> int:  # fmt: skip
    """Bracket the crossings between one sample and the next as `search_closely` does.

    Returns the number found in all, or -1 where the depth at one end has another sign than
    `begin` or `end`, its values in single precision, by which the gaps beside are judged.
    """
    size = compass.shape[1]
    spacing = 2.0 * math.pi / size
    t = (s + 1) % size
    g0, d0, _, r0, _, _, v0 = gap(record, i, j, dx, dy, compass[0, s], compass[1, s], modes)
    g1, d1, _, r1, _, _, v1 = gap(record, i, j, dx, dy, compass[0, t], compass[1, t], modes)
    if (g0 > 0.0) != (begin > 0.0) or (g1 > 0.0) != (end > 0.0):
        return -1
    bend_i = fourth_derivative(record, i, modes)
    bend_j = fourth_derivative(record, j, modes)
    margin = margin_of(bend_i, bend_j, spacing, v0, v1, r0, r1, record[j, 2])
    first = n_found
    n_found, _ = halve_gap(
        record, i, j, dx, dy, compass[0, s], compass[1, s], spacing, margin, g0, g1, d0, d1, modes,
        stack, found, n_found, MOST_LOOKS,
    )  # fmt: skip
    for row in range(first, n_found):
        found[row, 0] = s
    return n_found


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def search_closely(
    record: Any, i: int, j: int, dx: float, dy: float, compass: Any, start: int, count: int,
    modes: Any, stack: Any, found: Any,
) -> int:  # fmt: skip
    """Bracket the crossings of one pair by halving, in double precision.

    Rows of `found`: number of the sample, bracket as angles from it, the sign of the depth at its
    start, and a guess of the crossing; without crossings the first row holds the sign everywhere.
    Returns their number, or -1 where the contours are the same.
    """
    size = compass.shape[1]
    spacing = 2.0 * math.pi / size
    whole = count > size
    mean_j = record[j, 2]
    bend_i = fourth_derivative(record, i, modes)
    bend_j = fourth_derivative(record, j, modes)
    n_found = 0
    looks = MOST_LOOKS + 8 * count
    largest = 0.0
    g1, d1, _, r1, _, _, v1 = gap(record, i, j, dx, dy, compass[0, start], compass[1, start], modes)
    g_first = g1
    d_first = d1
    r_first = r1
    v_first = v1
    for index in range(count - 1):
        s = (start + index) % size
        g0 = g1
        d0 = d1
        r0 = r1
        v0 = v1
        t = (s + 1) % size
        if whole and index == count - 2:
            g1 = g_first
            d1 = d_first
            r1 = r_first
            v1 = v_first
        else:
            g1, d1, _, r1, _, _, v1 = gap(record, i, j, dx, dy, compass[0, t], compass[1, t], modes)
        margin = margin_of(bend_i, bend_j, spacing, v0, v1, r0, r1, mean_j)
        largest = max(largest, abs(g1))
        before = n_found
        n_found, looks = halve_gap(
            record, i, j, dx, dy, compass[0, s], compass[1, s], spacing, margin, g0, g1, d0, d1,
            modes, stack, found, n_found, looks,
        )  # fmt: skip
        for row in range(before, n_found):
            found[row, 0] = s
    if whole and largest < 1e-12 * mean_j:
        return -1
    if n_found == 0:
        found[0, 3] = 1.0 if g_first > 0.0 else -1.0
    return n_found
