"""Crossings from the gaps between samples: how many there are, where, and at last to round-off.

In a gap the depth is interpolated in single precision. One evaluation of both contours in double
precision, with two derivatives, and a step of order three then settle nearly every crossing.
"""

from typing import Any

from numba import njit

from cellquant.sim.gathers import gather_pair, scatter_rows
from cellquant.sim.grazes import FLAGS, HULL_MARGIN
from cellquant.sim.lanes import (
    LANES,
    absolute,
    both,
    choose,
    differ,
    doubles_pair,
    either,
    greatest,
    least,
    load_pair,
    pick,
    root,
    singles_pair,
    store,
    widen_pair,
)
from cellquant.sim.records import HEAD
from cellquant.sim.sampling import (
    ANGLE,
    HIGH,
    INNER,
    KIND,
    LISTED,
    LOW,
    MEAN,
    OTHER,
    OWNER,
    PAIR,
    PLACE,
    SAMPLE,
    SIGN,
    TARGET,
)

END_MARGIN = 2e-6  # of a sample in single precision, relative to A0
FINE_MARGIN = 1e-5  # of the interpolation through four samples, single precision included
BENT = 1e-3  # of A0: of what degree 7 bends the cubic by, it leaves a share of this over it squared
MISSED = 3.0  # times that may be left where it bends by more
ROUGH = 1e-2  # of A0: where a gap bends by more, others are not even listed
STEPS = 3  # of Newton in a gap
TWO, UNSURE, HIDDEN = 2, 3, 4  # crossings in a gap; the last: search the whole pair
SLACK = 0.05  # of a gap: an extremum just beyond its end counts as within
BEYOND = 1e-3  # of a gap: how far from it a crossing may be found
TINY = 1e-30


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def nonzero(x: Any) -> Any:
    """What a division survives."""
    return choose(absolute(x) > TINY, x, TINY)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def full_step(piece: Any, room: int, g: int) -> Any:
    """One Newton step on the polynomial of degree 7, from within the piece."""
    g0 = load_pair(piece, g)
    e0 = load_pair(piece, room + g)
    c2 = load_pair(piece, 2 * room + g)
    c3 = load_pair(piece, 3 * room + g)
    q0 = load_pair(piece, 4 * room + g)
    q1 = load_pair(piece, 5 * room + g)
    q2 = load_pair(piece, 6 * room + g)
    q3 = load_pair(piece, 7 * room + g)
    t = load_pair(piece, 12 * room + g)
    t = greatest(least(t, load_pair(piece, 11 * room + g)), load_pair(piece, 10 * room + g))
    u = t + 1.0
    w = t * (t - 1.0)
    q = q0 + u * (q1 + u * (q2 + u * q3))
    value = g0 + t * (e0 + t * (c2 + t * c3)) + w * w * q
    rate = e0 + t * (2.0 * c2 + 3.0 * t * c3)
    rate += w * ((4.0 * t - 2.0) * q + w * (q1 + u * (2.0 * q2 + 3.0 * u * q3)))
    return t - value / nonzero(rate)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", forceinline=True)
def height(piece: Any, room: int, g: int, t: Any) -> Any:
    """The polynomial of degree 7 at t."""
    u = t + 1.0
    w = t * (t - 1.0)
    q = load_pair(piece, 6 * room + g) + u * load_pair(piece, 7 * room + g)
    q = load_pair(piece, 4 * room + g) + u * (load_pair(piece, 5 * room + g) + u * q)
    p = load_pair(piece, 2 * room + g) + t * load_pair(piece, 3 * room + g)
    return load_pair(piece, g) + t * (load_pair(piece, room + g) + t * p) + w * w * q


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def judge_gaps(
    depth: Any, change: Any, rows: Any, begin: int, end: int, second: bool, spacing: float,
    piece: Any,
) -> None:  # fmt: skip
    """How often the depth crosses zero in every gap, and where (ANGLE to SIGN of `piece`).

    With the samples beyond both ends the interpolation is of degree 7: the cubic p(t) through the
    ends plus t^2 (t - 1)^2 q(t), q cubic. The crossing is the first one in the gap, or the second
    one where that is asked for.

    Rows of `piece` hold p, q at u = t + 1, the depth and its slope at the end, the part of the gap
    that is searched, and t. Each pass is short, so that operations seldom wait for each other.
    """
    room = LISTED
    for g in range(begin, end, 2 * LANES):
        before, g0, g1, after = gather_pair(depth, rows, PLACE + g, -1)
        e_before, e0, e1, e_after = gather_pair(change, rows, PLACE + g, -1)
        share = choose(load_pair(piece, INNER + g) > 0.0, singles_pair(0.25), singles_pair(0.0))
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
        last = share * (tilt_2 - 3.0 * miss_2)
        store(piece, 8 * room + g, g1)
        store(piece, 9 * room + g, e1)
        store(piece, g, g0)
        store(piece, room + g, e0)
        store(piece, 2 * room + g, c2)
        store(piece, 3 * room + g, c3)
        store(piece, 4 * room + g, q0)
        store(piece, 5 * room + g, q1)
        store(piece, 6 * room + g, (3.0 * rise - 2.0 * q1 - last) * (1.0 / 3.0))
        store(piece, 7 * room + g, (q1 + last - 2.0 * rise) * (1.0 / 9.0))
    for g in range(begin, end, 2 * LANES):
        g0 = load_pair(piece, g)
        e0 = load_pair(piece, room + g)
        c2 = load_pair(piece, 2 * room + g)
        c3 = load_pair(piece, 3 * room + g)
        a0 = load_pair(piece, MEAN + g)
        g1 = load_pair(piece, 8 * room + g)
        flat = HULL_MARGIN * a0
        inner = load_pair(piece, INNER + g)
        # What degree 7 changes, at both ends and in the middle, tells what it leaves.
        q0 = load_pair(piece, 4 * room + g)
        q1 = load_pair(piece, 5 * room + g)
        q2 = load_pair(piece, 6 * room + g)
        q3 = load_pair(piece, 7 * room + g)
        bent = absolute(q0 + (q1 + (q2 + q3)))
        bent = greatest(bent, absolute(q0 + 1.5 * (q1 + 1.5 * (q2 + 1.5 * q3))))
        bent = greatest(bent, absolute(q0 + 2.0 * (q1 + 2.0 * (q2 + 2.0 * q3))))
        bent = bent * (1.0 / 16.0)
        share = least(bent / (BENT * a0), 1.0)
        left = FINE_MARGIN * a0 + MISSED * bent * (share * share)
        margin = choose(inner > 0.0, left, flat)
        # Extrema of the cubic, put on the ends where they lie outside. Conditions are signs.
        square = c2 * c2 - 3.0 * c3 * e0
        spread = root(greatest(square, 0.0))
        total = -(c2 + pick(c2, -spread, spread))
        ta = choose(square > 0.0, total / nonzero(3.0 * c3), singles_pair(-1.0))
        tb = choose(square > 0.0, e0 / nonzero(total), singles_pair(-1.0))
        t1 = least(ta, tb)
        t2 = greatest(ta, tb)
        near_1 = absolute(t1 - 0.5) - (0.5 + SLACK)
        near_2 = absolute(t2 - 0.5) - (0.5 + SLACK)
        t1 = least(greatest(t1, 0.0), 1.0)
        t2 = least(greatest(t2, 0.0), 1.0)
        p1 = choose(t1 > 0.0, choose(t1 < 1.0, height(piece, room, g, t1), g1), g0)
        p2 = choose(t2 > 0.0, choose(t2 < 1.0, height(piece, room, g, t2), g1), g0)
        change_1 = differ(g0, p1)
        change_2 = differ(p1, p2)
        change_3 = differ(p2, g1)
        b1 = absolute(g0 + e0 * (1.0 / 3.0))
        b2 = absolute(g1 - load_pair(piece, 9 * room + g) * (1.0 / 3.0))
        close = either(both(near_1, absolute(p1) - margin), both(near_2, absolute(p2) - margin))
        thrice = both(both(change_1, change_2), change_3)
        unsure = either(either(close, greatest(b1, b2) - flat), thrice)
        # At a sample the interpolation is no worse than the sample.
        ends = least(absolute(g0), absolute(g1)) - choose(inner > 0.0, END_MARGIN * a0, flat)
        unsure = either(unsure, ends)
        one, none = singles_pair(1.0), singles_pair(0.0)
        number = pick(change_1, one, none) + pick(change_2, one, none) + pick(change_3, one, none)
        if second:
            low = pick(change_3, t2, pick(change_2, t1, none))
            high = pick(change_3, one, pick(change_2, t2, t1))
            begin_of_it = pick(change_1, t1, t2)
            end_of_it = singles_pair(1.0 + BEYOND)
            store(piece, SIGN + g, pick(g0, one, -one))
        else:
            # The first piece between extrema that crosses zero, or else the last one.
            hidden = pick(ROUGH * a0 - bent, singles_pair(HIDDEN), singles_pair(UNSURE))
            store(piece, KIND + g, pick(either(unsure, ROUGH * a0 - bent), hidden, number))
            low = pick(change_1, none, pick(change_2, t1, t2))
            high = pick(change_1, t1, pick(change_2, t2, one))
            begin_of_it = singles_pair(-BEYOND)
            store(piece, SIGN + g, pick(g0, -one, one))
            end_of_it = choose(number == TWO, pick(change_1, t1, t2), 1.0 + BEYOND)
        store(piece, LOW + g, begin_of_it * spacing)
        store(piece, HIGH + g, end_of_it * spacing)
        # From an extremum, of height p2 at t2 and else p1, the parabola through it leads close.
        turning = choose(low > 0.0, low, high)
        value = choose(turning == t2, p2, p1)
        away = root(greatest(-value / nonzero(c2 + 3.0 * c3 * turning), 0.0))
        chord = g0 / nonzero(g0 - g1)
        t = choose(low > 0.0, turning + away, choose(high < 1.0, turning - away, chord))
        t = greatest(least(t, high), low)
        value = g0 + t * (e0 + t * (c2 + t * c3))
        t -= value / nonzero(e0 + t * (2.0 * c2 + 3.0 * t * c3))
        store(piece, 10 * room + g, low)
        store(piece, 11 * room + g, high)
        store(piece, 12 * room + g, t)
    for _ in range(STEPS):
        for g in range(begin, end, 2 * LANES):
            store(piece, 12 * room + g, full_step(piece, room, g))
    for g in range(begin, end, 2 * LANES):
        t = load_pair(piece, 12 * room + g)
        t = greatest(least(t, load_pair(piece, 11 * room + g)), load_pair(piece, 10 * room + g))
        store(piece, ANGLE + g, t * spacing)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def radii(
    record: Any, rows: Any, row: int, count: int, modes: Any, scratch: Any, lines: Any, column: int,
) -> None:  # fmt: skip
    """Radius of a contour and two derivatives for every listed direction, to round-off.

    Rows `column` and `column` + 1 of `lines` hold the directions, the next three take the answers.
    """
    n_modes = len(modes)
    top = n_modes - 1
    room = LISTED
    imaginary = n_modes * LANES
    for r in range(0, count, LANES):
        c = load_pair(lines, column * room + r)
        s = load_pair(lines, (column + 1) * room + r)
        for m in range(0, 2 * n_modes + 1, 4):
            c0, c1, c2, c3 = gather_pair(record, rows, row + r, HEAD + m)
            store(scratch, m * LANES, c0)
            store(scratch, m * LANES + LANES, c1)
            store(scratch, m * LANES + 2 * LANES, c2)
            store(scratch, m * LANES + 3 * LANES, c3)
        pr = load_pair(scratch, top * LANES)
        pi = load_pair(scratch, imaginary + top * LANES)
        qr = doubles_pair(0.0)
        qi = doubles_pair(0.0)
        hr = doubles_pair(0.0)
        hi = doubles_pair(0.0)
        for k in range(1, n_modes):
            cr = load_pair(scratch, (top - k) * LANES)
            ci = load_pair(scratch, imaginary + (top - k) * LANES)
            hr, hi = hr * c + (qr - hi * s), hr * s + (qi + hi * c)
            qr, qi = qr * c + (pr - qi * s), qr * s + (pi + qi * c)
            pr, pi = pr * c + (cr - pi * s), pr * s + (ci + pi * c)
        # With p(z) = sum C_n z^(n - 2), q = dp/dz and 2 h = dq/dz the slope is
        # Re i (2 z^2 p + z^3 q) and its derivative -Re (4 z^2 p + 5 z^3 q + 2 z^4 h).
        hr, hi = 5.0 * qr + 2.0 * (hr * c - hi * s), 5.0 * qi + 2.0 * (hr * s + hi * c)
        hr, hi = hr * c + (4.0 * pr - hi * s), hr * s + (4.0 * pi + hi * c)
        qr, qi = qr * c + (2.0 * pr - qi * s), qr * s + (2.0 * pi + qi * c)
        zr = c * c - s * s
        zi = 2.0 * c * s
        mean = load_pair(scratch, 2 * imaginary)
        store(lines, (column + 2) * room + r, pr * zr + (mean - pi * zi))
        store(lines, (column + 3) * room + r, -(qr * zi + qi * zr))
        store(lines, (column + 4) * room + r, hi * zi - hr * zr)


@njit(cache=True, fastmath=FLAGS, error_model="numpy", inline="always")
def polish(
    circle: Any, apart: Any, record: Any, rows: Any, piece: Any, count: int, modes: Any,
    scratch: Any, lines: Any, roots: Any,
) -> None:  # fmt: skip
    """Step of order three on the crossing in every listed gap, then its data.

    See `sampling` for `rows` and `piece`. Row 0 of `lines` takes the error of every crossing, row 1
    the angle. Each pass is short, so that operations seldom wait for each other.
    """
    room = LISTED
    jerk = 1.0 * (len(modes) + 1) ** 2  # a sixth of the third derivative of rho over A0, and more
    for r in range(0, count, LANES):
        c, s, _, _ = gather_pair(circle, rows, SAMPLE + r, 0)
        angle = widen_pair(piece, ANGLE + r)
        q = angle * angle
        # Angles are below 0.14: what the series lack is below 1e-17.
        sine = 1 / 120 + q * (-1 / 5040 + q * (1 / 362880))
        sine = angle * (1.0 + q * (-1 / 6 + q * sine))
        cosine = 1 / 24 + q * (-1 / 720 + q * (1 / 40320 + q * (-1 / 3628800)))
        cosine = 1.0 + q * (-0.5 + q * cosine)
        store(lines, r, c * cosine - s * sine)
        store(lines, room + r, s * cosine + c * sine)
    for side in range(2):
        if side == 1:
            for r in range(0, count, LANES):
                c = load_pair(lines, r)
                s = load_pair(lines, room + r)
                rho = load_pair(lines, 2 * room + r)
                slope = load_pair(lines, 3 * room + r)
                curve = load_pair(lines, 4 * room + r)
                dx, dy, _, _ = gather_pair(apart, rows, PAIR + r, 0)
                x = rho * c - dx
                y = rho * s - dy
                tx = slope * c - rho * s
                ty = slope * s + rho * c
                nx = curve * c - slope * s - ty
                ny = curve * s + slope * c + tx
                square = x * x + y * y
                inverse = 1.0 / root(square)
                ux = x * inverse
                uy = y * inverse
                # Derivatives of the distance to j, and of the direction as seen from j.
                away = ux * tx + uy * ty
                turn = (ux * ty - uy * tx) * inverse
                distance = square * inverse
                store(lines, 5 * room + r, ux)
                store(lines, 6 * room + r, uy)
                store(lines, 10 * room + r, distance)
                store(lines, 11 * room + r, away)
                store(lines, 12 * room + r, turn)
                store(lines, 13 * room + r, (ux * nx + uy * ny) + distance * (turn * turn))
                store(lines, 14 * room + r, ((ux * ny - uy * nx) - 2.0 * away * turn) * inverse)
                store(lines, 15 * room + r, dx)
                store(lines, 16 * room + r, dy)
        radii(record, rows, OTHER if side else OWNER, count, modes, scratch, lines, 5 * side)
    for r in range(0, count, LANES):
        depth = load_pair(lines, 7 * room + r) - load_pair(lines, 10 * room + r)
        turn = load_pair(lines, 12 * room + r)
        slope_j = load_pair(lines, 8 * room + r)
        rate = 1.0 / (slope_j * turn - load_pair(lines, 11 * room + r))
        newton = -depth * rate
        curve = load_pair(lines, 9 * room + r) * (turn * turn) - load_pair(lines, 13 * room + r)
        curve += slope_j * load_pair(lines, 14 * room + r)
        # Half the second derivative over the first bends the step.
        second = -0.5 * curve * rate * newton
        step = newton * (1.0 + second)
        q = step * step
        sine = step * (1.0 - q * (1 / 6))
        cosine = 1.0 - 0.5 * q
        c = load_pair(lines, r)
        s = load_pair(lines, room + r)
        rho = load_pair(lines, 3 * room + r) + 0.5 * step * load_pair(lines, 4 * room + r)
        rho = load_pair(lines, 2 * room + r) + step * rho
        c, s = c * cosine - s * sine, s * cosine + c * sine
        x = rho * c - load_pair(lines, 15 * room + r)
        y = rho * s - load_pair(lines, 16 * room + r)
        square = x * x + y * y
        inverse = 1.0 / root(square)
        moved = widen_pair(piece, ANGLE + r) + step
        inside = (moved > widen_pair(piece, LOW + r)) & (moved < widen_pair(piece, HIGH + r))
        # What is left out is of order three: of the step, and of the radius there.
        error = absolute(newton) * (jerk * newton * newton + 2.0 * second * second)
        error = choose(inside, error, 1.0)
        store(lines, r, error)
        store(lines, room + r, moved)
        sign = widen_pair(piece, SIGN + r)
        scatter_rows(roots, rows, TARGET + r, 0, c, s, sign, rho)
        scatter_rows(roots, rows, TARGET + r, 4, x * inverse, y * inverse, -sign, square * inverse)
